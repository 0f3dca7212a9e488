"""Files: the robot (TOML), shapes (CSV, NPZ), results (JSON, NPZ), calibrations and what markers see (JSON), data sets."""

from .calibration_file import CALIBRATION_SUFFIXES, unit_of, write_calibration
from .dataset_file import read_dataset_spec
from .observability_file import write_observability, write_observability_table
from .result_file import RESULT_SUFFIXES, read_fit, write_result
from .robot_file import read_robot
from .robot_text import write_calibrated
from .shape_file import Shapes, read_shapes, write_shapes
from .shard_file import Dataset, has_shard, prepare_folder, read_dataset, write_manifest, write_shard

__all__ = [
    "CALIBRATION_SUFFIXES",
    "RESULT_SUFFIXES",
    "Dataset",
    "Shapes",
    "has_shard",
    "prepare_folder",
    "read_dataset",
    "read_dataset_spec",
    "read_fit",
    "read_robot",
    "read_shapes",
    "unit_of",
    "write_calibrated",
    "write_calibration",
    "write_manifest",
    "write_observability",
    "write_observability_table",
    "write_result",
    "write_shapes",
    "write_shard",
]
