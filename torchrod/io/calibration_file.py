"""CALIBRATION.json: what torchrod calibrate found (docs/files.md)."""

import math
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ..analysis.calibration import Calibration
from ..model.uncertainty import SHIFT, TURN
from .json_file import plain, put_json
from .uncertainty import Calibrated

CALIBRATION_SUFFIXES = (".json",)


def write_calibration(path: str | Path, calibration: Calibration, samples: list[str], robot: str, noise: float) -> None:
    """The record of a calibration as JSON. noise: as stated, m. Errors: InputError where the file cannot be written."""
    c = calibration
    content = {
        "robot": robot,
        "status": c.status.label,
        "accepted": c.accepted,
        "message": c.message,
        "iterations": c.iterations,
        "chi2": plain(c.chi2),
        "dof": c.dof,
        "rms_residual_m": plain(c.rms_residual),
        "noise_m": noise,
        "std_from": "residuals" if c.rescaled else "noise",
        "correlation": [[plain(v) for v in row] for row in c.correlation.tolist()],
        "cannot_be_told_apart": [list(pair) for pair in c.alike],
        "samples": [name for name, used in zip(samples, c.used.tolist(), strict=True) if used],
        "left_out": [name for name, used in zip(samples, c.used.tolist(), strict=True) if not used],
        "parameters": [
            {
                "name": name,
                "unit": c.units[i],
                "before": plain(float(c.before[i])),
                "after": plain(float(c.values[i])),
                "std": plain(float(c.std[i])),
                "std_noise": plain(float(c.std_noise[i])),
                "interval_95": [plain(v) for v in c.interval_95[i].tolist()],
                "determined": name not in c.undetermined,
            }
            for i, name in enumerate(c.names)
        ],
    }
    put_json(path, content)


IN_PLACE = ("mass", "stiffness")  # whose values stand where the file has them, and tension_offset_1, ..


def calibrated_by(found: Calibration, noise: float, s: Float[Tensor, " P"] | None) -> Calibrated:
    """[calibration] of what was found.

    noise: as stated (m); written is what the residuals show, where that is larger. s: (m), of the markers, where they are said to
    be off by what is left over on average; the noise is then that about it, and of how sure it is.
    """
    values = {}
    for unknown, z in zip(found.unknowns, found.z.tolist(), strict=True):
        if unknown.parameter is not None:
            name = unknown.parameter.name
            in_place = name in IN_PLACE or name.startswith("tension_offset")
            values[name] = 0.0 if in_place else unknown.error(z)
    if found.frame is not None:
        values |= dict(zip((*SHIFT, *TURN), found.frame.zeta.tolist(), strict=True))
    if s is None:
        return Calibrated(values, found.found, noise * math.sqrt(max(1.0, found.chi2 / max(found.dof, 1))))
    offsets = found.marker_offsets(s)
    about = found.residual - found.residual.nanmean(0)
    explained = float((found.residual.square() - about.square()).nansum()) / noise**2
    excess = (found.chi2 - explained) / max(found.dof - 3 * len(offsets), 1)
    sure = float(offsets[:, 4].square().mean())
    return Calibrated(values, found.found, math.sqrt(noise**2 * max(1.0, excess) + sure), offsets)
