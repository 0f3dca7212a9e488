"""RESULT: what the estimate found, as JSON for people and scripts or NPZ for large batches (docs/files.md)."""

import csv
import io
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..analysis.alternatives import Solution
from ..analysis.count import Evidence
from ..analysis.diagnosis import Diagnosis
from ..analysis.noise import Noise
from ..estimation.draws import Method
from ..estimation.intervals import Intervals, interval_of
from ..estimation.load_places import LoadPlaces
from ..estimation.load_profile import Profile
from ..estimation.result import Estimate, FittedRod
from ..mechanics.lie import move
from ..util.errors import InputError, shown
from ..util.files import put, put_text, reading
from ..util.status import Status
from .base_pose import BasePose
from .json_file import plain
from .npz_file import UNREADABLE, why

RESULT_SUFFIXES = (".json", ".npz", ".csv")


# What a record is made of: worked out once for the whole batch, and turned to plain numbers once.
COLUMNS = (
    *("force", "net_force", "magnitude", "magnitude_std", "magnitude_interval", "location", "location_std", "location_interval"),
    *("width", "magnitude_location_covariance", "rms_residual", "status", "accepted", "iterations", "restarts", "warm_started"),
    *("chi2", "dof", "base_wrench", "tip", "registration", "tension", "tension_std", "parameters", "parameters_std"),
    *("axial", "axial_std"),
)
Columns = dict[str, list[Any]]
WITH_UNITS = {
    "force_local_N": "force",
    "magnitude_N": "magnitude",
    "magnitude_std_N": "magnitude_std",
    "location_m": "location",
    "location_std_m": "location_std",
    "width_m": "width",
    "force_axial_N": "axial",
    "force_axial_std_N": "axial_std",
    "rms_residual_m": "rms_residual",
}
AXIAL = ("force_axial_N", "force_axial_std_N")  # only where the force along the rod is unknown
LOAD_NUMBERS = {name: field for name, field in WITH_UNITS.items() if name not in ("force_local_N", "rms_residual_m", *AXIAL)}


# Of each load, with the units in their names: in RESULT.json, as columns of LOADS.csv and as arrays of RESULT.npz.
SPACE = ("force_base_N", "position_m", "force_lab_N", "position_lab_m")


@dataclass(frozen=True)
class Result:
    """What is written of an estimate of B samples; None and () for what is not known of it.

    samples: their names. robot: its name. evidence: for each number of loads, where it was chosen from the data. profile: f(s) of
    every sample (torchrod.load_profile). diagnosis: the mistake behind fits that are not accepted (torchrod.diagnose). noise: where
    it was estimated. places: of the loads in space (torchrod.Analysis.places). base: where the robot stands in the lab. time: of
    the samples (s). intervals: from draws of the posterior (estimation.intervals), which then stand in place of the normal ones.
    parameters: the names of the robot's parameters that were unknown.
    """

    estimate: Estimate
    samples: Sequence[str]
    robot: str
    evidence: Evidence | None = None
    profile: Profile | None = None
    diagnosis: Diagnosis | None = None
    noise: Noise | None = None
    places: LoadPlaces | None = None
    base: BasePose | None = None
    time: Float[Tensor, " B"] | None = None
    intervals: Intervals | None = None
    parameters: Sequence[str] = ()

    @cached_property
    def messages(self) -> list[str]:
        """What became of every sample, and what is wrong with it."""
        said, diagnosis = self.estimate.messages, self.diagnosis
        return said if diagnosis is None else [f"{text} {diagnosis.message(b)}".rstrip() for b, text in enumerate(said)]


