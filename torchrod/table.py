"""The table on the screen."""

import math

from .diagnosis import Diagnosis
from .noise import Noise
from .result import Estimate
from .status import Status


def table(result: Estimate, samples: list[str], diagnosis: Diagnosis, noise: Noise | None) -> str:
    """The table on the screen: one line per load."""
    columns = f"{'force (N)':>20}{'F_x (N)':>10}{'F_y (N)':>10}{'location (mm)':>20}{'rms (mm)':>10}"
    lines = [f"{'sample':>8}  {'status':<13} {'ok':<4}{'load':>4}{columns}"]
    notes = []
    for b, name in enumerate(samples):
        status = Status(int(result.status[b])).label
        ok = "yes" if result.accepted[b] else "no"
        rms = float(result.rms_residual[b]) * 1e3
        present = [k for k in range(result.force.shape[1]) if not math.isnan(float(result.force[b, k, 0]))]
        for k in present or [None]:
            head = f"{name:>8}  {status:<13} {ok:<4}" if k in (0, None) else " " * 28
            if k is None:
                none = "no load" if status != "invalid" else "-"
                lines.append(f"{head}{'-':>4}{none:>20}{'':>40}{rms:>10.3f}")
                continue
            force = f"{float(result.magnitude[b, k]):.4f} +- {float(result.magnitude_std[b, k]):.4f}"
            place = f"{float(result.location[b, k]) * 1e3:.1f} +- {float(result.location_std[b, k]) * 1e3:.1f}"
            fx, fy = result.force[b, k].tolist()
            lines.append(f"{head}{k + 1:>4}{force:>20} {fx:>9.4f} {fy:>9.4f}{place:>20} {rms:>9.3f}")
        if result.tip is not None and result.tip_covariance is not None and not bool(result.tip[b].isnan().all()):
            std = result.tip_covariance[b].diagonal().sqrt().tolist()
            both = [f"{v:.4f} +- {s:.4f}" for v, s in zip(result.tip[b].tolist(), std, strict=True) if s > 0 or math.isnan(s)]
            lines.append(f"{'':>28} tip, base frame: force (N) {', '.join(both[:3])}" + _moment(both[3:]))
        lines += _further(result, b, noise)
        if not result.accepted[b] or diagnosis.message(b):
            notes.append(f"sample {name}: {result.message(b)} {diagnosis.message(b)}".rstrip())
    return "\n".join([*lines, *notes])


def _moment(values: list[str]) -> str:
    return f"; moment (N m) {', '.join(values)}" if values else ""


def _further(result: Estimate, b: int, noise: Noise | None) -> list[str]:
    """What was estimated beside the loads, and the markers left aside."""
    said = []
    if result.tension is not None and result.tension_std is not None:
        pairs = zip(result.tension[b].tolist(), result.tension_std[b].tolist(), strict=True)
        said.append("tensions (N) " + ", ".join(f"{v:.3f} +- {std:.3f}" for v, std in pairs))
    if noise is not None and math.isnan(float(noise.sigma[b])):
        said.append("noise not known: too few markers to tell it")
    elif noise is not None:
        said.append(f"noise (mm) {1e3 * float(noise.sigma[b]):.3f} +- {1e3 * float(noise.std[b]):.3f}")
    if bool(result.outlier[b].any()):
        names = ", ".join(str(i + 1) for i in result.outlier[b].nonzero().flatten().tolist())
        said.append(f"left aside as outliers: markers {names}")
    return [f"{'':>28} {words}" for words in said]
