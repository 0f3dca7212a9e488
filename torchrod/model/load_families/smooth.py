"""A distributed load of no given form: a Gaussian process along the rod."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import FourierLoads, Load
from ...util.precision import DTYPE
from .family import Gamma, LoadReport
from .fourier import FourierCoordinates

TERMS = 12  # cosines of each component: down to waves of a sixth of the rod, which markers hardly tell from none


@dataclass(frozen=True)
class SmoothCoordinates:
    """f_x and f_y are Matern processes (nu = 1/2, which allows for jumps) of standard deviation `deviation` force scales / L and
    length scale `correlation` L, in cosines:

        f(s) = sum_k (S(k pi / L))^(1/2) z_k phi_k(s),    S(w) = 2 l / (1 + (w l)^2),    z ~ N(0, 1),

    phi_0 = L^-1/2, phi_k = (2 / L)^1/2 cos(k pi s / L). gamma: z of x, then of y. Linear in gamma. Errors: ValueError for scales
    that are not positive. Source: Solin & Sarkka, Statistics and Computing 30 (2020) 419.
    """

    length: float
    force_scale: float
    deviation: float
    correlation: float
    terms: int = TERMS

    def __post_init__(self):
        for name in ("deviation", "correlation"):
            if not getattr(self, name) > 0:
                raise ValueError(f"SmoothCoordinates.{name} is {getattr(self, name)}; it must be positive")

    @property
    def size(self) -> int:
        """Two components."""
        return 2 * self.terms

    @property
    def informative_priors(self) -> int:
        """All of them."""
        return self.size

    @property
    def prior_name(self) -> str:
        """Of the process."""
        return f"smooth({self.correlation:g} L, {self.deviation:g})"

    def _units(self) -> Float[Tensor, " K"]:
        """N/m of the amplitude of a cosine for one unit of z."""
        k, ell = torch.arange(self.terms, dtype=DTYPE), self.correlation
        spectrum = 2 * ell / (1 + (k * math.pi * ell) ** 2)  # with the rod's length as the unit
        return self.deviation * self.force_scale / self.length * (spectrum * torch.where(k == 0, 1.0, 2.0)).sqrt()

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """A Fourier series whose period is twice the rod."""
        cosine = gamma.unflatten(-1, (2, -1)) * self._units()
        return (FourierLoads(cosine, torch.zeros_like(cosine[..., 1:]), 2 * self.length),)

    def start(self) -> Float[Tensor, " n"]:
        """No load."""
        return torch.zeros(self.size, dtype=DTYPE)

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Standard normal."""
        return self.start(), torch.ones(self.size, dtype=DTYPE)

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Times the factor."""
        return factor * gamma

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step: the density is linear in gamma."""
        return gamma + step

    def describe(self, gamma: Gamma) -> LoadReport:
        """The whole load as one: its net force, where that acts and the spread about it."""
        return FourierCoordinates.as_one(self.loads(gamma)[0], self.length)
