"""Coordinates of the unknown loads: how a vector gamma of unit-sized numbers becomes loads, and what is known of it.

The filter works on gamma; these classes are the only place that knows what its entries mean. Each supplies loads(gamma), a cold
start, a Gaussian prior (mean and precision per entry; precision 0 for none) and describe(gamma), the quantities a person asks for.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from .lie import Vector
from .loads import FourierLoads, GaussianLoads, Load, PointForces, on_rod_fraction
from .rod import DTYPE

Gamma = Float[Tensor, "... n"]

WIDTH_OF_PRIOR = {"point": 1 / 100, "contact": 1 / 40, "distributed": 1 / 4}  # sigma / L: 4, 10 and 100 mm on the paper's rod
ETA_OF_RESTART = 3.0  # S(3) = 0.95
LOG_C_STD = 1.0  # of the weak prior on log c
WEAK_STD = 10.0  # of the priors that only keep unobservable directions finite (a load of no force has no location)


@dataclass(frozen=True)
class LoadReport:
    """What a person asks for, one entry per load: force (..., K, 2) N (section frame), location (..., K) m, width (..., K) m.

    location is the centroid parameter mu or the point of application, width the Gaussian's sigma (0 for a point force). net_force
    is the paper's (13), which counts what hangs over the tip; force is what acts on the rod.
    """

    force: Float[Tensor, "... K 2"]
    location: Float[Tensor, "... K"]
    width: Float[Tensor, "... K"]
    net_force: Float[Tensor, "... K 2"]


@runtime_checkable
class LoadCoordinates(Protocol):
    """What every parameterization supplies."""

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        ...

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """The loads that gamma means."""
        ...

    def start(self) -> Float[Tensor, " n"]:
        """A cold start."""
        ...

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Mean and precision of each entry."""
        ...

    @property
    def informative_priors(self) -> int:
        """How many prior entries count as data in the chi-square test."""
        ...

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """The same loads with other magnitudes: where to try again when a fit is not accepted."""
        ...

    def describe(self, gamma: Gamma) -> LoadReport:
        """Force, location and width of each load."""
        ...


def logit(t: float) -> float:
    """The inverse of the sigmoid."""
    return math.log(t / (1 - t))


@dataclass(frozen=True)
class GaussianCoordinates:
    """The default: per load [F_x, F_y, eta, log(c L^2)], F the net force on the rod in units of the rod's force scale.

    mu = L S(eta), S the logistic function (11). The amplitude is a = F / (sqrt(pi / c) x fraction of the Gaussian on the rod), so F
    stays what the rod feels when the Gaussian hangs over the tip, where (13) does not. A known location leaves eta out.
    """

    count: int
    length: float
    force_scale: float
    prior_name: str = "contact"
    locations: tuple[float, ...] | None = None

    @property
    def per_load(self) -> int:
        """Entries per load: 4, or 3 where the location is known."""
        return 4 if self.locations is None else 3

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        return self.count * self.per_load

    @property
    def informative_priors(self) -> int:
        """One per load where the width has a prior."""
        return 0 if self.prior_name == "none" else self.count

    def _split(self, gamma: Gamma) -> tuple[Tensor, Tensor, Tensor]:
        """Force (..., K, 2) N, mu (..., K) m, c (..., K) 1/m^2."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        force, c = each[..., :2] * self.force_scale, torch.exp(each[..., -1]) / self.length**2
        if self.locations is None:
            return force, self.length * torch.sigmoid(each[..., 2]), c
        return force, torch.tensor(self.locations, dtype=gamma.dtype).expand(*each.shape[:-1]), c

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One GaussianLoads."""
        force, mu, c = self._split(gamma)
        spread = (math.pi / c).sqrt() * on_rod_fraction(mu, c, self.length)
        return (GaussianLoads(force / spread.unsqueeze(-1), mu, c),)

    def start(self) -> Float[Tensor, " n"]:
        """No force, evenly spread along the rod, the prior's width."""
        rows = []
        for k in range(self.count):
            eta = [] if self.locations is not None else [logit((k + 1) / (self.count + 1))]
            rows.append([0.0, 0.0, *eta, self._log_c()])
        return torch.tensor(rows, dtype=DTYPE).flatten()

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Weak in force and eta; log c has the named prior, +-1."""
        width_std = WEAK_STD if self.prior_name == "none" else LOG_C_STD
        eta = [] if self.locations is not None else [0.0]
        mean = torch.tensor([0.0, 0.0, *eta, self._log_c()], dtype=DTYPE).repeat(self.count)
        std = torch.full((self.per_load,), WEAK_STD, dtype=DTYPE)
        std[-1] = width_std
        return mean, std.repeat(self.count) ** -2

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Forces times the factor, no load closer to an end than 5 % of the rod, the prior's width."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        eta = each[..., 2:-1].clamp(-ETA_OF_RESTART, ETA_OF_RESTART)
        return torch.cat([factor * each[..., :2], eta, torch.full_like(each[..., -1:], self._log_c())], -1).flatten(-2)

    def _log_c(self) -> float:
        name = "contact" if self.prior_name == "none" else self.prior_name
        return -math.log(2 * WIDTH_OF_PRIOR[name] ** 2)

    def describe(self, gamma: Gamma) -> LoadReport:
        """Net force on the rod, mu and sigma = 1 / sqrt(2 c)."""
        force, mu, c = self._split(gamma)
        net = force / on_rod_fraction(mu, c, self.length).unsqueeze(-1)
        return LoadReport(force, mu, (2 * c) ** -0.5, net)


@dataclass(frozen=True)
class PaperCoordinates:
    """The paper's: per load [a_x, a_y, eta, c] in N/m, -, 1/m^2 (10)-(11); no prior. For comparison, not for use."""

    count: int
    length: float
    width: float = 0.02
    informative_priors: int = 0

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        return 4 * self.count

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One GaussianLoads."""
        each = gamma.unflatten(-1, (self.count, 4))
        return (GaussianLoads(each[..., :2], self.length * torch.sigmoid(each[..., 2]), each[..., 3]),)

    def start(self) -> Float[Tensor, " n"]:
        """No load, evenly spread, of the given width (m)."""
        rows = [[0.0, 0.0, logit((k + 1) / (self.count + 1)), 0.5 / self.width**2] for k in range(self.count)]
        return torch.tensor(rows, dtype=DTYPE).flatten()

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """None."""
        return self.start(), torch.zeros(self.size, dtype=DTYPE)

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Amplitudes times the factor."""
        return (gamma.unflatten(-1, (self.count, 4)) * gamma.new_tensor([factor, factor, 1.0, 1.0])).flatten(-2)

    def describe(self, gamma: Gamma) -> LoadReport:
        """The net force by (13), mu and sigma."""
        each = gamma.unflatten(-1, (self.count, 4))
        mu, c = self.length * torch.sigmoid(each[..., 2]), each[..., 3]
        net = each[..., :2] * (math.pi / c).sqrt().unsqueeze(-1)
        return LoadReport(net * on_rod_fraction(mu, c, self.length).unsqueeze(-1), mu, (2 * c) ** -0.5, net)