def _in_space(result: Result) -> dict[str, Tensor]:
    """Forces and places (B, K, 3) of all loads: in the robot's base frame and, where that is known, in the lab's.

    An error of the base frame that was estimated has moved the robot in the lab, not in its own frame.
    """
    estimate, base = result.estimate, result.base
    if result.places is None:
        return {}
    force, position = result.places.force, result.places.position
    found = {"force_base_N": force, "position_m": position}
    if base is not None:
        zeta = torch.zeros_like(estimate.base_wrench) if estimate.registration is None else estimate.registration
        turn = torch.cat([torch.zeros_like(zeta[:, :3]), zeta[:, 3:]], -1)
        found |= {"force_lab_N": base.turned(move(turn, force)), "position_lab_m": base.to_lab(move(zeta, position))}
        if estimate.tip is not None:
            found["tip_force_lab_N"] = base.turned(move(turn, estimate.tip[:, None, :3])).squeeze(1)
    return found


def _columns(result: Result) -> Columns:
    estimate, drawn = result.estimate, result.intervals
    found = {name: getattr(estimate, name) for name in COLUMNS} | _in_space(result)
    if drawn is not None:
        found |= {f"{name}_interval": interval_of(estimate, drawn, name) for name in ("magnitude", "location")}
        found |= {"drawn_force": drawn.force, "resultant": drawn.resultant, "k_hat": drawn.k_hat, "ess": drawn.ess}
        found |= {"method": drawn.method, "tip_interval": drawn.tip, "axial_interval": drawn.axial}
    if estimate.tip_covariance is not None:
        found["tip_std"] = estimate.tip_covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    if bool(estimate.outlier.any()):
        found["outlier"] = estimate.outlier
    return {name: value.tolist() for name, value in found.items() if value is not None}


def _numbers(value: object) -> str:
    """JSON of numbers by their names, with null for what is not known: JSON has no NaN and no infinity."""
    text = json.dumps(value)
    if "NaN" in text or "Infinity" in text:
        text = text.replace("NaN", "null").replace("-Infinity", "null").replace("Infinity", "null")
    return text


def _axial(of: Columns, b: int, k: int, name: str) -> dict[str, object]:
    """The entry of the force along the rod, where that is unknown."""
    return {"force_axial_N": of[name][b][k]} if name in of else {}


def _loads(of: Columns, b: int) -> list[dict[str, object]]:
    return [
        {
            "force_local_N": force,
            **_axial(of, b, k, "axial"),
            "magnitude_N": of["magnitude"][b][k],
            "location_m": of["location"][b][k],
            "width_m": of["width"][b][k],
            **{name: of[name][b][k] for name in SPACE if name in of},
            "net_force_local_N": of["net_force"][b][k],
            "covariance": of["magnitude_location_covariance"][b][k],
            "std": {"magnitude_N": of["magnitude_std"][b][k], "location_m": of["location_std"][b][k]}
            | _axial(of, b, k, "axial_std"),
            "interval_95": {"magnitude_N": of["magnitude_interval"][b][k], "location_m": of["location_interval"][b][k]}
            | ({"force_local_N": of["drawn_force"][b][k]} if "drawn_force" in of else {})
            | _axial(of, b, k, "axial_interval"),
        }
        for k, force in enumerate(of["force"][b])
        if not math.isnan(force[0])
    ]


def _solution(other: Solution) -> dict[str, object]:
    loads = [{"force_local_N": f, "location_m": s} for f, s in zip(other.force.tolist(), other.location.tolist(), strict=True)]
    tip = {} if other.tip is None else {"tip": {"force_N": other.tip[:3].tolist(), "moment_Nm": other.tip[3:].tolist()}}
    return {"chi2": other.chi2, "loads": loads, **tip}


