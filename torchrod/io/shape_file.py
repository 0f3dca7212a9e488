"""SHAPES: measured marker positions, CSV or NPZ. Every refusal is one sentence with file, place and remedy."""

import csv
import io
import math
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..mechanics.grid import on_rod
from ..mechanics.robot import Robot
from ..model.marker_geometry import at_origin, too_far, too_short
from ..model.sensors import Markers
from ..util.errors import InputError, shown
from ..util.files import put, reading
from ..util.precision import Float64
from .npz_file import UNREADABLE, read_arrays, why

REQUIRED = ("s", "x", "y", "z")
OFFSETS = ("rx", "ry", "rz")
SLACK = 0.05  # of the largest tension in the file: a load cell's zero may drift by so much
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*", re.ASCII)


@dataclass(frozen=True)
class Shapes(Float64):
    """Marker positions of B named samples, as a file holds them; their noise is not in it.

    s: (P,) m. positions: (B, P, 3) m, base frame, NaN where missing. samples: their names. offsets: (P, 3) m, from the centre line
    in the section frame. tension: (B, T) N, readings of the load cells.
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    samples: list[str]
    offsets: Float[Tensor, "P 3"] | None = None
    tension: Float[Tensor, "B T"] | None = None

    def markers(self, noise: float | Float[Tensor, " B"]) -> Markers:
        """The sensor, with the standard deviation of a coordinate (m), one for all samples or one for each."""
        return Markers(self.s, self.positions, noise, self.offsets)


def read_shapes(path: str | Path, robot: Robot) -> Shapes:
    """Markers from a CSV or NPZ file (docs/files.md), checked against the robot. Errors: InputError naming file and remedy."""
    path = Path(path)
    with reading(path):
        if "\0" in str(path) or not path.is_file():
            raise InputError(f"{path}: no such file; check the path")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty; expected a CSV with header s,x,y,z or an NPZ with s and positions")
        with path.open("rb") as file:
            shapes = _read_npz(path, file) if path.suffix == ".npz" else _read_csv(path, file)
    gap, L = at_origin(shapes.markers(1.0)), robot.rod.length
    markers = replace(shapes, positions=torch.where(gap.unsqueeze(-1), torch.nan, shapes.positions))
    outside = ~on_rod(markers.s, L)
    if bool(outside.any()):
        hint = "is it in millimetres? give metres" if float(markers.s.max()) > 30 * L else "s is in metres"
        raise InputError(f"{path}: s = {float(markers.s[outside][0]):g} m lies outside the rod of 0 to {L:g} m; {hint}")
    if said := too_short(markers.s, L) or too_far(markers.markers(1.0), L):
        raise InputError(f"{path}: {said}")
    T = len(robot.tendons)
    if T and markers.tension is None:
        raise InputError(f"{path}: tensions are missing; the robot has {T} tendons, add tension_1..tension_{T} (N)")
    given = 0 if markers.tension is None else markers.tension.shape[-1]
    if given != T:
        raise InputError(f"{path}: has {given} tensions but the robot has {T} tendons; give one per tendon, in N")
    _check_pulls(path, markers, robot)
    if bool(gap.any()):
        _warn_of_gaps(path, gap, markers.s)
    return replace(markers, s=markers.s.clamp(0, L))


def _warn_of_gaps(path: Path, gap: Bool[Tensor, "B P"], s: Float[Tensor, " P"]) -> None:
    """Say once which positions are taken as missing."""
    where = f" in {int(gap.any(-1).sum())} of {len(gap)} samples" if len(gap) > 1 else ""
    places = gap.any(0).nonzero().flatten()
    named = ", ".join(f"{1e3 * v:.4g}" for v in s[places[:5]].tolist()) + (", ..." if len(places) > 5 else "")
    warnings.warn(
        f"{path}: markers at exactly (0, 0, 0), {int(gap.sum())}{where} (s = {named} mm), are taken as missing; "
        "leave the cells of a missing marker empty",
        stacklevel=3,
    )


def _check_pulls(path: Path, markers: Shapes, robot: Robot) -> None:
    """A tendon can only pull. A load cell's reading may lie a little below zero, and is then that of a slack tendon (a warning);
    one that mostly does so by more than its zero may drift counts the other way, and is refused.
    """
    if markers.tension is None or not markers.tension.numel():
        return
    offset = markers.tension.new_tensor([t.tension_offset for t in robot.tendons.tendons]).clamp(min=0)
    pull = markers.tension + offset  # what a known offset makes positive is none of this
    below = pull < 0
    if not bool(below.any()):
        return
    mostly = 2 * below.sum(0) > len(pull)
    far = pull.amin(0) < -SLACK * max(float(pull.max()), 0.0)
    if bool((mostly & far).any()):
        raise InputError(f"{path}: tension {float(markers.tension.min()):g} N is negative; a tendon can only pull, give at least 0")
    warnings.warn(
        f"{path}: negative tensions, {int(below.sum())} in {int(below.any(-1).sum())} of {len(pull)} samples, down to "
        f"{float(markers.tension.min()):g} N, are taken as those of slack tendons, which carry nothing",
        stacklevel=3,
    )


def _increasing(path: Path, s: np.ndarray, offsets: np.ndarray | None, sample: str) -> None:
    """s must increase; markers at one arc length are told apart by their offsets only."""
    if (back := np.flatnonzero(np.diff(s) < 0)).size:
        i = int(back[0])
        raise InputError(f"{path}: sample {sample}: s = {s[i + 1]:g} m follows {s[i]:g} m; sort the markers so that s increases")
    places = s[:, None] if offsets is None else np.column_stack([s, offsets])
    unique, count = np.unique(places, axis=0, return_counts=True)
    if (count > 1).any():
        at = unique[count > 1][0, 0]
        raise InputError(
            f"{path}: sample {sample}: two markers at s = {at:g} m; keep one, tell them apart by rx,ry,rz, or let s increase"
        )


def _read_npz(path: Path, file: IO[bytes]) -> Shapes:
    try:
        data = read_arrays(file)
    except UNREADABLE as error:
        raise InputError(f"{path}: is not an NPZ of plain numbers ({why(error)}); save numeric arrays only") from None
    expected = {"s": "(P,)", "positions": "(B, P, 3)", "tensions": "(B, T)", "offsets": "(P, 3)"}
    for key, value in data.items():
        if key not in expected:
            raise InputError(f"{path}: unknown array '{key}'; known: {', '.join(expected)}")
        if not (np.issubdtype(value.dtype, np.floating) or np.issubdtype(value.dtype, np.integer)):
            raise InputError(f"{path}: array '{key}' does not hold numbers; save it as float64")
    for key in ("s", "positions"):
        if key not in data:
            raise InputError(f"{path}: array '{key}' is missing; expected s (P,) and positions (B, P, 3)")
    data = {key: value.astype(np.float64) for key, value in data.items()}
    P, B = data["s"].size, len(data["positions"]) if data["positions"].ndim else 0
    if not P or not data["positions"].size:
        raise InputError(f"{path}: holds no marker; give at least one in s (P,) and one sample of it in positions (B, P, 3)")
    shapes = {
        "s": (P,),
        "positions": (B, P, 3),
        "tensions": (B, *data.get("tensions", np.empty((0, 0))).shape[1:2]),
        "offsets": (P, 3),
    }
    for key, value in data.items():
        if value.shape != shapes[key]:
            raise InputError(f"{path}: array '{key}' has shape {value.shape}; expected {expected[key]} with P = {P} and B = {B}")
        if np.isinf(value).any() or (key in ("s", "offsets") and np.isnan(value).any()):
            raise InputError(
                f"{path}: array '{key}' holds a value that is not finite; only positions may be NaN (a missing marker)"
            )
    _increasing(path, data["s"], data.get("offsets"), "all")
    tensor = {key: torch.from_numpy(value) for key, value in data.items()}
    names = [str(i) for i in range(B)]
    return Shapes(tensor["s"], tensor["positions"], names, tensor.get("offsets"), tensor.get("tensions"))


def _without_comments(lines: Iterable[str], comments: list[str]) -> Iterator[str]:
    """The lines, those that begin with # emptied and collected; not within quotes, where a line goes on."""
    quoted = False
    for line in lines:
        if not quoted and line.lstrip().startswith("#"):
            comments.append(line.lstrip()[1:])
            yield "\n"  # a line all the same: refusals count them
            continue
        quoted ^= line.count('"') % 2 == 1
        yield line


