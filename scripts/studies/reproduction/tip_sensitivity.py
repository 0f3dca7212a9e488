"""The paper's Figures 3 and 4: how much force, or location, one unit of deflection means, on a beam with L = 1 m and EI = 1 N m^2.

    (6)  delta(L) = F (3 L mu^2 - mu^3) / (6 EI)          tip of an Euler-Bernoulli cantilever under F at mu
    (7)  dF/ddelta = 6 EI / (3 L mu^2 - mu^3),            dmu/ddelta = EI / (F (L mu - mu^2 / 2))
    (8)  [d delta; d c] = H [d alpha; d gamma]  ->  J = H12 - H11 H21^+ H22,   [dF/ddelta; dmu/ddelta] = J^+

for a Cosserat rod, gamma = [F, mu], by the blocks of H = dh/dx at the equilibrium. Figure 4 takes (8) one parameter at a time, as
(7) is: the norm of the pseudo-inverse of one column of J. delta is the position of the tip, or of several points along the rod.
"""

import math
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import SubFigure
from matplotlib.lines import Line2D
from torch import Tensor

from torchrod import Markers, PointCoordinates, PointForces, Problem, Robot, Unknowns, solve_shape

from .sinusoids import printed_beam

L, EI, STEPS = 1.0, 1.0, 40
FORCES, PLACES = (0.1, 1.0, 2.0, 5.0, 8.0), (0.25, 0.5, 0.75, 0.95)  # N, m: of the table
GRID, QUICK_GRID = 33, 13  # values of force and of location in the figures
MOST = 8.0  # N: at 0.95 m it turns the tip by 150 degrees, and beyond it the tip points backwards
POINTS = 20  # evenly spaced, the last at the tip: what more measured points are worth
COLOURS = ("#1b2a41", "#0a7f8c", "#e08a1e", "#c8102e")  # of PLACES
NAMES = {"magnitude": ("dF/dδ (N/m)", "(a) magnitude"), "location": ("dμ/dδ (m/m)", "(b) location")}


def beam_by_tip(F: Tensor, mu: Tensor) -> tuple[Tensor, Tensor]:
    """(7): N/m and m/m."""
    return (6 * EI / (3 * L * mu**2 - mu**3)).expand_as(F), EI / (F * (L * mu - mu**2 / 2))


def equilibrium_jacobian(robot: Robot, F: Tensor, a: Tensor, s: Tensor) -> Tensor:
    """J of (8) for forces F (B,) along the section's x at a (B,), measured at s (P,): (B, 3 P, 2) in m/N and m/m."""
    scale, length = robot.rod.force_scale, robot.rod.length
    load = PointForces(torch.nn.functional.pad(F[:, None, None], (0, 2)), a.unsqueeze(-1))
    shape = solve_shape(robot, (load,), None, s, len(F), STEPS)
    gamma = torch.stack([F / scale, 0 * F, torch.logit(a / length)], -1)
    # The noise plays no part in H.
    problem = Problem(robot, Unknowns(PointCoordinates(1, length, scale), scaled=False), [Markers(s, shape.p, 1.0)], steps=STEPS)
    _, H = problem.linearized(problem.state.join(gamma, shape.base_wrench))
    # From (F / scale, eta) to (F, a): da/deta = a (1 - a / L).
    chain = torch.stack([torch.full_like(F, 1 / scale), 1 / (a * (1 - a / length))], -1).unsqueeze(1)
    p, c = H[:, :-6], H[:, -6:]
    H11, H12, H21, H22 = p[..., -6:], p[..., [0, 2]] * chain, c[..., -6:], c[..., [0, 2]] * chain
    return H12 - H11 @ torch.linalg.pinv(H21) @ H22


def one_at_a_time(J: Tensor) -> Tensor:
    """Norm of the pseudo-inverse of each column of J (..., z, 2): (..., 2)."""
    return torch.stack([torch.linalg.pinv(J[..., k : k + 1]).flatten(-2).norm(dim=-1) for k in range(2)], -1)


