"""Figures 3 and 4, (6)-(8): how well a shape pins down one point force, F (N) at s = a, the paper's mu.

The paper's own figures are in tip_sensitivity.py. Here is what we found beyond them, on the rod of the studies, clamped, under a
force F normal to it at a. "A shape error of 1 mm" is an error of the curve p(s) whose root mean square over the rod is 1 mm; |.|
below is that root mean square.

Euler-Bernoulli, as (6) and (7) but over the whole rod:
    (a)  w = F s^2 (3 a - s) / (6 EI) for s <= a,   F a^2 (3 s - a) / (6 EI) beyond
    (b)  dw/dF = w / F;   dw/da = F s^2 / (2 EI) for s <= a,   F a (2 s - a) / (2 EI) beyond
    (c)  |dw/dF|^2 = (1/L) a^4 / (36 EI^2) [33 a^3 / 35 + ((3 L - a)^3 - 8 a^3) / 9]
    (d)  |dw/da|^2 = (1/L) F^2 / (4 EI^2) [a^5 / 5 + a^2 ((2 L - a)^3 - a^3) / 6]
         by int_0^a s^4 (3 a - s)^2 = 33 a^7 / 35, int_a^L (3 s - a)^2 = ((3 L - a)^3 - 8 a^3) / 9 and the like
    (e)  sensitivities: dF = 1 mm / |dw/dF|, free of F;  da = 1 mm / |dw/da|, like 1 / F

Cosserat, as (8). The model gives h = [p, c] as a function of gamma = (F, a) and the base wrench alpha; in equilibrium the tip
residual stays zero, H21 dalpha + H22 dgamma = 0, hence the Jacobian of the forward solve, which (8) inverts,
    (f)  J = H12 - H11 H21^+ H22,   here with rows weighted so that |J x|^2 is the mean over the rod
    (g)  one parameter at a time: 1 mm / (norm of its column), which is (e) where the rod is straight
    (h)  both unknown: J^+ = (J^T J)^-1 J^T, and 1 mm x the norms of its two rows, sqrt(diag (J^T J)^-1). A shape error of 1 mm
         moves a parameter by that much at worst; with independent errors of the points it is their standard deviation, up to one
         factor. With q the angle between the columns it is (g) / sin q, for both parameters alike.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from torchrod import PointForces, PointWrenches, Robot, solve_shape

from .cases import L, steel_rod
from .tip_sensitivity import draw_beam, draw_rod, equilibrium_jacobian, tip_figures, tip_lines

POINTS = 40
S = (torch.arange(POINTS, dtype=torch.float64) + 0.5) * L / POINTS  # midpoint rule: every point stands for the same length
ERROR = 1e-3  # m, root mean square over the rod
PLACES = (0.1, 0.2, 0.3, 0.39)  # m
FORCES = (0.1, 1.0, 5.0, 10.0)  # N
COLOURS = ("#1b2a41", "#0a7f8c", "#e08a1e", "#c8102e")  # of PLACES
FRAMES = {"section": "-", "base frame": ":"}  # line styles


def beam(EI: float, F: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
    """Sensitivities (e): of the magnitude (N) and of the location (m)."""
    to_force = a**2 / (6 * EI) * ((33 * a**3 / 35 + ((3 * L - a) ** 3 - 8 * a**3) / 9) / L).sqrt()
    to_place = F / (2 * EI) * ((a**5 / 5 + a**2 * ((2 * L - a) ** 3 - a**3) / 6) / L).sqrt()
    return ERROR / to_force.expand_as(to_place), ERROR / to_place


def jacobian(robot: Robot, F: Tensor, a: Tensor) -> Tensor:
    """(f) for forces F (B,) along the section's x at a (B,): (B, 3 POINTS, 2) in m/N and m/m, rows weighted."""
    return equilibrium_jacobian(robot, F, a, S) / POINTS**0.5


def dead_jacobian(robot: Robot, F: Tensor) -> Tensor:
    """The same for a force that keeps its direction in the base frame, at PLACES: (P, B, 3 POINTS, 2).

    By central differences of one forward solve of all: each sample has a force at one of the places a - step, a, a + step.
    """
    step, P, B = 1e-4, len(PLACES), len(F)
    at = torch.tensor([a + d for a in PLACES for d in (-step, 0.0, step)], dtype=torch.float64)
    force = F.new_zeros(P, 4, B, 3 * P, 3)
    variants = ((1, F * (1 + step)), (1, F * (1 - step)), (2, F), (0, F))  # which of the three places, which force
    for i in range(P):
        for k, (where, size) in enumerate(variants):
            force[i, k, :, 3 * i + where, 0] = size
    force = force.flatten(0, 2)
    shape = solve_shape(robot, (PointWrenches(force, 0 * force, at),), None, S, len(force), POINTS)
    more, less, beyond, before = shape.p.flatten(1).unflatten(0, (P, 4, B)).unbind(1)
    return torch.stack([(more - less) / (2 * step * F.unsqueeze(-1)), (beyond - before) / (2 * step)], -1) / POINTS**0.5


