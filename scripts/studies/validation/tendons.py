"""Tendons: 19 runs of a public C++ Rucker-Webster model, two segments, six tendons, with forces at the tip."""

import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrod import PointWrenches, Robot, Rod, Shape, Tendon, Tendons, shape_from_base, solve_shape

from .common import FINE, GREY, NAVY, RED, TEAL, Row, all_solved, as_data, distance, own_reference, tensor

TITLE = "Tendon robot: a C++ Rucker-Webster model"
LAST_DIGIT = 1e-9  # m, of their positions


def robot_of(r: dict[str, Any]) -> Robot:
    """Their robot: three tendons end at the first segment's end, three at the tip."""
    E, offset = r["youngs_modulus_Pa"], r["tendon_offset_m"]
    angles = [math.radians(a) for a in r["tendon_angles_deg"]]
    ends = (r["tendons_1_to_3_end_at_m"], r["tendons_4_to_6_end_at_m"])
    tendons = tuple(Tendon.straight(offset * math.cos(a), offset * math.sin(a), end) for end in ends for a in angles)
    rod = Rod.circular(sum(r["segments_m"]), 2 * r["backbone_radius_m"], E, E / (2 * (1 + r["poisson_ratio"])))
    return Robot(rod, Tendons(tendons))


def through_their_discs(robot: Robot, tip: PointWrenches, alpha: Tensor, tension: Tensor, s: Tensor, theirs: Tensor) -> Shape:
    """Our rod under the base wrench that brings it closest to their discs (B, P, 3), m; alpha (B, 6) N, N m is the start.

    If it meets them, their rod obeys our equations, and its tip residual is what their shooting left.
    """

    def shape(alpha: Tensor) -> Shape:
        return shape_from_base(robot, (tip,), alpha, tension, s, 40, differentiable=False)

    units = tensor([1e-5] * 3 + [1e-6] * 3)
    J = torch.stack([(shape(alpha + d).p - shape(alpha - d).p).flatten(1) / 2 for d in torch.diag(units)], -1)
    fit = shape(alpha)
    for _ in range(3):  # Gauss-Newton with the first Jacobian: the start is within 1e-3
        off = (theirs - fit.p).flatten(1).unsqueeze(-1)
        alpha = alpha + units * torch.linalg.lstsq(J, off).solution.squeeze(-1)
        fit = shape(alpha)
    return fit


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Position errors of the 21 discs of every run. There is nothing to leave out: quick is the same."""
    data = own_reference("tendon")
    robot, cases = robot_of(data["robot"]), data["cases"]
    force, tension = tensor([[c["tip_force_world_N"]] for c in cases]), tensor([c["tensions_N"] for c in cases])
    s, theirs = tensor(data["robot"]["disk_arc_lengths_m"]), tensor([c["disk_positions_m"] for c in cases])
    tip = PointWrenches(force, 0 * force, tensor([robot.rod.length]))
    shapes = [solve_shape(robot, (tip,), tension, s, len(cases), steps) for steps in (40, FINE)]
    all_solved(*(shape.status for shape in shapes))
    errors, step = distance(shapes[0].p, theirs), float(distance(shapes[0].p, shapes[1].p).max())
    deflection = distance(theirs[:, -1], tensor([0.0, 0.0, robot.rod.length]))
    fitted = through_their_discs(robot, tip, shapes[0].base_wrench, tension, s, theirs)
    left, missed = distance(fitted.p, theirs).amax(1), fitted.tip_residual.unflatten(-1, (2, 3)).norm(dim=-1).amax(0)
    rows = [Row.of("C++ Rucker-Webster", "largest disc position error of a run", "m", errors.amax(1))]
    lines = [
        f"{len(cases)} runs, {len(s)} discs each, tip deflections {1e3 * deflection.min():.0f} to {1e3 * deflection.max():.0f}",
        f"mm on a rod of {1e3 * robot.rod.length:.0f} mm; {int((errors.amax(1) < 1e-5).sum())} runs agree within 0.01 mm at",
        "every disc.",
        "",
        f"What limits it: the tolerance of that solver's shooting. With {FINE} steps instead of 40 none of our discs moves by",
        f"more than {1e3 * step:.1g} mm. And our rod, given the base wrench that suits their discs best instead of equilibrium",
        f"at the tip, meets all of their discs within {1e3 * float(left.max()):.1g} mm; its tip is then out of balance by up to",
        f"{float(missed[0]):.1g} N and {float(missed[1]):.1g} N m. That is what the same equations give when their",
        "iteration stops early.",
        "",
        "![Errors of the discs against tip deflection and along the rod](validation_tendons.png)",
    ]
    _figure(s, errors, left, deflection, folder / "validation_tendons.png")
    return as_data(
        rows,
        step_m=step,
        fitted_m=float(left.max()),
        tip_residual=missed.tolist(),
        deflection_m=[float(deflection.min()), float(deflection.max())],
    ), lines


def _figure(s: Tensor, errors: Tensor, fitted: Tensor, deflection: Tensor, path: Path) -> None:
    figure = Figure(figsize=(9.5, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    seen = 1e3 * errors[:, 1:]  # the first disc is the base itself
    x = (1e3 * deflection).unsqueeze(1).expand_as(seen)
    left.semilogy(x.flatten(), seen.flatten(), ".", ms=4, color=GREY, label="each disc")
    left.semilogy(1e3 * deflection, seen.amax(1), "o", color=RED, label="largest of a run")
    left.semilogy(1e3 * deflection, 1e3 * fitted, "o", mfc="none", color=TEAL, label="largest, base wrench fitted to their discs")
    left.set_xlabel("tip deflection (mm)")
    left.set_ylim(bottom=2e-9)  # room for the legends
    left.set_ylabel("position error of a disc (mm)")
    left.legend(fontsize=8, loc="lower right")
    for k, row in enumerate(seen):
        right.semilogy(1e3 * s[1:], row, "-", lw=1, color=NAVY, alpha=0.6, label="one run" if k == 0 else None)
    right.set_xlabel("arc length (mm)")
    right.axhline(1e3 * LAST_DIGIT, color=GREY, ls=":", label="last digit of their positions")
    right.legend(fontsize=8, loc="lower right")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