def jointly(J: Tensor) -> Tensor:
    """Norms of the two rows of the pseudo-inverse of J: (..., 2)."""
    return torch.linalg.pinv(J).norm(dim=-1)


def _by_points(count: int, F: Tensor, mu: Tensor) -> Tensor:
    s = torch.linspace(L / count, L, count, dtype=torch.float64)
    return equilibrium_jacobian(printed_beam(), F.flatten(), mu.flatten(), s).unflatten(0, F.shape)


def tip_figures() -> dict[str, Any]:
    """(8) over (7) at PLACES and FORCES, from the tip and from POINTS points; at 1 mN, one parameter at a time and jointly."""
    F, mu = torch.meshgrid(torch.tensor(FORCES).double(), torch.tensor(PLACES).double(), indexing="ij")
    straight = torch.stack(beam_by_tip(F, mu), -1)
    tip, many = one_at_a_time(_by_points(1, F, mu)), one_at_a_time(_by_points(POINTS, F, mu))
    weak = 0 * mu[0] + 1e-3
    J, small = _by_points(1, weak, mu[0]), torch.stack(beam_by_tip(weak, mu[0]), -1)
    keys = ("alone_magnitude", "alone_location", "joint_magnitude", "joint_location")
    factors = torch.cat([one_at_a_time(J) / small, jointly(J) / small], -1)
    data: dict[str, Any] = {
        "at_1_mN": {f"{a:g}": dict(zip(keys, v.tolist(), strict=True)) for a, v in zip(PLACES, factors, strict=True)}
    }
    for k, name in enumerate(NAMES):
        for label, values in (("tip", tip / straight), ("points", many / straight)):
            data[f"{name}_{label}"] = {
                f"{a:g}": {f"{f:g}": float(values[i, j, k]) for i, f in enumerate(FORCES)} for j, a in enumerate(PLACES)
            }
    return data


def tip_lines(d: dict[str, Any]) -> list[str]:
    """What the paper's figures show, in numbers."""
    off = max(abs(row[k] - 1) for row in d["at_1_mN"].values() for k in ("alone_magnitude", "alone_location"))
    lines = [
        "## Figures 3 and 4, (6)-(8): sensitivity",
        "",
        "![Top: (7) over force and location. Bottom: the same over the whole shape of the rod of the studies](figure3.png)",
        "",
        "One point force F at mu, L = 1 m, EI = 1 N m^2. Top of figure 3: (7), from the deflection of the tip alone, one",
        "parameter at",
        "a time. dF/ddelta depends on mu only; dmu/ddelta falls like 1/F.",
        "",
        "![Top: (8) over force and location, and over the force. Bottom: the rod of the studies](figure4.png)",
        "",
        "Top of figure 4: (8) for the Cosserat rod, by the blocks of H and their pseudo-inverses, with the force fixed in the",
        "section",
        f"as in (9). At 1 mN it meets (7) within {100 * off:.2f} %. The factor by which it exceeds (7), from the tip:",
        "",
    ]
    for name in NAMES:
        lines += [f"| {name}, mu (m) | " + " | ".join(f"{F:g} N" for F in FORCES) + " |", "|---|" + "---|" * len(FORCES)]
        lines += [f"| {a} | " + " | ".join(f"{v:.3g}" for v in row.values()) + " |" for a, row in d[f"{name}_tip"].items()]
        lines.append("")
    joint = [row["joint_magnitude"] for row in d["at_1_mN"].values()]
    few = d["magnitude_points"]["0.95"], d["location_points"]["0.95"]
    return [
        *lines,
        "dmu/ddelta itself falls with the force while the rod is nearly straight, and rises where the factor grows faster than the",
        "force (near the tip beyond 3 N).",
        f"With {POINTS} points along the rod instead of the tip, both are smaller: at 0.95 m and 0.1 N {few[0]['0.1']:.2f} and",
        f"{few[1]['0.1']:.2f} of (7), at 8 N {few[0]['8']:.2f} and {few[1]['8']:.2f}. More points lower the uncertainty; it",
        "rises with",
        "the force all the same. (7) and (8) agree one parameter at a time only: the rows of the pseudo-inverse of both",
        "columns of J",
        f"differ from (7) even at 1 mN, for the magnitude by a factor of {min(joint):.1g} to {max(joint):.1g}.",
        "",
    ]


