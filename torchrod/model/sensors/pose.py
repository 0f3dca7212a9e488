"""Poses: position and orientation of sensors on the rod, such as electromagnetic trackers with six degrees of freedom."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, conjugate, logarithm, matvec, product, rotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, check_units, noise_shape, rows_of, shape_error, variance


@dataclass(frozen=True)
class Poses(Float64):
    """Measured poses of P sensors on B samples: position p(s) + R(s) r and orientation R(s) R_r, six rows for each sensor.

    s: (P,) m. positions: (B, P, 3) m and orientations: (B, P, 4), unit quaternions (x, y, z, w), both in the base frame, NaN where
    missing: either may be missing alone. noise (m) and angle_noise (rad): standard deviations of a coordinate and of each component
    of the rotation vector of the orientation's error, one number, one for each sample (B,) or one for each sensor
    (B, P). offsets: (P, 3) m, r in the section frame. mounting: (P, 4), R_r, the sensor's axes in the section frame; None: they are
    the section's.

    The rows of the orientation are the deviation from what was read, Log(R_measured^T R(s) R_r) (rad), so that their reading is 0.
    Errors: ValueError of `check`. Source: J. Sola et al., A micro Lie theory for state estimation in robotics, 2018, (44).
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    orientations: Float[Tensor, "B P 4"]
    noise: float | Float[Tensor, " B"] | Float[Tensor, "B P"]
    angle_noise: float | Float[Tensor, " B"] | Float[Tensor, "B P"]
    offsets: Float[Tensor, "P 3"] | None = None
    mounting: Float[Tensor, "P 4"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "noise", "angle_noise")

    @property
    def present(self) -> Bool[Tensor, "B P 2"]:
        """Whether the position and the orientation of each sensor were read."""
        return torch.stack([torch.isfinite(x).all(-1) for x in (self.positions, self.orientations)], -1)

    @property
    def rows(self) -> int:
        """Six for each sensor."""
        return 6 * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A sensor's six rows."""
        return torch.arange(len(self.s)).repeat_interleave(6)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """[p(s) + R(s) r, Log(R_measured^T R(s) R_r)] for each sensor."""
        p = rod.p if self.offsets is None else rod.p + rotate(rod.q, self.offsets)
        q = rod.q if self.mounting is None else product(rod.q, self.mounting)
        measured = torch.where(torch.isfinite(self.orientations), self.orientations, q.new_tensor([0.0, 0.0, 0.0, 1.0]))
        return torch.cat([p, logarithm(product(conjugate(measured), q))], -1).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """The positions (m), and zero for every orientation that was read."""
        turn = torch.where(torch.isfinite(self.orientations[..., :3]), 0.0, torch.nan)
        return torch.cat([self.positions, turn], -1).flatten(1)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2 and 1 / angle_noise^2."""
        p, q = self.present.to(self.s.dtype).unbind(-1)
        own = [w / variance(noise) for w, noise in ((p, self.noise), (q, self.angle_noise))]
        return torch.stack(own, -1).repeat_interleave(3, -1).flatten(1)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """Those of the positions."""
        return rows.unflatten(-1, (-1, 6))[..., :3]

    def take(self, index: Int[Tensor, " b"]) -> "Poses":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "positions", "orientations", "noise", "angle_noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "Poses":
        """The sensors of these groups not read."""
        gone = groups.unsqueeze(-1)
        return replace(
            self,
            positions=self.positions.masked_fill(gone, torch.nan),
            orientations=self.orientations.masked_fill(gone, torch.nan),
        )

    def moved(self, R: Matrix, t: Vector) -> "Poses":
        """The poses in the frame p' = R p + t."""
        import roma

        turn = roma.rotmat_to_unitquat(R).expand_as(self.orientations)
        return replace(self, positions=matvec(R, self.positions) + t, orientations=product(turn, self.orientations))

    def check(self) -> None:
        """Shapes that belong together, unit quaternions, noises."""
        P, B = self.s.numel(), len(self.positions)
        noises = {name: noise_shape(getattr(self, name), B, P) for name in ("noise", "angle_noise")}
        own = noises | {"offsets": (P, 3), "mounting": (P, 4)}
        if said := shape_error(self, {"s": (P,), "positions": (B, P, 3), "orientations": (B, P, 4)} | own):
            raise ValueError(f"{said} with {P} arc lengths and {B} samples")
        if not P or not B:
            raise ValueError("there are no poses; give at least one sample with one sensor")
        check_units("Poses.orientations", self.orientations, "unit quaternions (x, y, z, w)")
        check_units("Poses.mounting", self.mounting, "unit quaternions (x, y, z, w)")
        check_noise("Poses.noise", self.noise, "m")
        check_noise("Poses.angle_noise", self.angle_noise, "rad")