def _record(of: Columns, b: int, sample: str, message: str) -> dict[str, str]:
    """One sample's entry of RESULT.json: by each key the JSON of its value."""
    whole = sample.isascii() and sample.isdecimal() and len(sample) < 16 and str(int(sample)) == sample
    wrench = of["base_wrench"][b]
    record = {
        "sample": sample if whole else json.dumps(sample),
        "status": json.dumps(Status(of["status"][b]).label),
        "accepted": json.dumps(of["accepted"][b]),
        "message": json.dumps(message),
        "iterations": str(of["iterations"][b]),
        "restarts": str(of["restarts"][b]),
        "warm_started": json.dumps(of["warm_started"][b]),
        "chi2": _numbers(of["chi2"][b]),
        "dof": str(of["dof"][b]),
        "rms_residual_m": _numbers(of["rms_residual"][b]),
        "loads": _numbers(_loads(of, b)),
        "base_wrench": _numbers({"force_N": wrench[:3], "moment_Nm": wrench[3:]}),
    }
    if "tip_std" in of:
        tip, std = of["tip"][b], of["tip_std"][b]
        spread = {"force_N": std[:3], "moment_Nm": std[3:]}
        lab = {"force_lab_N": of["tip_force_lab_N"][b]} if "tip_force_lab_N" in of else {}
        content = {"force_N": tip[:3], "moment_Nm": tip[3:], **lab, "std": spread}
        if "tip_interval" in of:
            content["interval_95"] = {"force_N": of["tip_interval"][b][:3], "moment_Nm": of["tip_interval"][b][3:]}
        record["tip"] = _numbers(content)
    if "method" in of:
        whole = of["resultant"][b]
        record["resultant"] = _numbers({"interval_95": {"force_base_N": whole[:3], "magnitude_N": whole[3]}})
        record["draws"] = _numbers({"method": Method(of["method"][b]).label, "k_hat": of["k_hat"][b], "ess": of["ess"][b]})
    if "registration" in of:
        twist = of["registration"][b]
        record["registration"] = _numbers({"translation_m": twist[:3], "rotation_rad": twist[3:]})
    if "tension_std" in of:
        record["tensions"] = _numbers({"tension_N": of["tension"][b], "std": {"tension_N": of["tension_std"][b]}})
    if "outlier" in of and any(of["outlier"][b]):
        record["outliers"] = json.dumps([i + 1 for i, left in enumerate(of["outlier"][b]) if left])
    return record


def _rounded(value: np.ndarray, largest: float) -> list[object]:
    """Numbers for a person to read, to five digits of the largest."""
    unit = 10.0 ** (5 - math.ceil(math.log10(largest)) if largest > 0 else 0)
    return (np.rint(value * unit) / unit + 0.0).tolist() if math.isfinite(unit) and unit > 0 else value.tolist()


def _profile(profile: Profile, b: int) -> str:
    """The load profile of one sample on one line: a number to a line would be 800 lines. Null where f or a band is not known."""
    s, f, band = profile.s.numpy(), profile.f[b].numpy(), profile.band[b].numpy()
    if not np.isfinite(f).all():
        return "null"
    seen = [np.abs(f).max(initial=0.0), np.abs(band[np.isfinite(band)]).max(initial=0.0)]
    largest = float(max(seen))
    of = {name: _rounded(band[:, i], largest) for i, name in enumerate(("fx", "fy", "magnitude"))}
    content = {"s_m": _rounded(s, float(s.max())), "f_local_N_per_m": _rounded(f, largest), "band_95": of}
    return _numbers(content)


def _evidence(evidence: Evidence, b: int) -> dict[str, object]:
    every = zip(evidence.names, evidence.bic[b].tolist(), evidence.foreseen[b].tolist(), strict=True)
    rows = [row for row in every if row[0] not in evidence.spare or not math.isnan(row[1])]
    by_draws: dict[str, object] = {}
    if evidence.probability is not None:
        shares = zip(evidence.names, evidence.probability[b].tolist(), strict=True)
        by_draws["probability"] = {name: plain(share) for name, share in shares if share > 0}
        if evidence.something is not None:
            by_draws["probability_of_any_load"] = plain(float(evidence.something[b]))
    return {
        "chosen": evidence.names[int(evidence.choice[b])],
        **by_draws,
        "bic": {name: plain(value) for name, value, _ in rows},
        "not_converged": [name for name, value, _ in rows if math.isinf(value)],
        "bic_foreseen": {name: plain(promised) for name, value, promised in rows if math.isnan(value)},
    }


