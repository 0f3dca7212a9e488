"""A real beam: motion of the tip markers of a clamped silicone beam under gravity, and under gravity with 52 g at its tip."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torchrod import Equilibrium, PointWrenches, Robot, Rod, Tendons, solve_shape
from torchrod.mechanics.lie import rotate

from .common import GREY, RED, TEAL, Row, all_solved, as_data, distance, tensor, third_party

TITLE = "A real silicone beam"
E, NU, RHO, A, L = 263824.0, 0.499, 1070.0, 0.03, 0.1  # Pa, -, kg/m^3, side of the square section m, length m
RUNS = {"gravity_V2_a": 0.0, "gravity_V2_b": 0.0, "load52_V2_a": 0.510, "load52_V2_b": 0.510}  # force at the tip, N
LABELS = {"gravity_V2_a": "gravity, a", "gravity_V2_b": "gravity, b", "load52_V2_a": "52 g, a", "load52_V2_b": "52 g, b"}


def beam(shear: bool = True) -> Robot:
    """The beam; without shear it is stiff in shear and as soft as before in tension."""
    G = E / (2 * (1 + NU))
    GA = 5 / 6 * G * A**2 if shear else 1e9
    K_se, K_bt = tensor([GA, GA, E * A**2]), tensor([E * A**4 / 12, E * A**4 / 12, G * 0.1406 * A**4])
    return Robot(Rod.from_stiffness(L, torch.diag(K_se), torch.diag(K_bt), RHO * A**2), Tendons(), tensor([-9.81, 0.0, 0.0]))


@dataclass(frozen=True)
class Motion:
    """One run: tip markers (3, 3) at the start and in equilibrium, the unloaded tip at L e3; base: its markers' motion (3,). m."""

    start: Tensor
    end: Tensor
    base: Tensor


def read(folder: Path, run_name: str) -> Motion:
    """A run of the capture, moved so that the centre line leaves the origin along +z."""
    with (folder / "static_marker_positions_m.csv").open(encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if run_name in r["file"]]

    def positions(marker: str, state: str) -> Tensor:
        chosen = [r for r in rows if r["marker"].startswith(marker) and r["state"] == state]
        return tensor([[float(r[k]) for k in ("x_m", "y_m", "z_m")] for r in chosen])

    start, end = positions("Tip", "start"), positions("Tip", "static_end")
    centre = (start.amax(0) + start.amin(0)) / 2
    centre[2] = start[:, 2].mean()
    tip = tensor([0.0, 0.0, L])
    return Motion(start - centre + tip, end - centre + tip, distance(positions("Base", "start"), positions("Base", "static_end")))


def predict(motion: Motion, force: float, shear: bool = True) -> Tensor:
    """Predicted marker positions (3, 3), m: each marker is fixed to the tip section; the force (N) acts at the tip along -x."""
    shape = bent(force, tensor([L]), shear)
    offset = motion.start - tensor([0.0, 0.0, L])
    return shape.p[0] + rotate(shape.q[0].expand(len(offset), 4), offset)


def bent(force: float, s: Tensor, shear: bool = True) -> Equilibrium:
    """The beam under its weight and a force (N) at the tip along -x, at s (m)."""
    load = PointWrenches(tensor([[[-force, 0.0, 0.0]]]), torch.zeros(1, 1, 3, dtype=torch.float64), tensor([L]))
    shape = solve_shape(beam(shear), (load,), None, s, 1)
    all_solved(shape.status)
    return shape


