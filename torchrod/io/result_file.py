"""RESULT: what the estimate found, as JSON for people and scripts or NPZ for large batches (docs/files.md)."""

import json
import math
import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from ..analysis.count import Evidence
from ..analysis.diagnosis import Diagnosis
from ..analysis.noise import Noise
from ..estimation.load_profile import Profile
from ..estimation.result import Estimate, FittedRod
from ..util.errors import InputError
from ..util.files import put, put_text, reading
from ..util.status import Status
from .json_file import plain

RESULT_SUFFIXES = (".json", ".npz")


def _loads(estimate: Estimate, b: int) -> list[dict[str, object]]:
    force, net = estimate.force[b].tolist(), estimate.net_force[b].tolist()
    pair = estimate.magnitude_location_covariance[b]
    return [
        {
            "force_local_N": [plain(v) for v in force[k]],
            "magnitude_N": plain(float(estimate.magnitude[b, k])),
            "location_m": plain(float(estimate.location[b, k])),
            "width_m": plain(float(estimate.width[b, k])),
            "net_force_local_N": [plain(v) for v in net[k]],
            "covariance": [[plain(v) for v in row] for row in pair[k].tolist()],
            "std": {
                "magnitude_N": plain(float(estimate.magnitude_std[b, k])),
                "location_m": plain(float(estimate.location_std[b, k])),
            },
            "interval_95": {
                "magnitude_N": [plain(v) for v in estimate.magnitude_interval[b, k].tolist()],
                "location_m": [plain(v) for v in estimate.location_interval[b, k].tolist()],
            },
        }
        for k in range(len(force))
        if not math.isnan(force[k][0])
    ]


def _message(estimate: Estimate, diagnosis: Diagnosis | None, b: int) -> str:
    return f"{estimate.message(b)} {'' if diagnosis is None else diagnosis.message(b)}".rstrip()


def result_record(estimate: Estimate, b: int, sample: str, diagnosis: Diagnosis | None = None) -> dict[str, object]:
    """One sample's entry of RESULT.json."""
    wrench = [plain(v) for v in estimate.base_wrench[b].tolist()]
    record: dict[str, object] = {
        "sample": int(sample)
        if sample.isascii() and sample.isdecimal() and len(sample) < 16 and str(int(sample)) == sample
        else sample,
        "status": Status(int(estimate.status[b])).label,
        "accepted": bool(estimate.accepted[b]),
        "message": _message(estimate, diagnosis, b),
        "iterations": int(estimate.iterations[b]),
        "restarts": int(estimate.restarts[b]),
        "warm_started": bool(estimate.warm_started[b]),
        "chi2": plain(float(estimate.chi2[b])),
        "dof": int(estimate.dof[b]),
        "rms_residual_m": plain(float(estimate.rms_residual[b])),
        "loads": _loads(estimate, b),
        "base_wrench": {"force_N": wrench[:3], "moment_Nm": wrench[3:]},
    }
    if estimate.tip is not None and estimate.tip_covariance is not None:
        tip = [plain(v) for v in estimate.tip[b].tolist()]
        std = [plain(v) for v in estimate.tip_covariance[b].diagonal().clamp(min=0).sqrt().tolist()]
        record["tip"] = {"force_N": tip[:3], "moment_Nm": tip[3:], "std": {"force_N": std[:3], "moment_Nm": std[3:]}}
    if estimate.registration is not None:
        twist = [plain(v) for v in estimate.registration[b].tolist()]
        record["registration"] = {"translation_m": twist[:3], "rotation_rad": twist[3:]}
    if estimate.tension is not None and estimate.tension_std is not None:
        values, stds = ([plain(v) for v in x[b].tolist()] for x in (estimate.tension, estimate.tension_std))
        record["tensions"] = {"tension_N": values, "std": {"tension_N": stds}}
    if bool(estimate.outlier[b].any()):
        record["outliers"] = [i + 1 for i in estimate.outlier[b].nonzero().flatten().tolist()]
    return record


def _rounded(value: Tensor, largest: float) -> list[object]:
    """Numbers for a person to read, to five digits of the largest; null for the unknown."""
    if value.ndim > 1:
        return [_rounded(v, largest) for v in value]
    places = 5 - math.ceil(math.log10(largest)) if largest > 0 else 0
    return [round(v, places) + 0.0 if math.isfinite(v) else None for v in value.tolist()]


