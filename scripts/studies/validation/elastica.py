"""Closed forms: the large-deflection elastica, a circle under a pure moment; and how the error falls with the number of steps."""

import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ellipeinc, ellipkinc
from torch import Tensor
from tqdm import tqdm

from torchrod import PointWrenches, Robot, Rod, Tendon, Tendons, shape_from_base, solve_shape

from .common import GREY, NAVY, RED, TEAL, Row, all_solved, as_data, distance, tensor

TITLE = "Elastica, circle, and order of convergence"
# P L^2 / EI -> deflection w / L, abscissa x / L of an inextensible cantilever under a dead transverse tip load (literature)
TABLE = {
    0.5: (0.16214358, 0.98408104),
    1.0: (0.30172077, 0.94356676),
    2.0: (0.49345748, 0.83935828),
    5.0: (0.71379152, 0.61237164),
    10.0: (0.81060902, 0.44500440),
}
TABLE_DIGIT = 1e-8
FOURTH_ORDER = {"passive": "passive rod", "tendon": "tendon robot, one tendon ends mid-rod", "circle": "circle (exact)"}


def inextensible(length: float, EI: float) -> Robot:
    """A rod too stiff to stretch or shear: L (m), EI (N m^2)."""
    return Robot(Rod.from_stiffness(length, torch.eye(3, dtype=torch.float64) * 1e12, torch.diag(tensor([EI, EI, 0.8 * EI]))))


def elastica(alpha: Tensor, steps: int) -> Tensor:
    """Our (w / L, x / L) under P L^2 / EI = alpha (B,): (B, 2)."""
    force = torch.nn.functional.pad(alpha[:, None, None], (0, 2))
    load = PointWrenches(force, 0 * force, tensor([1.0]))
    shape = solve_shape(inextensible(1.0, 1.0), (load,), None, tensor([1.0]), len(alpha), steps)
    all_solved(shape.status)
    return shape.p[:, 0, [0, 2]]


def elliptic(tip_angle: Tensor) -> tuple[Tensor, Tensor]:
    """P L^2 / EI (B,) that turns the tip by tip_angle (rad), and (w / L, x / L) (B, 2), by SciPy's elliptic integrals."""
    m = (1 + torch.sin(tip_angle)) / 2
    phi = torch.asin(1 / (2 * m).sqrt())
    root = torch.from_numpy(ellipkinc(math.pi / 2, m.numpy()) - ellipkinc(phi.numpy(), m.numpy()))
    second = torch.from_numpy(ellipeinc(math.pi / 2, m.numpy()) - ellipeinc(phi.numpy(), m.numpy()))
    return root**2, torch.stack([1 - 2 * second / root, (2 * torch.sin(tip_angle)).sqrt() / root], -1)


def circle_error(steps: int) -> Tensor:
    """Largest error (m) at a quarter, half and the whole of a circle of 0.7 m bent by the moment 2 pi EI / L."""
    L, EI = 0.7, 0.04
    moment = tensor([[[0.0, 2 * math.pi * EI / L, 0.0]]])
    load = PointWrenches(
        0 * moment, moment, tensor([L]), frame="local"
    )  # turns with the tip, so that it stays on the section's y axis
    r = L / (2 * math.pi)
    exact = tensor([[r, 0.0, r], [2 * r, 0.0, 0.0], [0.0, 0.0, 0.0]])
    shape = solve_shape(inextensible(L, EI), (load,), None, tensor([L / 4, L / 2, L]), 1, steps)
    all_solved(shape.status)
    return distance(shape.p[0], exact).max()


def robots() -> dict[str, tuple[Robot, Tensor | None]]:
    """The paper's steel rod, alone; and with gravity, a helical tendon and a straight one that ends at 0.24 of 0.4 m; tensions (N).

    Step boundaries of 20 n steps fall on the tendon's end and on the knots of the helix, so all steps are alike.
    """
    L = 0.4
    s = torch.linspace(0, L, 21, dtype=torch.float64).tolist()
    helix = Tendon(tuple((x, 0.007 * math.cos(12 * x), 0.007 * math.sin(12 * x)) for x in s), L)
    tendons = Tendons((helix, Tendon.straight(0.0, 0.007, 0.24)))
    heavy = Robot(Rod.circular(L, 0.0014, 207e9, 79e9, 0.1), tendons, tensor([9.81, 0.0, 0.0]))
    return {"passive": (Robot(Rod.circular(L, 0.0014, 207e9, 79e9)), None), "tendon": (heavy, tensor([[3.0, 2.0]]))}