def _texts(result: Result) -> Iterator[str]:
    """The entry of every sample, one after the other: all of them at once would take more memory than the fit."""
    of, messages = _columns(result), result.messages
    evidence, profile, diagnosis, noise = result.evidence, result.profile, result.diagnosis, result.noise
    time = None if result.time is None else result.time.tolist()
    for b, name in enumerate(result.samples):
        record = _record(of, b, name, messages[b])
        if time is not None:
            record["time_s"] = _numbers(time[b])
        if result.parameters:
            found = zip(result.parameters, of["parameters"][b], of["parameters_std"][b], strict=True)
            record["parameters"] = _numbers({name: {"error": error, "std": std} for name, error, std in found})
        if evidence is not None:
            record["evidence"] = json.dumps(_evidence(evidence, b))
        if diagnosis is not None:
            record["suspect_markers"] = json.dumps(diagnosis.suspects(b))
            if diagnosis.others and diagnosis.others[b]:
                record["other_solutions"] = _numbers([_solution(other) for other in diagnosis.others[b]])
        if noise is not None:
            record["noise"] = _numbers({"noise_m": float(noise.sigma[b]), "std_m": float(noise.std[b])})
        if profile is not None:
            record["profile"] = _profile(profile, b)
        yield "{\n" + ",\n".join(f' "{key}": {text}' for key, text in record.items()) + "\n}"


def _load_table(result: Result) -> str:
    """A row for each load of each sample, the tip's last, and one for a sample without any."""
    of = _columns(result)
    vectors = {"force_local_N": "force", **{name: name for name in SPACE if name in of}}
    parts = {name: "xyz"[: 2 if name == "force_local_N" else 3] for name in vectors}
    single = LOAD_NUMBERS | {name: WITH_UNITS[name] for name in AXIAL if WITH_UNITS[name] in of}
    ends = {"magnitude_N": "magnitude_interval", "location_m": "location_interval"}
    header = ["time_s", "sample", "status", "accepted", "load", *single]
    header += [f"{name.rpartition('_')[0]}_{end}_{name.rpartition('_')[2]}" for name in ends for end in ("low", "high")]
    header += [f"{name.rpartition('_')[0]}_{axis}_{name.rpartition('_')[2]}" for name, axes in parts.items() for axis in axes]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for b, name in enumerate(result.samples):
        head = ["" if result.time is None else float(result.time[b]), name, Status(of["status"][b]).label, int(of["accepted"][b])]
        loads = [k for k, v in enumerate(of["location"][b]) if not math.isnan(v)]
        for k in loads:
            numbers = [of[field][b][k] for field in single.values()]
            numbers += [v for field in ends.values() for v in of[field][b][k]]
            numbers += [v for field in vectors.values() for v in of[field][b][k]]
            writer.writerow([*head, k + 1, *("" if math.isnan(v) else v for v in numbers)])
        tip = {f"force_base_{axis}_N": v for axis, v in zip("xyz", of["tip"][b], strict=False)} if "tip" in of else {}
        if tip and not math.isnan(tip["force_base_x_N"]):
            if "tip_force_lab_N" in of:
                tip |= {f"force_lab_{axis}_N": v for axis, v in zip("xyz", of["tip_force_lab_N"][b], strict=True)}
            tip["magnitude_N"] = math.hypot(*of["tip"][b][:3])
            tip["magnitude_std_N"] = _std_of_size(of["tip"][b][:3], result, b)
            writer.writerow([*head, "tip", *(tip.get(name, "") for name in header[len(head) + 1 :])])
        elif not loads:
            writer.writerow([*head, *[""] * (len(header) - len(head))])
    return text.getvalue()


