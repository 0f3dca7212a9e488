"""DATASET.toml: what a data set is to hold. Every refusal is one sentence with file, key and remedy."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..io.robot_file import read_robot
from ..io.values import as_number, as_numbers, as_table, read_toml
from ..mechanics.robot import Robot
from ..util.errors import InputError, shown
from .dataset import DISTRIBUTIONS, FAMILIES, DatasetSpec, Range

KEYS = {
    "dataset": {"samples", "shard_size", "seed", "noise"},
    "loads": {"contacts", "family", "force", "force_scale", "distribution", "location", "min_gap", "width", "contact_friction"},
    "markers": {"count", "at"},
    "robot": {"file", "robots"},
    "vary": {"tension", "gravity", "gravity_magnitude"},
}
REQUIRED = ("dataset", "loads", "robot")
SHARD_SIZE = 10_000  # about 10 MB with 20 markers
MOST_SAMPLES = 10**10
STANDARD_GRAVITY = 9.81  # m/s^2


def _integer(where: str, value: object, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InputError(f"{where} is {shown(value)}; it must be a whole number from {least} to {most}")
    return value


def _choice(where: str, value: object, known: Sequence[str]) -> str:
    if not isinstance(value, str) or value not in known:
        raise InputError(f"{where} is {shown(value)}; it must be {' or '.join(repr(k) for k in known)}")
    return value


def _range(where: str, value: object, most: float | None = None, positive: bool = False) -> Range:
    """[lowest, highest], not negative."""
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where} is {shown(value)}; it must be [lowest, highest], two numbers")
    low, high = as_numbers(where, value, 2)
    if low > high:
        raise InputError(f"{where} is {shown(value)}; the lowest comes first")
    if low < 0 or (positive and low == 0):
        raise InputError(f"{where} is {shown(value)}; its lowest must be {'positive' if positive else 'at least 0'}")
    if most is not None and high > most:
        raise InputError(f"{where} is {shown(value)}; its highest must be at most {most:g}, a fraction of the rod's length")
    return low, high


def _needed(where: str, table: dict[str, Any], key: str, remedy: str) -> object:
    if key not in table:
        raise InputError(f"{where}.{key} is missing; give {remedy}")
    return table[key]


def _one_of(where: str, table: dict[str, Any], first: str, second: str) -> str:
    if (first in table) == (second in table):
        raise InputError(f"{where} needs either {first} or {second}, not both and not neither")
    return first if first in table else second


def _loads(where: str, table: dict[str, Any]) -> dict[str, Any]:
    contacts = _integer(f"{where}.contacts", table.get("contacts", 1), 1, 100)
    family = _choice(f"{where}.family", table.get("family", "point"), FAMILIES)
    distribution = _choice(f"{where}.distribution", table.get("distribution", "uniform"), DISTRIBUTIONS)
    key = _one_of(where, table, "force", "force_scale")
    force = _range(f"{where}.{key}", table[key], positive=distribution == "log-uniform")
    location = _range(f"{where}.location", _needed(where, table, "location", "[lowest, highest] as fractions of the length"), 1.0)
    gap = as_number(f"{where}.min_gap", table.get("min_gap", 0.0), least=0.0)
    if (contacts - 1) * gap > location[1] - location[0]:
        raise InputError(f"{where}.min_gap is {gap}: {contacts} contacts do not fit into the range of location; lower one of them")
    if family == "point" and "width" in table:
        raise InputError(f"{where}.width stands beside family = 'point', which has none; remove it or let family be 'gaussian'")
    width = None
    if family == "gaussian":
        width = _range(f"{where}.width", _needed(where, table, "width", "[lowest, highest] as fractions of the length"), 10.0, True)
    unit = "N" if key == "force" else "EI/L^2"
    friction = (
        as_number(f"{where}.contact_friction", table["contact_friction"], positive=True) if "contact_friction" in table else None
    )
    return {
        **{"contacts": contacts, "family": family, "distribution": distribution, "force": force, "force_unit": unit},
        **{"location": location, "min_gap": gap, "width": width, "contact_friction": friction},
    }


def _markers(where: str, table: dict[str, Any]) -> tuple[float, ...]:
    """Fractions of the length."""
    if not table:
        table = {"count": 20}
    if _one_of(where, table, "count", "at") == "count":
        count = _integer(f"{where}.count", table["count"], 1, 10_000)
        return tuple((i + 1) / count for i in range(count))
    at = table["at"]
    if not isinstance(at, list) or not at:
        raise InputError(f"{where}.at is {shown(at)}; it must be a list of fractions of the length")
    at = as_numbers(f"{where}.at", at, len(at))
    if any(not 0 <= v <= 1 for v in at) or any(b <= a for a, b in pairwise(at)):
        raise InputError(f"{where}.at must increase and lie between 0 (the base) and 1 (the tip)")
    return tuple(at)


def _robots(path: Path, table: dict[str, Any]) -> tuple[Robot, ...]:
    where = f"{path}: robot"
    key = _one_of(where, table, "file", "robots")
    names = [table[key]] if key == "file" else table[key]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        what = "a file name" if key == "file" else "a list of file names"
        raise InputError(f"{where}.{key} is {shown(table[key])}; it must be {what}, relative to this file")
    robots = tuple(read_robot(path.parent / name) for name in names)
    for name, robot in zip(names, robots, strict=True):
        if len(robot.tendons) != len(robots[0].tendons):
            raise InputError(f"{where}.{key}: {name} has another number of tendons than {names[0]}; make one data set for each")
    return robots


def _vary(where: str, table: dict[str, Any], robots: tuple[Robot, ...]) -> dict[str, Any]:
    tendons = len(robots[0].tendons)
    if tendons and "tension" not in table:
        raise InputError(f"{where}.tension is missing; the robot has {tendons} tendons, give [lowest, highest] in N")
    if not tendons and "tension" in table:
        raise InputError(f"{where}.tension is given but the robot has no tendons; remove it")
    tension = _range(f"{where}.tension", table["tension"]) if tendons else None
    if "gravity" not in table:
        if "gravity_magnitude" in table:
            raise InputError(f"{where}.gravity_magnitude is given without gravity; add gravity = 'any' or remove it")
        return {"tension": tension, "gravity": None}
    _choice(f"{where}.gravity", table["gravity"], ("any",))
    for robot in robots:
        if robot.rod.mass == 0:
            raise InputError(f"{where}.gravity is given but {robot.name} has no mass; add mass_per_length (kg/m) to its file")
    magnitude = table.get("gravity_magnitude", [STANDARD_GRAVITY, STANDARD_GRAVITY])
    return {"tension": tension, "gravity": _range(f"{where}.gravity_magnitude", magnitude)}


def read_dataset_spec(path: str | Path, samples: int | None = None, seed: int | None = None) -> DatasetSpec:
    """A data set's specification from DATASET.toml (docs/files.md); samples and seed, where given, instead of the file's.

    Errors: InputError naming file, key and remedy.
    """
    path = Path(path)
    content = read_toml(path)
    as_table(str(path), content, set(KEYS))
    for name in REQUIRED:
        if name not in content:
            raise InputError(f"{path}: has no [{name}] table; known keys: {', '.join(sorted(KEYS[name]))}")
    tables = {name: as_table(f"{path}: {name}", content.get(name, {}), known) for name, known in KEYS.items()}
    general, where = tables["dataset"], f"{path}: dataset"
    count = _needed(where, general, "samples", "the number of samples, or --samples") if samples is None else samples
    robots = _robots(path, tables["robot"])
    return DatasetSpec(
        robots=robots,
        samples=_integer("--samples" if samples is not None else f"{where}.samples", count, 1, MOST_SAMPLES),
        shard_size=_integer(f"{where}.shard_size", general.get("shard_size", SHARD_SIZE), 1, 10**7),
        seed=_integer(
            "--seed" if seed is not None else f"{where}.seed", general.get("seed", 0) if seed is None else seed, 0, 2**63 - 1
        ),
        noise=as_number(f"{where}.noise", general.get("noise", 0.0), least=0.0),
        markers=_markers(f"{path}: markers", tables["markers"]),
        **_loads(f"{path}: loads", tables["loads"]),
        **_vary(f"{path}: vary", tables["vary"], robots),
    )