def convergence(quick: bool) -> tuple[list[int], dict[str, Tensor]]:
    """Numbers of steps, and the largest error (m) with each: against a solution four times finer than the finest, or exact."""
    steps = [20 * 2**k for k in range(4 if quick else 5)]
    alpha, s = tensor([[0.6, 0.5, 0.2, 0.1, 0.2, 0.05]]), tensor([0.2, 0.4])
    errors = {}
    for name, (robot, tension) in robots().items():
        counts = tqdm([4 * steps[-1], *steps], desc=f"RK4, {name}", delay=1.0, leave=False)
        fine, *coarse = [shape_from_base(robot, (), alpha, tension, s, n, differentiable=False).p for n in counts]
        errors[name] = torch.stack([distance(p, fine).max() for p in coarse])
    errors["circle"] = torch.stack([circle_error(n) for n in steps])
    return steps, errors


def slope_of(steps: list[int], errors: Tensor) -> float:
    """Order of convergence: minus the slope of log error against log steps, least squares over 40 steps and more."""
    x, y = tensor(steps[1:]).log(), errors[1:].log()
    x = x - x.mean()
    return float(-(x * y).sum() / (x * x).sum())


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """The table, the elliptic integrals, the circle and the orders."""
    loads = tensor(list(TABLE))
    table = (elastica(loads, 40) / tensor(list(TABLE.values())) - 1).abs()
    alpha, exact = elliptic(torch.linspace(0.05, 1.42, 12 if quick else 40, dtype=torch.float64))
    closed = {n: (elastica(alpha, n) / exact - 1).abs() for n in (40, 160)}
    steps, errors = convergence(quick)
    slopes = {name: slope_of(steps, e) for name, e in errors.items()}
    closure = float(circle_error(400))
    rows = [
        Row.of("elastica, table", "tip deflection and abscissa", "relative", table),
        Row.of("elastica, elliptic integrals", "the same", "relative", closed[40]),
        Row.of("circle under a moment", "largest position error, 400 steps", "m", tensor([closure])),
    ]
    lines = [
        f"An inextensible cantilever under a dead transverse tip load: {len(TABLE)} loads of a printed table, and {len(alpha)}",
        f"loads up to P L^2 / EI = {float(alpha.max()):.0f} by SciPy's elliptic integrals. A moment 2 pi EI / L closes a circle.",
        "",
        "| P L^2 / EI | w / L | x / L | error of w | error of x |",
        "|---|---|---|---|---|",
        *(
            f"| {a:g} | {w:.8f} | {x:.8f} | {e[0]:.1e} | {e[1]:.1e} |"
            for (a, (w, x)), e in zip(TABLE.items(), table.tolist(), strict=True)
        ),
        "",
        f"Order of convergence (slope of the error from {steps[1]} to {steps[-1]} steps; the robots under a given base wrench,",
        f"against {4 * steps[-1]} steps):",
        "; ".join(f"{FOURTH_ORDER[name]} {slope:.2f}" for name, slope in slopes.items()) + ".",
        "",
        f"What limits it: the table's last digit is {TABLE_DIGIT:g}; RK4's own error, which 160 steps instead of 40 cut from "
        f"{float(closed[40].max()):.1g} to {float(closed[160].max()):.1g} against the elliptic integrals.",
        "",
        "![Relative error of the elastica, and error against the number of steps](validation_elastica.png)",
    ]
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_elastica(left, loads, table, alpha, exact, closed)
    _draw_convergence(right, steps, errors, slopes)
    figure.savefig(folder / "validation_elastica.png", dpi=150)
    return as_data(rows, slopes=slopes, steps=steps, errors_m={name: e.tolist() for name, e in errors.items()}), lines


def _draw_elastica(axes: Axes, loads: Tensor, table: Tensor, alpha: Tensor, exact: Tensor, closed: dict[int, Tensor]) -> None:
    for (n, error), colour in zip(closed.items(), (RED, NAVY), strict=True):
        axes.loglog(alpha, error.amax(1), ".-", ms=4, lw=1, color=colour, label=f"elliptic integrals, {n} steps")
    axes.loglog(loads, table.amax(1), "o", mfc="none", color=TEAL, label="printed table, 40 steps")
    axes.loglog(alpha, 0.5 * TABLE_DIGIT / exact.amin(1), ":", color=GREY, label="half the table's last digit")
    axes.set_xlabel("load P L² / EI")
    axes.set_ylabel("relative error of tip position (larger of w, x)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_convergence(axes: Axes, steps: list[int], errors: dict[str, Tensor], slopes: dict[str, float]) -> None:
    for (name, e), colour, mark in zip(errors.items(), (NAVY, RED, TEAL), "os^", strict=True):
        axes.loglog(steps, 1e3 * e, f"{mark}-", color=colour, label=f"{FOURTH_ORDER[name]}: slope −{slopes[name]:.2f}")
    start = 3e3 * max(float(e[0]) for e in errors.values())
    axes.loglog(steps, [start * (n / steps[0]) ** -4 for n in steps], "--", color=GREY, label="slope −4")
    axes.set_xticks(steps, [str(n) for n in steps])
    axes.minorticks_off()
    axes.set_xlabel("RK4 steps along the rod")
    axes.set_ylabel("largest position error (mm)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