def tip_turn(robot: Robot, F: Tensor, a: Tensor) -> Tensor:
    """Angle (degrees) by which the tip leaves its first direction under forces F (B,) fixed in the section at a (B,)."""
    load = PointForces(torch.nn.functional.pad(F[:, None, None], (0, 2)), a.unsqueeze(-1))
    d = solve_shape(robot, (load,), None, S, len(F), POINTS).p[:, -2:].diff(dim=1)[:, 0]
    return torch.rad2deg(torch.atan2(d[:, :2].norm(dim=-1), d[:, 2]))


def alone(J: Tensor) -> Tensor:
    """(g): N and m, (B, 2)."""
    return ERROR / J.norm(dim=-2)


def jointly(J: Tensor) -> Tensor:
    """(h): N and m, (B, 2), from columns of unit length so that the inverse is of numbers of one size."""
    size = J.norm(dim=-2)
    unit = J / size.unsqueeze(-2)
    return ERROR * torch.linalg.inv(unit.mT @ unit).diagonal(dim1=-2, dim2=-1).sqrt() / size


def unit_check(J: Tensor) -> dict[str, float]:
    """What of the pseudo-inverse of J (3 POINTS, 2) depends on the units of (F, a), at one load.

    Rows: pinv(J D) is D^-1 pinv(J), so they only scale. Norm of the whole and the minimum-norm answer to one measurement, the
    tip's deflection off by 1 mm: both carried back to N and mm, from the units (N, m) and (N, mm).
    """
    D = torch.diag(torch.tensor([1.0, 1e-3], dtype=torch.float64))  # columns per N and per mm instead of per m
    metre, millimetre = torch.linalg.pinv(J), torch.linalg.pinv(J @ D)
    tip = J[-3:-2] * POINTS**0.5
    few, few_mm = torch.linalg.pinv(tip)[:, 0] * ERROR, D @ torch.linalg.pinv(tip @ D)[:, 0] * ERROR
    return {
        "rows_off": float(((D @ millimetre - metre).norm(dim=-1) / metre.norm(dim=-1)).max()),
        "norm_N_m": ERROR * float(torch.linalg.matrix_norm(metre, 2)),
        "norm_N_mm": ERROR * float(torch.linalg.matrix_norm(millimetre, 2)),
        "minimum_norm_N_m_force_N": float(few[0]),
        "minimum_norm_N_m_location_m": float(few[1]),
        "minimum_norm_N_mm_force_N": float(few_mm[0]),
        "minimum_norm_N_mm_location_m": float(few_mm[1]),
    }


@dataclass(frozen=True)
class Curves:
    """Sensitivities (N and m, (P, B, 2)) over the forces F (B,) at PLACES: beam, and per frame one at a time and jointly."""

    F: Tensor
    beam: Tensor
    alone: dict[str, Tensor]
    jointly: dict[str, Tensor]


def curves(quick: bool) -> Curves:
    """FORCES first, so that tables need no interpolation; then those between, for the figure."""
    robot = steel_rod()
    between = [] if quick else torch.logspace(-1, 1, 33, dtype=torch.float64)[1:-1].tolist()
    F = torch.tensor([*FORCES, *between], dtype=torch.float64)
    J = {
        "section": jacobian(robot, F.repeat(len(PLACES)), F.new_tensor(PLACES).repeat_interleave(len(F))).unflatten(
            0, (-1, len(F))
        ),
        "base frame": dead_jacobian(robot, F),
    }
    straight = torch.stack([torch.stack(beam(robot.rod.bending_stiffness, F, F.new_tensor(a)), -1) for a in PLACES])
    return Curves(F, straight, {k: alone(v) for k, v in J.items()}, {k: jointly(v) for k, v in J.items()})


