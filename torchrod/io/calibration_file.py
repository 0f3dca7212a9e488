"""CALIBRATION.json: what torchrod calibrate found (docs/files.md)."""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..analysis.calibration import Calibration
from ..estimation.shared import BaseFrame
from ..model.uncertainty import SHIFT, TURN, Found
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


def calibrated_by(found: Calibration, before: Calibrated | None, noise: float, s: Float[Tensor, " P"], offsets: bool) -> Calibrated:
    """[calibration] of what was found about a robot that may have been calibrated before.

    noise: as stated (m); written is what the residuals show, where that is larger. s: (m), of the markers; offsets: whether they
    are said to be off by what is left over.
    """
    old = before or Calibrated({}, Found((), torch.zeros(0, 0)))
    values = dict(old.values)
    for unknown, z in zip(found.unknowns, found.z.tolist(), strict=True):
        if unknown.parameter is None:
            continue
        name, error = unknown.parameter.name, unknown.error(z)
        if name in IN_PLACE or name.startswith("tension_offset"):
            values[name] = 0.0
        elif unknown.parameter.relative:
            values[name] = (1 + values.get(name, 0.0)) * (1 + error) - 1
        else:
            values[name] = values.get(name, 0.0) + error
    if found.frame is not None:
        zeta = BaseFrame(old.zeta, torch.zeros(6, 6)).moved_by(found.frame.zeta)
        values |= dict(zip((*SHIFT, *TURN), zeta.tolist(), strict=True))
    kept = [i for i, name in enumerate(old.found.names) if name not in found.found.names]
    names = (*found.found.names, *(old.found.names[i] for i in kept))
    covariance = torch.block_diag(found.found.covariance, old.found.covariance[kept][:, kept])
    return Calibrated(
        {name: values[name] for name in names},
        Found(names, covariance),
        noise * math.sqrt(max(1.0, found.chi2 / max(found.dof, 1))),
        found.marker_offsets(s) if offsets else old.markers,
    )
