"""OptiTrack Motive CSV, versions 1.2x, with its header or without; rigid bodies and markers, labelled or not."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...util.errors import InputError, shown
from .layout import Layout
from .recording import Recording
from .text import Rows, numbers, rows_of, triplets, unused


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Without a header: frame, time (s), then X, Y, Z of each marker (m)."""
    rows = rows_of(path, content)
    head = next((i for i, row in enumerate(rows) if [c.lower() for c in row[:2]] == ["frame", "time (seconds)"]), None)
    if head is None:
        table = numbers(path, rows, 0)
        if table.shape[1] < 5:
            raise InputError(f"{path}: has no header, and not frame, time, x, y, z in its lines; export it from Motive as CSV")
        return Recording(table[:, 1], triplets([], table, 2), units="m")
    said = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    if said.get("Rotation Type", "Quaternion").lower() != "quaternion":
        raise InputError(f"{path}: has rotations as {shown(said['Rotation Type'])}; export it with quaternions")
    names, kinds = _labels(path, rows[:head], len(rows[head]))
    table = numbers(path, rows, head + 1, len(rows[head]))
    axes, points, rotations = [cell.upper() for cell in rows[head]], {}, {}
    for column in range(2, table.shape[1] - 2):
        if kinds[column] != "position" or axes[column : column + 3] != ["X", "Y", "Z"]:
            continue
        name = unused(names[column] or f"point {len(points) + 1}", points)
        points[name] = table[:, column : column + 3]
        if column >= 6 and kinds[column - 4] == "rotation" and axes[column - 4 : column] == ["X", "Y", "Z", "W"]:
            rotations[name] = unit(table[:, column - 4 : column])
    return Recording(table[:, 1], points, rotations, units=said.get("Length Units"))


def unit(q: Float[np.ndarray, "F 4"]) -> Float[np.ndarray, "F 4"]:
    """Quaternions of length 1; NaN where there is none."""
    size = np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(np.abs(size - 1) < 0.1, q / np.where(size > 0, size, 1.0), np.nan)


def _labels(path: Path, head: Rows, width: int) -> tuple[list[str], list[str]]:
    """Of every column its name, and whether it is of a position or a rotation; other columns (errors, quality) are neither."""
    rows = {row[1].lower(): row for row in head if len(row) > 2 and row[1]}
    names = next((row for key, row in rows.items() if key == "name"), None)
    kinds = next((row for row in reversed(head) if {"position"} & {cell.lower() for cell in row[2:]}), None)
    if names is None or kinds is None:
        raise InputError(f"{path}: has no rows Name and Position above its frames; export it from Motive as CSV")
    pad = [""] * width
    return (names + pad)[:width], [cell.lower() for cell in (kinds + pad)[:width]]
