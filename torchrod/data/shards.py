"""The folder of a data set: shards (NPZ) with a sidecar (JSON) each, and the manifest (JSON).

    shard-00000.npz    the arrays of data.dataset.ARRAYS; the same arrays make the same file, byte for byte
    shard-00000.json   its checksum; written after it, so a shard without a sidecar is not finished
    manifest.json      specification, units and checksums; written by whoever finds all sidecars
    spec.json          until then: the checksum of the first job's specification; whoever has another is refused

Every file is written beside its place and then moved there, so that a reader sees all of it or nothing. No two jobs of a cluster
share a file but the manifest, which is the same whoever writes it. Every refusal is one sentence with file and remedy.
"""

import hashlib
import json
import os
import uuid
import zipfile
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..io.json_file import put_json
from ..io.npz_file import UNREADABLE, read_arrays
from ..mechanics.pieces import Pieces
from ..mechanics.robot import Robot
from ..mechanics.rod import Rod
from ..mechanics.tendons import Tendon, Tendons
from ..util.errors import InputError
from ..util.files import put, writing
from .dataset import SCHEMA, DatasetSpec, digest

MANIFEST, CLAIM = "manifest.json", "spec.json"


@dataclass(frozen=True)
class Dataset:
    """N samples, float64, SI units; robot[i] is sample i's place in spec.robots and its row of s.

    s: (R, P) m. positions, positions_clean (noise-free): (N, P, 3) m, base frame. force: (N, K, 2) N on the rod, section frame.
    location, width: (N, K) m. base_wrench: (N, 6) N, N m. tension: (N, T) N. gravity: (N, 3) m/s^2, base frame.
    axial: (N, K) N, along the rod; None where no contact drags. digest: over the shards' checksums, in the manifest.
    """

    spec: DatasetSpec
    digest: str
    robot: Int[Tensor, " N"]
    s: Float[Tensor, "R P"]
    positions: Float[Tensor, "N P 3"]
    positions_clean: Float[Tensor, "N P 3"]
    force: Float[Tensor, "N K 2"]
    location: Float[Tensor, "N K"]
    width: Float[Tensor, "N K"]
    base_wrench: Float[Tensor, "N 6"]
    tension: Float[Tensor, "N T"]
    gravity: Float[Tensor, "N 3"]
    axial: Float[Tensor, "N K"] | None = None


def shard_path(folder: Path, index: int, suffix: str = ".npz") -> Path:
    """shard-00000.npz, or its sidecar .json."""
    return folder / f"shard-{index:05d}{suffix}"


def _write_npz(file: IO[bytes], arrays: dict[str, np.ndarray]) -> None:
    """As numpy.savez, but without the time of day and the system in it."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, value in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.create_system = 3
            with archive.open(entry, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, value, allow_pickle=False)


def _read_json(path: Path) -> dict[str, Any] | None:
    """The table in a JSON file, None where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _read_npz(path: Path, spec: DatasetSpec) -> dict[str, np.ndarray]:
    found = read_arrays(path)
    return {name: found[name] for name in spec.arrays}


def prepare_folder(folder: Path, spec: DatasetSpec) -> None:
    """Make the folder and those around it, or see that it holds shards of this specification. Errors: InputError otherwise."""
    with writing(folder):
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; give a folder")
        folder.mkdir(parents=True, exist_ok=True)
    for path in (folder / MANIFEST, *sorted(folder.glob("shard-*.json"))):
        _check_spec(folder, path, spec)
    _claim(folder, spec)


def _check_spec(folder: Path, path: Path, spec: DatasetSpec) -> None:
    content = _read_json(path)
    if content is not None and content.get("spec_sha256") != spec.sha256():
        raise InputError(f"{folder}: holds a data set of another specification ({path.name}); choose another folder or empty it")


def _claim(folder: Path, spec: DatasetSpec) -> None:
    """Say in the folder whose it is, before the first shard: of jobs that begin together the first is the one. Errors: InputError.

    A link to a whole file is made or refused at once, on one machine and over the network.
    """
    path, beside = folder / CLAIM, folder / f".{uuid.uuid4().hex}"
    if _read_json(path) is None:
        try:
            put_json(beside, {"schema": SCHEMA, "spec_sha256": spec.sha256()})
            if path.exists():  # it cannot be read, so it says nothing
                beside.replace(path)
            else:
                os.link(beside, path)
        except FileExistsError:
            pass  # another job was first
        except OSError:  # a file system without links
            put_json(path, {"schema": SCHEMA, "spec_sha256": spec.sha256()})
        finally:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
    _check_spec(folder, path, spec)


def write_shard(folder: Path, spec: DatasetSpec, index: int, arrays: dict[str, np.ndarray]) -> None:
    """A shard and, once it is there, its sidecar."""
    put(shard_path(folder, index), lambda file: _write_npz(file, arrays))
    put_json(shard_path(folder, index, ".json"), {"torchrod": version("torchrod"), **_sidecar(spec, index, arrays)})


def _sidecar(spec: DatasetSpec, index: int, arrays: dict[str, np.ndarray]) -> dict[str, object]:
    """What a sidecar says of its shard, but for the version that made it."""
    return {
        "schema": SCHEMA,
        "spec_sha256": spec.sha256(),
        "file": shard_path(Path(), index).name,
        "robot": spec.robot_of(index).name,
        "samples": len(arrays["force"]),
        "rejected": int(arrays["rejected"]),
        "sha256": digest(arrays),
    }


def has_shard(folder: Path, spec: DatasetSpec, index: int) -> bool:
    """Whether the shard is there, of this specification, and its sidecar says of it what it is."""
    record = _read_json(shard_path(folder, index, ".json"))
    if record is None or not isinstance(record.get("torchrod"), str):
        return False
    try:
        said = _sidecar(spec, index, _read_npz(shard_path(folder, index), spec))
        return all(record.get(key) == value for key, value in said.items())
    except UNREADABLE:
        return False


