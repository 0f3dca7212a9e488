"""What the parts share: where the reference data are, the rows of the summary table, and small helpers."""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[3]
NAVY, RED, TEAL, GREY = "#1b2a41", "#c8102e", "#0a7f8c", "#9a9a9a"
FINE = 160  # steps: RK4 then errs 4^4 times less than with the default 40, so the difference is our own step error
UNITS = {"m": (1e3, "mm"), "N": (1.0, "N"), "N m": (1.0, "N m"), "relative": (1.0, "relative")}


class SkippedError(Exception):
    """The data of a part are not at hand; the message says which."""


def data_folder() -> Path:
    """The reference data: the folder TORCHROD_SHARED names, or shared/data beside the repository."""
    named = os.environ.get("TORCHROD_SHARED")
    return Path(named) if named else ROOT.parent / "shared" / "data"


def third_party(name: str) -> Path:
    """The folder of third-party data, read in place: its licence is its own. Raises SkippedError where it is missing."""
    folder = data_folder() / "third_party" / name
    if not folder.is_dir():
        raise SkippedError(f"no folder third_party/{name} in the shared data (TORCHROD_SHARED, or ../shared/data)")
    return folder


def own_reference(name: str) -> Any:
    """tests/data/NAME_reference.json: reference shapes that the project may carry."""
    path = ROOT / "tests" / "data" / f"{name}_reference.json"
    if not path.is_file():
        raise SkippedError(f"no {path.name} in tests/data")
    return json.loads(path.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Row:
    """A row of the summary table: the error's median, 95 % point and maximum over the cases, in `unit`."""

    reference: str
    what: str
    unit: str
    cases: int
    median: float
    p95: float
    worst: float

    @classmethod
    def of(cls, reference: str, what: str, unit: str, errors: Tensor) -> "Row":
        """errors: one number per case, in `unit` (a key of UNITS)."""
        e = errors.flatten()
        points = [float(e.quantile(q)) for q in (0.5, 0.95, 1.0)]
        return cls(reference, what, unit, len(e), *points)


def as_data(rows: list[Row], **more: Any) -> dict[str, Any]:
    """The figures of a part: its rows under "rows", and whatever else it measured."""
    return {"rows": [asdict(row) for row in rows], **more}


def summary_line(row: dict[str, Any]) -> str:
    """A row of the summary table in Markdown; lengths in mm."""
    scale, unit = UNITS[row["unit"]]
    numbers = " | ".join(f"{scale * row[k]:.2g}" for k in ("median", "p95", "worst"))
    return f"| {row['reference']} | {row['what']} | {row['cases']} | {numbers} | {unit} |"


def tensor(values: Any) -> Tensor:
    """float64, whatever the default."""
    return torch.tensor(values, dtype=torch.float64)


def distance(a: Tensor, b: Tensor) -> Tensor:
    """|a - b| over the last dimension."""
    return (a - b).norm(dim=-1)


def all_solved(*status: Tensor) -> None:
    """A shape that was not solved would leave NaN in the figures: stop instead."""
    if any(bool((s != 0).any()) for s in status):
        raise RuntimeError("a reference shape was not solved")