def _std_of_size(F: list[float], result: Result, b: int) -> float | str:
    """Of |F| at the tip (N), to first order; "" where it is not known."""
    covariance, size = result.estimate.tip_covariance, math.hypot(*F)
    if covariance is None or not size > 0:
        return ""
    way = torch.tensor(F, dtype=covariance.dtype) / size
    std = float((way @ covariance[b, :3, :3] @ way).clamp(min=0).sqrt())
    return "" if math.isnan(std) else std


def _stream(file: IO[bytes], result: Result, texts: Iterator[str]) -> None:
    markers = result.estimate.outlier.shape[1]
    file.write(f'{{"robot": {json.dumps(result.robot)}, "markers": {markers}, "results": [\n'.encode())
    for b, text in enumerate(texts):
        file.write((",\n" * (b > 0) + text).encode())
    file.write(b"\n]}\n")


def _arrays(result: Result) -> dict[str, np.ndarray]:
    """The content of RESULT.npz."""
    estimate, evidence, intervals, noise, profile = result.estimate, result.evidence, result.intervals, result.noise, result.profile
    texts = result.messages
    place = {text: i for i, text in enumerate(sorted(set(texts)))}
    names = {"sample": np.array(result.samples), "robot": np.array(result.robot), "messages": np.array(list(place))}
    names["message"] = np.array([place[text] for text in texts])
    if result.parameters:
        names["parameter_names"] = np.array(list(result.parameters))
    arrays = {f.name: getattr(estimate, f.name) for f in fields(Estimate)}
    if evidence is not None:
        arrays |= {"hypothesis": evidence.choice, "bic": evidence.bic, "bic_foreseen": evidence.foreseen}
        names["hypotheses"] = np.array(evidence.names)
        arrays["probability"] = evidence.probability
    for name in ("magnitude_location_covariance", "warm_started"):
        arrays[name] = getattr(estimate, name)
    arrays |= {f"{name}_interval": interval_of(estimate, intervals, name) for name in ("magnitude", "location")}
    if intervals is not None:
        arrays |= {"force_interval": intervals.force, "resultant_interval": intervals.resultant, "tip_interval": intervals.tip}
        arrays["axial_interval"] = intervals.axial
        arrays |= {"k_hat": intervals.k_hat, "ess": intervals.ess, "draws_method": intervals.method}
    if noise is not None:
        arrays |= {"noise": noise.sigma, "noise_std": noise.std}
    if profile is not None:
        arrays |= {"profile_s": profile.s, "profile_f": profile.f.float(), "profile_band": profile.band.float()}
    arrays |= _in_space(result) | {name: getattr(estimate, field) for name, field in WITH_UNITS.items()} | {"time_s": result.time}
    return names | {k: v.numpy() for k, v in arrays.items() if v is not None}


def write_result(path: str | Path, result: Result) -> None:
    """RESULT.json, RESULT.npz with the fields of torchrod.Estimate as arrays, or LOADS.csv with a row for each load.

    Errors: InputError for another suffix, for more or fewer names than samples, and where the file cannot be written.
    """
    path, samples = Path(path), len(result.estimate.status)
    if path.suffix not in RESULT_SUFFIXES:
        raise InputError(f"{path}: results are written as .json, .npz or .csv; change the suffix")
    if len(result.samples) != samples:
        raise InputError(f"{path}: {len(result.samples)} names for {samples} samples; give every sample its name")
    if path.suffix == ".csv":
        put_text(path, _load_table(result))
    elif path.suffix == ".json":
        put(path, lambda file: _stream(file, result, _texts(result)))
    else:
        content = _arrays(result)
        # Uncompressed: deflating random digits takes six times as long as estimating them, and saves a third.
        put(path, lambda file: np.savez(file, **content))  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True)
