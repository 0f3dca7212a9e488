"""A table with a line for each point of a centre line: x, y, z and, of several frames, the frame or its time."""

from pathlib import Path

import numpy as np

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording
from .text import numbers, rows_of

AXES = ("x", "y", "z")
FRAME = ("frame", "sample", "time")


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Columns x, y, z, capitals or not, and `time` of the layout, or frame, sample or time; without a header three columns."""
    rows = [row for row in rows_of(path, content) if any(row) and not row[0].startswith("#")]
    header = [cell.lower() for cell in rows[0]] if rows else []
    named = {*AXES} <= {*header}
    if not named and (len(header) != len(AXES) or layout.time is not None):
        raise InputError(f"{path}: has no columns x, y, z; name them in its first line")
    wanted = (layout.time.lower(),) if layout.time is not None else FRAME
    frame = next((header.index(name) for name in wanted if name in header), None) if named else None
    if frame is None and layout.time is not None:
        raise InputError(f"{path}: has no column {layout.time}; columns: {', '.join(header)[:200]}")
    table = numbers(path, rows, int(named), len(header))
    p = table[:, [header.index(a) for a in AXES] if named else [0, 1, 2]]
    if frame is None:
        return Recording(None, line=p[None])
    when, which, count = np.unique(table[:, frame], return_inverse=True, return_counts=True)
    if not np.isfinite(when).all():
        raise InputError(f"{path}: column {header[frame]} must have a number in every line")
    order = np.argsort(which, kind="stable")
    line = np.full((len(when), count.max(), 3), np.nan)
    line[which[order], np.concatenate([np.arange(n) for n in count])] = p[order]
    timed = layout.time is not None or header[frame] == "time"
    time = when if timed else None if layout.rate is None else (when - when[0]) / layout.rate
    return Recording(time, line=line)
