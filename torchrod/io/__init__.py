"""Files: the robot (TOML), shapes (CSV, NPZ), results (JSON, NPZ), calibrations and what markers see (JSON)."""

from .base_pose import BasePose
from .calibration_file import CALIBRATION_SUFFIXES, calibrated_by, write_calibration
from .observability_file import write_observability, write_observability_table
from .result_file import RESULT_SUFFIXES, Result, read_fit, write_result
from .robot_file import read_base_pose, read_robot
from .robot_text import write_calibrated
from .shape_file import read_shapes, write_shapes
from .shapes import KINDS, Noises, Shapes
from .uncertainty import Calibrated, NearlyKnown, check_parameters, read_uncertainty

__all__ = [
    "CALIBRATION_SUFFIXES",
    "KINDS",
    "RESULT_SUFFIXES",
    "BasePose",
    "Calibrated",
    "NearlyKnown",
    "Noises",
    "Result",
    "Shapes",
    "calibrated_by",
    "check_parameters",
    "read_base_pose",
    "read_fit",
    "read_robot",
    "read_shapes",
    "read_uncertainty",
    "write_calibrated",
    "write_calibration",
    "write_observability",
    "write_observability_table",
    "write_result",
    "write_shapes",
]
