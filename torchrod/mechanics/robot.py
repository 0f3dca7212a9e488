"""The robot: a rod, its tendons and gravity."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from ..util.precision import DTYPE, Float64
from .lie import Vector
from .loads import LoadIntegrals, PointWrenches
from .rod import Rod
from .tendons import Tendons


@dataclass(frozen=True)
class Robot(Float64):
    """A rod with tendons in a gravity field. gravity: (3,) or (B, 3), m/s^2, base frame. Errors: ValueError for another shape."""

    rod: Rod
    tendons: Tendons = field(default_factory=Tendons)
    gravity: Vector = field(default_factory=lambda: torch.zeros(3, dtype=DTYPE))
    name: str = "rod"

    def __post_init__(self):
        super().__post_init__()
        if self.gravity.ndim not in (1, 2) or self.gravity.shape[-1] != 3:
            raise ValueError(f"gravity has shape {tuple(self.gravity.shape)}; it must be (3,) or (samples, 3), in m/s^2")
        beyond = [t.ends_at for t in self.tendons.tendons if t.ends_at > self.rod.length * (1 + 1e-6)]
        if beyond:
            raise ValueError(f"a tendon ends at {beyond[0]:g} m, beyond the rod's length of {self.rod.length:g} m")

    @property
    def weight(self) -> Vector:
        """Gravity force per length (..., 3), N/m, base frame, without what hangs at points: the mean where it varies."""
        return self.rod.mass_per_length.unsqueeze(-1) * self.gravity

    @property
    def weightless(self) -> bool:
        """True where gravity plays no part."""
        if not bool(self.gravity.any()):
            return True
        return not bool((self.weight != 0).any() | (self.rod.masses[:, 1:] * self.gravity[..., None, :] != 0).any())

    @property
    def point_weights(self) -> PointWrenches:
        """What the masses on the rod pull (..., K, 3), N, base frame."""
        force = self.rod.masses[:, 1:] * self.gravity[..., None, :]
        return PointWrenches(force, torch.zeros_like(force), self.rod.masses[:, 0])

    def weight_beyond(self, s: Float[Tensor, "... S 3"], inside: Float[Tensor, "... S 3"]) -> LoadIntegrals:
        """Wn(s) (N, base frame): the weight that hangs beyond s, rho g (L - s) where the rod is uniform."""
        if self.weightless:
            return LoadIntegrals()
        rod = LoadIntegrals(Wn=self.weight[..., None, None, :] * self.rod.length_beyond(s, inside).unsqueeze(-1))
        if not len(self.rod.masses):
            return rod
        return rod + LoadIntegrals(Wn=self.point_weights.integrals(s, inside).Wn)