def _profile(profile: Profile) -> str:
    """The load profile of one sample on one line: a number to a line would be 800 lines."""
    largest = float(torch.cat([profile.f.flatten(), profile.band.flatten()]).nan_to_num(0.0).abs().max())
    band = {name: _rounded(profile.band[:, i], largest) for i, name in enumerate(("fx", "fy", "magnitude"))}
    f = _rounded(profile.f, largest)
    known = f[0] is not None and bool(torch.isfinite(profile.f).all())
    content = {"s_m": _rounded(profile.s, float(profile.s.max())), "f_local_N_per_m": f, "band_95": band}
    return json.dumps(content if known else None, separators=(",", ":"))


def _evidence(evidence: Evidence, b: int) -> dict[str, object]:
    rows = list(zip(evidence.names, evidence.bic[b].tolist(), evidence.foreseen[b].tolist(), strict=True))
    return {
        "chosen": evidence.names[int(evidence.choice[b])],
        "bic": {name: plain(value) for name, value, _ in rows},
        "not_converged": [name for name, value, _ in rows if math.isinf(value)],
        "bic_foreseen": {name: plain(promised) for name, value, promised in rows if math.isnan(value)},
    }


def write_result(
    path: str | Path,
    estimate: Estimate,
    samples: list[str],
    robot: str,
    evidence: Evidence | None = None,
    profile: Profile | None = None,
    diagnosis: Diagnosis | None = None,
    noise: Noise | None = None,
) -> None:
    """RESULT.json, or RESULT.npz with the fields of torchrod.Estimate as arrays.

    evidence: for each number of loads, where it was chosen from the data. profile: f(s) of every sample (torchrod.load_profile).
    diagnosis: the mistake behind fits that are not accepted (torchrod.diagnose). noise: where it was estimated.
    Errors: InputError for another suffix, and where the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in RESULT_SUFFIXES:
        raise InputError(f"{path}: results are written as .json or .npz; change the suffix")
    if path.suffix == ".json":
        records = [result_record(estimate, b, name, diagnosis) for b, name in enumerate(samples)]
        for b, record in enumerate(records if evidence is not None else ()):
            record["evidence"] = _evidence(evidence, b)  # pyright: ignore[reportArgumentType]
        for b, record in enumerate(records if diagnosis is not None else ()):
            record["suspect_markers"] = diagnosis.suspects(b)  # pyright: ignore[reportOptionalMemberAccess]
        for b, record in enumerate(records if noise is not None else ()):
            record["noise"] = {"noise_m": plain(float(noise.sigma[b])), "std_m": plain(float(noise.std[b]))}  # pyright: ignore[reportOptionalMemberAccess]
        texts = [json.dumps(record, indent=1) for record in records]
        if profile is not None:
            texts = [f'{text[:-2]},\n "profile": {_profile(profile.of(b))}\n}}' for b, text in enumerate(texts)]
        put_text(path, f'{{"robot": {json.dumps(robot)}, "results": [\n' + ",\n".join(texts) + "\n]}\n")
        return
    said, which = np.unique([_message(estimate, diagnosis, b) for b in range(len(samples))], return_inverse=True)
    names = {"sample": np.array(samples), "robot": np.array(robot), "messages": said, "message": which}
    arrays = {f.name: getattr(estimate, f.name) for f in fields(Estimate)}
    if evidence is not None:
        arrays |= {"hypothesis": evidence.choice, "bic": evidence.bic, "bic_foreseen": evidence.foreseen}
        names["hypotheses"] = np.array(evidence.names)
    for name in ("magnitude_location_covariance", "location_interval", "warm_started"):
        arrays[name] = getattr(estimate, name)
    if noise is not None:
        arrays |= {"noise": noise.sigma, "noise_std": noise.std}
    if profile is not None:
        arrays |= {"profile_s": profile.s, "profile_f": profile.f.float(), "profile_band": profile.band.float()}
    content = names | {k: v.numpy() for k, v in arrays.items() if v is not None}
    # Uncompressed: deflating random digits takes six times as long as estimating them, and saves a third.
    put(path, lambda file: np.savez(file, **content))  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True)
class _Asked:
    """Which fit of which file, and what it has to be of where that is known: the robot's name, the number of markers."""

    path: Path
    sample: str
    robot: str | None
    markers: int | None

    def index(self, names: list[str]) -> int:
        if self.sample not in names:
            raise InputError(f"{self.path}: has no sample {self.sample}; choose one of those estimated with --sample")
        return names.index(self.sample)

    def check(self, robot: object, markers: int | None) -> None:
        """Refuse a result of another robot or of other shapes; None in the file goes through."""
        if None not in (robot, self.robot) and robot != self.robot:
            raise InputError(f"{self.path}: is of robot {robot!r}, not of {self.robot!r}; give the robot that was estimated")
        if None not in (markers, self.markers) and markers != self.markers:
            raise InputError(f"{self.path}: is of {markers} markers, not of {self.markers}; give the shapes that were estimated")


