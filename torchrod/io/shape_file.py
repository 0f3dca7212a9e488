"""SHAPES: what was measured, CSV or NPZ. Every refusal is one sentence with file, place and remedy."""

import csv
import io
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mechanics.grid import on_rod
from ..mechanics.robot import Robot
from ..model.marker_geometry import against_chords, at_origin, misturned, too_far, too_short
from ..util.errors import InputError
from ..util.files import put, reading
from ..util.units import metres_per
from .csv_file import Table, ignored, read_table
from .npz_file import UNREADABLE, read_arrays, why
from .shapes import KINDS, Kind, Of, Shapes
from .tension_file import TENSION, read_tensions

COLUMNS = ("sample", "time", "s", *(name for kind in KINDS for name in kind.columns))
TENSION_EXAMPLES = ("tension_1", "tension_2")
POSITIONS, OFFSETS = KINDS[0], KINDS[1]
LINE = next(kind for kind in KINDS if kind.of is Of.POINT)
PLACES = 81  # between which a centre line's points are looked for
FAR = 5.0  # times the rod's length: no base frame is so far off
UNITS = re.compile(r"""\s*units\s*[=:]\s*["']?([^"']*?)["']?\s*""", re.IGNORECASE)
SLACK = 0.05  # of the largest tension in the file: a load cell's zero may drift by so much
UNIT_QUATERNION = 1e-2
MOST_READINGS = 100_000_000  # of one kind, samples times places: gigabytes
LEAST_COLUMNS = 2  # known ones, in a line that is a header


def read_shapes(path: str | Path, robot: Robot, units: str | None = None, tensions: str | Path | None = None) -> Shapes:
    """Measurements from a CSV or NPZ file (docs/files.md), checked against the robot.

    units: of its lengths, as metres_per takes it; by default what a remark of the file says, else metres. tensions: a file of
    tensions over time, from which those of every sample come by its time. Errors: InputError naming file and remedy.
    """
    path = Path(path)
    with reading(path):
        if "\0" in str(path) or not path.is_file():
            raise InputError(f"{path}: no such file; check the path")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty; expected a CSV with header s,x,y,z or an NPZ with s and positions")
        with path.open("rb") as file:
            shapes = _read_npz(path, file, units) if path.suffix == ".npz" else _read_csv(path, file, units)
    if LINE.name in shapes.readings:
        markers, gap = _line_on(path, shapes, robot.rod.length), torch.zeros(0, dtype=torch.bool)
    else:
        markers, gap = _markers_on(path, shapes, robot.rod.length)
    T, cells = len(robot.tendons), path
    if tensions is not None:
        cells, markers = Path(tensions), with_tensions(path, markers, robot, tensions)
    if T and markers.tension is None:
        raise InputError(f"{path}: tensions are missing; the robot has {T} tendons, add tension_1..tension_{T} (N) or --tensions")
    given = 0 if markers.tension is None else markers.tension.shape[-1]
    if given != T:
        remedy = "give one per tendon, in N" if T else "leave them out, or add a [[tendons]] table for each to ROBOT.toml"
        raise InputError(f"{path}: has tensions of {given} tendons but the robot has {T}; {remedy}")
    _check_pulls(cells, markers, robot)
    if bool(gap.any()):
        _warn_of_gaps(path, gap, markers.s)
    return replace(markers, s=markers.s.clamp(0, robot.rod.length))


def _markers_on(path: Path, shapes: Shapes, L: float) -> tuple[Shapes, Bool[Tensor, "B P"]]:
    """What was measured at known places of a rod of length L (m), without positions at exactly zero; where these were."""
    _check_rotations(path, shapes)
    gap = at_origin(shapes.markers(1.0))
    markers = replace(shapes, positions=torch.where(gap.unsqueeze(-1), torch.nan, shapes.positions))
    outside = ~on_rod(markers.s, L)
    if bool(outside.any()):
        hint = "is it in millimetres? give metres, or --units mm" if float(markers.s.max()) > 30 * L else "s is in metres"
        raise InputError(f"{path}: s = {float(markers.s[outside][0]):g} m lies outside the rod of 0 to {L:g} m; {hint}")
    if said := too_short(markers.s, L) or too_far(markers.markers(1.0), L):
        raise InputError(f"{path}: {said}")
    return markers, gap


