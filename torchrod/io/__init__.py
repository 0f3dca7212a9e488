"""Files: the robot (TOML), shapes (CSV, NPZ) and results (JSON, NPZ)."""

from .result_file import RESULT_SUFFIXES, read_fit, write_result
from .robot_file import read_robot
from .shape_file import Shapes, read_shapes, write_shapes

__all__ = ["RESULT_SUFFIXES", "Shapes", "read_fit", "read_robot", "read_shapes", "write_result", "write_shapes"]
