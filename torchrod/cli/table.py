"""The table on the screen."""

import math

from ..analysis.diagnosis import Diagnosis
from ..analysis.noise import Noise
from ..estimation.result import Estimate
from ..util.status import Status

HEADS = {"force (N)": 20, "F_x (N)": 10, "F_y (N)": 10, "location (mm)": 20}  # and the least width of a column
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


def _cells(result: Estimate, there: list[tuple[int, int]]) -> list[list[str]]:
    """The columns of HEADS for the loads (sample, number) that there are."""
    b, k = ([pair[i] for pair in there] for i in range(2))
    size, std = result.magnitude[b, k].tolist(), result.magnitude_std[b, k].tolist()
    place, place_std = (1e3 * result.location[b, k]).tolist(), (1e3 * result.location_std[b, k]).tolist()
    decimals = _decimals(size, std, 4)
    parts = [[_number(v, decimals) for v in result.force[b, k, i].tolist()] for i in range(2)]
    return [_pairs(size, std, 4), *parts, _pairs(place, place_std, 1)]


def table(result: Estimate, samples: list[str], diagnosis: Diagnosis, noise: Noise | None) -> str:
    """The table on the screen: one line per load."""
    force = result.force[..., 0].tolist()
    there = [(b, k) for b, row in enumerate(force) for k, v in enumerate(row) if not math.isnan(v)]
    cells = _cells(result, there)
    widths = [max([least, *(GAP + len(cell) for cell in column)]) for least, column in zip(HEADS.values(), cells, strict=True)]
    loads = {
        which: "".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True))
        for which, row in zip(there, zip(*cells, strict=True), strict=True)
    }
    columns = "".join(f"{head:>{width}}" for head, width in zip(HEADS, widths, strict=True))
    lines = [f"{'sample':>8}  {'status':<13} {'ok':<4}{'load':>4}{columns}{'rms (mm)':>10}"]
    notes = []
    for b, name in enumerate(samples):
        status = Status(int(result.status[b])).label
        rms = f" {_rms(1e3 * float(result.rms_residual[b])):>9}"
        head = f"{name:>8}  {status:<13} {'yes' if result.accepted[b] else 'no':<4}"
        present = [k for k in range(len(force[b])) if (b, k) in loads]
        if not present:
            none = "no load" if status != "invalid" else "-"
            lines.append(f"{head}{'-':>4}{none:>{widths[0]}}{'':>{sum(widths[1:])}}{rms}")
        for k in present:
            lines.append(f"{head if k == present[0] else '':<28}{k + 1:>4}{loads[b, k]}{rms}")
        lines += _further(result, b, noise)
        if not result.accepted[b] or diagnosis.message(b):
            notes.append(f"sample {name}: {result.message(b)} {diagnosis.message(b)}".rstrip())
    return "\n".join([*lines, *notes])


def _rms(millimetres: float) -> str:
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