def _delimiter(header: str) -> str:
    """Of a CSV, by its header: a comma, or what spreadsheets put where the comma is the decimal mark."""
    return next((mark for mark in (",", ";", "\t") if mark in header), ",")


def _names(cells: list[str]) -> list[str]:
    return [name.strip().lower() for name in cells]


def _rows(path: Path, file: IO[bytes]) -> tuple[list[tuple[int, list[str]]], bool]:
    """The numbered rows of cells, header first, and whether a comma is their decimal mark."""
    comments: list[str] = []
    try:
        text = file.read().decode("utf-8-sig")
        lines = list(_without_comments(io.StringIO(text, newline=""), comments))
        first = next((line for line in lines if line.strip()), "")
        mark, header = _delimiter(first), None
        reader = csv.reader(lines, delimiter=mark)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
        if comments and not set(REQUIRED) <= set(_names(rows[0][1] if rows else [])):  # as numpy.savetxt puts a header
            header = next((c for c in comments if set(REQUIRED) <= set(_names(next(csv.reader([c], delimiter=mark), [])))), None)
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: is not a CSV text file; expected the header s,x,y,z") from None
    if header is not None:
        rows.insert(0, (0, next(csv.reader([header], delimiter=mark))))
    return rows, mark != ","


def _read_csv(path: Path, file: IO[bytes]) -> Shapes:
    numbered, comma = _rows(path, file)
    header = _names(numbered[0][1]) if numbered else []
    _check_header(path, header)
    if len(numbered) < 2:
        raise InputError(f"{path}: has a header but no rows; give one row per marker")
    samples: dict[str, list[dict[str, float]]] = {}
    for number, row in numbered[1:]:
        if len(row) != len(header):
            raise InputError(
                f"{path}: line {number} has {len(row)} cells, the header {len(header)}; leave a missing marker's cells empty"
            )
        cells = dict(zip(header, row, strict=True))
        name = cells.pop("sample", "0").strip()
        samples.setdefault(name, []).append({key: _cell(path, number, key, text, comma) for key, text in cells.items()})
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
                f"{path}: unexpected column '{name[:80]}'; known: s,x,y,z,sample,rx,ry,rz and tension_1..tension_T, once each"
            )
    if 0 < sum(name in header for name in OFFSETS) < 3:
        raise InputError(f"{path}: rx,ry,rz come together; add the missing one of them")


