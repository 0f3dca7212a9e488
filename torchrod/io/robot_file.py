"""ROBOT.toml: the robot. Every refusal is one sentence with file, key and remedy."""

import math
import tomllib
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError
from ..robot import Robot
from ..rod import DTYPE, Rod
from ..tendons import Tendon, Tendons

TOP_KEYS = {"name", "rod", "tendons"}
ROD_KEYS = {
    "length",
    "diameter",
    "youngs_modulus",
    "shear_modulus",
    "mass_per_length",
    "gravity",
    "reference_curvature",
    "K_se",
    "K_bt",
}
SECTION_KEYS = ("diameter", "youngs_modulus", "shear_modulus")
TENDON_KEYS = {"offset", "routing", "ends_at", "tension_offset"}


def _table(where: str, value: object, known: set[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where} must be a table of keys; known keys: {', '.join(sorted(known))}")
    for key in value:
        if key not in known:
            raise InputError(f"{where}: unknown key '{key}'; known keys: {', '.join(sorted(known))}")
    return value


def _number(where: str, value: object, positive: bool = False, least: float = -math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} is {value!r}; it must be a number in SI units")
    try:
        value = float(value)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise InputError(f"{where} is {value}; it must be finite")
    if (positive and value <= 0) or value < least:
        raise InputError(f"{where} is {value}; it must be {'positive' if positive else f'at least {least:g}'}")
    return value


def _numbers(where: str, value: object, count: int) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{where} is {value!r}; it must be a list of {count} numbers")
    return [_number(where, v) for v in value]


def _rows(where: str, value: object, count: int) -> list[list[float]]:
    """A table given as a list of rows whose first entry, s, increases."""
    if not isinstance(value, list) or not value:
        raise InputError(f"{where} must be a list of rows of {count} numbers, s first")
    rows = [_numbers(f"{where}[{i}]", row, count) for i, row in enumerate(value)]
    if any(b[0] <= a[0] for a, b in pairwise(rows)):
        raise InputError(f"{where}: s must increase from row to row")
    return rows


def _stiffness(where: str, value: object) -> torch.Tensor:
    """Three numbers (the diagonal) or three rows of three: symmetric positive definite."""
    if isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) for row in value):
        K = torch.tensor([_numbers(f"{where}[{i}]", row, 3) for i, row in enumerate(value)], dtype=DTYPE)
    else:
        K = torch.diag(torch.tensor(_numbers(where, value, 3), dtype=DTYPE))
    if not torch.allclose(K, K.mT, rtol=1e-6, atol=0) or int(torch.linalg.cholesky_ex(K).info) != 0:
        raise InputError(f"{where} must be symmetric positive definite, in N (K_se) or N m^2 (K_bt)")
    return K


def _curvature(where: str, value: object) -> list[list[float]]:
    """Rows [s, ux, uy, uz], or one [ux, uy, uz] for the whole rod."""
    if isinstance(value, list) and value and not isinstance(value[0], list):
        return [[0.0, *_numbers(where, value, 3)]]
    return _rows(where, value, 4)


