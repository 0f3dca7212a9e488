"""ROBOT.toml: the robot. Every refusal is one sentence with file, key and remedy."""

import math
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from ..mechanics.robot import Robot
from ..mechanics.rod import Rod, check_stiffness
from ..mechanics.tendons import Tendon, Tendons
from ..util.errors import InputError, shown
from ..util.precision import DTYPE
from .base_pose import BasePose, as_base_pose
from .values import as_number, as_numbers, as_rows, as_table, in_si, read_toml

TOP_KEYS = {"name", "rod", "tendons", "base"}
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
SOFTEST, HARDEST = 1e4, 2e12  # Pa: below the softest silicone and above diamond
RUBBER, SLENDER = 1e6, 1 / 40  # Pa, and a diameter over the length: so soft and so slender a rod does not hold itself
MOST_COILS = 200  # turns of the unloaded rod
ROD_LENGTHS = {"length", "diameter"}
TENDON_LENGTHS = {"offset", "routing", "ends_at", "radius"}
TENDON_KEYS = TENDON_LENGTHS | {"angle", "tension_offset"}


def _stiffness(where: str, value: object) -> torch.Tensor:
    """Three numbers (the diagonal) or three rows of three: symmetric positive definite."""
    if isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) for row in value):
        K = torch.tensor([as_numbers(f"{where}[{i}]", row, 3) for i, row in enumerate(value)], dtype=DTYPE)
    elif isinstance(value, list) and len(value) == 3:
        K = torch.diag(torch.tensor(as_numbers(where, value, 3), dtype=DTYPE))
    else:
        raise InputError(f"{where} is {shown(value)}; it must be three numbers (the diagonal) or three rows of three numbers")
    try:
        check_stiffness(where, K, "N (K_se) or N m^2 (K_bt)")
    except ValueError as error:
        raise InputError(str(error)) from None
    return K


def _curvature(where: str, value: object) -> list[list[float]]:
    """Rows [s, ux, uy, uz], two with the same s for a jump, or one [ux, uy, uz] for the whole rod."""
    if isinstance(value, list) and value and not isinstance(value[0], list):
        return [[0.0, *as_numbers(where, value, 3)]]
    if not isinstance(value, list) or not value:
        raise InputError(f"{where} must be [ux, uy, uz] or a list of rows [s, ux, uy, uz]")
    rows = [as_numbers(f"{where}[{i}]", row, 4) for i, row in enumerate(value)]
    if any(b[0] < a[0] for a, b in pairwise(rows)):
        raise InputError(f"{where}: s must not fall from row to row")
    if any(c[0] == a[0] for a, c in zip(rows, rows[2:], strict=False)):
        raise InputError(f"{where}: more than two rows have the same s; give two, before and after the jump")
    return rows


def _coils(rows: list[list[float]], length: float) -> float:
    """How many turns the rod makes at most without load."""
    ends = [(0.0, math.hypot(*rows[0][1:])), *((r[0], math.hypot(*r[1:])) for r in rows), (length, math.hypot(*rows[-1][1:]))]
    inside = [(min(max(s, 0.0), length), u) for s, u in ends]
    return sum((b - a) * max(u, w) for (a, u), (b, w) in pairwise(inside)) / (2 * math.pi)


def _rod(path: Path, table: dict[str, Any]) -> Rod:
    where = f"{path}: rod"
    if "length" not in table:
        raise InputError(f"{where}.length is missing; give the rod's length in metres")
    length = as_number(f"{where}.length", table["length"], positive=True)
    mass = as_number(f"{where}.mass_per_length", table.get("mass_per_length", 0.0), least=0.0)
    curvature = table.get("reference_curvature")
    table_of = None if curvature is None else _curvature(f"{where}.reference_curvature", curvature)
    if table_of is not None and not (turns := _coils(table_of, length)) <= MOST_COILS:
        raise InputError(f"{where}.reference_curvature winds the rod {turns:.4g} times, more than {MOST_COILS}; it must be in 1/m")
    rows = None if table_of is None else torch.tensor(table_of, dtype=DTYPE)
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
    diameter, E, G = (as_number(f"{where}.{k}", table[k], positive=True) for k in SECTION_KEYS)
    if not SOFTEST <= E <= HARDEST:
        remedy = "is it in GPa or MPa? steel is 207e9" if E < SOFTEST else "steel is 207e9"
        raise InputError(f"{where}.youngs_modulus is {E:g} Pa, which no rod has; give it in pascals ({remedy})")
    if not 1e-5 * length <= diameter <= length or not 0.1 * E <= G <= E:
        warnings.warn(f"{where}: diameter {diameter} m, youngs_modulus {E} Pa, shear_modulus {G} Pa: check the units", stacklevel=2)
    elif E < RUBBER and diameter < SLENDER * length:
        warnings.warn(
            f"{where}.youngs_modulus is {E:g} Pa, that of soft rubber, in a slender rod; if it is in MPa, give {1e6 * E:g} Pa",
            stacklevel=2,
        )
    return Rod.circular(length, diameter, E, G, mass, rows)


