"""Luna ODiSI TSV: key and value lines, dashes, rows x-axis, then a measurement a line: strain (1e-6) along one fibre."""

import math
from datetime import datetime
from pathlib import Path

import numpy as np

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording
from .text import numbers, rows_of


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Rows that measure strain; the places along the fibre (m) are those of the row x-axis."""
    rows = rows_of(path, content)
    axis = next((i for i, row in enumerate(rows) if row and row[0].lower().rstrip(":") in ("x-axis", "x axis")), None)
    if axis is None:
        raise InputError(f"{path}: has no row x-axis; export it from ODiSI as TSV")
    lines = [row for row in rows[axis + 1 :] if any(row) and "strain" in [cell.lower() for cell in row[1:4]]]
    first = next((k for k, cell in enumerate(rows[axis][1:], 1) if cell and _is_number(cell)), 0)
    if not lines or not first:
        raise InputError(f"{path}: has no lines of strain after its row x-axis; export strain from ODiSI as TSV")
    x = numbers(path, [rows[axis][first:]], 0)[0]
    strain = numbers(path, [row[first:] for row in lines], 0, len(x), blank=True)
    seen = np.isfinite(x)
    if seen.sum() < 2 or (np.diff(x[seen]) <= 0).any():
        raise InputError(f"{path}: the places of its row x-axis must increase; export it again")
    try:
        stamps = [datetime.fromisoformat(row[0].replace("/", "-")).timestamp() for row in lines]
        time = np.array(stamps) - stamps[0]
    except ValueError:
        time = None if layout.rate is None else np.arange(len(lines)) / layout.rate
    return Recording(time, fibre=(x[seen], 1e-6 * strain[:, seen]))


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False