class _Asked:
    """Which fit of which file, and what it has to be of where that is known: the robot's name, its length (m), how many markers."""

    path: Path
    sample: str
    robot: str | None
    markers: int | None
    length: float | None

    def index(self, names: list[str]) -> int:
        if self.sample not in names:
            raise InputError(f"{self.path}: has no sample {self.sample}; choose one of those estimated with --sample")
        return names.index(self.sample)

    def check(self, robot: object, markers: int | None) -> None:
        """Refuse a result of another robot or of other shapes; None in the file goes through."""
        if None not in (robot, self.robot) and robot != self.robot:
            raise InputError(f"{self.path}: is of robot {shown(robot)}, not of {self.robot!r}; give the robot that was estimated")
        if None not in (markers, self.markers) and markers != self.markers:
            raise InputError(f"{self.path}: is of {markers} markers, not of {self.markers}; give the shapes that were estimated")

    def check_places(self, fit: FittedRod) -> None:
        """Refuse loads where this robot has no rod: its length or its unit has been changed since."""
        places = [fit.location] if fit.profile is None else [fit.location, fit.profile.s]
        farthest = max([float(p.max()) for p in places if p.numel()], default=0.0)
        nearest = min([float(p.min()) for p in places if p.numel()], default=0.0)
        if self.length is not None and not (nearest >= 0 and farthest <= self.length * (1 + 1e-6)):
            place = farthest if nearest >= 0 else nearest
            raise InputError(
                f"{self.path}: has loads at s = {place:g} m, and the rod runs from 0 to {self.length:g} m; "
                "give the robot as it was when the loads were estimated, or estimate them again"
            )


def _there(values: list[float | None]) -> list[float | None] | None:
    """Nothing where every number is unknown: a tip that the data did not ask for."""
    return None if all(v is None or math.isnan(v) for v in values) else values


Values = dict[str, object]


def _arrays_of(asked: _Asked, opened: IO[bytes]) -> tuple[Values, Values | None]:
    """What a figure needs of a RESULT.npz; the profile."""
    with np.load(opened, allow_pickle=False) as file:
        asked.check(str(file["robot"]) if "robot" in file else None, file["outlier"].shape[1] if "outlier" in file else None)
        b = asked.index([str(n) for n in file["sample"]])
        values: Values = {key: file[key][b] for key in ("force", "location", "width", "base_wrench")}
        values["registration"] = file["registration"][b] if "registration" in file else None
        values["tip"] = _there(file["tip"][b][:3].tolist()) if "tip" in file else None
        values["interval"] = file["location_interval"][b] if "location_interval" in file else None
        values["axial"] = file["axial"][b] if "axial" in file else None
        if "parameter_names" in file and "parameters" in file:
            names = [str(name) for name in file["parameter_names"]]
            values["errors"] = dict(zip(names, file["parameters"][b].tolist(), strict=True))
        if "profile_f" not in file:
            return values, None
        return values, {"s": file["profile_s"], "f": file["profile_f"][b], "band": file["profile_band"][b]}


def _record_of(asked: _Asked, opened: IO[bytes]) -> tuple[Values, Values | None]:
    """The same of a RESULT.json."""
    content = json.load(opened)
    results = content["results"]
    asked.check(content.get("robot"), content.get("markers"))
    record = results[asked.index([str(r["sample"]) for r in results])]
    loads, wrench = record["loads"], record["base_wrench"]
    keys = {"force": "force_local_N", "location": "location_m", "width": "width_m"}
    values: Values = {name: [load[key] for load in loads] for name, key in keys.items()}
    values["base_wrench"] = [*wrench["force_N"], *wrench["moment_Nm"]]
    twist = record.get("registration")
    values["registration"] = None if twist is None else [*twist["translation_m"], *twist["rotation_rad"]]
    values["tip"] = _there(record["tip"]["force_N"]) if "tip" in record else None
    values["interval"] = [load["interval_95"]["location_m"] for load in loads]
    values["axial"] = [load["force_axial_N"] for load in loads] if any("force_axial_N" in load for load in loads) else None
    values["errors"] = {name: p["error"] for name, p in record["parameters"].items()} if "parameters" in record else {}
    profile = record.get("profile")
    if profile is None:
        return values, None
    band = np.stack([np.array(profile["band_95"][key], dtype=float) for key in ("fx", "fy", "magnitude")], 1)
    return values, {"s": profile["s_m"], "f": profile["f_local_N_per_m"], "band": band}