def small_force_off() -> float:
    """Largest relative difference of (g) from (e) at 1 mN, magnitude and location, at PLACES."""
    robot, a = steel_rod(), torch.tensor(PLACES, dtype=torch.float64)
    F = torch.full_like(a, 1e-3)
    return float((alone(jacobian(robot, F, a)) / torch.stack(beam(robot.rod.bending_stiffness, F, a), -1) - 1).abs().max())


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Tables of the factors by which Cosserat differs from the beam, what units do, and the two figures."""
    c, robot = curves(quick), steel_rod()
    at = torch.tensor([1.0], dtype=torch.float64)
    data: dict[str, Any] = {"small_force_off": small_force_off(), "units": unit_check(jacobian(robot, at, 0.2 * at)[0])}
    for frame in FRAMES:
        short = frame.split()[0]
        for k, name in enumerate(("magnitude", "location")):
            data[f"{name}_factor_{short}"] = _by_place(c.alone[frame][..., k] / c.beam[..., k])
        data[f"joint_factor_{short}"] = _by_place(c.jointly[frame][..., 0] / c.alone[frame][..., 0])
        data[f"joint_location_factor_{short}"] = _by_place(c.jointly[frame][..., 1] / c.alone[frame][..., 1])
    F = torch.tensor(FORCES, dtype=torch.float64)
    data["tip_turn_deg"] = _by_place(torch.stack([tip_turn(robot, F, torch.full_like(F, a)) for a in PLACES]))
    data["tip"] = tip_figures()
    data["beam_magnitude_N"] = {f"{a:g}": float(v) for a, v in zip(PLACES, c.beam[:, 0, 0], strict=True)}
    data["beam_location_m_at_1_N"] = {f"{a:g}": float(v) for a, v in zip(PLACES, c.beam[:, 1, 1], strict=True)}
    _beam_figure(robot, folder / "figure3.png")
    _force_figure(c, folder / "figure4.png", quick)
    return data, _lines(data)


def _by_place(values: Tensor) -> dict[str, dict[str, float]]:
    """{place (m): {force (N): value}} of (P, B)."""
    return {
        f"{a:g}": {f"{F:g}": float(v) for F, v in zip(FORCES, row[: len(FORCES)], strict=True)}
        for a, row in zip(PLACES, values, strict=True)
    }


def _table(*by_place: dict[str, dict[str, float]], form: str = ".3g") -> list[str]:
    """A row for each place, a column for each force; in each cell the values of the given tables."""
    lines = ["| a (mm) | " + " | ".join(f"{F:g} N" for F in FORCES) + " |", "|---|" + "---|" * len(FORCES)]
    for a, row in by_place[0].items():
        cells = [" / ".join(format(table[a][F], form) for table in by_place) for F in row]
        lines.append(f"| {1e3 * float(a):.0f} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _lines(d: dict[str, Any]) -> list[str]:
    straight = "; ".join(
        f"a = {1e3 * float(a):.0f} mm: {1e3 * F:.1f} mN, {1e3 * d['beam_location_m_at_1_N'][a]:.2f} mm"
        for a, F in d["beam_magnitude_N"].items()
    )
    return [
        *tip_lines(d["tip"]),
        "### Beyond the paper: the whole shape, on the rod of the studies",
        "",
        "By how much must F, or a, change to move the cantilever by 1 mm (root mean square over the rod, not at the tip alone)?",
        "Lower halves of figures 3 and 4. Euler-Bernoulli, the magnitude, and the location at 1 N:",
        f"{straight}. The location's falls like 1/F.",
        "",
        f"Cosserat, one parameter at a time: at 1 mN it meets Euler-Bernoulli within {100 * d['small_force_off']:.3f} %. The",
        "factor by which the error of the MAGNITUDE exceeds Euler-Bernoulli's, force fixed in the section / in the base frame:",
        "",
        *_table(d["magnitude_factor_section"], d["magnitude_factor_base"]),
        "It rises with the force: the bent rod is stiffer. With the force fixed in the base frame it rises throughout. A force",
        "fixed in the section, as in (9), turns with the rod: the factor rises until the tip points backwards, and then swings.",
        "The tip's turn in degrees, force fixed in the section:",
        "",
        *_table(d["tip_turn_deg"], form=".0f"),
        "LOCATION: Euler-Bernoulli's error falls like 1/F; that of Cosserat is higher by the factor",
        "",
        *_table(d["location_factor_section"], d["location_factor_base"]),
        "so in millimetres it falls with the force too, until the factor grows faster than F: then it rises again (figure 4).",
        *_joint_lines(d),
    ]


def _joint_lines(d: dict[str, Any]) -> list[str]:
    u = d["units"]
    return [
        "",
        "Both unknown: sqrt of the diagonal of (J^T J)^-1. The error of either grows by 1 / sin of the angle between the columns,",
        "",
        *_table(d["joint_factor_section"], d["joint_factor_base"]),
        "because a push nearer the base looks like a weaker one farther out. (8) and (7) therefore agree one parameter at a",
        "time; with the pseudo-inverse of both columns they differ by this factor even for the smallest force. Bending makes",
        "the columns less alike: with both unknown, the magnitude of a force fixed in the section gets surer before it gets less",
        "sure (figure 4, right); that of a force fixed in the base frame only gets less sure.",
        "",
        "Units, at 1 N and 200 mm. The rows of the pseudo-inverse only scale when m become mm",
        f"(to {u['rows_off']:.0e}); their norms are the answer above. The norm of the whole mixes units: for 1 mm it is",
        f"{u['norm_N_m']:.3f} in (N, m) and {u['norm_N_mm']:.1f} in (N, mm), neither newtons nor millimetres. And with fewer",
        "measurements than parameters the minimum-norm answer itself changes: the tip 1 mm off means",
        f"{1e3 * u['minimum_norm_N_m_force_N']:.2f} mN and",
        f"{1e3 * u['minimum_norm_N_m_location_m']:.2f} mm in (N, m), {1e3 * u['minimum_norm_N_mm_force_N']:.2f} mN and",
        f"{1e3 * u['minimum_norm_N_mm_location_m']:.5f} mm in (N, mm).",
        "",
    ]


def _beam_figure(robot: Robot, path: Path) -> None:
    """Top: the paper's, (7). Bottom: (e) along the rod of the studies."""
    figure = Figure(figsize=(10, 8.4), layout="constrained")
    halves = figure.add_gridspec(2, 1, height_ratios=(1, 1))
    top, bottom = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
    draw_beam(top)
    left, right = bottom.subplots(1, 2)
    a = torch.linspace(0.05, 1, 96, dtype=torch.float64) * L
    for F, colour in zip((0.1, 1.0, 10.0), COLOURS, strict=False):
        _, location = beam(robot.rod.bending_stiffness, a.new_tensor(F), a)
        right.semilogy(1e3 * a, 1e3 * location, color=colour, label=f"F = {F:g} N")
    magnitude, _ = beam(robot.rod.bending_stiffness, a.new_tensor(1.0), a)
    left.semilogy(1e3 * a, magnitude.expand_as(a), color=COLOURS[0], label="any F")
    left.set_ylabel("error of the magnitude (N)")
    right.set_ylabel("error of the location (mm)")
    for axes in (left, right):
        axes.set_xlabel("location a of the force (mm)")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    bottom.suptitle("Beyond the paper: rod of the studies (400 mm), what a shape error of 1 mm RMS over the rod means", fontsize=11)
    figure.savefig(path, dpi=120)


