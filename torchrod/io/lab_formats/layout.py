"""LAYOUT.toml: what the names of a measuring system's file are on the robot. Every refusal is one sentence with file and key."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...util.errors import InputError, shown
from ...util.precision import DTYPE
from ...util.units import metres_per
from ..base_pose import BasePose, as_base_pose
from ..values import as_number, as_numbers, as_table, in_si, read_toml

TOP = {"units", "up", "left_handed", "time", "rate", "base", "markers", "bodies", "gratings", "centre_line"}
PLACES = {"names", "s", "offset"}
BASE = {"names", "at", "body", "position", "rotation", "moving"}
GRATINGS = {"s", "kx", "ky", "cores", "core", "start", "unit"}
LENGTHS = {"s", "offset", "at", "position", "core", "start"}


@dataclass(frozen=True)
class Places:
    """Markers or rigid bodies along the rod: names in the file (None: the rod has to tell them), s (P,) m, offsets (P, 3) m or
    None, and of bodies the rotation of the body in the section frame, (x, y, z, w).
    """

    names: list[str] | None
    s: Float[Tensor, " P"]
    offsets: Float[Tensor, "P 3"] | None
    mounting: Float[Tensor, "4"] | None = None


@dataclass(frozen=True)
class Plate:
    """Where the base frame is: markers on the plate, by name or to be found, at their places (m) in it; or the base's pose in the
    frame of a rigid body; or its pose in the file's. moving: to be found in every frame.
    """

    names: list[str] | None
    at: Float[Tensor, "M 3"] | None
    body: str | None
    pose: BasePose | None
    moving: bool


@dataclass(frozen=True)
class Gratings:
    """Of G places s (m): columns of curvature kx, ky (1/m), or the strain of cores at `core` (C, 2) m in the section, whose columns
    are named place by place, or which begin at the arc lengths `start` (C,) m of one fibre. unit: of a strain in the file.
    """

    s: Float[Tensor, " G"]
    kx: list[str]
    ky: list[str]
    cores: list[list[str]]
    core: Float[Tensor, "C 2"] | None
    start: list[float] | None
    unit: float


@dataclass(frozen=True)
class Layout:
    """The content of a LAYOUT.toml. units: of length, where the file does not say or says something else. time: column of a table.
    rate: frames per second, where the file has no times. centre_line: whether the file's points are those of one.
    """

    path: Path
    units: str | None
    up: str
    left_handed: bool
    time: str | None
    rate: float | None
    base: Plate | None
    markers: Places | None
    bodies: Places | None
    gratings: Gratings | None
    centre_line: bool = False

    @property
    def names(self) -> list[str]:
        """Every name of a point or a rigid body."""
        groups = [p.names or [] for p in (self.markers, self.bodies, self.base) if p is not None]
        body = [self.base.body] if self.base is not None and self.base.body is not None else []
        return [*(name for group in groups for name in group), *body]


def _texts(where: str, value: object) -> list[str]:
    if not isinstance(value, list) or not value or not all(isinstance(v, str) for v in value):
        raise InputError(f"{where} is {shown(value)}; it must be a list of names in quotes")
    if len(set(value)) < len(value):
        raise InputError(f"{where} has a name twice; give every name once")
    return value


def _vectors(where: str, value: object, size: int, count: int | None = None) -> Float[Tensor, "P k"]:
    """A list of vectors; where as many are needed, one stands for all."""
    if count is not None and isinstance(value, list) and len(value) == size and not any(isinstance(v, list) for v in value):
        value = [value] * count
    if not isinstance(value, list) or not value or (count is not None and len(value) != count):
        raise InputError(f"{where} is {shown(value)}; it must be a list of {count or 'as many'} vectors of {size} numbers")
    return torch.tensor([as_numbers(f"{where}[{i}]", v, size) for i, v in enumerate(value)], dtype=DTYPE)


def _flag(where: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{where} is {shown(value)}; it must be true or false")
    return value


def _arc(where: str, table: dict[str, Any]) -> Float[Tensor, " P"]:
    if "s" not in table:
        raise InputError(f"{where}.s is missing; give the arc lengths, as s_mm = [...] or in metres")
    values = table["s"]
    if not isinstance(values, list) or not values:
        raise InputError(f"{where}.s is {shown(values)}; it must be a list of arc lengths")
    return torch.tensor(as_numbers(f"{where}.s", values, len(values)), dtype=DTYPE)


def _places(where: str, value: object, bodies: bool = False) -> Places:
    table = as_table(where, in_si(where, value, LENGTHS, {"rotation"}), PLACES | ({"rotation"} if bodies else set()))
    s = _arc(where, table)
    names = None if "names" not in table else _texts(f"{where}.names", table["names"])
    if names is None and bodies:
        raise InputError(f"{where}.names is missing; rigid bodies are known by their names")
    if names is not None and len(names) != len(s):
        raise InputError(f"{where} has {len(names)} names and {len(s)} arc lengths; give one s for each name")
    offsets = None if "offset" not in table else _vectors(f"{where}.offset", table["offset"], 3, len(s))
    mounting = as_base_pose(where, {"rotation": table["rotation"]}).rotation if "rotation" in table else None
    return Places(names, s, offsets, mounting)


def _plate(where: str, value: object) -> Plate:
    table = as_table(where, in_si(where, value, LENGTHS, {"rotation"}), BASE)
    pose = as_base_pose(where, {k: table[k] for k in ("position", "rotation") if k in table})
    moving, body = _flag(f"{where}.moving", table.get("moving", False)), table.get("body")
    if "at" in table:
        if body is not None or "position" in table or "rotation" in table:
            raise InputError(f"{where}.at stands beside body, position or rotation; give the markers of the plate or the pose")
        at = _vectors(f"{where}.at", table["at"], 3)
        names = _texts(f"{where}.names", table["names"]) if "names" in table else None
        if len(at) < 3 or (names is not None and len(names) != len(at)):
            raise InputError(f"{where} has {len(names or at)} markers and {len(at)} places; give at least three, a place for each")
        span = at - at.mean(0)
        if float(torch.linalg.svdvals(span)[1]) < 0.05 * float(torch.linalg.svdvals(span)[0]):
            raise InputError(f"{where}.at are on one line, so that the plate may turn about it; add a marker beside it")
        return Plate(names, at, None, None, moving)
    if "names" in table:
        raise InputError(
            f"{where}.at is missing; give the places of the plate's markers in the base frame, as at_mm = [[x, y, z], ..]"
        )
    if body is not None and not isinstance(body, str):
        raise InputError(f"{where}.body is {shown(body)}; it must be the name of a rigid body")
    if moving and body is None:
        raise InputError(f"{where}.moving is true, but a stated pose stays where it is; give body, or names and at of markers")
    return Plate(None, None, body, pose, moving)


def _gratings(where: str, value: object) -> Gratings:
    table = as_table(where, in_si(where, value, LENGTHS), GRATINGS)
    s, G = _arc(where, table), len(table["s"])
    kx, ky = ([] if key not in table else _texts(f"{where}.{key}", table[key]) for key in ("kx", "ky"))
    unit = as_number(f"{where}.unit", table.get("unit", 1e-6), positive=True)
    if kx or ky:
        if len(kx) != G or len(ky) != G:
            raise InputError(
                f"{where} has {len(kx)} names in kx and {len(ky)} in ky for {G} arc lengths; give one of each for each s"
            )
        if idle := sorted({"core", "cores", "start", "unit"} & set(table)):
            raise InputError(f"{where}.{idle[0]} stands beside kx and ky, which are curvatures (1/m) already; keep one of them")
        return Gratings(s, kx, ky, [], None, None, unit)
    if "core" not in table or ("cores" in table) == ("start" in table):
        raise InputError(f"{where} needs kx and ky, or core_mm = [[x, y], ..] with cores = [[names], ..] or start_mm = [..]")
    core = _vectors(f"{where}.core", table["core"], 2)
    if len(core) < 3 or float(torch.linalg.svdvals(core - core.mean(0))[-1]) < 1e-3 * float(core.abs().max()):
        raise InputError(f"{where}.core must be at least three places that are not on one line; strain of fewer tells no curvature")
    if "start" in table:
        return Gratings(s, [], [], [], core, as_numbers(f"{where}.start", table["start"], len(core)), unit)
    cores = table["cores"]
    if not isinstance(cores, list) or len(cores) != G:
        raise InputError(f"{where}.cores must be a list of {G} lists of names, one for each s")
    named = [_texts(f"{where}.cores[{i}]", row) for i, row in enumerate(cores)]
    if any(len(row) != len(core) for row in named):
        raise InputError(f"{where}.cores must name {len(core)} columns for each s, one for each place in core")
    return Gratings(s, [], [], named, core, None, unit)


def read_layout(path: str | Path) -> Layout:
    """A LAYOUT.toml (docs/import.md). Errors: InputError."""
    path = Path(path)
    table = as_table(str(path), read_toml(path), TOP)
    units, up, time = table.get("units"), table.get("up", "z"), table.get("time")
    if units is not None:
        metres_per(f"{path}: units", units)
    if up not in ("x", "y", "z"):
        raise InputError(f"{path}: up is {shown(up)}; it must be 'x', 'y' or 'z', the axis of the file's world that points up")
    if time is not None and not isinstance(time, str):
        raise InputError(f"{path}: time is {shown(time)}; it must be the name of a column")
    rate = None if "rate" not in table else as_number(f"{path}: rate", table["rate"], positive=True)
    made = {
        "markers": lambda value: _places(f"{path}: markers", value),
        "bodies": lambda value: _places(f"{path}: bodies", value, True),
        "base": lambda value: _plate(f"{path}: base", value),
        "gratings": lambda value: _gratings(f"{path}: gratings", value),
    }
    parts = {key: make(table[key]) if key in table else None for key, make in made.items()}
    line = "centre_line" in table
    as_table(f"{path}: centre_line", table.get("centre_line", {}), set())
    places = [key for key in ("markers", "bodies", "gratings") if parts[key] is not None]
    if not places and not line:
        raise InputError(f"{path}: names nothing on the rod; add [markers], [bodies], [gratings] or [centre_line]")
    if places and line:
        raise InputError(f"{path}: {places[0]} stands beside centre_line, whose points are at no known s; import each by itself")
    left = _flag(f"{path}: left_handed", table.get("left_handed", False))
    if rate is not None and not math.isfinite(1 / rate):
        raise InputError(f"{path}: rate is {rate}; it must be in frames per second")
    if rate is not None and time is not None:
        raise InputError(f"{path}: time and rate both say when the frames are; give one of them")
    return Layout(path, units, up, left, time, rate, parts["base"], parts["markers"], parts["bodies"], parts["gratings"], line)
