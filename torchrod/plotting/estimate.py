"""The figure: the rod in space with its markers, the fitted shape and the loads on it, in the manner of the paper's Figure 6."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from ..estimation.result import FittedRod
from ..mechanics.grid import DEFAULT_STEPS
from ..mechanics.lie import move, rotate
from ..mechanics.robot import Robot
from ..mechanics.statics import shape_from_base
from ..util.errors import InputError
from ..util.files import put
from ..util.precision import DTYPE

INK, LOAD, MARKER, TENDON, TRUTH = "#1b2a41", "#c8102e", "#0a7f8c", "#9a9a9a", "#b5b5b5"
ARROW = 0.28  # the largest net force is drawn this long, in rod lengths
ENVELOPE = 0.12  # and the densest load this high
MOST_NEAR = 2000  # points of the line that are added where the loads are
MOST_NAMED = 12  # loads: the largest have their force and place written beside them
ROW_FROM, ROW = 0.8, 0.9  # of the height of |f|: what the curves may take, and where the contacts' locations stand


@dataclass(frozen=True)
class _Scene:
    """Everything to be drawn, in the measured frame: dense centre line, load envelope, and the net forces with their points."""

    line: Float[Tensor, "D 3"]
    envelope: Float[Tensor, "D 3"]
    loaded: Tensor
    points: Float[Tensor, "K 3"]
    tails: Float[Tensor, "K 3"]
    tendons: list[Tensor]


def _scene(robot: Robot, fit: FittedRod, tension: Tensor | None) -> _Scene:
    L = robot.rod.length
    loads = fit.loads(L)
    near = (fit.location.unsqueeze(-1) + fit.width.unsqueeze(-1) * torch.linspace(-3, 3, 25, dtype=DTYPE)).flatten().clamp(0, L)
    near = near[:: math.ceil(len(near) / MOST_NEAR) or 1]
    s = torch.cat([torch.linspace(0, L, 121, dtype=DTYPE), near, fit.location]).sort().values
    tension = None if tension is None else tension.unsqueeze(0)
    shape = shape_from_base(robot, loads, fit.base_wrench.unsqueeze(0), tension, s, DEFAULT_STEPS, differentiable=False)
    p, q = shape.p[0], shape.q[0]
    if not bool(torch.isfinite(p).all()):
        raise InputError(
            "the base wrench of the result leaves this robot no shape; give the robot that was estimated, as it was then"
        )

    def measured(x: Tensor) -> Tensor:
        return x if fit.registration is None else move(fit.registration, x)

    density = loads[0].density(s)
    assert density is not None
    height = density.norm(dim=-1)
    scale = ENVELOPE * L / float(height.max()) if float(height.max()) > 0 else 0.0
    at = [int((s - x).abs().argmin()) for x in fit.location]
    pushes = rotate(q[at], fit.pushes)
    if fit.tip_force is not None:
        at, pushes = [*at, len(s) - 1], torch.cat([pushes, fit.tip_force.unsqueeze(0)])
    longest = float(pushes.norm(dim=-1).max()) if len(pushes) else 0.0
    tails = p[at] - pushes * (ARROW * L / longest if longest > 0 else 0.0)
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


def _arrows(axes: Axes3D, scene: _Scene, colour: str, width: float, label: str, order: int) -> None:
    if len(scene.points):
        look = {"color": colour, "linewidth": width, "arrow_length_ratio": 0.18, "label": label, "zorder": order}
        axes.quiver(*scene.tails.T.numpy(), *(scene.points - scene.tails).T.numpy(), **look)


def _label(fit: FittedRod, k: int) -> str:
    if k == len(fit.force) and fit.tip_force is not None:
        return f"{float(fit.tip_force.norm()):.3g} N at the tip"
    return f"{float(fit.force[k].norm()):.3g} N at {float(fit.location[k]) * 1e3:.0f} mm"


def draw_on(
    axes: Axes3D,
    robot: Robot,
    fit: FittedRod,
    positions: Float[Tensor, "P 3"],
    tension: Float[Tensor, " T"] | None = None,
    truth: FittedRod | None = None,
    true_colour: str = TRUTH,
) -> None:
    """Draw one sample: markers at positions (m, teal; NaN where missing), fitted rod (dark) under its tensions (N), loads (red).

    Equal axes in metres. truth: the true loads where they are known (in true_colour, grey by default, and in the title).
    """
    axes.computed_zorder = False  # by depth, the arrow of a good estimate would vanish behind the true one
    scene = _scene(robot, fit, tension)
    seen = positions[torch.isfinite(positions).all(-1)]
    for i, line in enumerate(scene.tendons):
        axes.plot(*line.T.numpy(), color=TENDON, linewidth=1.2, zorder=1, label=None if i else "tendons")
    axes.plot(*scene.line.T.numpy(), color=INK, linewidth=2.5, zorder=4, label="fitted rod")
    look = {"color": MARKER, "s": 28, "depthshade": False, "zorder": 6}
    axes.scatter(*seen.T.numpy(), label="markers", **look)  # pyright: ignore[reportArgumentType]
    if scene.loaded.any():
        envelope = torch.where(scene.loaded.unsqueeze(-1), scene.envelope, torch.nan)  # no line from one load to the next
        axes.plot(*envelope.T.numpy(), color=LOAD, linewidth=1, zorder=3, label="load per length")
        rays = torch.stack([scene.envelope, scene.line], 1)[scene.loaded].numpy()
        axes.add_collection3d(Line3DCollection(rays, colors=LOAD, linewidths=0.5, alpha=0.5, zorder=3))
    vectors, everything = scene.points - scene.tails, torch.cat([scene.line, seen, scene.tails, scene.envelope])
    if truth is not None:
        true_scene = _scene(robot, truth, tension)
        _arrows(axes, true_scene, true_colour, 6.0, "true force", 2)
        everything = torch.cat([everything, true_scene.tails])
        both = [(_label(truth, k), _label(fit, k)) for k in range(min(len(truth.force), len(fit.force)))]
        axes.set_title("\n".join(f"true {a}, estimated {b}" for a, b in both), fontsize=12)
    else:
        pushes = (scene.points - scene.tails).norm(dim=-1)
        for k in sorted(pushes.argsort(descending=True)[:MOST_NAMED].tolist()):
            x, y, z = scene.tails[k].tolist()
            axes.text(x, y, z, _label(fit, k), color=LOAD, fontsize=11, fontweight="bold", ha="center", va="bottom")
    _arrows(axes, scene, LOAD, 2.2, "net force", 5)
    axes.scatter(*scene.line[0].tolist(), color=INK, marker="s", s=60, zorder=6, label="clamp")
    _equal_axes(axes, everything)
    chord = scene.line[-1] - scene.line[0]
    off_chord = scene.line - scene.line[0]
    off_chord = off_chord - (off_chord @ chord / (chord @ chord)).unsqueeze(-1) * chord
    bulge = off_chord[off_chord.norm(dim=-1).argmax()]
    bent = [bulge] if bulge.norm() > 0.02 * chord.norm() else []
    _look_across(axes, torch.cat([torch.stack([chord, *bent]), vectors]))


def _stems(axes: Axes, at: Float[Tensor, " K"], value: Float[Tensor, " K"]) -> None:
    """Point forces: a stem each."""
    axes.vlines(1e3 * at, 0, value, color=LOAD, lw=2)
    axes.plot(1e3 * at, value, "o", color=LOAD, ms=6)


def _where(axes: Axes, fit: FittedRod) -> None:
    """The contacts and the 95 % intervals of their locations, in a row above the curves."""
    at = 1e3 * fit.location
    interval = torch.full_like(at, torch.nan).unsqueeze(-1) if fit.location_interval is None else 1e3 * fit.location_interval
    reach = (at.unsqueeze(-1) - interval).abs().nan_to_num(0.0).T
    across = axes.get_xaxis_transform()
    look = {"fmt": "o", "color": INK, "ms": 6, "capsize": 5, "lw": 1.8, "transform": across, "clip_on": False}
    axes.errorbar(at, torch.full_like(at, ROW), xerr=reach.numpy(), label="contact location, 95 %", **look)


def draw_profile_on(axes: Sequence[Axes], fit: FittedRod, length: float) -> None:
    """f_x, f_y and |f| along the rod (N/m), section frame, in three axes one above the other, each with its 95 % band.

    Above |f| the contacts with the intervals of their locations. Point forces (no profile) are stems (N). length: L (m).
    """
    sizes = torch.cat([fit.force, fit.force.norm(dim=-1, keepdim=True)], -1)
    for i, (panel, name) in enumerate(zip(axes, ("$f_x$", "$f_y$", "$|f|$"), strict=True)):
        panel.axhline(0, color="#9a9a9a", lw=0.8)
        if fit.profile is None:
            _stems(panel, fit.location, sizes[:, i])
        else:
            s, f = 1e3 * fit.profile.s, torch.cat([fit.profile.f, fit.profile.f.norm(dim=-1, keepdim=True)], -1)
            panel.fill_between(
                s, fit.profile.band[:, i, 0], fit.profile.band[:, i, 1], color=LOAD, alpha=0.2, lw=0, label="95 % band"
            )
            panel.plot(s, f[:, i], color=LOAD, lw=2, label="load per length")
        panel.set_ylabel(f"{name} ({'N' if fit.profile is None else 'N/m'})", fontsize=12)
        panel.grid(alpha=0.3)
        panel.set_xlim(0, 1e3 * length)
        panel.tick_params(labelbottom=panel is axes[-1], labelsize=10)
    low, high = axes[-1].get_ylim()
    axes[-1].set_ylim(low, low + (high - low) / ROW_FROM)
    if len(fit.force):
        _where(axes[-1], fit)
    axes[-1].set_xlabel("arc length from the base, s (mm)", fontsize=12)


def draw(
    path: str | Path,
    robot: Robot,
    fit: FittedRod,
    positions: Float[Tensor, "P 3"],
    tension: Float[Tensor, " T"] | None,
    title: str,
) -> None:
    """Write the figure of one sample: the rod by `draw_on`, and beside it the loads along it by `draw_profile_on`.

    Errors: InputError where the file cannot be written.
    """
    figure = Figure(figsize=(13, 7), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1))
    axes = figure.add_subplot(grid[:, 0], projection="3d")
    assert isinstance(axes, Axes3D)
    draw_on(axes, robot, fit, positions, tension)
    panels = [figure.add_subplot(grid[i, 1]) for i in range(3)]
    draw_profile_on(panels, fit, robot.rod.length)
    figure.suptitle(textwrap.fill(title, 120), fontsize=13, parse_math=False)  # a name may hold a $
    names = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    names |= dict(zip(*reversed(panels[-1].get_legend_handles_labels()), strict=True))
    figure.legend(names.values(), names.keys(), loc="outside lower center", ncols=5, frameon=False, fontsize=11)
    put(path, lambda file: figure.savefig(file, format=Path(path).suffix[1:] or None, dpi=150))
