"""The compiled kernel: built on first use (build), and what it computes: the march (marching), the fit (fitting, derivatives)."""

from .build import available, library
from .derivatives import measured
from .filtering import Iteration, iterate_all
from .fitting import (
    FAMILIES,
    FitTables,
    Sums,
    balance_now,
    cost_now,
    measure,
    measure_now,
    normal_equations,
    normal_equations_now,
    posterior_now,
    seconds,
)
from .marching import march_linearized, with_rows
from .perceptron import Perceptron
from .structures import SHARED_DIMENSIONS

__all__ = [
    "FAMILIES",
    "SHARED_DIMENSIONS",
    "FitTables",
    "Iteration",
    "Perceptron",
    "Sums",
    "available",
    "balance_now",
    "cost_now",
    "iterate_all",
    "library",
    "march_linearized",
    "measure",
    "measure_now",
    "measured",
    "normal_equations",
    "normal_equations_now",
    "posterior_now",
    "seconds",
    "with_rows",
]