def _tendon(where: str, value: object, length: float) -> Tendon:
    table = as_table(where, in_si(where, value, TENDON_LENGTHS, {"angle"}), TENDON_KEYS)
    if ("radius" in table) != ("angle" in table):
        raise InputError(f"{where}.{'radius' if 'angle' in table else 'angle'} is missing; radius and angle are given together")
    if sum(key in table for key in ("offset", "routing", "radius")) != 1:
        raise InputError(f"{where} needs either offset = [x, y] or routing = [[s, x, y], ...], in metres, or radius and angle")
    ends_at = as_number(f"{where}.ends_at", table.get("ends_at", length), positive=True)
    if ends_at > length * (1 + 1e-9):
        raise InputError(f"{where}.ends_at is {ends_at} m, beyond the rod's length of {length} m")
    correction = as_number(f"{where}.tension_offset", table.get("tension_offset", 0.0))
    if "radius" in table:
        radius, angle = (as_number(f"{where}.{key}", table[key]) for key in ("radius", "angle"))
        tendon = Tendon.straight(radius * math.cos(angle), radius * math.sin(angle), ends_at, correction)
    elif "offset" in table:
        x, y = as_numbers(f"{where}.offset", table["offset"], 2)
        tendon = Tendon.straight(x, y, ends_at, correction)
    else:
        rows = as_rows(f"{where}.routing", table["routing"], 3)
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
    return robot_of(Path(path), read_toml(Path(path)))


def read_base_pose(path: str | Path) -> BasePose | None:
    """Where [base] of a ROBOT.toml puts the robot in the lab; None where it does not say. Errors: InputError."""
    return base_pose_of(Path(path), read_toml(Path(path)))


def base_pose_of(path: Path, content: dict[str, Any]) -> BasePose | None:
    """The same from what a ROBOT.toml says."""
    if "base" not in content:
        return None
    where = f"{path}: base"
    return as_base_pose(where, in_si(where, content["base"], {"position"}, {"rotation"}))


def robot_of(path: Path, content: dict[str, Any]) -> Robot:
    """The same from what a ROBOT.toml says; path: what refusals call it."""
    if "rod" not in content:
        raise InputError(f"{path}: has no [rod] table; give at least length, diameter, youngs_modulus and shear_modulus")
    as_table(str(path), content, TOP_KEYS)
    table = as_table(f"{path}: rod", in_si(f"{path}: rod", content["rod"], ROD_LENGTHS), ROD_KEYS)
    rod = _rod(path, table)
    gravity = torch.tensor(as_numbers(f"{path}: rod.gravity", table.get("gravity", [0.0, 0.0, 0.0]), 3), dtype=DTYPE)
    if bool(gravity.any()) and float(rod.mass_per_length) == 0:
        warnings.warn(f"{path}: rod.gravity is given without mass_per_length, so nothing hangs; add it (kg/m)", stacklevel=2)
    base_pose_of(path, content)
    name = content.get("name", path.stem)
    if not isinstance(name, str):
        raise InputError(f"{path}: name is {shown(name)}; it must be a text in quotes")
    listed = content.get("tendons", [])
    if not isinstance(listed, list):
        raise InputError(f"{path}: tendons must be an array of tables, [[tendons]]")
    tendons = Tendons(tuple(_tendon(f"{path}: tendons[{i}]", t, rod.length) for i, t in enumerate(listed)))
    return Robot(rod, tendons, gravity, name)