def _line_on(path: Path, shapes: Shapes, L: float) -> Shapes:
    """Points of a centre line, with the places of a rod of length L (m) between which they are looked for."""
    p = shapes.readings[LINE.name]
    reach = p.norm(dim=-1).nan_to_num(0.0).amax(-1)
    if float(reach.max()) > FAR * L:
        raise InputError(
            f"{path}: points of the centre line are up to {float(reach.max()):.3g} m from the base of a rod of {L:g} m; give "
            "metres or --units, in the robot's base frame"
        )
    if float(reach.max()) < L / FAR:
        raise InputError(
            f"{path}: no point of the centre line is farther than {float(reach.max()):.3g} m from the base of a rod of {L:g} m; "
            "give metres or --units"
        )
    s = torch.linspace(0, L, PLACES, dtype=p.dtype)
    return replace(shapes, s=s, positions=p.new_full((len(p), PLACES, 3), torch.nan))


def with_tensions(path: Path, shapes: Shapes, robot: Robot, tensions: str | Path) -> Shapes:
    """The shapes of a file with the tensions (N) of another, interpolated in time. Errors: InputError."""
    if not len(robot.tendons):
        raise InputError(f"{tensions}: the robot has no tendons; leave out --tensions, or add [[tendons]] to the robot")
    if shapes.tension is not None:
        raise InputError(f"{path}: has tensions of its own; leave out --tensions, or its columns tension_1, ..")
    if shapes.time is None:
        raise InputError(f"{path}: has no times, by which --tensions are found; add a column time (s)")
    return replace(shapes, tension=read_tensions(tensions, len(robot.tendons)).at(shapes.time, path))


def _check_rotations(path: Path, shapes: Shapes) -> None:
    """Quaternions of length 1, to what a file rounds them to, that go with the positions."""
    q = shapes.readings.get("orientations")
    if q is None:
        return
    off = (q.norm(dim=-1) - 1).abs()
    if bool((off > UNIT_QUATERNION).any()):
        size = float(q.norm(dim=-1)[off > UNIT_QUATERNION][0])
        raise InputError(f"{path}: qx,qy,qz,qw have the length {size:.3g}; a rotation is a unit quaternion, give it as such")
    if said := misturned(lambda change: against_chords(shapes.s, shapes.positions, change(q), shapes.offsets)):
        warnings.warn(f"{path}: {said}", stacklevel=3)


def _scale(path: Path, asked: str | None, stated: str | None) -> float:
    """Metres in the file's unit of length."""
    if asked is not None and stated is not None and metres_per("--units", asked) != metres_per(f"{path}: units", stated):
        raise InputError(f"{path}: says units = {stated!r} but --units is {asked}; give one of them, or correct the file")
    return metres_per("--units", asked) if asked is not None else metres_per(f"{path}: units", stated or "m")


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
        again = "; if the next shape begins there, number the shapes in a column 'sample'" if s[i + 1] <= s[0] else ""
        raise InputError(
            f"{path}: sample {sample}: s = {s[i + 1]:g} m follows {s[i]:g} m; sort the markers so that s increases{again}"
        )
    places = s[:, None] if offsets is None else np.column_stack([s, offsets])
    unique, count = np.unique(places, axis=0, return_counts=True)
    if (count > 1).any():
        at = unique[count > 1][0, 0]
        raise InputError(
            f"{path}: sample {sample}: two markers at s = {at:g} m; keep one, tell them apart by rx,ry,rz, or let s increase"
        )


# NPZ.


