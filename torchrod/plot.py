"""The figure: the rod in space with its markers, the fitted shape and the loads on it, in the manner of the paper's Figure 6."""

import math
import textwrap
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from .grid import DEFAULT_STEPS
from .lie import move, rotate
from .measurement import Markers
from .result import Fit
from .robot import Robot
from .rod import DTYPE
from .statics import shape_from_base

INK, LOAD, MARKER, TENDON = "#1b2a41", "#c8102e", "#0a7f8c", "#9a9a9a"
ARROW = 0.28  # the largest net force is drawn this long, in rod lengths
ENVELOPE = 0.12  # and the densest load this high


@dataclass(frozen=True)
class _Scene:
    """Everything to be drawn, in the measured frame: dense centre line, load envelope, and the net forces with their points."""

    line: Float[Tensor, "D 3"]
    envelope: Float[Tensor, "D 3"]
    loaded: Tensor
    points: Float[Tensor, "K 3"]
    tails: Float[Tensor, "K 3"]
    tendons: list[Tensor]


def _scene(robot: Robot, fit: Fit, tension: Tensor | None) -> _Scene:
    L = robot.rod.length
    loads = fit.loads(L)
    near = (fit.location.unsqueeze(-1) + fit.width.unsqueeze(-1) * torch.linspace(-3, 3, 25, dtype=DTYPE)).flatten().clamp(0, L)
    s = torch.cat([torch.linspace(0, L, 121, dtype=DTYPE), near, fit.location]).sort().values
    tension = None if tension is None else tension.unsqueeze(0)
    shape = shape_from_base(robot, loads, fit.base_wrench.unsqueeze(0), tension, s, DEFAULT_STEPS, differentiable=False)
    p, q = shape.p[0], shape.q[0]

    def measured(x: Tensor) -> Tensor:
        return x if fit.registration is None else move(fit.registration, x)

    density = loads[0].density(s)
    assert density is not None
    height = density.norm(dim=-1)
    scale = ENVELOPE * L / float(height.max()) if float(height.max()) > 0 else 0.0
    force = torch.cat([fit.force, torch.zeros_like(fit.force[:, :1])], -1)
    at = [int((s - x).abs().argmin()) for x in fit.location]
    longest = float(force.norm(dim=-1).max()) if len(force) else 0.0
    tails = p[at] - rotate(q[at], force) * (ARROW * L / longest if longest > 0 else 0.0)
    tendons = []
    for tendon in robot.tendons.tendons:
        r, _ = tendon.offset_at(s)
        tendons.append(measured((p + rotate(q, r))[s <= tendon.ends_at + 1e-9]))
    return _Scene(
        measured(p),
        measured(p - rotate(q, density) * scale),
        height > 0.02 * height.max(),
        measured(p[at]),
        measured(tails),
        tendons,
    )


def _equal_axes(axes: Axes3D, points: Float[Tensor, "n 3"]) -> None:
    low, high = points.min(0).values, points.max(0).values
    half = 0.55 * float((high - low).max())
    for name, middle in zip("xyz", ((low + high) / 2).tolist(), strict=True):
        getattr(axes, f"set_{name}lim")(middle - half, middle + half)
        getattr(axes, f"set_{name}label")(f"{name} (m)", labelpad=8)
        getattr(axes, f"{name}axis").set_major_locator(MaxNLocator(5))
    axes.set_box_aspect((1, 1, 1))


def _look_across(axes: Axes3D, vectors: Float[Tensor, "n 3"]) -> None:
    """From a little above, and from the side on which the most foreshortened of the vectors is least so."""
    elevation = math.radians(18)
    azimuth = torch.arange(0, 360, 5, dtype=DTYPE).deg2rad()
    level = math.cos(elevation) * torch.stack([azimuth.cos(), azimuth.sin()], -1)
    eye = torch.cat([level, torch.full_like(level[:, :1], math.sin(elevation))], -1)
    units = vectors / vectors.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    best = (units @ eye.T).abs().amax(0).argmin()
    axes.view_init(elev=18, azim=float(azimuth[best].rad2deg()))


def draw(path: str | Path, robot: Robot, fit: Fit, markers: Markers, sample: int, title: str) -> None:
    """Write the figure of one sample: markers (teal), fitted rod (dark), loads (red); equal axes in metres."""
    scene = _scene(robot, fit, None if markers.tension is None else markers.tension[sample])
    seen = markers.positions[sample][markers.present[sample]]
    figure = Figure(figsize=(8, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    assert isinstance(axes, Axes3D)
    for i, line in enumerate(scene.tendons):
        axes.plot(*line.T.numpy(), color=TENDON, linewidth=1.2, label=None if i else "tendons")
    axes.plot(*scene.line.T.numpy(), color=INK, linewidth=2.5, label="fitted rod")
    axes.scatter(*seen.T.numpy(), color=MARKER, s=28, depthshade=False, label="markers")  # pyright: ignore[reportArgumentType]
    if scene.loaded.any():
        axes.plot(*scene.envelope[scene.loaded].T.numpy(), color=LOAD, linewidth=1, label="load per length")
        for i in scene.loaded.nonzero().flatten().tolist():
            axes.plot(*torch.stack([scene.envelope[i], scene.line[i]]).T.numpy(), color=LOAD, linewidth=0.5, alpha=0.5)
    labels: list[tuple[tuple[float, float, float], str]] = []
    for k, (head, tail) in enumerate(zip(scene.points, scene.tails, strict=True)):
        axes.quiver(
            *tail.tolist(),
            *(head - tail).tolist(),
            color=LOAD,
            linewidth=2.2,
            arrow_length_ratio=0.18,
            label="net force" if k == 0 else None,
        )
        text = f"{float(fit.force[k].norm()):.3g} N at {float(fit.location[k]) * 1e3:.0f} mm"
        labels.append((tuple(tail.tolist()), text))
    axes.scatter(*scene.line[0].tolist(), color=INK, marker="s", s=60, label="clamp")
    everything = torch.cat([scene.line, seen, scene.tails, scene.envelope])
    _equal_axes(axes, everything)
    chord = scene.line[-1] - scene.line[0]
    off_chord = scene.line - scene.line[0]
    off_chord = off_chord - (off_chord @ chord / (chord @ chord)).unsqueeze(-1) * chord
    bulge = off_chord[off_chord.norm(dim=-1).argmax()]
    bent = [bulge] if bulge.norm() > 0.02 * chord.norm() else []
    _look_across(axes, torch.cat([torch.stack([chord, *bent]), scene.points - scene.tails]))
    axes.set_title(textwrap.fill(title, 80), fontsize=12)
    for (x, y, z), text in labels:
        axes.text(x, y, z, text, color=LOAD, fontsize=11, fontweight="bold", ha="center", va="bottom")
    figure.legend(loc="outside lower center", ncols=6, frameon=False)
    figure.savefig(path, dpi=150)
