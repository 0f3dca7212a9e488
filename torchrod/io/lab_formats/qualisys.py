"""Qualisys QTM TSV of 3D data: key and value lines, then frames of X Y Z for each marker, mm."""

from pathlib import Path

import numpy as np

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording
from .text import numbers, rows_of, triplets


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """With columns Frame and Time, or without them; markers at exactly (0, 0, 0) were not seen."""
    rows = rows_of(path, content)
    keys = {row[0].upper(): row[1:] for row in rows[:40] if row and row[0].replace("_", "").isalpha()}
    if "MARKER_NAMES" not in keys:
        raise InputError(f"{path}: has no line MARKER_NAMES; export it from QTM as TSV with headers")
    names = [name for name in keys["MARKER_NAMES"] if name]
    last = max(i for i, row in enumerate(rows[:40]) if row and (row[0].replace("_", "").isalpha() or row[0].endswith(" X")))
    table = numbers(path, rows, last + 1)
    first = 2 if table.shape[1] >= 3 * len(names) + 2 else 0
    table = table[:, : first + 3 * len(names)]
    points = triplets([*[""] * first, *(cell for name in names for cell in (name, "", ""))], table, first)
    points = {name: np.where((p == 0).all(-1, keepdims=True), np.nan, p) for name, p in points.items()}
    try:
        rate = float(keys.get("FREQUENCY", ["0"])[0]) if layout.rate is None else layout.rate
    except (ValueError, IndexError):
        rate = 0.0
    time = table[:, 1] if first and layout.rate is None else np.arange(len(table)) / rate if rate > 0 else None
    return Recording(time, points, units="mm")
