"""A distributed load as a Fourier series."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import FourierLoads, Load
from ...util.precision import DTYPE
from .family import WEAK_STD, Gamma, LoadReport, check_loads


@dataclass(frozen=True)
class FourierCoordinates:
    """A Fourier series of `periods` periods (K): gamma is [a_0..a_K, b_1..b_K] for x, then for y, in units of force scale / L.

    f(s) is that of FourierLoads. length: L (m). force_scale: of the rod (N). force_std: standard deviation of each coefficient's
    prior about zero, in the units of gamma; weak by default. Errors: ValueError for scales that are not positive.
    """

    periods: int
    length: float
    force_scale: float
    force_std: float = WEAK_STD

    def __post_init__(self):
        check_loads(self, self.periods)

    @property
    def informative_priors(self) -> int:
        """None."""
        return 0

    @property
    def size(self) -> int:
        """2 (2 K + 1): 14 for three periods."""
        return 2 * (2 * self.periods + 1)

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One FourierLoads."""
        each = gamma.unflatten(-1, (2, -1)) * (self.force_scale / self.length)
        return (FourierLoads(each[..., : self.periods + 1], each[..., self.periods + 1 :], self.length),)

    def start(self) -> Float[Tensor, " n"]:
        """No load."""
        return torch.zeros(self.size, dtype=DTYPE)

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Zero +- force_std in every coefficient."""
        return self.start(), torch.full((self.size,), self.force_std**-2, dtype=DTYPE)

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Coefficients times the factor."""
        return factor * gamma

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step: the density is linear in the coefficients."""
        return gamma + step

    def describe(self, gamma: Gamma) -> LoadReport:
        """The whole series as one load: its net force, where that acts (as_one) and the spread about it."""
        return self.as_one(self.loads(gamma)[0], self.length)

    @staticmethod
    def as_one(load: Load, length: float) -> LoadReport:
        """A distributed load as one, from 201 places along the rod: its net force F, and the place and the spread

            s_F = int s f . F ds / |F|^2,    spread^2 = int |f| (s - s_F)^2 ds / int |f| ds

        so that F there has the moment of f; at the end of the rod where it would lie beyond, as it may where f changes sign.
        """
        s = torch.linspace(0.0, length, 201, dtype=DTYPE)
        density = load.density(s)
        assert density is not None
        f = density[..., :2]
        net = torch.trapezoid(f, s, dim=-2).unsqueeze(-2)
        along, size = (f * net).sum(-1), net.square().sum((-2, -1)).clamp(min=1e-300)
        middle = 0.5 * length  # of no force
        place = (middle + torch.trapezoid(along * (s - middle), s, dim=-1) / size).clamp(0.0, length)
        weight = f.square().sum(-1).clamp(min=1e-300).sqrt()
        spread = ((weight * (s - place.unsqueeze(-1)) ** 2).sum(-1) / weight.sum(-1)).sqrt()
        return LoadReport(net, place.unsqueeze(-1), spread.unsqueeze(-1), net)
