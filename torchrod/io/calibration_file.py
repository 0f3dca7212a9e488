"""CALIBRATION.json: what torchrod calibrate found (docs/files.md)."""

from pathlib import Path

from ..analysis.calibration import Calibration
from .json_file import plain, put_json

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
