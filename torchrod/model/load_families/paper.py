"""The paper's own parameterization, to stand beside the default."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import GaussianLoads, Load, on_rod_fraction
from ...util.precision import DTYPE
from .family import Gamma, LoadReport, logit


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

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step, but c by its logarithm: it is positive."""
        each, by = gamma.unflatten(-1, (self.count, 4)), step.unflatten(-1, (self.count, 4))
        c = each[..., 3:] * torch.exp(by[..., 3:] / each[..., 3:])
        return torch.cat([each[..., :3] + by[..., :3], c], -1).flatten(-2)

    def describe(self, gamma: Gamma) -> LoadReport:
        """The net force by (13), mu and sigma."""
        each = gamma.unflatten(-1, (self.count, 4))
        mu, c = self.length * torch.sigmoid(each[..., 2]), each[..., 3]
        net = each[..., :2] * (math.pi / c).sqrt().unsqueeze(-1)
        return LoadReport(net * on_rod_fraction(mu, c, self.length).unsqueeze(-1), mu, (2 * c) ** -0.5, net)
