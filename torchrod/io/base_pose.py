"""The pose of a robot's base in the lab's frame, as [base] of ROBOT.toml or of a layout says it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.lie import exponential, product, rotate
from ..util.errors import InputError, shown
from ..util.precision import DTYPE, Float64
from .values import as_numbers, as_table

BASE_KEYS = {"position", "rotation"}
ORTHONORMAL = 1e-3  # by so much the rows of a matrix, or the length of a quaternion, may be off


@dataclass(frozen=True)
class BasePose(Float64):
    """p_lab = R(rotation) p_base + position. position: (3,) m. rotation: (4,), unit quaternion (x, y, z, w)."""

    position: Float[Tensor, "3"]
    rotation: Float[Tensor, "4"]

    def to_lab(self, p: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
        """Points (m) of the base frame in the lab's."""
        return self.turned(p) + self.position

    def moved(self, zeta: Float[Tensor, " 6"]) -> "BasePose":
        """Of a base that is off by zeta (m, rad) in the frame of this one."""
        return BasePose(self.to_lab(zeta[:3]), product(self.rotation, exponential(zeta[3:])))

    def turned(self, v: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
        """Vectors of the base frame in the lab's."""
        return rotate(self.rotation, v)


def _rotation(where: str, value: object) -> Float[Tensor, "4"]:
    """[x, y, z, w], a rotation vector (rad), or three rows of a matrix whose columns are the base's axes in the lab."""
    import roma

    if isinstance(value, list) and len(value) == 4:
        q = torch.tensor(as_numbers(where, value, 4), dtype=DTYPE)
        if abs(float(q.norm()) - 1) > ORTHONORMAL:
            raise InputError(f"{where} is a quaternion of length {float(q.norm()):.4g}; give a unit quaternion [x, y, z, w]")
        return q / q.norm()
    if isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) for row in value):
        R = torch.tensor([as_numbers(f"{where}[{i}]", row, 3) for i, row in enumerate(value)], dtype=DTYPE)
        if float((R @ R.T - torch.eye(3, dtype=DTYPE)).abs().max()) > ORTHONORMAL:
            raise InputError(f"{where} is no rotation matrix: its rows must be of length 1 and at right angles")
        if float(torch.linalg.det(R)) < 0:
            raise InputError(f"{where} is a reflection (its determinant is -1): one of its axes points the other way")
        return roma.rotmat_to_unitquat(roma.special_procrustes(R))
    if isinstance(value, list) and len(value) == 3:
        return exponential(torch.tensor(as_numbers(where, value, 3), dtype=DTYPE))
    raise InputError(
        f"{where} is {shown(value)}; give a unit quaternion [x, y, z, w], a rotation vector (rad) or the rows of a rotation matrix"
    )


def as_base_pose(where: str, value: object) -> BasePose:
    """A table with `position` (m) and `rotation`, either of which may be left out. Errors: InputError."""
    table = as_table(where, value, BASE_KEYS)
    position = as_numbers(f"{where}.position", table.get("position", [0.0, 0.0, 0.0]), 3)
    return BasePose(torch.tensor(position, dtype=DTYPE), _rotation(f"{where}.rotation", table.get("rotation", [0.0, 0.0, 0.0])))