def _force_figure(c: Curves, path: Path, quick: bool) -> None:
    """Top: the paper's, (8). Bottom: the rod of the studies; rows magnitude and location, columns one at a time and jointly."""
    figure = Figure(figsize=(10, 15.5), layout="constrained")
    halves = figure.add_gridspec(2, 1, height_ratios=(1, 1))
    top, bottom = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
    draw_rod(top, quick)
    grid = bottom.subplots(2, 2, sharex=True, sharey="row")
    for k, unit in enumerate(("magnitude (N)", "location (mm)")):
        for column, (values, title) in enumerate(((c.alone, "the other parameter known"), (c.jointly, "both unknown"))):
            _draw(grid[k, column], c, {frame: v[..., k] * (1, 1e3)[k] for frame, v in values.items()}, c.beam[..., k] * (1, 1e3)[k])
            grid[k, column].set_title(f"{unit.split(' ')[0]}, {title}", fontsize=10)
        grid[k, 0].set_ylabel(f"error of the {unit}")
    for axes in grid[1]:
        axes.set_xlabel("force F (N)")
    places = [Line2D([], [], color=colour, label=f"a = {1e3 * a:.0f} mm") for a, colour in zip(PLACES, COLOURS, strict=True)]
    styles = [Line2D([], [], color="black", ls=ls, label=f"Cosserat, force fixed in the {frame}") for frame, ls in FRAMES.items()]
    styles += [Line2D([], [], color="black", ls="--", lw=0.8, label="Euler-Bernoulli, other parameter known")]
    bottom.legend(handles=places + styles, loc="outside lower center", ncols=4, fontsize=8)
    bottom.suptitle("Beyond the paper: rod of the studies (400 mm), what a shape error of 1 mm RMS over the rod means", fontsize=11)
    figure.savefig(path, dpi=100)


def _draw(axes: Axes, c: Curves, values: dict[str, Tensor], straight: Tensor) -> None:
    order = c.F.argsort()
    for i, colour in enumerate(COLOURS):
        for frame, style in FRAMES.items():
            axes.loglog(c.F[order], values[frame][i, order], style, color=colour)
        axes.loglog(c.F[order], straight[i, order], "--", lw=0.8, color=colour)
    axes.grid(alpha=0.3, which="both")
