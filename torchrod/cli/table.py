"""The table on the screen."""

import math
import sys

import torch
from torch import Tensor

from ..analysis.diagnosis import Diagnosis
from ..analysis.noise import Noise
from ..estimation.intervals import Intervals
from ..estimation.result import Z95, Estimate
from ..util.status import Status
from .screen import one_line

MOST_LINES = 50  # on a terminal, where more would push the first away
MOST_NOTES = 10
HEADS = {"force (N)": 20, "F_x (N)": 10, "F_y (N)": 10, "location (mm)": 20}  # and the least width of a column
AXIAL = {"F_z (N)": 20}  # of one more, where the force along the rod is unknown
GAP = 2
MOST_DECIMALS = 7  # what needs more is written with an exponent


def _decimals(values: list[float], spreads: list[float], usual: int) -> int:
    """As many as show two digits of the least spread (of the values, where none is known), but never less than usual."""
    known = [v for v in spreads if math.isfinite(v) and v > 0] or [abs(v) / 10 for v in values if math.isfinite(v) and v]
    return max([usual, *(1 - math.floor(math.log10(v)) for v in known)])


def _number(value: float, decimals: int) -> str:
    return f"{value:.3e}" if decimals > MOST_DECIMALS else f"{value:.{decimals}f}"


def _pairs(values: list[float], spreads: list[float], usual: int) -> list[str]:
    """Every value +- its spread, all with the same decimals."""
    decimals = _decimals(values, spreads, usual)
    return [f"{_number(v, decimals)} +- {_number(s, decimals)}" for v, s in zip(values, spreads, strict=True)]


def _spread(std: Tensor, drawn: Tensor | None) -> list[float]:
    """One standard deviation; where there are draws, what a normal distribution has whose 95 % interval is as wide as theirs."""
    if drawn is None:
        return std.tolist()
    wide = drawn.diff(dim=-1).squeeze(-1) / (2 * Z95)
    return torch.where(wide.isnan(), std, wide).tolist()


def _cells(result: Estimate, there: list[tuple[int, int]], drawn: Intervals | None) -> list[list[str]]:
    """The columns of HEADS, and of AXIAL, for the loads (sample, number) that there are."""
    b, k = ([pair[i] for pair in there] for i in range(2))
    sizes, places = (None, None) if drawn is None else (drawn.magnitude[b, k], drawn.location[b, k])
    size, std = result.magnitude[b, k].tolist(), _spread(result.magnitude_std[b, k], sizes)
    place = (1e3 * result.location[b, k]).tolist()
    place_std = [1e3 * v for v in _spread(result.location_std[b, k], places)]
    decimals = _decimals(size, std, 4)
    parts = [[_number(v, decimals) for v in result.force[b, k, i].tolist()] for i in range(2)]
    cells = [_pairs(size, std, 4), *parts, _pairs(place, place_std, 1)]
    if result.axial is None or result.axial_std is None:
        return cells
    return [*cells, _pairs(result.axial[b, k].tolist(), result.axial_std[b, k].tolist(), 4)]


def table(result: Estimate, samples: list[str], diagnosis: Diagnosis, noise: Noise | None, drawn: Intervals | None = None) -> str:
    """The table on the screen: one line per load, sentences on the fits that are not accepted, and how many are.

    drawn: the intervals of draws, where there are any, whose widths are then shown.

    On a terminal no more than MOST_LINES lines and MOST_NOTES sentences, and a word on where the rest is.
    """
    terminal = sys.stdout is not None and sys.stdout.isatty()
    shown = len(samples)
    if terminal and len(samples) + int((~result.accepted).sum()) > MOST_LINES:
        shown = min(shown, MOST_LINES - MOST_NOTES)
    lines = _lines(result, samples[:shown], noise, drawn)
    notes, further = [], 0
    for b in _noted(result, diagnosis):
        if terminal and len(notes) == MOST_NOTES and shown < len(samples):
            further += 1
        else:
            notes.append(one_line(f"sample {samples[b]}: {result.message(b)} {diagnosis.message(b)}".rstrip()))
    if shown < len(samples):
        rest = f"{len(samples) - shown} more samples" + (f" and {further} more sentences" if further else "")
        lines.append(f"... {rest}: with --out in RESULT, or here where the output goes to a file or a pipe")
    return "\n".join([*lines, *notes, _summary(result)])


