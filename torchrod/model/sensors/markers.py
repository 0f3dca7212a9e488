"""Markers: positions of points on the rod, from a tracker or a camera system."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, matvec, rotate
from ...util.precision import Float64
from .sensor import RodState, check_noise, noise_shape, shape_error, variance


@dataclass(frozen=True)
class Markers(Float64):
    """Measured positions of P markers on B samples: p(s) + R(s) r + noise, three rows for each marker.

    s: (P,) m, arc lengths. positions: (B, P, 3) m, base frame, NaN where a marker is missing. noise: standard deviation of a
    coordinate (m), one number, one for each sample (B,) or one for each marker of each sample (B, P). offsets: (P, 3) m, r, from
    the centre line in the section frame. Errors: ValueError of `check`.
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    noise: float | Float[Tensor, " B"] | Float[Tensor, "B P"]
    offsets: Float[Tensor, "P 3"] | None = None

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.noise, Tensor):
            object.__setattr__(self, "noise", float(self.noise))

    @property
    def present(self) -> Bool[Tensor, "B P"]:
        """Which markers were seen."""
        x, y, z = torch.isfinite(self.positions).unbind(-1)  # .all(-1) takes three times as long
        return x & y & z

    @property
    def rows(self) -> int:
        """Three for each marker."""
        return 3 * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A marker's three rows."""
        return torch.arange(len(self.s)).repeat_interleave(3)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """p(s) + R(s) r."""
        return (rod.p if self.offsets is None else rod.p + rotate(rod.q, self.offsets)).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """The positions (m)."""
        return self.positions.flatten(1)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2."""
        return (self.present.to(self.s.dtype) / variance(self.noise)).repeat_interleave(3, -1)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """All of them."""
        return rows.unflatten(-1, (-1, 3))

    def take(self, index: Int[Tensor, " b"]) -> "Markers":
        """The samples of an index."""
        noise = self.noise[index] if isinstance(self.noise, Tensor) else self.noise
        return Markers(self.s, self.positions[index], noise, self.offsets)

    def without(self, groups: Bool[Tensor, "B G"]) -> "Markers":
        """The markers of these groups missing."""
        return replace(self, positions=self.positions.masked_fill(groups.unsqueeze(-1), torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "Markers":
        """The positions in the frame p' = R p + t."""
        return replace(self, positions=matvec(R, self.positions) + t)

    def check(self) -> None:
        """Shapes that belong together, at least one marker of one sample, finite arc lengths, a noise."""
        P, B = self.s.numel(), len(self.positions)
        if said := shape_error(
            self, {"s": (P,), "positions": (B, P, 3), "noise": noise_shape(self.noise, B, P), "offsets": (P, 3)}
        ):
            raise ValueError(f"{said} with {P} arc lengths and {B} samples")
        if not P or not B:
            raise ValueError("there are no markers; give at least one sample with markers")
        check_noise("Markers.noise", self.noise, "m")
