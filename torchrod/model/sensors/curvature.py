"""Curvature at gratings, as fibre Bragg gratings are read out by their interrogator's software."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, rows_of, shape_error, variance


@dataclass(frozen=True)
class Curvature(Float64):
    """Measured curvature of P gratings on B samples: u_x, u_y and, if read, the twist u_z of the section, two or three rows each.

    u (1/m) is the whole curvature, R' = R hat(u), the unloaded rod's own included. s: (P,) m. readings: (B, P, 2) or (B, P, 3) 1/m,
    about the fibre's x, y (and z) axes, NaN where missing. noise (1/m), twist_noise (1/m, that of u_z; None: as noise): standard
    deviations of a component, one number or one for each sample (B,). angle: (P,) rad, by which the fibre's x axis is turned from
    the section's about z; None: not at all. Only differences of orientation show, so it tells nothing of the base frame. Errors:
    ValueError of `check`. Source: docs/model.md (the balance that gives u).
    """

    s: Float[Tensor, " P"]
    readings: Float[Tensor, "B P C"]
    noise: float | Float[Tensor, " B"]
    twist_noise: float | Float[Tensor, " B"] | None = None
    angle: Float[Tensor, " P"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "noise", "twist_noise")

    @property
    def rows(self) -> int:
        """Two or three for each grating."""
        return self.readings.shape[-1] * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A grating's rows."""
        return torch.arange(len(self.s)).repeat_interleave(self.readings.shape[-1])

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """u in the fibre's axes."""
        _, u = rod.strains()
        x, y, z = u.unbind(-1)
        if self.angle is not None:
            c, s = self.angle.cos(), self.angle.sin()
            x, y = c * x + s * y, c * y - s * x
        return torch.stack([x, y, z][: self.readings.shape[-1]], -1).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """As read (1/m)."""
        return self.readings.flatten(1)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2, 1 / twist_noise^2."""
        read = torch.isfinite(self.readings).to(self.readings.dtype)
        bend, twist = variance(self.noise, 2), variance(self.noise if self.twist_noise is None else self.twist_noise, 2)
        return torch.cat([read[..., :2] / bend, read[..., 2:] / twist], -1).flatten(1)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """None."""
        return rows.new_empty(len(rows), 0, 3)

    def take(self, index: Int[Tensor, " b"]) -> "Curvature":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "readings", "noise", "twist_noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "Curvature":
        """The gratings of these groups not read."""
        return replace(self, readings=self.readings.masked_fill(groups.unsqueeze(-1), torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "Curvature":
        """Itself: it sits in the rod, whatever frame others measure in."""
        return self

    def check(self) -> None:
        """Shapes that belong together, two or three numbers a grating, noises."""
        P, B = self.s.numel(), len(self.readings)
        own = {"noise": (B,), "twist_noise": (B,), "angle": (P,)}
        if said := shape_error(self, {"s": (P,), "readings": (B, P, None)} | own):
            raise ValueError(f"{said} with {P} gratings and {B} samples")
        if not P or not B:
            raise ValueError("there are no gratings; give at least one sample with one grating")
        if self.readings.shape[-1] not in (2, 3):
            found = self.readings.shape[-1]
            raise ValueError(f"Curvature.readings has {found} numbers a grating; give kx, ky, or kx, ky and the twist (1/m)")
        check_noise("Curvature.noise", self.noise, "1/m")
        if self.twist_noise is not None:
            check_noise("Curvature.twist_noise", self.twist_noise, "1/m")
