"""ROBOT.toml: the robot. Every refusal is one sentence with file, key and remedy."""

import math
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from ..mechanics.pieces import Ends, Piece
from ..mechanics.robot import Robot
from ..mechanics.rod import Rod, check_stiffness
from ..mechanics.tendons import Tendon, Tendons
from ..util.errors import InputError, shown
from ..util.precision import DTYPE
from .base_pose import BasePose, as_base_pose
from .uncertainty import uncertainty_of
from .values import as_number, as_numbers, as_rows, as_table, in_si, read_toml

TOP_KEYS = {"name", "rod", "tendons", "base", "uncertainty", "calibration"}
KINDS = {"round": ("diameter", "inner_diameter"), "oval": ("axes", "angle"), "stiffness": ("K_se", "K_bt")}  # of a section
MODULI = ("youngs_modulus", "shear_modulus")
SECTION_KEYS = (*KINDS["round"], *KINDS["oval"], *KINDS["stiffness"], *MODULI)
ROD_KEYS = {"length", "mass_per_length", "gravity", "reference_curvature", "sections", "masses", *SECTION_KEYS}
MASS_KEYS = {"s", "mass"}
SOFTEST, HARDEST = 1e4, 2e12  # Pa: below the softest silicone and above diamond
RUBBER, SLENDER = 1e6, 1 / 40  # Pa, and a diameter over the length: so soft and so slender a rod does not hold itself
MOST_GRAVITY = 100.0  # m/s^2
MOST_COILS = 200  # turns of the unloaded rod
ROD_LENGTHS = {"length", "diameter", "inner_diameter", "axes"}
SECTION_LENGTHS = {"to", "diameter", "inner_diameter", "axes"}
TENDON_LENGTHS = {"offset", "routing", "ends_at", "radius", "discs"}
TENDON_KEYS = TENDON_LENGTHS | {"angle", "tension_offset", "friction", "motion"}
MOTIONS = {"pull": 1.0, "release": -1.0}


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


def _ends(where: str, value: object, positive: bool = True) -> Ends:
    """A number, or two: at the start and at the end."""
    least = -math.inf if positive else 0.0
    if isinstance(value, list) and len(value) == 2:
        a, b = (as_number(f"{where}[{i}]", v, positive, least) for i, v in enumerate(value))
        return a, b
    if isinstance(value, list):
        raise InputError(f"{where} is {shown(value)}; it must be a number, or two: at the section's start and at its end")
    return as_number(where, value, positive, least)


def _largest(value: Ends) -> float:
    return max(value) if isinstance(value, tuple) else value


def _moduli(where: dict[str, str], table: dict[str, Any], diameter: float, length: float) -> tuple[float, float]:
    """Young's and shear modulus (Pa), and a warning where they and the diameter (m) look as if in other units."""
    E, G = (as_number(where[k], table[k], positive=True) for k in ("youngs_modulus", "shear_modulus"))
    if not SOFTEST <= E <= HARDEST:
        remedy = "is it in GPa or MPa? steel is 207e9" if E < SOFTEST else "steel is 207e9"
        raise InputError(f"{where['youngs_modulus']} is {E:g} Pa, which no rod has; give it in pascals ({remedy})")
    if diameter > length:
        home = where["youngs_modulus"].removesuffix(".youngs_modulus")
        raise InputError(
            f"{home}: the section is {diameter:g} m across, more than the rod's length of {length:g} m; give both in metres, or as "
            "diameter_mm and length_mm"
        )
    if not 1e-5 * length <= diameter or not 0.1 * E <= G <= E:
        home = where["youngs_modulus"].removesuffix(".youngs_modulus")
        warnings.warn(f"{home}: diameter {diameter} m, youngs_modulus {E} Pa, shear_modulus {G} Pa: check the units", stacklevel=2)
    elif E < RUBBER and diameter < SLENDER * length:
        warnings.warn(
            f"{where['youngs_modulus']} is {E:g} Pa, that of soft rubber, in a slender rod; if it is in MPa, give {1e6 * E:g} Pa",
            stacklevel=2,
        )
    return E, G


