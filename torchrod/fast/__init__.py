"""The compiled kernel: built on first use (build), and what it computes: the march (marching) and the fit (fitting)."""

from .build import available, library
from .fitting import (
    FAMILIES,
    FitTables,
    Iteration,
    Sums,
    measure,
    measure_now,
    measured,
    normal_equations,
    normal_equations_now,
    seconds,
)
from .marching import known, march_linearized, with_rows
from .structures import SHARED_DIMENSIONS

__all__ = [
    "FAMILIES",
    "SHARED_DIMENSIONS",
    "FitTables",
    "Iteration",
    "Sums",
    "available",
    "known",
    "library",
    "march_linearized",
    "measure",
    "measure_now",
    "measured",
    "normal_equations",
    "normal_equations_now",
    "seconds",
    "with_rows",
]