def write_manifest(folder: Path, spec: DatasetSpec) -> str | None:
    """The manifest from the sidecars, and the digest over all shards; None, and nothing is written, while one is missing."""
    keys = ("file", "robot", "samples", "rejected", "sha256")
    records = [_read_json(shard_path(folder, index, ".json")) for index in range(spec.shards)]
    shards = [r for r in records if r is not None and r.get("spec_sha256") == spec.sha256() and r.keys() >= {"torchrod", *keys}]
    if len(shards) < spec.shards:
        return None
    content = {
        "schema": SCHEMA,
        "torchrod": ", ".join(sorted({str(r["torchrod"]) for r in shards})),
        "digest": _over_all(shards),
        "seed": spec.seed,
        "samples": spec.samples,
        "spec_sha256": spec.sha256(),
        "spec": spec.record(),
        "arrays": {name: dict(zip(("shape", "unit", "meaning"), row, strict=True)) for name, row in spec.arrays.items()},
        "shards": [{key: r[key] for key in keys} for r in shards],
    }
    put_json(folder / MANIFEST, content)
    with suppress(OSError):  # the manifest says whose the folder is from now on
        (folder / CLAIM).unlink(missing_ok=True)
    return content["digest"]


def _over_all(shards: list[dict[str, Any]]) -> str:
    return hashlib.sha256("".join(str(record["sha256"]) for record in shards).encode()).hexdigest()


def _robot(record: dict[str, Any]) -> Robot:
    K_se, K_bt, curvature, gravity = (
        torch.tensor(record[key], dtype=torch.float64) for key in ("K_se", "K_bt", "reference_curvature", "gravity")
    )
    rod = Rod.from_stiffness(record["length"], K_se, K_bt, record["mass_per_length"], curvature)
    if "pieces" in record:
        parts = {name: torch.tensor(value, dtype=torch.float64) for name, value in record["pieces"].items()}
        rod = replace(rod, pieces=Pieces(**parts))
    if "masses" in record:
        rod = replace(rod, masses=torch.tensor(record["masses"], dtype=torch.float64))
    tendons = tuple(
        Tendon(
            tuple((s, x, y) for s, x, y in t["routing"]),
            t["ends_at"],
            **{name: t[name] for name in ("tension_offset", "tension_gain", "friction", "motion", "discs") if name in t},
        )
        for t in record["tendons"]
    )
    return Robot(rod, Tendons(tendons), gravity, record["name"])


def _spec(record: dict[str, Any]) -> DatasetSpec:
    """The specification of a manifest."""
    plain: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in record.items() if key not in ("schema", "robots")
    }
    return DatasetSpec(robots=tuple(_robot(r) for r in record["robots"]), **plain)


def read_dataset(folder: str | Path, verify: bool = False) -> Dataset:
    """The data set that torchrod simulate-dataset has written into a folder, as tensors.

    The manifest and the arrays' shapes are always checked, the checksums of their contents with verify=True.
    Errors: InputError naming file and remedy.
    """
    folder = Path(folder)
    manifest = _read_json(folder / MANIFEST)
    if manifest is None:
        raise InputError(f"{folder}: has no readable {MANIFEST}; let torchrod simulate-dataset make all of its shards")
    try:
        if manifest["schema"] != SCHEMA:
            raise InputError(f"{folder / MANIFEST}: has schema {manifest['schema']}, not {SCHEMA}; make the data set again")
        spec, shards = _spec(manifest["spec"]), manifest["shards"]
        sound = spec.sha256() == manifest["spec_sha256"] and _over_all(shards) == manifest["digest"]
    except UNREADABLE:
        sound, spec, shards = False, None, []
    if spec is None or not sound or len(shards) != spec.shards:
        raise InputError(f"{folder / MANIFEST}: is damaged; run torchrod simulate-dataset again to write it anew")
    arrays: dict[str, np.ndarray] = {}
    for index, record in enumerate(shards):
        _place(arrays, spec, index, shard_path(folder, index), record["sha256"] if verify else None)
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    of_shard = torch.arange(spec.samples) // spec.shard_size
    s = torch.stack([spec.arc_lengths(robot) for robot in spec.robots])
    return Dataset(spec, manifest["digest"], of_shard % len(spec.robots), s, **tensors)


def _place(arrays: dict[str, np.ndarray], spec: DatasetSpec, index: int, path: Path, sha256: str | None) -> None:
    """Copy a shard to its place among all samples."""
    remedy = "run torchrod simulate-dataset again to make it anew"
    try:
        shard = _read_npz(path, spec)
    except UNREADABLE:
        raise InputError(f"{path}: is missing or damaged; {remedy}") from None
    if sha256 is not None and digest(shard) != sha256:
        raise InputError(f"{path}: does not have the checksum of the manifest; {remedy}")
    n, P, K, T = spec.samples_in(index), len(spec.markers), spec.contacts, len(spec.robots[0].tendons)
    sizes = {"n": n, "P": P, "K": K, "T": T}
    first = index * spec.shard_size
    for name, (shape, _, _) in spec.arrays.items():
        expected = tuple(sizes[x] if x in sizes else int(x) for x in shape.strip("()").replace(" ", "").split(",") if x)
        if shard[name].shape != expected or shard[name].dtype != np.float64:
            raise InputError(f"{path}: array '{name}' is not float64 of shape {expected}; {remedy}")
        if "n" in shape:
            all_samples = arrays.setdefault(name, np.empty((spec.samples, *expected[1:])))
            all_samples[first : first + n] = shard[name]