def _noted(result: Estimate, diagnosis: Diagnosis) -> list[int]:
    """The samples of which there is something to say."""
    sound = (result.accepted & ~result.unstable).tolist()
    return [b for b, fine in enumerate(sound) if not fine or diagnosis.message(b)]


def _summary(result: Estimate) -> str:
    """How many samples came to what."""
    status = result.status.tolist()
    words = [f"{status.count(int(s))} {s.label.replace('_', ' ')}" for s in Status if s is Status.CONVERGED or int(s) in status]
    return f"{len(status)} sample{'s' * (len(status) != 1)}: {', '.join(words)}; {int(result.accepted.sum())} accepted"


def _lines(result: Estimate, samples: list[str], noise: Noise | None, drawn: Intervals | None) -> list[str]:
    """The head of the table, and the lines of the first samples."""
    force = result.force[: len(samples), :, 0].tolist()
    there = [(b, k) for b, row in enumerate(force) for k, v in enumerate(row) if not math.isnan(v)]
    cells, heads = _cells(result, there, drawn), HEADS | ({} if result.axial is None else AXIAL)
    widths = [max([least, *(GAP + len(cell) for cell in column)]) for least, column in zip(heads.values(), cells, strict=True)]
    loads: dict[int, list[str]] = {}
    for (b, k), row in zip(there, zip(*cells, strict=True), strict=True):
        loads.setdefault(b, []).append(f"{k + 1:>4}" + "".join(f"{c:>{w}}" for c, w in zip(row, widths, strict=True)))
    columns = "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True))
    lines = [f"{'sample':>8}  {'status':<13} {'ok':<4}{'load':>4}{columns}{'rms (mm)':>10}"]
    accepted, status, residual = result.accepted.tolist(), result.status.tolist(), result.rms_residual.tolist()
    more = result.tip is not None or result.tension_std is not None or noise is not None
    further = (result.outlier.any(-1) | more).tolist()
    for b, name in enumerate(samples):
        label, rms = Status(status[b]).label, f" {_rms(1e3 * residual[b]):>9}"
        head = f"{one_line(name):>8}  {label:<13} {'yes' if accepted[b] else 'no':<4}"
        if b not in loads:
            none = "no load" if label != "invalid" else "-"
            lines.append(f"{head}{'-':>4}{none:>{widths[0]}}{'':>{sum(widths[1:])}}{rms}")
        for i, load in enumerate(loads.get(b, [])):
            lines.append(f"{'' if i else head:<28}{load}{rms}")
        lines += _further(result, b, noise) if further[b] else []
    return lines


def _rms(millimetres: float) -> str:
    if math.isnan(millimetres):  # of what has no position
        return "-"
    return f"{millimetres:.2g}" if 0 < millimetres < 1e-3 else f"{millimetres:.3f}"


def _tip(result: Estimate, b: int) -> list[str]:
    """What acts on the tip, as far as it was estimated."""
    if result.tip is None or result.tip_covariance is None or bool(result.tip[b].isnan().all()):
        return []
    tip, std = result.tip[b].tolist(), result.tip_covariance[b].diagonal().sqrt().tolist()
    said = []
    for name, part in (("force (N)", slice(0, 3)), ("moment (N m)", slice(3, 6))):
        known = [(v, s) for v, s in zip(tip[part], std[part], strict=True) if s > 0 or math.isnan(s)]
        if known:
            said.append(f"{name} {', '.join(_pairs([v for v, _ in known], [s for _, s in known], 4))}")
    return [f"tip, base frame: {'; '.join(said)}"]


def _further(result: Estimate, b: int, noise: Noise | None) -> list[str]:
    """What was estimated beside the loads, and the markers left aside."""
    said = _tip(result, b)
    if result.tension is not None and result.tension_std is not None:
        said.append("tensions (N) " + ", ".join(_pairs(result.tension[b].tolist(), result.tension_std[b].tolist(), 3)))
    if noise is not None and math.isnan(float(noise.sigma[b])):
        said.append("noise not known: too few markers to tell it")
    elif noise is not None:
        said += [f"noise (mm) {pair}" for pair in _pairs([1e3 * float(noise.sigma[b])], [1e3 * float(noise.std[b])], 3)]
    if bool(result.outlier[b].any()):
        names = ", ".join(str(i + 1) for i in result.outlier[b].nonzero().flatten().tolist())
        said.append(f"left aside as outliers: markers {names}")
    return [f"{'':>28} {words}" for words in said]
