"""Point forces, whose locations are nodes of the integration and may be unknown."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.lie import Vector
from ...mechanics.loads import Load, PointForces
from ...util.precision import DTYPE
from .family import ETA_OF_RESTART, WEAK_STD, Gamma, LoadReport, logit, single_loads


@dataclass(frozen=True)
class PointCoordinates:
    """Point forces normal to the rod: per load [F_x, F_y, eta], or [F_x, F_y] at known locations (m).

    force_std: standard deviation of each force component's prior about zero, in force scales; weak by default.
    """

    count: int
    length: float
    force_scale: float
    locations: tuple[float, ...] | None = None
    force_std: float = WEAK_STD
    informative_priors: int = 0

    def __post_init__(self):
        if self.locations is not None:  # what is kept from call to call is kept by a hash, which a list has not
            object.__setattr__(self, "locations", tuple(self.locations))

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

    def elsewhere(self, sides: tuple[float, float] = (1.0, 1.0)) -> Float[Tensor, "C n"]:
        """As in GaussianCoordinates."""
        if self.count != 1 or self.locations is not None:
            return torch.empty(0, self.size, dtype=DTYPE)
        force, eta = single_loads()
        return torch.cat([force * force.new_tensor(sides), eta.unsqueeze(-1)], -1)

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step."""
        return gamma + step

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
        """Zero +- force_std in each force, weak in eta."""
        std = torch.tensor([self.force_std, self.force_std, WEAK_STD][: self.per_load], dtype=DTYPE)
        return torch.zeros(self.size, dtype=DTYPE), std.repeat(self.count) ** -2