def differences_of_repeats(motions: dict[str, Motion]) -> tuple[float, float]:
    """Largest difference of a marker's motion between the repeats, and of its part along gravity (m)."""
    moved = {name: m.end - m.start for name, m in motions.items()}
    off = torch.cat([moved["gravity_V2_a"] - moved["gravity_V2_b"], moved["load52_V2_a"] - moved["load52_V2_b"]])
    return float(off.norm(dim=-1).max()), float(off[:, 0].abs().max())


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Predicted and measured motion of every marker. There is nothing to leave out: quick is the same."""
    source = third_party("beam_mocap")
    motions = {name: read(source, name) for name in RUNS}
    predicted = {name: predict(motion, RUNS[name]) for name, motion in motions.items()}
    off = {name: predicted[name] - motions[name].end for name in RUNS}
    data, table = {}, []
    for name, m in motions.items():
        moved = [m.end, predicted[name], predict(m, RUNS[name], shear=False)]
        figures = [*(distance(p, m.start).mean() for p in moved), off[name].norm(dim=-1).mean(), -off[name][:, 0].mean()]
        names = ("measured_m", "predicted_m", "without_shear_m", "distance_m", "sag_error_m")
        data[name] = dict(zip(names, map(float, figures), strict=True))
        table.append(f"| {LABELS[name]} | " + " | ".join(f"{1e3 * float(v):.2f}" for v in figures) + " |")
    repeat, sag = differences_of_repeats(motions)
    base = max(float(m.base.max()) for m in motions.values())
    row = Row.of("motion capture, silicone beam", "position of a tip marker", "m", torch.cat(list(off.values())).norm(dim=-1))
    lines = [
        f"{1e3 * L:.0f} x {1e3 * A:.0f} x {1e3 * A:.0f} mm, clamped, motion capture, under gravity and under gravity with 52 g",
        "at its tip; modulus and density as published with the data, nothing fitted. Means over the three tip markers, in mm:",
        "",
        "| run | motion, measured | predicted | predicted without shear | from prediction to marker | predicted sag too large by |",
        "|---|---|---|---|---|---|",
        *table,
        "",
        "Assumptions: the clamp does not move; the beam lies along the capture's +z, and gravity along -x (the way the tip",
        "sags); the centre line passes through the middle of the tip markers' bounding box; the start positions are the",
        "unloaded beam; the markers are fixed to the tip section; the 52 g (0.510 N) pull at the tip of the centre line; shear",
        "correction 5/6 and torsion constant 0.1406 a^4 of a square section.",
        "",
        f"What limits it: the aspect ratio of {L / A:.1f}, at the edge of rod theory; the one modulus given for the material;",
        f"and the measurement: a marker's motion differs between the repeats by up to {1e3 * repeat:.1f} mm, mostly sideways",
        f"({1e3 * sag:.1f} mm along gravity), and a base marker moves by up to {1e3 * base:.1f} mm.",
        "",
        "![The beam from the side, and the distance from prediction to marker](validation_beam.png)",
    ]
    _figure(motions, predicted, folder / "validation_beam.png")
    return as_data([row], runs=data, repeat_m=repeat, repeat_sag_m=sag, base_m=base), lines


def _figure(motions: dict[str, Motion], predicted: dict[str, Tensor], path: Path) -> None:
    figure = Figure(figsize=(11.5, 4.2), layout="constrained")
    side, error = figure.subplots(1, 2, width_ratios=(1.7, 1))
    _draw_side(side, motions, predicted)
    ticks = []
    for k, (name, m) in enumerate(motions.items()):
        for marker, mark in enumerate("os^"):
            error.plot(k, 1e3 * distance(predicted[name], m.end)[marker], mark, color=RED if RUNS[name] else TEAL)
        ticks.append(f"{LABELS[name]}\nmoved {1e3 * distance(m.end, m.start).mean():.1f} mm")
    error.set_xticks(range(len(ticks)), ticks, fontsize=7)
    error.set_ylabel("from predicted to measured marker (mm)")
    for marker, mark in enumerate("os^"):
        error.plot([], [], mark, color=GREY, label=f"tip marker {marker + 1}")
    error.set_xlim(-0.5, len(ticks) - 0.5)
    error.set_ylim(bottom=0)
    error.grid(alpha=0.3)
    error.legend(fontsize=8, loc="lower left")
    figure.savefig(path, dpi=150)


def _draw_side(axes: Axes, motions: dict[str, Motion], predicted: dict[str, Tensor]) -> None:
    axes.plot([0, 1e3 * L], [0, 0], color=GREY, lw=2, label="centre line, unloaded")
    s = torch.linspace(0, L, 41, dtype=torch.float64)
    for name, title, colour in (("gravity_V2_b", "gravity", TEAL), ("load52_V2_b", "gravity and 52 g", RED)):
        line, p, m = bent(RUNS[name], s).p[0], predicted[name], motions[name].end
        axes.plot(1e3 * line[:, 2], 1e3 * line[:, 0], color=colour, lw=2, label=f"centre line, {title}, predicted")
        axes.plot(1e3 * p[:, 2], 1e3 * p[:, 0], "x", ms=8, mew=2, color=colour, label="tip markers, predicted")
        axes.plot(1e3 * m[:, 2], 1e3 * m[:, 0], "o", ms=9, mfc="none", color=colour, label="tip markers, measured")
    axes.set_xlabel("z, from the clamp along the unloaded beam (mm)")
    axes.set_ylabel("x, up (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")
