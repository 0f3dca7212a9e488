"""Tables of text as measuring systems export them: their cells, and the numbers in them."""

import csv
import io
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...util.errors import InputError, shown

Rows = list[list[str]]
MOST_CELLS, TIMES = 1_000_000, 20  # of a table, and beyond that of those that the file has: one long line makes no table


def rows_of(path: Path, content: bytes) -> Rows:
    """The cells of every line, whatever divides them; letters beyond UTF-8 are those of Windows. Errors: InputError."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")
    if "\0" in text:
        raise InputError(f"{path}: is not a text file; export it as text, or name the format that it is in")
    longest = max(text.splitlines(), key=len, default="")
    mark = max("\t,;", key=longest.count)
    try:
        return [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text, newline=""), delimiter=mark)]
    except csv.Error as error:
        raise InputError(f"{path}: is not a table of text ({error}); export it again") from None


def line_with(path: Path, rows: Rows, *names: str) -> int:
    """The first line that begins with these cells, capitals or not. Errors: InputError."""
    wanted = [name.lower() for name in names]
    for i, row in enumerate(rows):
        if [cell.lower() for cell in row[: len(wanted)]] == wanted:
            return i
    raise InputError(f"{path}: has no line that begins with {','.join(names)}; is it a file of this format?")


def numbers(path: Path, rows: Rows, first: int, width: int | None = None, blank: bool = False) -> Float[np.ndarray, "F W"]:
    """The lines from `first` on as numbers, NaN where a cell is empty or a line ends early; without blank lines, unless asked for.

    Errors: InputError naming line and column of a cell that is no number.
    """
    lines = [(i, row) for i, row in enumerate(rows[first:], first) if blank or any(row)]
    if not lines:
        raise InputError(f"{path}: has no frames after its header; export it again")
    width = max(len(row) for _, row in lines) if width is None else width
    if width * len(lines) > max(MOST_CELLS, TIMES * sum(len(row) for _, row in lines)):
        longest = max(lines, key=lambda line: len(line[1]))
        raise InputError(f"{path}: line {longest[0] + 1} has {len(longest[1])} cells, far more than the others; export it again")
    found = np.full((len(lines), width), math.nan)
    for k, (i, row) in enumerate(lines):
        cells = row[:width]
        try:
            found[k, : len(cells)] = [float(cell) if cell else math.nan for cell in cells]
        except ValueError:
            found[k, : len(cells)] = [_number(path, i, j, cell) for j, cell in enumerate(cells)]
    return np.where(np.isfinite(found), found, math.nan)


def _number(path: Path, line: int, column: int, cell: str) -> float:
    try:
        return float(cell) if cell else math.nan
    except ValueError:
        raise InputError(f"{path}: line {line + 1}, column {column + 1}: {shown(cell)} is not a number") from None


def triplets(names: list[str], table: Float[np.ndarray, "F W"], first: int) -> dict[str, Float[np.ndarray, "F 3"]]:
    """Points X, Y, Z from column `first` on, each named at its X; a name that comes again is told apart by a number."""
    found: dict[str, Float[np.ndarray, "F 3"]] = {}
    for column in range(first, table.shape[1] - 2, 3):
        name = names[column] if column < len(names) else ""
        found[unused(name or f"point {len(found) + 1}", found)] = table[:, column : column + 3]
    return found


def unused(name: str, taken: dict[str, Float[np.ndarray, "F k"]]) -> str:
    """The name, with a number where it is taken."""
    k, fresh = 2, name
    while fresh in taken:
        fresh, k = f"{name} ({k})", k + 1
    return fresh


def clock(table: Float[np.ndarray, "F W"], column: int, rate: float | None) -> Float[np.ndarray, " F"] | None:
    """Times (s) of a column of them, or of frame numbers at a rate (1/s)."""
    if rate is not None:
        return (table[:, column] - table[0, column]) / rate
    return table[:, column]