@dataclass(frozen=True)
class PointCoordinates:
    """Point forces normal to the rod: per load [F_x, F_y, eta], or [F_x, F_y] at known locations (m)."""

    count: int
    length: float
    force_scale: float
    locations: tuple[float, ...] | None = None
    informative_priors: int = 0

    @property
    def per_load(self) -> int:
        """Entries per load: 3, or 2 where the location is known."""
        return 3 if self.locations is None else 2

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        return self.count * self.per_load

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Forces times the factor, no load closer to an end than 5 % of the rod."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        eta = each[..., 2:].clamp(-ETA_OF_RESTART, ETA_OF_RESTART)
        return torch.cat([factor * each[..., :2], eta], -1).flatten(-2)

    def describe(self, gamma: Gamma) -> LoadReport:
        """Force, point of application, width zero."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        force = each[..., :2] * self.force_scale
        if self.locations is None:
            at = self.length * torch.sigmoid(each[..., 2])
        else:
            at = torch.tensor(self.locations, dtype=gamma.dtype).expand(*each.shape[:-1])
        return LoadReport(force, at, torch.zeros_like(at), force)

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One PointForces."""
        report = self.describe(gamma)
        force: Vector = torch.cat([report.force, torch.zeros_like(report.force[..., :1])], -1)
        return (PointForces(force, report.location),)

    def start(self) -> Float[Tensor, " n"]:
        """No force, evenly spread."""
        rows = [[0.0, 0.0] + ([] if self.locations else [logit((k + 1) / (self.count + 1))]) for k in range(self.count)]
        return torch.tensor(rows, dtype=DTYPE).flatten()

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Weak."""
        return torch.zeros(self.size, dtype=DTYPE), torch.full((self.size,), WEAK_STD**-2, dtype=DTYPE)


@dataclass(frozen=True)
class FourierCoordinates:
    """A Fourier series (12) of `periods` periods: [a_0..a_K, b_1..b_K] for x, then for y, in units of force scale / L."""

    periods: int
    length: float
    force_scale: float
    informative_priors: int = 0

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
        """Weak."""
        return self.start(), torch.full((self.size,), WEAK_STD**-2, dtype=DTYPE)

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Coefficients times the factor."""
        return factor * gamma

    def describe(self, gamma: Gamma) -> LoadReport:
        """The whole series as one load: its net force, its centroid (by |f|) and the spread about it."""
        (load,) = self.loads(gamma)
        s = torch.linspace(0.0, self.length, 201, dtype=DTYPE)
        density = load.density(s)
        assert density is not None
        weight = density.square().sum(-1).clamp(min=1e-300).sqrt()
        centroid = (weight * s).sum(-1) / weight.sum(-1)
        spread = ((weight * (s - centroid.unsqueeze(-1)) ** 2).sum(-1) / weight.sum(-1)).sqrt()
        net = torch.trapezoid(density[..., :2], s, dim=-2).unsqueeze(-2)
        return LoadReport(net, centroid.unsqueeze(-1), spread.unsqueeze(-1), net)
