"""Point forces, whose locations are nodes of the integration and may be unknown."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import Load, PointForces
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


@dataclass(frozen=True)
class PointCoordinates:
    """Point forces: per load [F_x, F_y, eta], or [F_x, F_y] at known locations (m), and xi where there is a force along the rod.

    Forces are in units of the rod's force scale (N), and the location is L S(eta) as in GaussianCoordinates. length: L (m).
    force_std: standard deviation of each force component's prior about zero, in force scales; weak by default. friction: as in
    GaussianCoordinates. Errors: ValueError as there.
    """

    count: int
    length: float
    force_scale: float
    locations: tuple[float, ...] | None = None
    force_std: float = WEAK_STD
    friction: float | None = None

    def __post_init__(self):
        check_friction(self.friction)
        if self.locations is not None:  # what is kept from call to call is kept by a hash, which a list has not
            object.__setattr__(self, "locations", tuple(self.locations))
        check_loads(self, self.count, self.locations)

    @property
    def per_load(self) -> int:
        """Entries per load: 3, or 2 where the location is known; one more for the force along the rod."""
        return self._places + 2 + (self.friction is not None)

    @property
    def _places(self) -> int:
        return int(self.locations is None)

    @property
    def informative_priors(self) -> int:
        """One per load where its drag has a prior."""
        return self.count if self.friction is not None and math.isfinite(self.friction) else 0

    @property
    def size(self) -> int:
        """The number of entries of gamma."""
        return self.count * self.per_load

    def rescaled(self, gamma: Gamma, factor: float) -> Gamma:
        """Forces times the factor, no load closer to an end than 5 % of the rod, no drag."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        eta = each[..., 2 : 2 + self._places].clamp(-ETA_OF_RESTART, ETA_OF_RESTART)
        return self._joined(factor * each[..., :2], eta).flatten(-2)

    def _joined(self, force: Float[Tensor, "... 2"], eta: Float[Tensor, "... e"]) -> Float[Tensor, "... p"]:
        return torch.cat([force, eta, force.new_zeros(*force.shape[:-1], int(self.friction is not None))], -1)

    def elsewhere(self, sides: tuple[float, float] = (1.0, 1.0)) -> Float[Tensor, "C n"]:
        """As in GaussianCoordinates."""
        if self.count != 1 or self.locations is not None:
            return torch.empty(0, self.size, dtype=DTYPE)
        force, eta = single_loads()
        return self._joined(force * force.new_tensor(sides), eta.unsqueeze(-1))

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma + step."""
        return gamma + step

    def describe(self, gamma: Gamma) -> LoadReport:
        """Force, point of application, width zero."""
        each = gamma.unflatten(-1, (self.count, self.per_load))
        force, axial = each[..., :2] * self.force_scale, None
        if self.friction is not None:
            axial = self.force_scale * along_rod(each[..., :2], each[..., -1], self.friction)
        if self.locations is None:
            at = self.length * torch.sigmoid(each[..., 2])
        else:
            at = torch.tensor(self.locations, dtype=gamma.dtype).expand(*each.shape[:-1])
        return LoadReport(force, at, torch.zeros_like(at), force, axial)

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        """One PointForces."""
        report = self.describe(gamma)
        axial = torch.zeros_like(report.location) if report.axial is None else report.axial
        return (PointForces(torch.cat([report.force, axial.unsqueeze(-1)], -1), report.location),)

    def start(self) -> Float[Tensor, " n"]:
        """No force, evenly spread."""
        none = [0.0] * (self.friction is not None)
        places = [[logit((k + 1) / (self.count + 1))] * self._places for k in range(self.count)]
        return torch.tensor([[0.0, 0.0, *eta, *none] for eta in places], dtype=DTYPE).flatten()

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Zero +- force_std in each force, weak in eta, that of `axial_std` in xi."""
        each = [self.force_std] * 2 + [WEAK_STD] * self._places + axial_std(self.friction, self.force_std)
        std = torch.tensor(each, dtype=DTYPE)
        return torch.zeros(self.size, dtype=DTYPE), std.repeat(self.count) ** -2
