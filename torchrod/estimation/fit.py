"""What a figure needs of one sample's fit, and what speaks for each hypothesis about its loads."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..mechanics.loads import GaussianLoads, Load, PointForces, on_rod_fraction
from .load_profile import Profile


@dataclass(frozen=True)
class Evidence:
    """What speaks for each hypothesis: names (H); bic (B, H), chi^2 + k ln(n), of which the least is chosen; choice (B,), an index.

    NaN where a hypothesis was not needed, inf where its fit did not converge. foreseen (B, H): the BIC that the score test of the
    fit with one load less promises, to first order, by which a hypothesis was needed or not; NaN where there is no such fit.
    """

    names: tuple[str, ...]
    choice: Int[Tensor, " B"]
    bic: Float[Tensor, "B H"]
    foreseen: Float[Tensor, "B H"]


@dataclass(frozen=True)
class Fit:
    """What a figure needs of one sample: force (K, 2) N (section frame), location (K,) m, width (K,) m (0: a point force), base
    wrench (6,) [N, N m], the registration (6,) [m, rad] that carries the rod into the measured frame, or None, the unknown
    force (3,) N at the tip in the base frame, or None, the 95 % intervals (K, 2) m of the locations, NaN where they are not
    known, and the load profile with its band; both None where only the shape is to be drawn.
    """

    force: Float[Tensor, "K 2"]
    location: Float[Tensor, " K"]
    width: Float[Tensor, " K"]
    base_wrench: Float[Tensor, " 6"]
    registration: Float[Tensor, " 6"] | None = None
    tip_force: Float[Tensor, " 3"] | None = None
    location_interval: Float[Tensor, "K 2"] | None = None
    profile: Profile | None = None

    def loads(self, length: float) -> tuple[Load, ...]:
        """The loads as mechanics.loads has them."""
        point = self.width <= 0
        c = 0.5 / self.width[~point] ** 2
        spread = (math.pi / c).sqrt() * on_rod_fraction(self.location[~point], c, length)
        force = torch.cat([self.force, torch.zeros_like(self.force[:, :1])], -1)
        smooth = GaussianLoads(self.force[~point] / spread.unsqueeze(-1), self.location[~point], c)
        return (smooth, PointForces(force[point], self.location[point]))
