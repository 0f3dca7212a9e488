"""The paper's own parameterization, to stand beside the default."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import GaussianLoads, Load, on_rod_fraction
from ...util.errors import InputError
from ...util.precision import DTYPE
from .family import Gamma, LoadReport


@dataclass(frozen=True)
class PaperCoordinates:
    """The paper's Gaussians (10) in SI units, without a prior. For comparison, not for use.

    gamma holds [a_x (N/m), a_y (N/m), eta, c (1/m^2)] of one load after the other; (12) has the same numbers in the order
    [a_x of all loads, a_y of all, eta of all, c of all]. The centre is (11),

        mu = (beta2 - beta1) / 2 eta / sqrt(eps + eta^2) + (beta2 + beta1) / 2        (m)

    eps: sets the slope of mu over eta. beta1, beta2: the range of mu in m, the rod itself (0 to length) by default; it may reach a
    little beyond. width: sigma (m) of a cold start.
    Errors: InputError where eps, the range or width make no sense. Source: the paper, (10)-(13).
    """

    count: int
    length: float
    width: float = 0.006
    eps: float = 1.0
    beta1: float = 0.0
    beta2: float | None = None

    def __post_init__(self):
        if self.beta2 is None:
            object.__setattr__(self, "beta2", self.length)
        for name in ("eps", "width"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"PaperCoordinates: {name} is {value}; give a positive number")
        b1, b2 = self.range
        if not (math.isfinite(b1) and math.isfinite(b2) and b1 < b2):
            raise InputError(f"PaperCoordinates: the range of mu is {b1} to {b2} m; give a finite beta1 below a finite beta2")
        if b2 <= 0 or b1 >= self.length:
            raise InputError(
                f"PaperCoordinates: the range of mu, {b1} to {b2} m, misses the rod of 0 to {self.length} m; "
                "give beta1 and beta2 in metres along the rod"
            )

    @property
    def range(self) -> tuple[float, float]:
        """beta1 and beta2 (m)."""
        assert self.beta2 is not None
        return self.beta1, self.beta2

    @property
    def informative_priors(self) -> int:
        """None."""
        return 0

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        return 4 * self.count

    def _mu(self, eta: Tensor) -> Tensor:
        """(11), m."""
        b1, b2 = self.range
        return 0.5 * (b2 - b1) * eta / (self.eps + eta * eta).sqrt() + 0.5 * (b2 + b1)

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One GaussianLoads."""
        each = gamma.unflatten(-1, (self.count, 4))
        return (GaussianLoads(each[..., :2], self._mu(each[..., 2]), each[..., 3]),)

    def start(self) -> Float[Tensor, " n"]:
        """No load, evenly spread over the range, of the given width (m)."""
        rows = []
        for k in range(self.count):
            t = 2 * (k + 1) / (self.count + 1) - 1  # of eta / sqrt(eps + eta^2)
            rows.append([0.0, 0.0, t * math.sqrt(self.eps / (1 - t * t)), 0.5 / self.width**2])
        return torch.tensor(rows, dtype=DTYPE).flatten()

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """None."""
        return self.start(), torch.zeros(self.size, dtype=DTYPE)

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Amplitudes times the factor."""
        return (gamma.unflatten(-1, (self.count, 4)) * gamma.new_tensor([factor, factor, 1.0, 1.0])).flatten(-2)

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step, but c by its logarithm: it is positive."""
        each, by = gamma.unflatten(-1, (self.count, 4)), step.unflatten(-1, (self.count, 4))
        c = each[..., 3:] * torch.exp(by[..., 3:] / each[..., 3:])
        return torch.cat([each[..., :3] + by[..., :3], c], -1).flatten(-2)

    def describe(self, gamma: Gamma) -> LoadReport:
        """The net force by (13), mu and sigma."""
        each = gamma.unflatten(-1, (self.count, 4))
        mu, c = self._mu(each[..., 2]), each[..., 3]
        net = each[..., :2] * (math.pi / c).sqrt().unsqueeze(-1)
        return LoadReport(net * on_rod_fraction(mu, c, self.length).unsqueeze(-1), mu, (2 * c) ** -0.5, net)
