"""Values of TOML files: each is what its key says, or is refused in one sentence with file, key and remedy."""

import math
import tomllib
from collections.abc import Collection
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..util.errors import InputError, shown
from ..util.files import reading
from .npz_file import why

ALIKE = 0.8  # of two keys, from 0 to 1 (difflib): one may be meant for the other
MOST_WHOLE = 10**300  # a whole number beyond it has no float


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file. Errors: InputError."""
    with reading(path):
        try:
            return tomllib.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, or a path that is none
            raise InputError(f"{path}: is not valid TOML ({why(error)}); correct that place (docs/files.md has the keys)") from None


def as_table(where: str, value: object, known: set[str]) -> dict[str, Any]:
    """A table of known keys."""
    if not isinstance(value, dict):
        raise InputError(f"{where} must be a table of keys; known keys: {', '.join(sorted(known))}")
    for key in value:
        if key not in known:
            names = {name.lower(): name for name in sorted(known)}
            near = get_close_matches(key.lower().removesuffix("_mm").removesuffix("_deg"), list(names), 1, ALIKE)
            meant = f"is it {names[near[0]]}? " if near else ""
            raise InputError(f"{where}: unknown key {shown(key)}; {meant}known keys: {', '.join(sorted(known))}")
    return value


def in_si(where: str, value: object, lengths: Collection[str], angles: Collection[str] = ()) -> object:
    """A table with its keys NAME_mm and NAME_deg as NAME, in m and rad. Errors: InputError where a key stands in two units."""
    if not isinstance(value, dict):
        return value
    table: dict[str, Any] = {}
    for key, content in value.items():
        stem, _, unit = key.rpartition("_")
        factor = 1e-3 if unit == "mm" and stem in lengths else math.pi / 180 if unit == "deg" and stem in angles else None
        name = key if factor is None else stem
        if name in table or (factor is not None and stem in value):
            raise InputError(f"{where}.{name} is given in two units; keep one of them")
        table[name] = content if factor is None else _times(factor, content)
    return table


def _times(factor: float, value: object) -> object:
    """Numbers in however deep a list, multiplied; anything else as it is, to be refused where it is read."""
    if isinstance(value, list):
        return [_times(factor, v) for v in value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    return factor * value if isinstance(value, float) or abs(value) < MOST_WHOLE else value


def as_number(where: str, value: object, positive: bool = False, least: float = -math.inf) -> float:
    """A finite number, positive or at least `least` where that is asked for."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} is {shown(value)}; it must be a number in SI units")
    try:
        value = float(value)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise InputError(f"{where} is {value}; it must be finite")
    if (positive and value <= 0) or value < least:
        raise InputError(f"{where} is {value}; it must be {'positive' if positive else f'at least {least:g}'}")
    return value


def as_numbers(where: str, value: object, count: int) -> list[float]:
    """A list of `count` such numbers."""
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{where} is {shown(value)}; it must be a list of {count} numbers")
    return [as_number(where, v) for v in value]


def as_rows(where: str, value: object, count: int) -> list[list[float]]:
    """A table given as a list of rows whose first entry, s, increases."""
    if not isinstance(value, list) or not value:
        raise InputError(f"{where} must be a list of rows of {count} numbers, s first")
    rows = [as_numbers(f"{where}[{i}]", row, count) for i, row in enumerate(value)]
    if any(b[0] <= a[0] for a, b in pairwise(rows)):
        raise InputError(f"{where}: s must increase from row to row")
    return rows