def _kind(where: str, table: dict[str, Any]) -> str | None:
    """Which of KINDS a table describes; None: neither."""
    found = [kind for kind, keys in KINDS.items() if any(key in table for key in keys)]
    if "stiffness" in found:
        for key in ("K_se", "K_bt"):
            if key not in table:
                raise InputError(f"{where}.{key} is missing; K_se and K_bt are given together")
        for key in (*KINDS["round"], *KINDS["oval"], *MODULI):
            if key in table:
                raise InputError(
                    f"{where}.{key} stands beside K_se and K_bt; give either the stiffnesses or the section's measures"
                )
    elif len(found) > 1:
        given = next(key for key in KINDS["oval"] if key in table)
        raise InputError(f"{where}.{given} stands beside a diameter; give either diameter (round) or axes and angle (oval)")
    return found[0] if found else None


def _piece(where: str, home: str, rod: dict[str, Any], own: dict[str, Any], to: float, length: float) -> Piece:
    """The section that a table describes, with what it omits from [rod]; both tables' names first."""
    mine = _kind(where, own)
    kind = mine or _kind(home, rod)
    if kind == "stiffness" and any(key in own for key in MODULI):
        raise InputError(
            f"{where} gives a modulus, but {home} gives K_se and K_bt; give these in the section as well, or a diameter"
        )
    inherited = {k: v for k, v in rod.items() if mine in (None, "round", "oval") or k == "mass_per_length"}
    for other, keys in KINDS.items():
        if other != kind:
            inherited = {k: v for k, v in inherited.items() if k not in keys}
    table = inherited | own
    at = {key: f"{where if key in own else home}.{key}" for key in (*SECTION_KEYS, "mass_per_length")}
    mass = _ends(at["mass_per_length"], table.get("mass_per_length", 0.0), False)
    if kind == "stiffness":
        K_se, K_bt = (_stiffness_ends(at[k], table[k]) for k in ("K_se", "K_bt"))
        return Piece.of_stiffness(to, K_se, K_bt, mass)
    needed = ("axes" if kind == "oval" else "diameter", *MODULI)
    for key in needed:
        if key not in table:
            raise InputError(f"{where}.{key} is missing; give {', '.join(needed[:2])} and {needed[2]}, or K_se and K_bt")
    if kind == "oval":
        value = table["axes"]
        if not isinstance(value, list) or len(value) != 2:
            raise InputError(
                f"{at['axes']} is {shown(value)}; it must be two axes, [a, b], in metres (a taper: [[a, a_end], [b, b_end]])"
            )
        a, b = (_ends(f"{at['axes']}[{i}]", v) for i, v in enumerate(value))
        E, G = _moduli(at, table, max(_largest(a), _largest(b)), length)
        return Piece.oval(to, (a, b), E, G, mass, as_number(at["angle"], table.get("angle", 0.0)))
    outer, inner = _ends(at["diameter"], table["diameter"]), _ends(at["inner_diameter"], table.get("inner_diameter", 0.0), False)
    E, G = _moduli(at, table, _largest(outer), length)
    try:
        return Piece.round(to, outer, E, G, mass, inner)
    except ValueError:
        raise InputError(f"{at['inner_diameter']} is {shown(table['inner_diameter'])}; it must be less than the diameter") from None


def _stiffness_ends(where: str, value: object) -> torch.Tensor | tuple[torch.Tensor, torch.Tensor]:
    """A stiffness, or two: at the start and at the end."""
    if isinstance(value, list) and len(value) == 2:
        return _stiffness(f"{where}[0]", value[0]), _stiffness(f"{where}[1]", value[1])
    return _stiffness(where, value)


