"""torchrod: forces from shape. Estimates the external loads on continuum robots from measured marker positions.

This module is the whole public surface. Batch dimension first, physical dimensions last; SI units; float64.
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .actuation import Actuated, reference_lengths, solve_displacement
    from .calibration import Calibration, calibrate
    from .coordinates import FourierCoordinates, GaussianCoordinates, PaperCoordinates, PointCoordinates
    from .dataset import DatasetSpec, simulate_shard
    from .diagnosis import Diagnosis, diagnose
    from .errors import InputError
    from .estimator import Settings, estimate, paper_settings
    from .fit import Fit
    from .frame import BaseFrame, common_frame
    from .io import Dataset, Shapes, read_dataset, read_dataset_spec, read_robot, read_shapes, write_result, write_shapes
    from .jacobian import forward_jacobian
    from .loads import FourierLoads, GaussianLoads, PointForces, PointWrenches, PolynomialLoads
    from .measurement import Markers, Model
    from .noise import Noise, estimate_noise, estimate_noise_among
    from .observability import Observability, bounds, load_bound
    from .placement import Placement, place
    from .plot import draw, draw_on
    from .profile import Profile, load_profile
    from .result import Estimate
    from .robot import Robot
    from .rod import Rod
    from .starts import Start, cold_start
    from .statics import Equilibrium, Shape, shape_from_base, solve_shape
    from .status import Status
    from .stream import Estimator
    from .tendons import Tendon, Tendons
    from .warmstart import WarmStart, find_warm_start

_HOMES = {
    "actuation": ("Actuated", "reference_lengths", "solve_displacement"),
    "calibration": ("Calibration", "calibrate"),
    "coordinates": ("FourierCoordinates", "GaussianCoordinates", "PaperCoordinates", "PointCoordinates"),
    "dataset": ("DatasetSpec", "simulate_shard"),
    "diagnosis": ("Diagnosis", "diagnose"),
    "errors": ("InputError",),
    "estimator": ("Settings", "estimate", "paper_settings"),
    "fit": ("Fit",),
    "frame": ("BaseFrame", "common_frame"),
    "io": (
        "Dataset",
        "Shapes",
        "read_dataset",
        "read_dataset_spec",
        "read_robot",
        "read_shapes",
        "write_result",
        "write_shapes",
    ),
    "jacobian": ("forward_jacobian",),
    "loads": ("FourierLoads", "GaussianLoads", "PointForces", "PointWrenches", "PolynomialLoads"),
    "measurement": ("Markers", "Model"),
    "noise": ("Noise", "estimate_noise", "estimate_noise_among"),
    "observability": ("Observability", "bounds", "load_bound"),
    "placement": ("Placement", "place"),
    "plot": ("draw", "draw_on"),
    "profile": ("Profile", "load_profile"),
    "result": ("Estimate",),
    "robot": ("Robot",),
    "rod": ("Rod",),
    "starts": ("Start", "cold_start"),
    "statics": ("Equilibrium", "Shape", "shape_from_base", "solve_shape"),
    "status": ("Status",),
    "stream": ("Estimator",),
    "tendons": ("Tendon", "Tendons"),
    "warmstart": ("WarmStart", "find_warm_start"),
}
__all__ = [
    "Actuated",
    "BaseFrame",
    "Calibration",
    "Dataset",
    "DatasetSpec",
    "Diagnosis",
    "Equilibrium",
    "Estimate",
    "Estimator",
    "Fit",
    "FourierCoordinates",
    "FourierLoads",
    "GaussianCoordinates",
    "GaussianLoads",
    "InputError",
    "Markers",
    "Model",
    "Noise",
    "Observability",
    "PaperCoordinates",
    "Placement",
    "PointCoordinates",
    "PointForces",
    "PointWrenches",
    "PolynomialLoads",
    "Profile",
    "Robot",
    "Rod",
    "Settings",
    "Shape",
    "Shapes",
    "Start",
    "Status",
    "Tendon",
    "Tendons",
    "WarmStart",
    "bounds",
    "calibrate",
    "cold_start",
    "common_frame",
    "diagnose",
    "draw",
    "draw_on",
    "estimate",
    "estimate_noise",
    "estimate_noise_among",
    "find_warm_start",
    "forward_jacobian",
    "load_bound",
    "load_profile",
    "paper_settings",
    "place",
    "read_dataset",
    "read_dataset_spec",
    "read_robot",
    "read_shapes",
    "reference_lengths",
    "shape_from_base",
    "simulate_shard",
    "solve_displacement",
    "solve_shape",
    "write_result",
    "write_shapes",
]


def __getattr__(name: str) -> object:
    """Import a public name on first use, so that `torchrod --help` need not wait for torch."""
    for home, names in _HOMES.items():
        if name in names:
            value = getattr(importlib.import_module(f".{home}", __name__), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'torchrod' has no attribute {name!r}")
