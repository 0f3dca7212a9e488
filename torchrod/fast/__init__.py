"""The compiled kernel: built on first use (build), and what it computes: the march (marching) and the fit (fitting)."""

from .build import available, library
from .fitting import FAMILIES, FitTables, Sums, iterate, measure, measured, normal_equations, seconds
from .marching import known, march_linearized, with_rows

__all__ = [
    "FAMILIES",
    "FitTables",
    "Sums",
    "available",
    "iterate",
    "known",
    "library",
    "march_linearized",
    "measure",
    "measured",
    "normal_equations",
    "seconds",
    "with_rows",
]