def _pieces(where: str, table: dict[str, Any], length: float) -> tuple[list[Piece], list[list[float]] | None]:
    """The sections of a rod, and the rows of its reference curvature."""
    listed, rows, rod_rows = table.get("sections"), [], None
    rod = {key: v for key, v in table.items() if key in (*SECTION_KEYS, "mass_per_length")}
    if table.get("reference_curvature") is not None:
        rod_rows = _curvature(f"{where}.reference_curvature", table["reference_curvature"])
    if listed is None:
        return [_piece(where, where, {}, rod, length, length)], rod_rows
    if not isinstance(listed, list) or not listed:
        raise InputError(f"{where}.sections must be an array of tables, [[rod.sections]]")
    for key in ("diameter", "inner_diameter", "mass_per_length"):
        if isinstance(rod.get(key), list):
            raise InputError(f"{where}.{key} is a taper beside sections; give it in the sections, whose ends it then belongs to")
    pieces, start, own_rows = [], 0.0, False
    for i, value in enumerate(listed):
        here = f"{where}.sections[{i}]"
        own = as_table(
            here, in_si(here, value, SECTION_LENGTHS, {"angle"}), {"to", "mass_per_length", "reference_curvature", *SECTION_KEYS}
        )
        last = i == len(listed) - 1
        if "to" not in own and not last:
            raise InputError(f"{here}.to is missing; give the arc length in metres at which the section ends")
        to = as_number(f"{here}.to", own.get("to", length), positive=True)
        if last and abs(to - length) > 1e-9 * length:
            raise InputError(f"{here}.to is {to} m; the last section must end at the rod's length, {length} m")
        to = length if last else to
        if not start < to <= length:
            raise InputError(f"{here}.to is {to} m; sections must end one after the other, at most at the rod's length, {length} m")
        pieces.append(
            _piece(here, where, rod, {k: v for k, v in own.items() if k not in ("to", "reference_curvature")}, to, length)
        )
        if "reference_curvature" in own:
            own_rows, found = True, _curvature(f"{here}.reference_curvature", own["reference_curvature"])
        else:
            found = rod_rows or [[0.0, 0.0, 0.0, 0.0]]
        rows += _within(found, start, to)
        start = to
    return pieces, rows if own_rows else rod_rows


def _curvature_at(rows: list[list[float]], s: float, after: bool) -> list[float]:
    """u* of rows at s, just after or just before a jump there."""
    before = [r for r in rows if r[0] < s or (after and r[0] == s)]
    beyond = [r for r in rows if r[0] > s or (not after and r[0] == s)]
    if not before or not beyond:
        return (before[-1] if before else beyond[0])[1:]
    a, b = before[-1], beyond[0]
    t = (s - a[0]) / (b[0] - a[0])
    return [x + t * (y - x) for x, y in zip(a[1:], b[1:], strict=True)]


def _within(rows: list[list[float]], start: float, to: float) -> list[list[float]]:
    """The part of a table of reference curvature that lies on one section, its ends included."""
    inner = [r for r in rows if start < r[0] < to]
    return [[start, *_curvature_at(rows, start, True)], *inner, [to, *_curvature_at(rows, to, False)]]


def _masses(where: str, value: object, length: float) -> torch.Tensor:
    if not isinstance(value, list):
        raise InputError(f"{where} must be an array of tables, [[rod.masses]]")
    rows = []
    for i, entry in enumerate(value):
        table = as_table(f"{where}[{i}]", in_si(f"{where}[{i}]", entry, {"s"}), MASS_KEYS)
        for key in sorted(MASS_KEYS):
            if key not in table:
                raise InputError(f"{where}[{i}].{key} is missing; give s (m) and mass (kg)")
        s, mass = as_number(f"{where}[{i}].s", table["s"], least=0.0), as_number(f"{where}[{i}].mass", table["mass"], least=0.0)
        if s > length * (1 + 1e-9):
            raise InputError(f"{where}[{i}].s is {s} m, beyond the rod's length of {length} m")
        rows.append([min(s, length), mass])
    return torch.tensor(rows, dtype=DTYPE).reshape(-1, 2)


def _rod(path: Path, table: dict[str, Any]) -> Rod:
    where = f"{path}: rod"
    if "length" not in table:
        raise InputError(f"{where}.length is missing; give the rod's length in metres")
    length = as_number(f"{where}.length", table["length"], positive=True)
    if not 1e-3 <= length <= 10:
        warnings.warn(f"{where}.length is {length} m, unusual for a continuum robot; are the units metres?", stacklevel=2)
    pieces, curvature = _pieces(where, table, length)
    if curvature is not None and not (turns := _coils(curvature, length)) <= MOST_COILS:
        raise InputError(f"{where}.reference_curvature winds the rod {turns:.4g} times, more than {MOST_COILS}; it must be in 1/m")
    rows = None if curvature is None else torch.tensor(curvature, dtype=DTYPE)
    masses = _masses(f"{where}.masses", table.get("masses", []), length)
    if len(pieces) > 1 or not pieces[0].uniform:
        try:
            return Rod.of_pieces(tuple(pieces), rows, masses)
        except ValueError as error:
            raise InputError(f"{where}: {error}") from error
    one = pieces[0]
    return replace(Rod.from_stiffness(length, one.K_se[0], one.K_bt[0], float(one.mass[0]), rows), masses=masses)


