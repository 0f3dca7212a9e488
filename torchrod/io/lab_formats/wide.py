"""Any table with a line for each frame: names of columns in its header, which the layout puts together to points."""

from pathlib import Path

import numpy as np

from ...util.errors import InputError, shown
from .layout import Layout
from .recording import Recording
from .text import numbers, rows_of

ENDS = ("x", "y", "z", "qx", "qy", "qz", "qw")
DIVIDERS = ("", "_", " ", ".", ":", "-")


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Columns NAME_x, NAME_y, NAME_z (or NAMEx, NAME.X, .. or x_NAME) are a point, NAME_qx .. NAME_qw its rotation."""
    rows = [row for row in rows_of(path, content) if any(row) and not row[0].startswith("#")]
    if len(rows) < 2:
        raise InputError(f"{path}: has no frames under its header; give one line per frame")
    header = rows[0]
    if layout.time is not None and layout.time not in header:
        raise InputError(f"{path}: has no column {shown(layout.time)}; columns: {', '.join(header)[:200]}")
    wanted = set(layout.names)
    columns = {name: i for i, name in reversed(list(enumerate(header)))}
    table = numbers(path, rows, 1, len(header))
    lower = {name.lower(): i for name, i in columns.items()}
    points, rotations = {}, {}
    for name in wanted:
        found = {}
        for end in ENDS:
            tried = [f"{name}{d}{end}" for d in DIVIDERS] + [f"{end}{d}{name}" for d in DIVIDERS]
            found[end] = next((lower[t.lower()] for t in tried if t.lower() in lower), None)
        place = [found[end] for end in "xyz"]
        turn = [found[f"q{end}"] for end in "xyzw"]
        if None not in place:
            points[name] = table[:, place]
        if None not in turn:
            points.setdefault(name, np.full((len(table), 3), np.nan))
            rotations[name] = table[:, turn]
    time = table[:, columns[layout.time]] if layout.time is not None else None
    if time is None and layout.rate is not None:
        time = np.arange(len(table)) / layout.rate
    values = {name: table[:, i] for name, i in columns.items()}
    return Recording(time, points, rotations, values)