def _expected(P: int | None, B: int | None) -> dict[str, tuple[int | str | None, ...]]:
    """The shape of every array that is known, with the letters of docs/files.md where a number is not known or any will do."""
    shapes: dict[str, tuple[int | str | None, ...]] = {"s": (P or "P",), "time": (B or "B",), "sample": (B or "B",), "units": ()}
    shapes["tensions"] = (B or "B", "T")
    for kind in KINDS:
        of = {Of.MARKER: (B or "B", P or "P"), Of.PLACE: (P or "P",), Of.SAMPLE: (B or "B",), Of.POINT: (B or "B", "M", 3)}[kind.of]
        shapes[kind.name] = (*of, *((len(kind.columns),) if len(kind.columns) > 1 else ()))
    return shapes


def _read_npz(path: Path, file: IO[bytes], units: str | None) -> Shapes:
    try:
        data = read_arrays(file)
    except UNREADABLE as error:
        raise InputError(f"{path}: is not an NPZ of plain numbers ({why(error)}); save numeric arrays only") from None
    if unknown := [key for key in data if key not in _expected(None, None)]:
        ignored(path, "array", unknown, list(_expected(None, None)))
    data = {key: value for key, value in data.items() if key not in unknown}
    texts = {key: data.pop(key) for key in ("sample", "units") if key in data}
    for key, value in data.items():
        if not (np.issubdtype(value.dtype, np.floating) or np.issubdtype(value.dtype, np.integer)):
            raise InputError(f"{path}: array '{key}' does not hold numbers; save it as float64")
    given = [kind for kind in KINDS if kind.name in data and kind.of is not Of.PLACE]
    if alone := LINE.name in data:
        if other := [name for name in ("s", *(kind.name for kind in KINDS if kind is not LINE)) if name in data]:
            raise InputError(
                f"{path}: array '{other[0]}' stands beside {LINE.name}, whose points are at no known s; keep one of them"
            )
        data["s"] = np.zeros(1)
    if "s" not in data or not given:
        key = "s" if "s" not in data else "positions"
        raise InputError(f"{path}: array '{key}' is missing; expected s (P,) and positions (B, P, 3)")
    data = {key: value.astype(np.float64) for key, value in data.items()}
    first = data[given[0].name]
    P, B = data["s"].size, len(first) if first.ndim else 0
    if not P or not first.size:
        raise InputError(f"{path}: holds no marker; give at least one in s (P,) and one sample of it in positions (B, P, 3)")
    named, wanted = _expected(None, None), _expected(P, B)
    for key, value in (data | texts).items():
        if len(value.shape) != len(wanted[key]) or any(
            w not in ("T", "M", n) for w, n in zip(wanted[key], value.shape, strict=True)
        ):
            form = f"({', '.join(map(str, named[key]))}{',' * (len(named[key]) == 1)})"
            counts = f"P = {P}" if len(value.shape) < len(wanted[key]) else f"P = {P} and B = {B}"
            alone = "; one sample has B = 1" if named[key][:1] == ("B",) and len(value.shape) < len(wanted[key]) else ""
            raise InputError(f"{path}: array '{key}' has shape {value.shape}; expected {form} with {counts}{alone}")
    for key, value in data.items():
        if np.isinf(value).any() or (key in ("s", "offsets", "time") and np.isnan(value).any()):
            raise InputError(
                f"{path}: array '{key}' holds a value that is not finite; only positions may be NaN (a missing marker)"
            )
    if not alone:
        _increasing(path, data["s"], data.get("offsets"), "all")
    scale = _scale(path, units, str(texts["units"]) if "units" in texts else None)
    names = [str(name) for name in texts["sample"]] if "sample" in texts else [str(i) for i in range(B)]
    lengths = {"s"} | {kind.name for kind in KINDS if kind.length}
    found = {key: torch.from_numpy(value * scale if key in lengths and scale != 1.0 else value) for key, value in data.items()}
    readings = {k.name: found[k.name].unsqueeze(-1) if len(k.columns) == 1 else found[k.name] for k in _further(found)}
    positions = found.get("positions", torch.full((B, P, 3), torch.nan, dtype=torch.float64))
    return Shapes(found["s"], positions, names, found.get("offsets"), found.get("tensions"), found.get("time"), readings)


