"""The ratios, and the bars that were set beforehand, each beside what was measured."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .plans import SHOWN, WHOLE

OF_NUMBA, OF_JAX = 0.6, 0.05
COLD, WARM = 5000, 10000  # whole estimates a second
OUTSIDE = 0.5  # of the time, beyond the kernel
FRAME, TAIL = 3e-3, 2.0  # s; the 99 % point over the median
COMMAND, BEYOND = 1.5, 1.0  # times `import torch`, plus s
PEAK = 1.5e9  # bytes
LINEAR = 1.1  # time per sample, largest over smallest
STRAIGHT = 0.1  # of a call's time, to the line that fits all batches best
LARGE = 1024  # samples: in smaller calls what an estimate costs once, whatever its size, is a third of the time


@dataclass(frozen=True)
class Bar:
    """One line: what, the measured value and the bar as they are printed, the ratio or value as a number, and whether it is met."""

    what: str
    measured: str
    bar: str
    value: float | None
    met: bool | None


def ratios(data: dict[str, Any]) -> dict[str, dict[str, dict[str, float]]]:
    """torchrod's time of an iteration over every other path's, by torchrod's path and batch."""
    times, found = data["iteration"], {}
    for ours in (name for name in times if name.startswith("torchrod")):
        found[ours] = {
            theirs: {batch: times[ours][batch] / value for batch, value in times[theirs].items() if batch in times[ours]}
            for theirs in times
            if theirs != ours
        }
    return found


def bars(data: dict[str, Any]) -> list[dict[str, Any]]:
    """All of them; `met` is None where nothing was measured."""
    return [asdict(bar) for bar in [*_iteration(data), *_estimates(data), *_single(data), *_memory(data), *_linear(data)]]


def _missing(what: str, bar: str) -> Bar:
    return Bar(what, "not measured", bar, None, None)


def _iteration(data: dict[str, Any]) -> list[Bar]:
    """Against numba and JAX."""
    found = []
    for batch in map(str, SHOWN):
        for theirs, most in (("numba", OF_NUMBA), ("jax", OF_JAX), ("jax, tuned", OF_JAX)):
            what, bar = f"an iteration, batch {batch}: torchrod / {theirs}", f"<= {most:g}"
            value = data["ratios"]["torchrod"].get(theirs, {}).get(batch)
            if value is None:
                found.append(_missing(what, bar))
                continue
            mine, other = (1e6 * data["iteration"][name][batch] for name in ("torchrod", theirs))
            found.append(Bar(what, f"{value:.3g} ({mine:.1f} us / {other:.1f} us)", bar, value, value <= most))
    return found


def _estimates(data: dict[str, Any]) -> list[Bar]:
    """Whole estimates a second, and the share of their time beyond the kernel."""
    found = []
    for start, least in (("cold", COLD), ("warm", WARM)):
        row = data["estimates"][f"torchrod, {start}"]
        rate, share = 1 / row["seconds"], row["kernel_share"]
        what = f"whole estimates, {start}, batch {row['batch']}"
        found.append(Bar(f"{what}: a second", f"{rate:,.0f}", f">= {least:,}", rate, rate >= least))
        what, bar = f"{what}: share of time outside the kernel", f"< {OUTSIDE:g}"
        if share is None:
            found.append(_missing(what, bar))
        else:
            found.append(Bar(what, f"{1 - share:.2f}", bar, 1 - share, 1 - share < OUTSIDE))
    return found


def _single(data: dict[str, Any]) -> list[Bar]:
    """One frame, one command."""
    frames, command = data["single"]["frames"], data["command_line"]
    median, tail = frames["median_s"], frames["p99_s"] / frames["median_s"]
    found = [
        Bar("one frame, median after the first", f"{1e3 * median:.2f} ms", f"<= {1e3 * FRAME:g} ms", median, median <= FRAME),
        Bar("one frame, 99 % point / median", f"{tail:.2f}", f"<= {TAIL:g}", tail, tail <= TAIL),
    ]
    most = COMMAND * command["import_s"] + BEYOND
    value = command["command_s"]
    found.append(Bar("the command line on one shape, cold process", f"{value:.2f} s", f"<= {most:.2f} s", value, value <= most))
    return found


def _memory(data: dict[str, Any]) -> list[Bar]:
    """Peak memory."""
    batch, peak = max(((batch, row["peak"]) for batch, row in data["memory"].items()), key=lambda pair: pair[1])
    return [Bar(f"peak memory (batch {batch})", f"{peak / 1e9:.2f} GB", f"< {PEAK / 1e9:g} GB", peak, peak < PEAK)]


def _linear(data: dict[str, Any]) -> list[Bar]:
    """Time linear in the batch: the same per sample, and as a straight line, which leaves aside what a call costs once."""
    found = []
    for path, what in (("torchrod", "an iteration"), (WHOLE, "a whole estimate")):
        least = 0 if path == "torchrod" else LARGE
        times = {int(batch): seconds for batch, seconds in data["linear"][path].items() if int(batch) >= least}
        value = max(times.values()) / min(times.values())
        what = f"{what}'s time per sample, batches {min(times)} to {max(times)}: largest / smallest"
        found.append(Bar(what, f"{value:.2f}", f"<= {LINEAR:g}", value, value <= LINEAR))
    for path, what in (("torchrod", "an iteration"), (WHOLE, "whole estimates")):
        once, each, off = straight({int(batch): seconds for batch, seconds in data["linear"][path].items()})
        what = f"{what}: a call's time, off the line {1e3 * once:.2f} ms + {1e6 * each:.1f} us a sample, at most"
        found.append(Bar(what, f"{off:.1%}", f"<= {STRAIGHT:.0%}", off, off <= STRAIGHT))
    return found


def straight(per_sample: dict[int, float]) -> tuple[float, float, float]:
    """a + b B, the line closest to the times of calls of B samples (least squares of relative errors): a, b, the largest error."""
    batch, taken = np.array(list(per_sample)), np.array([b * t for b, t in per_sample.items()])
    (a, b), *_ = np.linalg.lstsq(np.stack([1 / taken, batch / taken], -1), np.ones(len(taken)), rcond=None)
    return float(a), float(b), float(np.abs((a + b * batch) / taken - 1).max())
