"""TENSIONS.csv: what load cells read over time, at a rate of their own."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..util.errors import InputError
from ..util.files import reading
from .csv_file import ignored, read_table

TENSION = re.compile(r"tension_\d+", re.ASCII)
SLIP = 1e-6  # s: what times are rounded to


@dataclass(frozen=True)
class TensionSeries:
    """Readings of T load cells: of each its times (s), increasing, and tensions (N)."""

    path: Path
    cells: list[tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]]

    def at(self, time: Float[Tensor, " B"], shapes: Path) -> Float[Tensor, "B T"]:
        """The tensions (N) at these times (s), linear between readings; shapes: the file that the times are of.

        Errors: InputError where a time lies before the first or after the last reading of a cell.
        """
        t, found = time.numpy(), []
        for i, (at, tension) in enumerate(self.cells):
            outside = (t < at[0] - SLIP) | (t > at[-1] + SLIP)
            if outside.any():
                raise InputError(
                    f"{self.path}: tension_{i + 1} was read from {at[0]:g} to {at[-1]:g} s, but {int(outside.sum())} of {len(t)} "
                    f"samples of {shapes} are of other times ({t.min():g} to {t.max():g} s); leave them out, or give both one clock"
                )
            found.append(np.interp(t, at, tension))
        return torch.from_numpy(np.stack(found, -1))


def read_tensions(path: str | Path, tendons: int) -> TensionSeries:
    """A CSV with the header time,tension_1,..,tension_T (s, N), rows in the order of time; an empty cell is a reading that this
    cell has not. Errors: InputError naming file and remedy.
    """
    path, wanted = Path(path), ["time", *(f"tension_{i + 1}" for i in range(tendons))]
    with reading(path):
        if not path.is_file():
            raise InputError(f"{path}: no such file; check the path")
        with path.open("rb") as file:
            table = read_table(path, file, lambda cells: "time" in [cell.strip().lower() for cell in cells])
    names = [name.strip().lower() for name in table.header]
    for name in wanted:
        if names.count(name) != 1:
            how = "is missing" if name not in names else "stands twice"
            raise InputError(f"{path}: column '{name}' {how}; the header is {','.join(wanted)}")
    if more := [name for name in names if TENSION.fullmatch(name) and name not in wanted]:
        raise InputError(f"{path}: has {more[0]}, but the robot has {tendons} tendons; give one column for each")
    if unknown := [name for name in names if name not in wanted]:
        ignored(path, "column", unknown, wanted)
    if not table.rows:
        raise InputError(f"{path}: has a header but no rows; give one row for each time")
    columns = {name: table.numbers(names.index(name)) for name in wanted}
    time = columns.pop("time")
    if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        bad = ~np.isfinite(time) | (np.diff(time, prepend=-np.inf) <= 0)
        raise InputError(f"{path}: line {table.lines[int(np.flatnonzero(bad)[0])]}: time must be a number, and increase")
    cells = []
    for name, tension in columns.items():
        if np.isinf(tension).any() or not np.isfinite(tension).any():
            raise InputError(f"{path}: column {name} must hold finite numbers (N)")
        read = np.isfinite(tension)
        cells.append((time[read], tension[read]))
    return TensionSeries(path, cells)