def _further(found: dict[str, Tensor]) -> list[Kind]:
    """The kinds that have no field of their own in Shapes."""
    return [kind for kind in KINDS if kind.name in found and kind not in (POSITIONS, OFFSETS)]


# CSV.


def _names(cells: list[str]) -> list[str]:
    return [name.strip().lower() for name in cells]


def _is_header(cells: list[str]) -> bool:
    names = set(_names(cells))
    return ("s" in names or names >= {*POSITIONS.columns}) and len(names & {*COLUMNS}) >= LEAST_COLUMNS


def _stated_units(remarks: list[str]) -> str | None:
    return next((match[1] for remark in remarks if (match := UNITS.fullmatch(remark.rstrip("\r\n")))), None)


def _read_csv(path: Path, file: IO[bytes], units: str | None) -> Shapes:
    table = read_table(path, file, _is_header)
    names = _names(table.header)
    kinds, tensions = _check_header(path, names)
    if not table.rows:
        raise InputError(f"{path}: has a header but no rows; give one row per marker")
    scale = _scale(path, units, _stated_units(table.remarks))
    samples, which = _samples_of(table, names)
    if "s" not in names:
        return _centre_line(path, table, names, kinds, tensions, (samples, which), scale)
    s = _finite(table, names, "s") * scale
    columns = {kind.name: np.stack([_column(table, names, kind, key) for key in kind.columns], -1) for kind in kinds}
    columns = {kind.name: columns[kind.name] * (scale if kind.length else 1.0) for kind in kinds}
    offsets = columns.get(OFFSETS.name)
    order = np.argsort(which, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(which[order])) + 1):
        _increasing(path, s[rows], None if offsets is None else offsets[rows], samples[which[rows[0]]])
    places, index = np.unique(s[:, None] if offsets is None else np.column_stack([s, offsets]), axis=0, return_inverse=True)
    index = index.reshape(-1)
    if len(samples) * len(places) > MOST_READINGS:
        raise InputError(
            f"{path}: {len(samples)} samples have {len(places)} different places together, too many for one table; round s, or "
            "give fewer samples in a file"
        )
    found: dict[str, Tensor] = {}
    for kind in kinds:
        if kind.of is Of.MARKER:
            whole = np.full((len(samples), len(places), len(kind.columns)), math.nan)
            whole[which, index] = columns[kind.name]
        elif kind.of is Of.SAMPLE:
            whole = np.stack(
                [_once(table, samples, which, v, key) for v, key in zip(columns[kind.name].T, kind.columns, strict=True)], -1
            )
        else:
            continue
        found[kind.name] = torch.from_numpy(whole)
    time = _once(table, samples, which, _finite(table, names, "time"), "time") if "time" in names else None
    pulls = [_once(table, samples, which, _finite(table, names, key), key) for key in tensions]
    positions = found.pop("positions", torch.full((len(samples), len(places), 3), torch.nan, dtype=torch.float64))
    return Shapes(
        torch.from_numpy(places[:, 0].copy()),
        positions,
        samples,
        None if offsets is None else torch.from_numpy(places[:, 1:].copy()),
        torch.from_numpy(np.stack(pulls, -1)) if pulls else None,
        None if time is None else torch.from_numpy(time),
        found,
    )


