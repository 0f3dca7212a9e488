"""The printed rows of the paper's Tables I-III (tables.csv), grouped into cases, and the means of its errors."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

TEXT = {"I": (0.32, 0.027), "II": (0.51, 0.0264), "III": (0.65, 0.0398)}  # mean errors in the paper's text, N and m
DIRECTION = {"in": (1.0, 0.0), "out": (0.0, 1.0), "": (math.sqrt(0.5), math.sqrt(0.5))}  # of a load, by its plane
READINGS = {"negative_is_pulled": "negative is pulled", "size_only": "size only"}
ROWS = Path(__file__).with_name("tables.csv")


@dataclass(frozen=True)
class Case:
    """One experiment: its printed rows, one per load, and the actuation (cm as printed, which can only be mm)."""

    table: str
    pair: str
    rows: tuple[dict[str, str], ...]

    @property
    def actuation(self) -> tuple[float, ...]:
        """As printed, one per tendon."""
        return tuple(float(self.rows[0][f"actuation_{j + 1}"]) for j in range(1 + (self.table == "III")))

    def pulled(self, reading: str) -> tuple[float, ...]:
        """Displacement (m) under a reading; negative: let go."""
        return tuple(1e-3 * (-a + 0.0 if reading == "negative_is_pulled" else abs(a)) for a in self.actuation)

    @property
    def readings(self) -> list[str]:
        """The readings that differ."""
        return [r for r in READINGS if r == "negative_is_pulled" or self.pulled(r) != self.pulled("negative_is_pulled")]

    @property
    def force(self) -> Tensor:
        """Measured, (K, 2) N."""
        return torch.tensor([[float(r["measured_N"]) * c for c in DIRECTION[r["plane"]]] for r in self.rows], dtype=torch.float64)

    @property
    def location(self) -> Tensor:
        """Measured, (K,) m."""
        return torch.tensor([1e-2 * float(r["measured_cm"]) for r in self.rows], dtype=torch.float64)


def read_cases() -> list[Case]:
    """tables.csv."""
    cases: dict[tuple[str, str], list[dict[str, str]]] = {}
    with ROWS.open(newline="") as file:
        for row in csv.DictReader(file):
            cases.setdefault((row["table"], row["pair"]), []).append(row)
    return [Case(*key, tuple(rows)) for key, rows in cases.items()]


def printed(case: Case, load: int) -> dict[str, Any]:
    """A row of the paper."""
    r = case.rows[load]
    return {
        "table": case.table,
        "pair": case.pair,
        "load": load + 1,
        "plane": r["plane"],
        "actuation_printed": list(case.actuation),
        "measured_N": float(r["measured_N"]),
        "measured_m": 1e-2 * float(r["measured_cm"]),
        "paper_N": float(r["estimated_N"]),
        "paper_m": 1e-2 * float(r["estimated_cm"]),
    }


def paper_means(table: str) -> tuple[float, float]:
    """Mean errors (N, m) of the paper's estimates over its printed rows."""
    rows = [printed(case, k) for case in read_cases() if case.table == table for k in range(len(case.rows))]
    force, location = ([abs(r[f"paper_{u}"] - r[f"measured_{u}"]) for r in rows] for u in ("N", "m"))
    return mean_known(force), mean_known(location)


def mean_known(values: Sequence[float | None]) -> float:
    """Of the numbers among them."""
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else math.nan