def _cell(path: Path, line: int, key: str, text: str, comma: bool) -> float:
    """A number; an empty cell or NaN is a missing one, which only a position may be. comma: it may be the decimal mark."""
    if comma and DECIMAL_COMMA.fullmatch(text):
        text = text.replace(",", ".")
    try:
        value = float(text) if text.strip() else math.nan
    except ValueError:
        raise InputError(f"{path}: line {line}, column {key}: {shown(text.strip())} is not a number") from None
    if not math.isfinite(value) and (key not in "xyz" or math.isinf(value)):
        raise InputError(
            f"{path}: line {line}, column {key}: must be a finite number; only x, y, z may be empty (a missing marker)"
        )
    return value


def _assemble(path: Path, header: list[str], samples: dict[str, list[dict[str, float]]]) -> Shapes:
    """One marker list for all samples, in the order of s; a marker that a sample does not have is missing there."""
    has_offsets = OFFSETS[0] in header
    keys = ("s", *OFFSETS) if has_offsets else ("s",)
    tensions = [f"tension_{i + 1}" for i in range(sum(name.startswith("tension_") for name in header))]
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
    return Shapes(table[:, 0].contiguous(), positions, list(samples), table[:, 1:].contiguous() if has_offsets else None, tension)


def write_shapes(path: str | Path, shapes: Shapes) -> None:
    """Markers as a CSV with the header of the contract, every digit kept; a missing marker has empty cells. Errors: InputError."""
    markers = shapes
    if len(shapes.samples) != len(markers.positions):
        raise InputError(f"{path}: {len(shapes.samples)} names for {len(markers.positions)} samples; give every sample its name")
    tensions = [] if markers.tension is None else [f"tension_{i + 1}" for i in range(markers.tension.shape[-1])]
    header = ["sample", *REQUIRED, *([] if markers.offsets is None else OFFSETS), *tensions]
    places = markers.s.tolist()
    offsets = [[]] * len(places) if markers.offsets is None else markers.offsets.tolist()

    def write(file: IO[bytes]) -> None:
        for b in range(-1, len(shapes.samples)):
            text = io.StringIO()
            writer = csv.writer(text)
            if b < 0:
                writer.writerow(header)
            else:
                name = _quoted(shapes.samples[b])
                tension = [] if markers.tension is None else markers.tension[b].tolist()
                for s, p, offset in zip(places, markers.positions[b].tolist(), offsets, strict=True):
                    text.write(name + ",")
                    writer.writerow([s, *("" if math.isnan(v) else v for v in p), *offset, *tension])
            file.write(text.getvalue().encode())

    put(path, write)


def _quoted(name: str) -> str:
    """A sample's name as a cell that no reader takes for a comment or for several cells."""
    return '"' + name.replace('"', '""') + '"' if not name or any(c in name for c in ',;\t"#\r\n') else name
