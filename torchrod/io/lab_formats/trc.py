"""TRC of OpenSim and Motion Analysis: tabs or commas; frame, time (s), then X Y Z of each marker."""

from pathlib import Path

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording
from .text import line_with, numbers, rows_of, triplets


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Markers by the names of the line Frame#."""
    rows = rows_of(path, content)
    keys = line_with(path, rows, "DataRate")
    head = line_with(path, rows, "Frame#", "Time")
    if len(rows) <= head + 1 or len(rows) <= keys + 1:
        raise InputError(f"{path}: ends within its header; export it again")
    said = dict(zip((key.lower() for key in rows[keys]), rows[keys + 1], strict=False))
    width = 2 + 3 * sum(1 for cell in rows[head][2:] if cell)
    table = numbers(path, rows, head + 2, width)
    return Recording(table[:, 1], triplets(rows[head], table, 2), units=said.get("units"))
