"""FBGS ILLumiSense text: date, time, line number, error status, then a column for each grating, strain in 1e-6."""

from datetime import datetime
from pathlib import Path

import numpy as np

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording
from .text import line_with, numbers, rows_of

FIRST = 4  # columns before the gratings


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """A header block may stand before the line that begins with Date."""
    rows = rows_of(path, content)
    head = line_with(path, rows, "Date", "Time")
    lines = [row for row in rows[head + 1 :] if any(row)]
    names = [name for name in rows[head][FIRST:] if name]
    if not names or not lines:
        raise InputError(f"{path}: has no gratings or no lines; export it from ILLumiSense as text")
    table = numbers(path, [row[FIRST:] for row in lines], 0, len(names), blank=True)
    values = {name: table[:, i] for i, name in enumerate(names)}
    return Recording(_times(lines, layout.rate), values=values)


def _times(lines: list[list[str]], rate: float | None) -> np.ndarray | None:
    """Seconds since the first line: by the rate and the line numbers, else by date and time as far as they tell lines apart."""
    if rate is not None:
        return np.arange(len(lines)) / rate
    stamps = []
    for row in lines:
        text = " ".join(cell for cell in row[:2] if cell).replace(",", ".")
        try:
            stamps.append(datetime.fromisoformat(text).timestamp())
        except ValueError:
            return None
    found = np.array(stamps) - stamps[0]
    return found if len(set(stamps)) == len(stamps) else None
