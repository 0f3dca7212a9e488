"""Files: the robot (TOML), shapes (CSV, NPZ), results (JSON, NPZ) and data sets (TOML, folders of NPZ and JSON)."""

from .dataset_file import read_dataset_spec
from .result_file import RESULT_SUFFIXES, read_fit, write_result
from .robot_file import read_robot
from .shape_file import Shapes, read_shapes, write_shapes
from .shard_file import Dataset, has_shard, prepare_folder, read_dataset, write_manifest, write_shard

__all__ = [
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
    "write_manifest",
    "write_result",
    "write_shapes",
    "write_shard",
]
