"""SHAPES: measured marker positions, CSV or NPZ. Every refusal is one sentence with file, place and remedy."""

import csv
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..errors import InputError
from ..measurement import Markers
from ..robot import Robot

REACH = 3.0  # in rod lengths: markers typically farther from the base than this are in the wrong unit or frame
REQUIRED = ("s", "x", "y", "z")
OFFSETS = ("rx", "ry", "rz")


@dataclass(frozen=True)
class Shapes:
    """Markers of named samples."""

    markers: Markers
    samples: list[str]


def read_shapes(path: str | Path, robot: Robot) -> Shapes:
    """Markers from a CSV or NPZ file (docs/files.md), checked against the robot. Errors: InputError naming file and remedy."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: is empty; expected a CSV with header s,x,y,z or an NPZ with s and positions")
    shapes = _read_npz(path) if path.suffix == ".npz" else _read_csv(path)
    markers, L = shapes.markers, robot.rod.length
    outside = (markers.s < -1e-9) | (markers.s > L * (1 + 1e-9))
    if bool(outside.any()):
        raise InputError(f"{path}: s = {float(markers.s[outside][0]):g} m lies outside the rod of 0 to {L:g} m; s is in metres")
    reach = markers.positions.norm(dim=-1).nanmedian() / L
    if reach > REACH:
        raise InputError(
            f"{path}: positions lie {float(reach):.3g} rod lengths from the base; give metres in the robot's base frame"
        )
    T = len(robot.tendons)
    if T and markers.tension is None:
        raise InputError(f"{path}: tensions are missing; the robot has {T} tendons, add tension_1..tension_{T} (N)")
    given = 0 if markers.tension is None else markers.tension.shape[-1]
    if given != T:
        raise InputError(f"{path}: has {given} tensions but the robot has {T} tendons; give one per tendon, in N")
    return Shapes(Markers(markers.s.clamp(0, L), markers.positions, markers.offsets, markers.tension), shapes.samples)


def _increasing(path: Path, s: np.ndarray, offsets: np.ndarray | None, sample: str) -> None:
    """s must increase; markers at one arc length are told apart by their offsets only."""
    for i in range(len(s) - 1):
        if s[i + 1] < s[i] or (s[i + 1] == s[i] and (offsets is None or np.array_equal(offsets[i], offsets[i + 1]))):
            raise InputError(
                f"{path}: sample {sample}: s = {s[i + 1]:g} m follows {s[i]:g} m; sort the markers so that s increases"
            )


def _read_npz(path: Path) -> Shapes:
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {key: np.asarray(file[key]) for key in file.files}
    except (ValueError, OSError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(
            f"{path}: is not an NPZ of plain numbers ({str(error).splitlines()[0]}); save numeric arrays only"
        ) from None
    for key in ("s", "positions"):
        if key not in data:
            raise InputError(f"{path}: array '{key}' is missing; expected s (P,) and positions (B, P, 3)")
    for key, value in data.items():
        if not np.issubdtype(value.dtype, np.number):
            raise InputError(f"{path}: array '{key}' does not hold numbers")
    s, positions = data["s"].astype(float), data["positions"].astype(float)
    if s.ndim != 1 or positions.ndim != 3 or positions.shape[1:] != (len(s), 3):
        raise InputError(f"{path}: shapes are s {s.shape} and positions {positions.shape}; expected (P,) and (B, P, 3)")
    expected = {"tensions": (len(positions), None), "offsets": (len(s), 3)}
    for key, shape in expected.items():
        if key in data and (data[key].ndim != 2 or any(n not in (None, m) for n, m in zip(shape, data[key].shape, strict=True))):
            raise InputError(f"{path}: array '{key}' has shape {data[key].shape}; expected {shape[0]} rows")
    if not np.isfinite(s).all():
        raise InputError(f"{path}: array 's' holds a value that is not finite")
    _increasing(path, s, data.get("offsets"), "all")
    tensor = {key: torch.from_numpy(value.astype(float)) for key, value in data.items()}
    markers = Markers(tensor["s"], tensor["positions"], tensor.get("offsets"), tensor.get("tensions"))
    return Shapes(markers, [str(i) for i in range(len(positions))])


def _read_csv(path: Path) -> Shapes:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: is not a CSV text file; expected the header s,x,y,z") from None
    header = [name.strip() for name in rows[0]] if rows else []
    _check_header(path, header)
    if len(rows) < 2:
        raise InputError(f"{path}: has a header but no rows; give one row per marker")
    samples: dict[str, list[dict[str, float]]] = {}
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise InputError(
                f"{path}: line {number} has {len(row)} cells, the header {len(header)}; leave a missing marker's cells empty"
            )
        cells = dict(zip(header, row, strict=True))
        name = cells.pop("sample", "0").strip()
        samples.setdefault(name, []).append({key: _cell(path, number, key, text) for key, text in cells.items()})
    return _assemble(path, header, samples)


def _check_header(path: Path, header: list[str]) -> None:
    tensions = [f"tension_{i + 1}" for i in range(sum(name.startswith("tension_") for name in header))]
    known = {*REQUIRED, *OFFSETS, "sample", *tensions}
    for name in REQUIRED:
        if name not in header:
            raise InputError(f"{path}: column '{name}' is missing; the header starts with s,x,y,z")
    for name in header:
        if name not in known or header.count(name) > 1:
            raise InputError(
                f"{path}: unexpected column '{name}'; known: s,x,y,z,sample,rx,ry,rz and tension_1..tension_T, once each"
            )
    if 0 < sum(name in header for name in OFFSETS) < 3:
        raise InputError(f"{path}: rx,ry,rz come together; add the missing one of them")


def _cell(path: Path, line: int, key: str, text: str) -> float:
    """A number; an empty cell or NaN is a missing one, which only a position may be."""
    try:
        value = float(text) if text.strip() else math.nan
    except ValueError:
        raise InputError(f"{path}: line {line}, column {key}: {text.strip()!r} is not a number") from None
    if not math.isfinite(value) and (key not in "xyz" or math.isinf(value)):
        raise InputError(
            f"{path}: line {line}, column {key}: must be a finite number; only x, y, z may be empty (a missing marker)"
        )
    return value


def _assemble(path: Path, header: list[str], samples: dict[str, list[dict[str, float]]]) -> Shapes:
    """One marker list for all samples, in the order of s; a marker that a sample does not have is missing there."""
    has_offsets = OFFSETS[0] in header
    keys = ("s", *OFFSETS) if has_offsets else ("s",)
    tensions = [name for name in header if name.startswith("tension_")]
    for name, rows in samples.items():
        at = np.array([[row[k] for k in keys] for row in rows])
        _increasing(path, at[:, 0], at[:, 1:] if has_offsets else None, name)
        if any(row[t] != rows[0][t] for row in rows for t in tensions):
            raise InputError(f"{path}: sample {name}: the tensions differ from row to row; one sample is one state of the robot")
    places = sorted({tuple(row[k] for k in keys) for rows in samples.values() for row in rows})
    index = {place: i for i, place in enumerate(places)}
    positions = torch.full((len(samples), len(places), 3), math.nan, dtype=torch.float64)
    for b, rows in enumerate(samples.values()):
        for row in rows:
            positions[b, index[tuple(row[k] for k in keys)]] = torch.tensor([row[k] for k in "xyz"], dtype=torch.float64)
    table = torch.tensor(places, dtype=torch.float64)
    tension = torch.tensor([[rows[0][t] for t in tensions] for rows in samples.values()], dtype=torch.float64) if tensions else None
    return Shapes(
        Markers(table[:, 0].contiguous(), positions, table[:, 1:].contiguous() if has_offsets else None, tension), list(samples)
    )


def write_shapes(path: str | Path, shapes: Shapes) -> None:
    """Markers as a CSV with the header of the contract, every digit kept; a missing marker has empty cells."""
    markers = shapes.markers
    tensions = [] if markers.tension is None else [f"tension_{i + 1}" for i in range(markers.tension.shape[-1])]
    header = ["sample", *REQUIRED, *([] if markers.offsets is None else OFFSETS), *tensions]
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for b, name in enumerate(shapes.samples):
            for i, s in enumerate(markers.s.tolist()):
                position = ["" if math.isnan(v) else v for v in markers.positions[b, i].tolist()]
                offset = [] if markers.offsets is None else markers.offsets[i].tolist()
                writer.writerow([name, s, *position, *offset, *([] if markers.tension is None else markers.tension[b].tolist())])