def _motion(where: str, value: object) -> float:
    """Which way a tendon moves through the robot."""
    if isinstance(value, str) and value in MOTIONS:
        return MOTIONS[value]
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1 <= value <= 1:
        raise InputError(f'{where} is {shown(value)}; it must be "pull", "release" or a number from -1 to 1')
    return float(value)


def _discs(where: str, value: object, length: float) -> tuple[float, ...]:
    """Arc lengths of the discs that a tendon runs through."""
    if not isinstance(value, list):
        raise InputError(f"{where} is {shown(value)}; it must be a list of arc lengths in metres")
    found = as_numbers(where, value, len(value))
    if any(b <= a for a, b in pairwise([0.0, *found])) or (found and found[-1] > length * (1 + 1e-9)):
        raise InputError(
            f"{where} is {shown(value)}; arc lengths must increase from above 0 to at most the rod's length, {length} m"
        )
    return tuple(min(s, length) for s in found)


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
    mu = as_number(f"{where}.friction", table.get("friction", 0.0), least=0.0)
    discs = _discs(f"{where}.discs", table.get("discs", []), length)
    tendon = replace(tendon, friction=mu, motion=_motion(f"{where}.motion", table.get("motion", 1.0)), discs=discs)
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
    turn = content["base"].get("rotation") if isinstance(content["base"], dict) else None
    if isinstance(turn, list) and len(turn) == 3 and all(isinstance(v, int | float) for v in turn):
        size = math.hypot(*turn)
        if 2 * math.pi < size < math.inf:
            raise InputError(f"{where}.rotation turns by {size:.3g} rad, more than once around; give it in rad, or as rotation_deg")
    return as_base_pose(where, in_si(where, content["base"], {"position"}, {"rotation"}))


def robot_of(path: Path, content: dict[str, Any]) -> Robot:
    """The same from what a ROBOT.toml says; path: what refusals call it."""
    if "rod" not in content:
        raise InputError(f"{path}: has no [rod] table; give at least length, diameter, youngs_modulus and shear_modulus")
    for key in content:
        if key not in TOP_KEYS and (key in ROD_KEYS or key.removesuffix("_mm") in ROD_LENGTHS):
            raise InputError(f"{path}: {key} stands outside of [rod]; put it below that line")
    as_table(str(path), content, TOP_KEYS)
    if isinstance(content["rod"], dict) and "poisson_ratio" in content["rod"]:
        raise InputError(f"{path}: rod.poisson_ratio is not read; give shear_modulus = E / (2 (1 + nu)) instead")
    table = as_table(f"{path}: rod", in_si(f"{path}: rod", content["rod"], ROD_LENGTHS, {"angle"}), ROD_KEYS)
    rod = _rod(path, table)
    gravity = torch.tensor(as_numbers(f"{path}: rod.gravity", table.get("gravity", [0.0, 0.0, 0.0]), 3), dtype=DTYPE)
    if float(gravity.norm()) > MOST_GRAVITY:
        warnings.warn(f"{path}: rod.gravity is {gravity.tolist()}; give it in m/s^2 (the earth's is 9.81 m/s^2)", stacklevel=2)
    if bool(gravity.any()) and rod.mass == 0:
        warnings.warn(f"{path}: rod.gravity is given without mass_per_length, so nothing hangs; add it (kg/m)", stacklevel=2)
    base_pose_of(path, content)
    calibrated = uncertainty_of(path, content).calibrated
    name = content.get("name", path.stem)
    if not isinstance(name, str):
        raise InputError(f"{path}: name is {shown(name)}; it must be a text in quotes")
    listed = content.get("tendons", [])
    if not isinstance(listed, list):
        raise InputError(f"{path}: tendons must be an array of tables, [[tendons]]")
    tendons = Tendons(tuple(_tendon(f"{path}: tendons[{i}]", t, rod.length) for i, t in enumerate(listed)))
    robot = Robot(rod, tendons, gravity, name)
    if calibrated is None:
        return robot
    try:
        return calibrated.applied(robot)
    except ValueError as error:
        raise InputError(f"{path}: calibration: {error}; calibrate again") from None
