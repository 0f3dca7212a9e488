"""The default parameterization: Gaussian loads by their net force, location and log width."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import GaussianLoads, Load, on_rod_fraction
from ...util.precision import DTYPE
from .family import (
    ETA_OF_RESTART,
    WEAK_STD,
    Gamma,
    LoadReport,
    along_rod,
    axial_std,
    check_friction,
    check_loads,
    logit,
    single_loads,
)

WIDTH_OF_PRIOR = {"point": 1 / 100, "contact": 1 / 40, "distributed": 1 / 4}  # sigma / L: 4, 10 and 100 mm on the paper's rod
LOG_C_STD = 1.0  # of the weak prior on log c
KNOWN = 0.5  # a force or a place with less relative error than this is known well enough for its logarithm to have one
SPREAD_LIMIT = 10.0  # of log |F|: what is drawn beyond it is not used, and must not overflow


@dataclass(frozen=True)
class GaussianCoordinates:
    """The default: per load [F_x, F_y, eta, log(c L^2)], F the net force on the rod in units of the rod's force scale.

    mu = L S(eta), S the logistic function: ours, the paper's (11) is algebraic (PaperCoordinates). The amplitude is
    a = F / (sqrt(pi / c) x fraction of the Gaussian on the rod), so F stays what the rod feels when the Gaussian hangs over the
    tip, where (13) does not. A known location leaves eta out. friction: mu of contacts that may drag along the rod, each by
    F_z ~ N(0, (mu |F|)^2); infinite: F_z is free; None: loads are normal to the rod. It adds a last entry xi (`along_rod`).
    force_std: standard deviation of each force component's prior about zero, in force scales; weak by default.
    length: L (m). force_scale: of the rod (N). prior_name: what is known of a width, log(c L^2) +-1 about sigma = L / 100
    ("point"), L / 40 ("contact") or L / 4 ("distributed"), or "none". locations: known ones (m), one for each load. Errors:
    ValueError for scales that are not positive, another prior, and locations that are not on the rod. Source: the paper, (10).
    """

    count: int
    length: float
    force_scale: float
    prior_name: str = "contact"
    locations: tuple[float, ...] | None = None
    force_std: float = WEAK_STD
    friction: float | None = None

    def __post_init__(self):
        check_friction(self.friction)
        if self.locations is not None:  # what is kept from call to call is kept by a hash, which a list has not
            object.__setattr__(self, "locations", tuple(self.locations))
        check_loads(self, self.count, self.locations)
        if self.prior_name not in (*WIDTH_OF_PRIOR, "none"):
            known = ", ".join((*WIDTH_OF_PRIOR, "none"))
            raise ValueError(f"GaussianCoordinates.prior_name is {self.prior_name!r}; it must be one of {known}")

    @property
    def per_load(self) -> int:
        """Entries per load: 4, or 3 where the location is known; one more for the force along the rod."""
        return self._width + 1 + (self.friction is not None)

    @property
    def _width(self) -> int:
        """Which of them is log c."""
        return 3 if self.locations is None else 2

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        return self.count * self.per_load

    @property
    def informative_priors(self) -> int:
        """One per load where the width has a prior, and one where its drag has."""
        of_drag = self.friction is not None and math.isfinite(self.friction)
        return self.count * ((self.prior_name != "none") + of_drag)

    def _split(self, gamma: Gamma) -> tuple[Tensor, Tensor, Tensor]:
        """Force (..., K, 2) N, mu (..., K) m, c (..., K) 1/m^2."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        force, c = each[..., :2] * self.force_scale, torch.exp(each[..., self._width]) / self.length**2
        if self.locations is None:
            return force, self.length * torch.sigmoid(each[..., 2]), c
        return force, torch.tensor(self.locations, dtype=gamma.dtype).expand(*each.shape[:-1]), c

    def axial(self, gamma: Gamma) -> Float[Tensor, "... K"] | None:
        """The forces along the rod (N); None where there are none."""
        if self.friction is None:
            return None
        each = gamma.unflatten(-1, (self.count, self.per_load))
        return self.force_scale * along_rod(each[..., :2], each[..., -1], self.friction)

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One GaussianLoads."""
        (force, mu, c), axial = self._split(gamma), self.axial(gamma)
        if axial is not None:
            force = torch.cat([force, axial.unsqueeze(-1)], -1)
        spread = (math.pi / c).sqrt() * on_rod_fraction(mu, c, self.length)
        return (GaussianLoads(force / spread.unsqueeze(-1), mu, c),)

    def start(self) -> Float[Tensor, " n"]:
        """No force, evenly spread along the rod, the prior's width."""
        rows, none = [], [0.0] * (self.friction is not None)
        for k in range(self.count):
            eta = [] if self.locations is not None else [logit((k + 1) / (self.count + 1))]
            rows.append([0.0, 0.0, *eta, self.log_c, *none])
        return torch.tensor(rows, dtype=DTYPE).flatten()

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Zero +- force_std in each force, weak in eta; log c has the named prior, +-1, and xi that of `axial_std`."""
        width_std = WEAK_STD if self.prior_name == "none" else LOG_C_STD
        drag = axial_std(self.friction, self.force_std)
        mean, std = torch.zeros(self.per_load, dtype=DTYPE), torch.full((self.per_load,), WEAK_STD, dtype=DTYPE)
        std[:2], mean[self._width], std[self._width] = self.force_std, self.log_c, width_std
        std[self._width + 1 :] = torch.tensor(drag, dtype=DTYPE)
        return mean.repeat(self.count), std.repeat(self.count) ** -2

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Forces times the factor, no load closer to an end than 5 % of the rod, the prior's width, no drag."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        eta = each[..., 2 : self._width].clamp(-ETA_OF_RESTART, ETA_OF_RESTART)
        return self._joined(factor * each[..., :2], eta).flatten(-2)

    def _joined(self, force: Float[Tensor, "... 2"], eta: Float[Tensor, "... e"]) -> Float[Tensor, "... p"]:
        """The entries of loads of these forces (force scales) at these places, of the prior's width and without drag."""
        none = force.new_zeros(*force.shape[:-1], int(self.friction is not None))
        return torch.cat([force, eta, torch.full_like(force[..., :1], self.log_c), none], -1)

    def with_drag(self, gamma: Gamma) -> Gamma:
        """gamma of loads without an entry xi (which a learned start does not know), with xi = 0 in its place."""
        if self.friction is None or not self.count:
            return gamma
        return torch.nn.functional.pad(gamma.unflatten(-1, (self.count, -1)), (0, 1)).flatten(-2)

    def one_more(self, force: Float[Tensor, "B 2"], eta: Float[Tensor, " B"]) -> Float[Tensor, "B p"]:
        """The entries of one load (force scales) at an unknown place."""
        return self._joined(force, eta.unsqueeze(-1))

    def elsewhere(self, sides: tuple[float, float] = (1.0, 1.0)) -> Float[Tensor, "C n"]:
        """A single load of several sizes, places and directions (C, n), where to look when a fit is plainly wrong.

        sides: Rod.sides; a push along the soft side of a flat backbone is of its own scale. None, (0, n), for more loads, or for
        one whose place is known.
        """
        if self.count != 1 or self.locations is not None:
            return torch.empty(0, self.size, dtype=DTYPE)
        force, eta = single_loads()
        return self.one_more(force * force.new_tensor(sides), eta)

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step where a force or a place is hardly known; else along [log |F|, direction, log location, log c].

        A push nearer the base looks like a weaker one farther out: the posterior is a banana in newtons and metres and more nearly
        an ellipse in these logarithms.
        """
        each, by, std = (v.unflatten(-1, (self.count, self.per_load)) for v in torch.broadcast_tensors(gamma, step, std))
        F, dF = each[..., :2], by[..., :2]
        size = F.norm(dim=-1, keepdim=True).clamp(min=1e-300)
        along, across = F / size, torch.stack([-F[..., 1], F[..., 0]], -1) / size
        growth, turn = ((dF * e).sum(-1, keepdim=True) / size for e in (along, across))
        curved = size * growth.clamp(max=SPREAD_LIMIT).exp() * (turn.cos() * along + turn.sin() * across)
        sure = std[..., :2].norm(dim=-1, keepdim=True) < KNOWN * size
        parts = [torch.where(sure, curved, F + dF), each[..., 2:] + by[..., 2:]]
        if self.locations is None:
            place = torch.sigmoid(each[..., 2:3])
            farther = (place * torch.exp((1 - place) * by[..., 2:3])).clamp(1e-6, 1 - 1e-6)
            sure = (1 - place) * std[..., 2:3] < KNOWN
            parts[1:] = [torch.where(sure, torch.logit(farther), parts[1][..., :1]), parts[1][..., 1:]]
        return torch.cat(parts, -1).flatten(-2)

    def report_slope(self, gamma: Gamma) -> Float[Tensor, "... K 4"]:
        """How each of [F_x, F_y, location, width], as described, moves with the one entry of gamma that moves it; 0: none does."""
        _, mu, c = self._split(gamma)
        force = torch.full_like(mu, self.force_scale)
        location = mu * (1 - mu / self.length) if self.locations is None else torch.zeros_like(mu)
        return torch.stack([force, force, location, -0.5 * (2 * c) ** -0.5], -1)

    @property
    def log_c(self) -> float:
        """The prior mean of log(c L^2)."""
        name = "contact" if self.prior_name == "none" else self.prior_name
        return -math.log(2 * WIDTH_OF_PRIOR[name] ** 2)

    def describe(self, gamma: Gamma) -> LoadReport:
        """Net force on the rod, mu and sigma = 1 / sqrt(2 c)."""
        force, mu, c = self._split(gamma)
        net = force / on_rod_fraction(mu, c, self.length).unsqueeze(-1)
        return LoadReport(force, mu, (2 * c) ** -0.5, net, self.axial(gamma))
