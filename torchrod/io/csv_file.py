"""CSV as people and programs write it: what divides its cells, its remarks, its numbers. A damaged one is refused in a sentence."""

import csv
import io
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from ..util.errors import InputError, shown

DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*", re.ASCII)
MARKS = (",", ";", "\t")
ALIKE = 0.85  # of difflib: one letter more or less in a word


@dataclass(frozen=True)
class Table:
    """The rows of a CSV below its header.

    path: what refusals call it. header: names as the file has them. rows: their cells; lines: the file's line of each. comma: a
    comma may be the decimal mark. remarks: the lines that began with #.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    comma: bool
    remarks: list[str]

    @cached_property
    def _columns(self) -> list[tuple[str, ...]]:
        return list(zip(*self.rows, strict=True))

    def texts(self, column: int) -> list[str]:
        """The cells of a column."""
        return [cell.strip() for cell in self._columns[column]]

    def numbers(self, column: int) -> Float[np.ndarray, " rows"]:
        """The numbers of a column, NaN where its cell is empty or says so. Errors: InputError naming line and column."""
        cells = self._columns[column]
        try:
            return np.array([float(cell) if cell else math.nan for cell in cells])
        except ValueError:
            key = self.header[column].strip().lower()
            return np.array([_number(self.path, n, key, cell, self.comma) for n, cell in zip(self.lines, cells, strict=True)])


def _number(path: Path, line: int, key: str, text: str, comma: bool) -> float:
    if comma and DECIMAL_COMMA.fullmatch(text):
        text = text.replace(",", ".")
    try:
        return float(text) if text.strip() else math.nan
    except ValueError:
        raise InputError(f"{path}: line {line}, column {key}: {shown(text.strip())} is not a number") from None


def _without_remarks(lines: Iterable[str], remarks: list[str]) -> Iterator[str]:
    """The lines, those that begin with # emptied and collected; not within quotes, where a line goes on."""
    quoted = False
    for line in lines:
        if not quoted and line.lstrip().startswith("#"):
            remarks.append(line.lstrip()[1:])
            yield "\n"  # a line all the same: refusals count them
            continue
        quoted ^= line.count('"') % 2 == 1
        yield line


def _delimiter(header: str) -> str:
    """Of a CSV, by its header: a comma, or what spreadsheets put where the comma is the decimal mark."""
    return next((mark for mark in MARKS if mark in header), ",")


def read_table(path: Path, file: IO[bytes], is_header: Callable[[list[str]], bool]) -> Table:
    """The table of a CSV; its header may stand in a remark, as numpy.savetxt puts it there. Errors: InputError."""
    remarks: list[str] = []
    try:
        text = file.read().decode("utf-8-sig")
        lines = list(_without_remarks(io.StringIO(text, newline=""), remarks))
        first = next((line for line in lines if line.strip()), "")
        mark, header = _delimiter(first), None
        reader = csv.reader(lines, delimiter=mark)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
        if remarks and not is_header(rows[0][1] if rows else []):
            header = next((c for c in (next(csv.reader([r], delimiter=mark), []) for r in remarks) if is_header(c)), None)
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: is not a CSV text file; expected the header s,x,y,z") from None
    if header is None:
        header = rows.pop(0)[1] if rows else []
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(
                f"{path}: line {number} has {len(row)} cells, the header {len(header)}; leave a missing marker's cells empty"
            )
    return Table(path, header, [row for _, row in rows], [number for number, _ in rows], mark != ",", remarks)


def ignored(path: Path, what: str, unknown: list[str], known: list[str]) -> None:
    """Say once what is left aside; refuse what looks like a slip of the pen, which would lose a measurement. Errors: InputError."""
    for name in unknown:
        if near := get_close_matches(name.strip().lower(), known, 1, ALIKE):
            raise InputError(f"{path}: unknown {what} '{name.strip()[:40]}'; if it is '{near[0]}', call it that; if not, rename it")
    names = ", ".join(f"'{name.strip()[:40]}'" for name in unknown[:5]) + (", ..." if len(unknown) > 5 else "")
    warnings.warn(
        f"{path}: {what}{'s' * (len(unknown) > 1)} {names} {'are' if unknown[1:] else 'is'} not known and ignored; "
        f"known: {','.join(known)}",
        stacklevel=4,
    )
