"""docs/performance.png: time of an iteration against batch, and its growth."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from .report import MICRO, label

COLOURS = {
    "torchrod": "#c8102e",
    "torchrod, eager": "#7a4b94",
    "numba": "#0a7f8c",
    "jax": "#1b2a41",
    "jax, tuned": "#4f7cac",
    "scipy": "#8a8d8f",
}
MARKS = {
    "torchrod": "o",
    "torchrod, eager": "X",
    "numba": "D",
    "jax": "s",
    "jax, tuned": "v",
    "scipy": "^",
}


def _number(value: float, _: int) -> str:
    return f"{value:,.0f}" if value >= 1 else f"{value:g}"


def _draw(axes: Axes, by_path: dict[str, dict[str, float]]) -> None:
    """One line a path, logarithmic both ways."""
    for name, times in by_path.items():
        if not times:
            continue
        x = sorted(times, key=int)
        y = [MICRO * times[v] for v in x]
        weight = {"lw": 2.2, "zorder": 4} if name == "torchrod" else {"lw": 1.4, "zorder": 3}
        axes.plot(
            [int(v) for v in x], y, MARKS[name], ls="-", ms=6, color=COLOURS[name], label=label(name).replace("`", ""), **weight
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(_number))
    axes.grid(alpha=0.3, which="major")
    axes.spines[["top", "right"]].set_visible(False)
    values = sorted({int(v) for times in by_path.values() for v in times})
    axes.xaxis.set_major_locator(FixedLocator(values))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(_number))


def _floors(axes: Axes, floor: dict[str, float]) -> None:
    """Dashed, with the name below it, where no curve runs."""
    cores, seconds = max(floor.items(), key=lambda item: int(item[0]))
    axes.axhline(MICRO * seconds, color="#444444", ls="--", lw=1.2)
    words = f"floor: 0.37 Mflop at the dgemm rate, {cores} cores"
    place = {"xycoords": ("axes fraction", "data"), "xytext": (0, -4), "textcoords": "offset points", "va": "top"}
    axes.annotate(words, (0.02, MICRO * seconds), **place)
    axes.set_ylim(bottom=0.5 * min(MICRO * seconds, axes.get_ylim()[0]))


def figure(data: dict[str, Any], path: Path) -> None:
    """Batch on the left; steps, markers, loads and cores on the right."""
    picture = Figure(figsize=(13, 6.4), layout="constrained")
    left, right = picture.subfigures(1, 2, width_ratios=[1.1, 1]).flat  # pyright: ignore[reportAttributeAccessIssue]
    axes = left.add_subplot()
    _draw(axes, data["iteration"])
    _floors(axes, data["machine"]["floor"])
    axes.set_xlabel("batch (samples)")
    axes.set_ylabel("one iteration, µs per sample")
    axes.set_title("One iteration: h, H, normal equations, update", loc="left", fontsize=11)
    panels = right.subplots(2, 2, sharey=True)
    grown = {**data["growth"], "cores": data["cores"]}
    for k, (panel, (what, by_path)) in enumerate(zip(panels.flat, grown.items(), strict=True)):
        _draw(panel, by_path)
        panel.set_xlabel({"steps": "RK4 steps"}.get(what, what))
        if k % 2 == 0:
            panel.set_ylabel("µs per sample")
    right.suptitle("Growth of an iteration", x=0.02, ha="left", fontsize=11)
    handles, labels = axes.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=10)
    picture.savefig(path, dpi=150)
