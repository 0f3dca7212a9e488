"""Vicon Nexus CSV: a section Trajectories with the frame rate, names, X Y Z, units, then frames."""

from pathlib import Path

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording
from .text import clock, line_with, numbers, rows_of, triplets


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """The trajectories; other sections of the file are left aside."""
    rows = rows_of(path, content)
    first = line_with(path, rows, "Trajectories")
    head = first + line_with(path, rows[first:], "Frame", "Sub Frame")
    if head < first + 3 or len(rows) < head + 2:
        raise InputError(f"{path}: its section Trajectories has no rate, names and units; export it from Nexus as ASCII")
    end = next((i for i in range(head + 2, len(rows)) if not any(rows[i])), len(rows))  # the next section
    try:
        rate = float(rows[first + 1][0])
    except (ValueError, IndexError):
        raise InputError(f"{path}: the line after Trajectories must be the frame rate; export it from Nexus as ASCII") from None
    table = numbers(path, rows[:end], head + 2, len(rows[head]))
    units = next((cell for cell in rows[head + 1] if cell), None)
    return Recording(clock(table, 0, rate if rate > 0 else None), triplets(rows[head - 1], table, 2), units=units)
