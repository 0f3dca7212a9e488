"""Shapes: 19 shapes by an independent solver of the same equations, 8th-order adaptive integration and shooting."""

from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from torchrod import Equilibrium, GaussianLoads, PointForces, Robot, Rod, Tendon, Tendons, solve_shape

from .common import FINE, GREY, NAVY, RED, TEAL, Row, all_solved, as_data, distance, own_reference, tensor

TITLE = "Shapes: an independent 8th-order solver"


def robot_of(case: dict[str, Any]) -> Robot:
    """Its robot; the weight per length (N/m) becomes a mass of 1 kg/m under that gravity."""
    r = case["robot"]
    rod = Rod.circular(r["length"], r["diameter"], r["youngs_modulus"], r["shear_modulus"], 1.0 if r["weight"] else 0.0)
    tendons = Tendons(tuple(Tendon.straight(x, y, end) for x, y, end in r["tendons"]))
    return Robot(rod, tendons, tensor(r["weight"] or [0.0, 0.0, 0.0]))


def loads_of(case: dict[str, Any]) -> tuple[PointForces | GaussianLoads, ...]:
    """Its point loads and its Gaussian, in the section frame (N, N/m)."""
    loads: list[PointForces | GaussianLoads] = []
    if case["points"]:
        force = tensor([[[p["fx"], p["fy"], 0.0] for p in case["points"]]])
        loads.append(PointForces(force, tensor([[p["s"] for p in case["points"]]])))
    if case["desc"]:
        d = case["desc"]
        loads.append(GaussianLoads(tensor([[[d["ax"], d["ay"]]]]), tensor([[d["mu"]]]), tensor([[d["c"]]])))
    return tuple(loads)


def solve(case: dict[str, Any], steps: int) -> Equilibrium:
    """Our shape of a case."""
    tension = tensor([case["tensions"]]) if case["tensions"] else None
    shape = solve_shape(robot_of(case), loads_of(case), tension, tensor(case["s"]), 1, steps)
    all_solved(shape.status)
    return shape


def errors_of(cases: list[dict[str, Any]], steps: int) -> Tensor:
    """Largest errors of each case (C, 3): position m, force at the base N, moment at the base N m."""
    rows = []
    for case in tqdm(cases, desc=f"shapes, {steps} steps", delay=1.0, leave=False):
        shape = solve(case, steps)
        off = shape.base_wrench[0] - tensor(case["base_wrench"])
        rows.append(torch.stack([distance(shape.p[0], tensor(case["positions"])).max(), off[:3].norm(), off[3:].norm()]))
    return torch.stack(rows)


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Errors of position and base wrench, with the default steps and with fine ones."""
    cases = own_reference("shape")
    errors, fine = errors_of(cases, 40), errors_of(cases, FINE)
    rows = [
        Row.of("8th-order solver", "largest position error of a shape", "m", errors[:, 0]),
        Row.of("8th-order solver", "error of the force at the base", "N", errors[:, 1]),
        Row.of("8th-order solver", "error of the moment at the base", "N m", errors[:, 2]),
    ]
    worst = cases[int(errors[:, 0].argmax())]["name"]
    lines = [
        f"{len(cases)} shapes: passive rods, tendon robots with gravity, point loads and Gaussians, made with the project's",
        "equations by other code (8th-order adaptive integration, shooting to a residual of",
        f"{max(c['residual'] for c in cases):.0e}): this checks the numerics, not the assumptions of rod theory.",
        "",
        f"What limits it: our 40 steps, worst for `{worst}`. With {FINE} steps the largest position error falls from",
        f"{1e3 * errors[:, 0].max():.1g} mm to {1e3 * fine[:, 0].max():.1g} mm.",
        "",
        "| shape | position, 40 steps (mm) | position, " + f"{FINE} steps (mm) | base force (N) | base moment (N m) |",
        "|---|---|---|---|---|",
    ]
    for case, e, f in zip(cases, errors, fine, strict=True):
        lines.append(f"| {case['name']} | {1e3 * e[0]:.1e} | {1e3 * f[0]:.1e} | {e[1]:.1e} | {e[2]:.1e} |")
    lines += ["", "![Errors of every shape](validation_shapes.png)"]
    _figure([c["name"] for c in cases], errors, fine, folder / "validation_shapes.png")
    return as_data(
        rows, shapes={c["name"]: e.tolist() for c, e in zip(cases, errors, strict=True)}, fine_m=fine[:, 0].tolist()
    ), lines


def _figure(names: list[str], errors: Tensor, fine: Tensor, path: Path) -> None:
    figure = Figure(figsize=(10, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    y = list(range(len(names)))
    floor = 1e-16  # a zero has no place on a logarithmic axis
    left.semilogx(1e3 * errors[:, 0].clamp(min=floor), y, "o", color=RED, label="40 steps (default)")
    left.semilogx(1e3 * fine[:, 0].clamp(min=floor), y, "o", mfc="none", color=GREY, label=f"{FINE} steps")
    left.set_xlabel("largest position error (mm)")
    left.set_yticks(y, names, fontsize=8)
    left.invert_yaxis()
    right.semilogx(errors[:, 1].clamp(min=floor), y, "s", color=NAVY, label="force (N), 40 steps")
    right.semilogx(errors[:, 2].clamp(min=floor), y, "^", color=TEAL, label="moment (N m), 40 steps")
    right.set_xlabel("error of the wrench at the base (N, N m)")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)
