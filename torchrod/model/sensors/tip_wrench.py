"""The tip wrench: a load cell at the tip, or at what the tip pushes against."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, unrotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, rows_of, shape_error, variance

FRAMES = ("base", "section")


@dataclass(frozen=True)
class TipWrench(Float64):
    """Readings [force N, moment N m] of what acts on the tip, six rows: the wrench of Unknowns.tip, which must be unknown.

    Source of the wrench: the rod's surroundings, on the rod; a cell that shows what the rod does to them reads the opposite.
    readings: (B, 6), NaN where missing (the moment of a cell that has none). force_noise (N), moment_noise (N m): standard
    deviations of a component, one number or one for each sample (B,). frame: "base", a cell that stands still, with axes in the
    robot's base frame, or "section", one that turns with the tip. orientation: (4,), the cell's axes in that frame (unit quaternion
    x, y, z, w); None: they are the frame's. The moment is about the tip. Errors: ValueError of `check`, and of Problem.check where
    nothing at the tip is unknown.
    """

    readings: Float[Tensor, "B 6"]
    force_noise: float | Float[Tensor, " B"]
    moment_noise: float | Float[Tensor, " B"]
    frame: str = "section"
    orientation: Float[Tensor, "4"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "force_noise", "moment_noise")

    @property
    def s(self) -> Float[Tensor, " P"]:
        """None: it needs the wrench at the tip alone."""
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
        """The force and the moment on the tip, in the cell's axes."""
        wrench = rod.tip_wrench.unflatten(-1, (2, 3))
        if self.frame == "section":
            wrench = unrotate(rod.tip_q.unsqueeze(-2), wrench)
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

    def take(self, index: Int[Tensor, " b"]) -> "TipWrench":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "readings", "force_noise", "moment_noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "TipWrench":
        """No reading where the only group is named."""
        return replace(self, readings=self.readings.masked_fill(groups, torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "TipWrench":
        """Itself: its axes are the robot's, whatever frame the cameras measure in."""
        return self

    def check(self) -> None:
        """Shapes that belong together, a frame, noises."""
        B = len(self.readings)
        if said := shape_error(self, {"readings": (B, 6), "force_noise": (B,), "moment_noise": (B,), "orientation": (4,)}):
            raise ValueError(f"{said} with {B} samples")
        if self.frame not in FRAMES:
            raise ValueError(f"TipWrench.frame is {self.frame!r}; it must be one of {', '.join(FRAMES)}")
        check_noise("TipWrench.force_noise", self.force_noise, "N")
        check_noise("TipWrench.moment_noise", self.moment_noise, "N m")
