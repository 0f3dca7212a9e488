"""NDI Aurora and Polaris: the CSV of tracking programs (x y z q0 qx qy qz for each tool) and of NDI ToolBox; mm."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...util.errors import InputError
from .layout import Layout
from .motive import unit
from .recording import Recording
from .text import line_with, numbers, rows_of

DAY = 86400.0  # s
MISSING = ("missing", "disabled", "out of volume", "partially out of volume")


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Columns Sample, Hour, Minutes, Seconds, ms, then seven for each tool, called a, b, c, .. as in the header."""
    rows = rows_of(path, content)
    head = line_with(path, rows, "Sample:")
    names = [cell[1:] for cell in rows[head][5:] if cell[:1] in ("X", "x")]
    width = 5 + 7 * len(names)
    if not names or len([cell for cell in rows[head] if cell]) != width:
        raise InputError(f"{path}: its header has {len(rows[head])} columns; expected five of time and seven for each tool")
    table = numbers(path, rows, head + 1, width)
    clock = table[:, 1:5] @ [3600.0, 60.0, 1.0, 1e-3]
    clock = clock + DAY * np.cumsum(np.diff(clock, prepend=clock[:1]) < -DAY / 2)  # past midnight
    points, rotations = {}, {}
    for i, name in enumerate(names):
        points[name], rotations[name] = _seen(table[:, 5 + 7 * i : 8 + 7 * i], table[:, 8 + 7 * i : 12 + 7 * i])
    return Recording(clock - clock[0], points, rotations, units="mm")


def _seen(p: Float[np.ndarray, "F 3"], q: Float[np.ndarray, "F 4"]) -> tuple[Float[np.ndarray, "F 3"], Float[np.ndarray, "F 4"]]:
    """Of a tool the position and the quaternion as x, y, z, w (it comes w first); zeros are what was not seen."""
    gone = (p == 0).all(-1, keepdims=True) & ((q == 0) | np.isnan(q)).all(-1, keepdims=True)
    return np.where(gone, np.nan, p), unit(q[:, [1, 2, 3, 0]])


def read_toolbox(path: Path, content: bytes, layout: Layout) -> Recording:
    """Groups that begin with a column Port: the tool's name, Frame, Face, State, Q0, Qx, Qy, Qz, Tx, Ty, Tz, Error."""
    rows = rows_of(path, content)
    head = line_with(path, rows, "Tools")
    header = [cell.lower() for cell in rows[head]]
    starts = [i for i, cell in enumerate(header) if cell.startswith("port")]
    if not starts or len(rows) < head + 2:
        raise InputError(f"{path}: has no columns Port in its header, or no frames; export it from NDI ToolBox as CSV")
    lines = [row + [""] * (len(header) - len(row)) for row in rows[head + 1 :] if any(row)]
    points, rotations, frames = {}, {}, None
    for start, end in zip(starts, [*starts[1:], len(header)], strict=True):
        group = header[start:end]
        columns = ["q0", "qx", "qy", "qz", "tx", "ty", "tz"]
        if not {"state", "frame", *columns} <= set(group):
            raise InputError(f"{path}: columns of {rows[head][start]} are missing; expected State, Frame, Q0..Qz, Tx..Tz")
        at = [start + group.index(name) for name in [*columns, "frame"]]
        seen = [row[start + group.index("state")].lower() not in MISSING for row in lines]
        cells = [[row[i] if ok or i == at[-1] else "" for i in at] for row, ok in zip(lines, seen, strict=True)]
        table = numbers(path, cells, 0, 8, blank=True)
        name = next((row[start] for row in lines if row[start]), rows[head][start])
        points[name], rotations[name] = _seen(table[:, 4:7], table[:, :4])
        frames = table[:, 7] if frames is None else np.where(np.isnan(frames), table[:, 7], frames)
    rate = layout.rate
    time = None if rate is None or frames is None else (frames - np.nanmin(frames)) / rate
    return Recording(time, points, rotations, units="mm")
