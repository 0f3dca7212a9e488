"""RESULT: what the estimate found, as JSON for people and scripts or NPZ for large batches (docs/files.md)."""

import json
import math
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

from ..errors import InputError
from ..result import Estimate, Evidence, Fit
from ..status import Status

RESULT_SUFFIXES = (".json", ".npz")


def _plain(value: float) -> float | None:
    """JSON has no NaN: an unknown number is null."""
    return value if math.isfinite(value) else None


def _loads(estimate: Estimate, b: int) -> list[dict[str, object]]:
    force, net = estimate.force[b].tolist(), estimate.net_force[b].tolist()
    return [
        {
            "force_local_N": [_plain(v) for v in force[k]],
            "magnitude_N": _plain(float(estimate.magnitude[b, k])),
            "location_m": _plain(float(estimate.location[b, k])),
            "width_m": _plain(float(estimate.width[b, k])),
            "net_force_local_N": [_plain(v) for v in net[k]],
            "std": {
                "magnitude_N": _plain(float(estimate.magnitude_std[b, k])),
                "location_m": _plain(float(estimate.location_std[b, k])),
            },
            "interval_95": {
                "magnitude_N": [_plain(v) for v in estimate.magnitude_interval[b, k].tolist()],
                "location_m": [_plain(v) for v in estimate.location_interval[b, k].tolist()],
            },
        }
        for k in range(len(force))
        if not math.isnan(force[k][0])
    ]


def result_record(estimate: Estimate, b: int, sample: str) -> dict[str, object]:
    """One sample's entry of RESULT.json."""
    wrench = [_plain(v) for v in estimate.base_wrench[b].tolist()]
    record: dict[str, object] = {
        "sample": int(sample)
        if sample.isascii() and sample.isdecimal() and len(sample) < 16 and str(int(sample)) == sample
        else sample,
        "status": Status(int(estimate.status[b])).label,
        "accepted": bool(estimate.accepted[b]),
        "message": estimate.message(b),
        "iterations": int(estimate.iterations[b]),
        "restarts": int(estimate.restarts[b]),
        "warm_started": bool(estimate.warm_started[b]),
        "chi2": _plain(float(estimate.chi2[b])),
        "dof": int(estimate.dof[b]),
        "rms_residual_m": _plain(float(estimate.rms_residual[b])),
        "loads": _loads(estimate, b),
        "base_wrench": {"force_N": wrench[:3], "moment_Nm": wrench[3:]},
    }
    if estimate.tip is not None and estimate.tip_covariance is not None:
        tip = [_plain(v) for v in estimate.tip[b].tolist()]
        std = [_plain(v) for v in estimate.tip_covariance[b].diagonal().clamp(min=0).sqrt().tolist()]
        record["tip"] = {"force_N": tip[:3], "moment_Nm": tip[3:], "std": {"force_N": std[:3], "moment_Nm": std[3:]}}
    if estimate.registration is not None:
        twist = [_plain(v) for v in estimate.registration[b].tolist()]
        record["registration"] = {"translation_m": twist[:3], "rotation_rad": twist[3:]}
    return record


def _evidence(evidence: Evidence, b: int) -> dict[str, object]:
    bic = {name: _plain(value) for name, value in zip(evidence.names, evidence.bic[b].tolist(), strict=True)}
    return {"chosen": evidence.names[int(evidence.choice[b])], "bic": bic}


def write_result(path: str | Path, estimate: Estimate, samples: list[str], robot: str, evidence: Evidence | None = None) -> None:
    """RESULT.json, or RESULT.npz with the fields of torchrod.Estimate as arrays. Errors: InputError for another suffix.

    evidence: for each number of loads, where it was chosen from the data.
    """
    path = Path(path)
    if path.suffix not in RESULT_SUFFIXES:
        raise InputError(f"{path}: results are written as .json or .npz; change the suffix")
    if path.suffix == ".json":
        records = [result_record(estimate, b, name) for b, name in enumerate(samples)]
        for b, record in enumerate(records if evidence is not None else ()):
            record["evidence"] = _evidence(evidence, b)  # pyright: ignore[reportArgumentType]
        content = {"robot": robot, "results": records}
        path.write_text(json.dumps(content, indent=1), encoding="utf-8")
        return
    arrays = {f.name: getattr(estimate, f.name) for f in fields(Estimate)}
    if evidence is not None:
        arrays |= {"hypothesis": evidence.choice, "bic": evidence.bic}
    np.savez_compressed(
        path, sample=np.array(samples), robot=np.array(robot), **{k: v.numpy() for k, v in arrays.items() if v is not None}
    )


def _index(path: Path, names: list[str], sample: str) -> int:
    if sample not in names:
        raise InputError(f"{path}: has no sample {sample}; choose one of those estimated with --sample")
    return names.index(sample)


def read_fit(path: str | Path, sample: str) -> Fit:
    """One sample of a RESULT.json or RESULT.npz. Errors: InputError naming file, sample and remedy."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; write it with torchrod estimate --out")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                names = [str(n) for n in file["sample"]]
                b = _index(path, names, sample)
                values = [file[key][b] for key in ("force", "location", "width", "base_wrench")]
                zeta = file["registration"][b] if "registration" in file else None
                tip = file["tip"][b][:3] if "tip" in file else None
        else:
            results = json.loads(path.read_text(encoding="utf-8"))["results"]
            names = [str(r["sample"]) for r in results]
            record = results[_index(path, names, sample)]
            loads, wrench = record["loads"], record["base_wrench"]
            values = [[load[key] for load in loads] for key in ("force_local_N", "location_m", "width_m")]
            values.append([*wrench["force_N"], *wrench["moment_Nm"]])
            twist = record.get("registration")
            zeta = None if twist is None else [*twist["translation_m"], *twist["rotation_rad"]]
            tip = record["tip"]["force_N"] if "tip" in record else None
        tensors = [None if v is None else torch.tensor(np.array(v, dtype=float)) for v in (*values, zeta, tip)]
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: is not a result of torchrod estimate ({error}); write it with --out") from None
    force, location, width, *rest = tensors
    assert force is not None and location is not None and width is not None
    there = torch.isfinite(force.reshape(-1, 2)).all(-1)
    loads = [force.reshape(-1, 2)[there], location[there], width[there]]
    if not all(bool(torch.isfinite(t).all()) for t in [*loads, *rest] if t is not None):
        raise InputError(f"{path}: sample {sample} has no fit to draw; see its message")
    return Fit(*loads, *rest)  # pyright: ignore[reportArgumentType]