def _map(figure: SubFigure, axes: Axes, F: Tensor, mu: Tensor, values: Tensor, name: str) -> None:
    """One sensitivity over force and location."""
    v = values.numpy()
    mesh = axes.pcolormesh(mu, F, v, norm=LogNorm(v.min(), v.max()), cmap="viridis", shading="gouraud")
    levels = [x for k in range(-2, 4) for x in (10**k, 2 * 10**k, 5 * 10**k) if v.min() < x < v.max()]
    lines = axes.contour(mu, F, v, levels=levels, colors="white", linewidths=0.8)
    axes.clabel(lines, fmt=lambda x: f"{x:g}", fontsize=8)
    figure.colorbar(mesh, ax=axes, label=NAMES[name][0])
    axes.set_xlabel("location μ (m)")
    axes.set_ylabel("force F (N)")
    axes.set_title(NAMES[name][1], fontsize=10)


def _mesh(count: int) -> tuple[Tensor, Tensor]:
    F, mu = torch.linspace(0.1, MOST, count, dtype=torch.float64), torch.linspace(0.1, 0.99, count, dtype=torch.float64)
    F, mu = torch.meshgrid(F, mu, indexing="ij")
    return F, mu


def draw_beam(figure: SubFigure) -> None:
    """The paper's Figure 3."""
    F, mu = _mesh(GRID)
    for axes, values, name in zip(figure.subplots(1, 2), beam_by_tip(F, mu), NAMES, strict=True):
        _map(figure, axes, F, mu, values, name)
    figure.suptitle("Paper's Figure 3, (7): what 1 m of tip deflection means, Euler-Bernoulli, L = 1 m, EI = 1 N m²", fontsize=11)


def draw_rod(figure: SubFigure, quick: bool) -> None:
    """The paper's Figure 4, on a coarser grid if quick, and cuts through it with (7) and with more points."""
    F, mu = _mesh(QUICK_GRID if quick else GRID)
    both = one_at_a_time(_by_points(1, F, mu))
    grid = figure.subplots(2, 2)
    force = torch.logspace(-1, math.log10(MOST), 18, dtype=torch.float64)
    cut_F, cut_mu = torch.meshgrid(force, torch.tensor(PLACES, dtype=torch.float64), indexing="ij")
    curves = {"-": one_at_a_time(_by_points(1, cut_F, cut_mu)), ":": one_at_a_time(_by_points(POINTS, cut_F, cut_mu))}
    curves["--"] = torch.stack(beam_by_tip(cut_F, cut_mu), -1)
    labels = {"-": "(8), tip", ":": f"(8), {POINTS} points", "--": "(7), tip, Euler-Bernoulli"}
    for k, name in enumerate(NAMES):
        _map(figure, grid[0, k], F, mu, both[..., k], name)
        axes = grid[1, k]
        for j, colour in enumerate(COLOURS):
            for style, values in curves.items():
                axes.loglog(force, values[:, j, k], style, color=colour, lw=0.8 if style == "--" else 1.5)
        axes.set_xlabel("force F (N)")
        axes.set_ylabel(NAMES[name][0])
        axes.grid(alpha=0.3, which="both")
    handles = [Line2D([], [], color=colour, label=f"μ = {a:g} m") for a, colour in zip(PLACES, COLOURS, strict=True)]
    handles += [Line2D([], [], color="black", ls=style, label=label) for style, label in labels.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle("Paper's Figure 4, (8): what 1 m of deflection means, Cosserat rod, L = 1 m, EI = 1 N m²", fontsize=11)