def _tensor(values: Values, name: str, *shape: int) -> Float[Tensor, "..."] | None:
    """Numbers of a shape; of no number the empty tensor of that shape. Errors: ValueError."""
    if values[name] is None:
        return None
    found = np.array(values[name], dtype=float)
    if found.size == 0 and 0 in shape:
        found = found.reshape(shape)
    if found.shape != shape:
        raise ValueError(f"{name} has shape {found.shape}, not {shape}")
    return torch.tensor(found)


def _fit_of(values: Values, stored: Values | None) -> FittedRod:
    K = len(values["location"])  # pyright: ignore[reportArgumentType]
    force, location, width = _tensor(values, "force", K, 2), _tensor(values, "location", K), _tensor(values, "width", K)
    wrench, zeta, tip = (_tensor(values, name, n) for name, n in (("base_wrench", 6), ("registration", 6), ("tip", 3)))
    interval, axial, profile = _tensor(values, "interval", K, 2), _tensor(values, "axial", K), None
    if force is None or location is None or width is None or wrench is None:
        raise ValueError("its loads are null")
    if stored is not None:
        S = len(stored["s"])  # pyright: ignore[reportArgumentType]
        s, f, band = _tensor(stored, "s", S), _tensor(stored, "f", S, 2), _tensor(stored, "band", S, 3, 2)
        if s is None or f is None or band is None:
            raise ValueError("its profile has no numbers")
        profile = Profile(s, f, band)
    there = torch.isfinite(force).all(-1)
    interval, axial = (None if value is None else value[there] for value in (interval, axial))
    errors = {str(name): float(error) for name, error in dict(values.get("errors") or {}).items()}  # pyright: ignore
    return FittedRod(force[there], location[there], width[there], wrench, zeta, tip, interval, profile, axial, errors)


def read_fit(
    path: str | Path, sample: str, robot: str | None = None, markers: int | None = None, length: float | None = None
) -> FittedRod:
    """One sample of a RESULT.json or RESULT.npz.

    robot, markers, length: the robot's name, the number of markers and the rod's length (m); a file that says otherwise is refused.
    Errors: InputError naming file, sample and remedy.
    """
    path = Path(path)
    if path.suffix == ".csv":
        raise InputError(f"{path}: a table of loads lacks what a figure needs; write RESULT.json by estimate --out, and plot that")
    with reading(path):
        if not path.is_file():
            raise InputError(f"{path}: no such file; write it with torchrod estimate --out")
        with path.open("rb") as opened:
            return _read_fit(_Asked(path, sample, robot, markers, length), opened)


def _read_fit(asked: _Asked, opened: IO[bytes]) -> FittedRod:
    try:
        fit = _fit_of(*(_arrays_of if asked.path.suffix == ".npz" else _record_of)(asked, opened))
    except InputError:
        raise
    except UNREADABLE as error:
        raise InputError(f"{asked.path}: is not a result of torchrod estimate ({why(error)}); write it with --out") from None
    numbers = [fit.force, fit.location, fit.width, fit.base_wrench, fit.registration, fit.tip_force, fit.axial]
    numbers.append(torch.tensor([*fit.errors.values(), 0.0]))
    if not all(bool(torch.isfinite(t).all()) for t in numbers if t is not None) or bool((fit.width < 0).any()):
        raise InputError(f"{asked.path}: sample {asked.sample} has no fit to draw; see its message")
    asked.check_places(fit)
    return fit
