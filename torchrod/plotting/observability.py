"""The figure of `torchrod observability`: which pushes show along the rod, and how well they are located."""

import textwrap
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from torch import Tensor

from ..analysis.observability import LOCALIZED, Observability
from ..util.files import put
from .estimate import INK, LOAD, MARKER

STYLES = ("-", "--")  # of the first layout and the one it is compared with
ROOM = 0.075  # of the panel's height, for one row of markers


@dataclass(frozen=True)
class Layout:
    """Markers s (P,) m under a name, and what they see."""

    name: str
    s: Float[Tensor, " P"]
    seen: Observability


def _curve(axes: Axes, at: Tensor, value: Tensor, colour: str, style: str, label: str, width: float = 2.0) -> None:
    drawn = torch.where(torch.isfinite(value), value, torch.nan)
    axes.semilogy(1e3 * at, drawn, style, color=colour, lw=width, label=label)


def _marker_rows(axes: Axes, layouts: list[Layout]) -> None:
    """The markers as ticks below the curves, one row per layout."""
    low, high = axes.get_ylim()
    rows = ROOM * (len(layouts) + 0.4)
    axes.set_ylim(low * (low / high) ** (rows / (1 - rows)), high)
    for row, layout in enumerate(layouts):
        height = ROOM * (len(layouts) - row - 0.3)
        name = "markers" if len(layouts) == 1 else f"markers, {layout.name}"
        where = torch.full_like(layout.s, height)
        look = {"marker": "|" if row else "^", "color": MARKER if row == 0 else INK, "ms": 7, "ls": "none", "clip_on": False}
        axes.plot(1e3 * layout.s, where, transform=axes.get_xaxis_transform(), label=name, zorder=5, **look)


def _finish(axes: Axes, layouts: list[Layout], length: float, title: str, unit: str) -> None:
    axes.set_title(title, fontsize=11, loc="left")
    axes.set_ylabel(unit)
    axes.set_xlim(0, 1.02e3 * length)  # a marker at the tip stands clear of the frame
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    _marker_rows(axes, layouts)
    axes.set_xlabel("arc length from the base, s (mm)")
    axes.grid(alpha=0.3)
    for text in axes.legend(fontsize=8, loc="upper right").get_texts():
        text.set_parse_math(False)  # a layout's name may hold a $


def draw_observability(path: str | Path, layouts: list[Layout], length: float, title: str, nearest: float | None = None) -> None:
    """Write the figure: the first layout solid, one that it is compared with dashed.

    length: L (m). nearest: the layout was proposed for pushes from there on (m); what is nearer the base is shaded.
    Errors: InputError where the file cannot be written.
    """
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    several = len(layouts) > 1
    for layout, style in zip(layouts, STYLES, strict=False):
        seen, of = layout.seen, f", {layout.name}" if several else ""
        _curve(left, seen.location, seen.localizable.amax(-1), LOAD, style, f"located to {LOCALIZED:.0%} of the rod{of}")
        _curve(left, seen.location, seen.detectable.amax(-1), INK, style, f"detected{of}")
        _curve(right, seen.location, 1e3 * seen.location_std.amax(-1), LOAD, style, f"worst direction{of}")
        if not several or style == STYLES[0]:
            _curve(right, seen.location, 1e3 * seen.location_std.mean(-1), INK, ":", f"mean over directions{of}")
    force = layouts[0].seen.force
    left.axhline(force, color="#9a9a9a", lw=1, label=f"the push of the right panel, {force:.3g} N")
    right.axhline(1e3 * LOCALIZED * length, color="#9a9a9a", lw=1, label=f"{LOCALIZED:.0%} of the rod")
    right.set_ylim(top=min(right.get_ylim()[1], 1e3 * length))
    for axes in (left, right) if nearest is not None else ():
        axes.axvspan(0, 1e3 * (nearest or 0.0), color="#ececec", zorder=0, label="not asked for in the proposal")
    _finish(left, layouts, length, "Smallest push that is ...", "force (N), worst direction")
    _finish(right, layouts, length, f"How well a push of {force:.3g} N is located", "standard deviation of the location (mm)")
    figure.suptitle(textwrap.fill(title, 120), fontsize=12, parse_math=False)  # a name may hold a $
    put(path, lambda file: figure.savefig(file, format=Path(path).suffix[1:] or None, dpi=150))