def _rod(path: Path, table: dict[str, Any]) -> Rod:
    where = f"{path}: rod"
    if "length" not in table:
        raise InputError(f"{where}.length is missing; give the rod's length in metres")
    length = _number(f"{where}.length", table["length"], positive=True)
    mass = _number(f"{where}.mass_per_length", table.get("mass_per_length", 0.0), least=0.0)
    curvature = table.get("reference_curvature")
    rows = None if curvature is None else torch.tensor(_curvature(f"{where}.reference_curvature", curvature), dtype=DTYPE)
    if not 1e-3 <= length <= 10:
        warnings.warn(f"{where}.length is {length} m, unusual for a continuum robot; are the units metres?", stacklevel=2)
    if "K_se" in table or "K_bt" in table:
        for key in ("K_se", "K_bt"):
            if key not in table:
                raise InputError(f"{where}.{key} is missing; K_se and K_bt are given together")
        for key in SECTION_KEYS:
            if key in table:
                raise InputError(f"{where}.{key} stands beside K_se and K_bt; give either the stiffnesses or the circular section")
        K_se, K_bt = (_stiffness(f"{where}.{k}", table[k]) for k in ("K_se", "K_bt"))
        return Rod.from_stiffness(length, K_se, K_bt, mass, rows)
    for key in SECTION_KEYS:
        if key not in table:
            raise InputError(f"{where}.{key} is missing; give diameter, youngs_modulus and shear_modulus, or K_se and K_bt")
    diameter, E, G = (_number(f"{where}.{k}", table[k], positive=True) for k in SECTION_KEYS)
    if not 1e-5 * length <= diameter <= length or E < 1e3 or not 0.1 * E <= G <= E:
        warnings.warn(f"{where}: diameter {diameter} m, youngs_modulus {E} Pa, shear_modulus {G} Pa: check the units", stacklevel=2)
    return Rod.circular(length, diameter, E, G, mass, rows)


def _tendon(where: str, value: object, length: float) -> Tendon:
    table = _table(where, value, TENDON_KEYS)
    if ("offset" in table) == ("routing" in table):
        raise InputError(f"{where} needs either offset = [x, y] or routing = [[s, x, y], ...], in metres")
    ends_at = _number(f"{where}.ends_at", table.get("ends_at", length), positive=True)
    if ends_at > length * (1 + 1e-9):
        raise InputError(f"{where}.ends_at is {ends_at} m, beyond the rod's length of {length} m")
    correction = _number(f"{where}.tension_offset", table.get("tension_offset", 0.0))
    if "offset" in table:
        x, y = _numbers(f"{where}.offset", table["offset"], 2)
        tendon = Tendon.straight(x, y, ends_at, correction)
    else:
        rows = _rows(f"{where}.routing", table["routing"], 3)
        if len(rows) > 1 and (rows[0][0] > 0 or rows[-1][0] < ends_at):
            raise InputError(
                f"{where}.routing runs from {rows[0][0]} to {rows[-1][0]} m; it must cover 0 to the tendon's end, {ends_at} m"
            )
        tendon = Tendon(tuple((s, x, y) for s, x, y in rows), ends_at, correction)
    if max(math.hypot(x, y) for _, x, y in tendon.routing) > 0.5 * length:
        warnings.warn(f"{where} runs more than half the rod's length beside it; are its offsets in metres?", stacklevel=2)
    return tendon


def read_robot(path: str | Path) -> Robot:
    """A robot from ROBOT.toml (docs/files.md). SI units. Errors: InputError naming file, key and remedy."""
    path = Path(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:  # not TOML, not UTF-8, or a path that is none
        raise InputError(f"{path}: is not valid TOML ({error})") from None
    if "rod" not in content:
        raise InputError(f"{path}: has no [rod] table; give at least length, diameter, youngs_modulus and shear_modulus")
    _table(str(path), content, TOP_KEYS)
    table = _table(f"{path}: rod", content["rod"], ROD_KEYS)
    rod = _rod(path, table)
    gravity = torch.tensor(_numbers(f"{path}: rod.gravity", table.get("gravity", [0.0, 0.0, 0.0]), 3), dtype=DTYPE)
    if bool(gravity.any()) and float(rod.mass_per_length) == 0:
        warnings.warn(f"{path}: rod.gravity is given without mass_per_length, so nothing hangs; add it (kg/m)", stacklevel=2)
    listed = content.get("tendons", [])
    if not isinstance(listed, list):
        raise InputError(f"{path}: tendons must be an array of tables, [[tendons]]")
    tendons = Tendons(tuple(_tendon(f"{path}: tendons[{i}]", t, rod.length) for i, t in enumerate(listed)))
    return Robot(rod, tendons, gravity, str(content.get("name", path.stem)))