def _centre_line(
    path: Path,
    table: Table,
    names: list[str],
    kinds: list[Kind],
    tensions: list[str],
    of: tuple[list[str], Int[np.ndarray, " rows"]],
    scale: float,
) -> Shapes:
    """Points without arc lengths, a row each."""
    if other := [kind.columns[0] for kind in kinds if kind is not POSITIONS]:
        raise InputError(f"{path}: column '{other[0]}' needs a column s; without s the rows are points of a centre line, x,y,z")
    samples, which = of
    p = scale * np.stack([_column(table, names, POSITIONS, key) for key in POSITIONS.columns], -1)
    order = np.argsort(which, kind="stable")
    parts = np.split(p[order], np.flatnonzero(np.diff(which[order])) + 1)
    whole = np.full((len(samples), max(len(part) for part in parts), 3), math.nan)
    if whole.size > MOST_READINGS:
        raise InputError(f"{path}: its samples have up to {whole.shape[1]} points, too many for one table; give fewer in a file")
    for b, part in enumerate(parts):
        whole[b, : len(part)] = part
    time = _once(table, samples, which, _finite(table, names, "time"), "time") if "time" in names else None
    pulls = [_once(table, samples, which, _finite(table, names, key), key) for key in tensions]
    return Shapes(
        torch.zeros(0),
        torch.zeros(len(samples), 0, 3),
        samples,
        None,
        torch.from_numpy(np.stack(pulls, -1)) if pulls else None,
        None if time is None else torch.from_numpy(time),
        {LINE.name: torch.from_numpy(whole)},
    )


def _check_header(path: Path, names: list[str]) -> tuple[list[Kind], list[str]]:
    """The kinds of measurement that there are, and the tensions' columns in their order."""
    if "s" not in names and not {*POSITIONS.columns} <= {*names}:
        found = ",".join(names[:6])
        raise InputError(
            f"{path}: column 's' is missing; the first line is a header that starts with s,x,y,z, or with x,y,z of a centre line, "
            f"not with {found!r}"
        )
    known = [*COLUMNS, *(name for name in names if TENSION.fullmatch(name))]
    for name in names:
        if name in known and names.count(name) > 1:
            raise InputError(f"{path}: column '{name}' stands twice in the header; keep one of them")
    if unknown := [name for name in names if name not in known]:
        ignored(path, "column", unknown, [*COLUMNS, *TENSION_EXAMPLES])
    kinds = []
    for kind in KINDS:
        there = [name for name in kind.columns if name in names]
        if there and len(there) < len(kind.columns):
            missing = next(name for name in kind.columns if name not in there)
            raise InputError(f"{path}: column '{missing}' is missing; {','.join(kind.columns)} come together")
        if there:
            kinds.append(kind)
    if not any(kind.of is Of.MARKER and kind.name != "position_std" for kind in kinds):
        raise InputError(f"{path}: column 'x' is missing; the header starts with s,x,y,z")
    tensions = sorted((name for name in names if TENSION.fullmatch(name)), key=lambda name: int(name[8:]))
    wanted = [f"tension_{i + 1}" for i in range(len(tensions))]
    if tensions != wanted:
        raise InputError(
            f"{path}: columns {', '.join(tensions)}; number the tendons tension_1..tension_{len(tensions)} without a gap"
        )
    return kinds, tensions


def _samples_of(table: Table, names: list[str]) -> tuple[list[str], Int[np.ndarray, " rows"]]:
    """The samples' names in the order of the file, and which of them every row is of: by name, or else by time."""
    key = "sample" if "sample" in names else "time" if "time" in names else None
    if key is None:
        return ["0"], np.zeros(len(table.rows), dtype=np.int64)
    index: dict[str, int] = {}
    which = np.array([index.setdefault(name, len(index)) for name in table.texts(names.index(key))])
    return list(index), which


def _finite(table: Table, names: list[str], key: str) -> Float[np.ndarray, " rows"]:
    """A column of which every row must have a number."""
    values = table.numbers(names.index(key))
    _refuse(table, key, ~np.isfinite(values))
    return values


def _column(table: Table, names: list[str], kind: Kind, key: str) -> Float[np.ndarray, " rows"]:
    """A column of measurements: NaN where there is none, but not of what all samples share."""
    values = table.numbers(names.index(key))
    _refuse(table, key, ~np.isfinite(values) if kind.of is Of.PLACE else np.isinf(values))
    return values