def _there(values: list[float | None]) -> list[float | None] | None:
    """Nothing where every number is unknown: a tip that the data did not ask for."""
    return None if all(v is None or math.isnan(v) for v in values) else values


def _arrays_of(asked: _Asked, opened: IO[bytes]) -> tuple[list[object], list[object] | None]:
    """What a figure needs of a RESULT.npz: force, location, width, base wrench, registration, tip force, intervals; the profile."""
    with np.load(opened, allow_pickle=False) as file:
        asked.check(str(file["robot"]) if "robot" in file else None, file["outlier"].shape[1] if "outlier" in file else None)
        b = asked.index([str(n) for n in file["sample"]])
        values: list[object] = [file[key][b] for key in ("force", "location", "width", "base_wrench")]
        values.append(file["registration"][b] if "registration" in file else None)
        values.append(_there(file["tip"][b][:3].tolist()) if "tip" in file else None)
        values.append(file["location_interval"][b] if "location_interval" in file else None)
        if "profile_f" not in file:
            return values, None
        return values, [file["profile_s"], file["profile_f"][b], file["profile_band"][b]]


def _record_of(asked: _Asked, opened: IO[bytes]) -> tuple[list[object], list[object] | None]:
    """The same of a RESULT.json."""
    content = json.load(opened)
    results = content["results"]
    asked.check(content.get("robot"), None)
    record = results[asked.index([str(r["sample"]) for r in results])]
    loads, wrench = record["loads"], record["base_wrench"]
    values: list[object] = [[load[key] for load in loads] for key in ("force_local_N", "location_m", "width_m")]
    values.append([*wrench["force_N"], *wrench["moment_Nm"]])
    twist = record.get("registration")
    values.append(None if twist is None else [*twist["translation_m"], *twist["rotation_rad"]])
    values.append(_there(record["tip"]["force_N"]) if "tip" in record else None)
    values.append([load["interval_95"]["location_m"] for load in loads])
    profile = record.get("profile")
    if profile is None:
        return values, None
    band = np.stack([np.array(profile["band_95"][key], dtype=float) for key in ("fx", "fy", "magnitude")], 1)
    return values, [profile["s_m"], profile["f_local_N_per_m"], band]


def read_fit(path: str | Path, sample: str, robot: str | None = None, markers: int | None = None) -> FittedRod:
    """One sample of a RESULT.json or RESULT.npz.

    robot, markers: the robot's name and the number of markers; a file that says otherwise is refused.
    Errors: InputError naming file, sample and remedy.
    """
    path = Path(path)
    with reading(path):
        if not path.is_file():
            raise InputError(f"{path}: no such file; write it with torchrod estimate --out")
        with path.open("rb") as opened:
            return _read_fit(_Asked(path, sample, robot, markers), opened)


def _read_fit(asked: _Asked, opened: IO[bytes]) -> FittedRod:
    try:
        values, stored = (_arrays_of if asked.path.suffix == ".npz" else _record_of)(asked, opened)
        *loads, wrench, zeta, tip, interval = [None if v is None else torch.tensor(np.array(v, dtype=float)) for v in values]
        profile = None if stored is None else Profile(*(torch.tensor(np.array(v, dtype=float)) for v in stored))
        force, location, width = (t.reshape(-1, 2) if i == 0 else t for i, t in enumerate(loads) if t is not None)
        there = torch.isfinite(force).all(-1)
        loads = [force[there], location[there], width[there]]
        interval = None if interval is None else interval.reshape(-1, 2)[there]
    except InputError:
        raise
    except (
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        AttributeError,
        EOFError,
        OSError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise InputError(f"{asked.path}: is not a result of torchrod estimate ({error}); write it with --out") from None
    if not all(bool(torch.isfinite(t).all()) for t in [*loads, wrench, zeta, tip] if t is not None):
        raise InputError(f"{asked.path}: sample {asked.sample} has no fit to draw; see its message")
    assert wrench is not None
    return FittedRod(loads[0], loads[1], loads[2], wrench, zeta, tip, interval, profile)
