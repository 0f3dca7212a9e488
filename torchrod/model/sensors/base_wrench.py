"""The base wrench: a force-torque sensor under the robot."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, unrotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, rows_of, shape_error, variance


@dataclass(frozen=True)
class BaseWrench(Float64):
    """Readings [force N, moment N m] of a force-torque sensor that carries the robot: R_s^T [n(0), m(0)], six rows.

    n(0), m(0) is what the whole section carries at s = 0, hence the resultant of all external loads, the rod's weight included,
    about the base; where the tendons' actuators hang on the robot's side of the sensor, tendon forces are internal and do not show.
    readings: (B, 6), NaN where missing, tared so that what the sensor carries besides the rod reads zero. force_noise (N),
    moment_noise (N m): standard deviations of a component, one number or one for each sample (B,). orientation: (4,), the sensor's
    axes in the robot's base frame (unit quaternion x, y, z, w); None: they are the base frame's. The sensor's origin is the base's:
    moments about another point must be moved there first. Errors: ValueError of `check`.
    """

    readings: Float[Tensor, "B 6"]
    force_noise: float | Float[Tensor, " B"]
    moment_noise: float | Float[Tensor, " B"]
    orientation: Float[Tensor, "4"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "force_noise", "moment_noise")

    @property
    def s(self) -> Float[Tensor, " P"]:
        """None: it needs the base wrench alone."""
        return self.readings.new_zeros(0)

    @property
    def rows(self) -> int:
        """Six."""
        return 6

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """All six rows are one reading."""
        return torch.zeros(6, dtype=torch.int64)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """R_s^T n(0), R_s^T m(0)."""
        wrench = rod.base_wrench.unflatten(-1, (2, 3))
        return (wrench if self.orientation is None else unrotate(self.orientation, wrench)).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """As read (N, N m)."""
        return self.readings

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / force_noise^2 and 1 / moment_noise^2."""
        read = torch.isfinite(self.readings).to(self.readings.dtype)
        return torch.cat([read[:, :3] / variance(self.force_noise), read[:, 3:] / variance(self.moment_noise)], -1)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """None."""
        return rows.new_empty(len(rows), 0, 3)

    def take(self, index: Int[Tensor, " b"]) -> "BaseWrench":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "readings", "force_noise", "moment_noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "BaseWrench":
        """No reading where the only group is named."""
        return replace(self, readings=self.readings.masked_fill(groups, torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "BaseWrench":
        """Itself: it sits under the robot, whatever frame the cameras measure in."""
        return self

    def check(self) -> None:
        """Shapes that belong together, and noises."""
        B = len(self.readings)
        if said := shape_error(self, {"readings": (B, 6), "force_noise": (B,), "moment_noise": (B,), "orientation": (4,)}):
            raise ValueError(f"{said} with {B} samples")
        check_noise("BaseWrench.force_noise", self.force_noise, "N")
        check_noise("BaseWrench.moment_noise", self.moment_noise, "N m")