def _refuse(table: Table, key: str, bad: Bool[np.ndarray, " rows"]) -> None:
    if bad.any():
        line = table.lines[int(np.flatnonzero(bad)[0])]
        raise InputError(
            f"{table.path}: line {line}, column {key}: must be a finite number; only x, y, z may be empty (a missing marker)"
        )


def _once(
    table: Table, samples: list[str], which: Int[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], key: str
) -> Float[np.ndarray, " B"]:
    """What is of a whole sample: the same in all of its rows that have it, NaN where none has."""
    found = np.full(len(samples), math.nan)
    there = np.flatnonzero(np.isfinite(values))
    found[which[there]] = values[there]
    differs = there[found[which[there]] != values[there]]
    if differs.size:
        name = samples[which[differs[0]]]
        what = "the tensions differ" if key.startswith("tension") else f"{key} differs"
        raise InputError(f"{table.path}: sample {name}: {what} from row to row; one sample is one state of the robot")
    return found


def write_shapes(path: str | Path, shapes: Shapes) -> None:
    """Measurements as an NPZ, or as a CSV with the header of docs/files.md; every digit is kept, and a missing number is an empty
    cell. Errors: InputError.
    """
    path = Path(path)
    if len(shapes.samples) != len(shapes.positions):
        raise InputError(f"{path}: {len(shapes.samples)} names for {len(shapes.positions)} samples; give every sample its name")
    if path.suffix == ".npz":
        content: dict[str, Tensor | None] = {"s": shapes.s, "positions": shapes.positions, "offsets": shapes.offsets}
        content = {} if LINE.name in shapes.readings else content
        content |= {"tensions": shapes.tension, "time": shapes.time}
        content |= {name: v.squeeze(-1) if v.shape[-1] == 1 else v for name, v in shapes.readings.items()}
        arrays = {name: value.numpy() for name, value in content.items() if value is not None}
        put(path, lambda file: np.savez(file, sample=np.array(shapes.samples), **arrays))  # pyright: ignore[reportArgumentType]
        return
    kinds = [kind for kind in KINDS if kind is POSITIONS or (kind.columns and kind.name in shapes.readings)]
    kinds += [OFFSETS] if shapes.offsets is not None else []
    tensions = [] if shapes.tension is None else [f"tension_{i + 1}" for i in range(shapes.tension.shape[-1])]
    time = [] if shapes.time is None else ["time"]
    line = shapes.readings.get(LINE.name)
    header = ["sample", *time, *(["s"] if line is None else []), *(name for kind in kinds for name in kind.columns), *tensions]
    places = [[s] for s in shapes.s.tolist()]

    def write(file: IO[bytes]) -> None:
        for b in range(-1, len(shapes.samples)):
            text = io.StringIO()
            writer = csv.writer(text)
            if b < 0:
                writer.writerow(header)
            else:
                name = _quoted(shapes.samples[b])
                at = [] if shapes.time is None else [shapes.time[b].item()]
                tension = [] if shapes.tension is None else shapes.tension[b].tolist()
                cells = torch.cat([_of_sample(shapes, kind, b) for kind in kinds], -1) if line is None else line[b]
                for s, row in zip(places if line is None else [[]] * len(cells), cells.tolist(), strict=True):
                    text.write(name + ",")
                    writer.writerow([*at, *s, *("" if math.isnan(v) else v for v in row), *tension])
            file.write(text.getvalue().encode())

    put(path, write)


def _of_sample(shapes: Shapes, kind: Kind, b: int) -> Float[Tensor, "P k"]:
    """The cells of a kind in the rows of one sample."""
    if kind is OFFSETS:
        assert shapes.offsets is not None
        return shapes.offsets
    values = shapes.positions[b] if kind is POSITIONS else shapes.readings[kind.name][b]
    return values.expand(len(shapes.s), -1) if kind.of is Of.SAMPLE else values


def _quoted(name: str) -> str:
    """A sample's name as a cell that no reader takes for a comment or for several cells."""
    return '"' + name.replace('"', '""') + '"' if not name or any(c in name for c in ',;\t"#\r\n') else name
