"""What every parameterization of the loads supplies to the filter."""

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.loads import Load
from ...util.precision import DTYPE

Gamma = Float[Tensor, "... n"]

# Forces (in force scales), places (of the length) and the number of directions at which a single load is looked for.
ELSEWHERE = (0.5, 1.5, 4.0), (0.4, 0.6, 0.8, 0.95), 8
ETA_OF_RESTART = 3.0  # S(3) = 0.95
FAINT = 1e-3  # in force scales: what a contact that hardly pushes may drag for
WEAK_STD = 10.0  # of the priors that only keep unobservable directions finite (a load of no force has no location)


@dataclass(frozen=True)
class LoadReport:
    """What a person asks for, one entry per load: force (..., K, 2) N (section frame), location (..., K) m, width (..., K) m.

    location is the centroid parameter mu or the point of application, width the Gaussian's sigma (0 for a point force). net_force
    is the paper's (13), which counts what hangs over the tip; force is what acts on the rod. axial (..., K) N: the force along the
    rod, positive towards the tip; None where loads are normal to the rod.
    """

    force: Float[Tensor, "... K 2"]
    location: Float[Tensor, "... K"]
    width: Float[Tensor, "... K"]
    net_force: Float[Tensor, "... K 2"]
    axial: Float[Tensor, "... K"] | None = None


@runtime_checkable
class LoadFamily(Protocol):
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

    def moved(self, gamma: Gamma, step: Gamma, std: Gamma) -> Gamma:
        """gamma moved by a draw `step` of its uncertainty, along curves on which the posterior is most nearly Gaussian.

        gamma + step to first order; std: the standard deviation of every entry.
        """
        ...

    def describe(self, gamma: Gamma) -> LoadReport:
        """Force, location and width of each load."""
        ...


def along_rod(force: Float[Tensor, "... K 2"], xi: Float[Tensor, "... K"], friction: float) -> Float[Tensor, "... K"]:
    """The force along the rod (force scales) of contacts that push with `force` (force scales).

        F_z = mu (|F|^2 + FAINT^2)^(1/2) xi,     xi ~ N(0, 1),

    is N(0, (mu |F|)^2) in an entry xi whose prior depends on nothing else. friction: mu; infinite: F_z = xi, free.
    """
    return xi if math.isinf(friction) else friction * (force.square().sum(-1) + FAINT**2).sqrt() * xi


def axial_std(friction: float | None, force_std: float) -> list[float]:
    """Of the prior of xi: that of a force where it is free; nothing where there is no such entry."""
    return [] if friction is None else [force_std if math.isinf(friction) else 1.0]


def check_friction(friction: float | None) -> None:
    """Refuse what is no coefficient of friction. Errors: ValueError."""
    if friction is not None and not friction > 0:
        raise ValueError(f"friction is {friction}; a contact's must be positive, infinite where the axial force is free, or None")


def check_loads(family: Any, count: int, locations: tuple[float, ...] | None = None) -> None:
    """Refuse scales (fields of the family) that are not positive, and places (m) that are not `count` or not on the rod.

    Errors: ValueError.
    """
    name = type(family).__name__
    for scale in ("length", "force_std"):
        value = getattr(family, scale)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}.{scale} is {value}; it must be positive and finite")
    if not (math.isfinite(family.force_scale) and family.force_scale >= 0):
        raise ValueError(f"{name}.force_scale is {family.force_scale} N; it must be finite and not negative")
    if count < 0:
        raise ValueError(f"{name} of {count} loads; give 0 or more")
    if locations is None:
        return
    length = family.length
    if len(locations) != count:
        raise ValueError(f"{name}.locations has {len(locations)} places for {count} loads; give one for each")
    if not all(0 <= s <= length * (1 + 1e-9) for s in locations):
        raise ValueError(f"{name}.locations is {locations}; they must lie on the rod, 0 to {length} m")


def single_loads() -> tuple[Float[Tensor, "C 2"], Float[Tensor, " C"]]:
    """Forces (force scales) and eta of ELSEWHERE, all with all."""
    sizes, places, directions = ELSEWHERE
    turns = 2 * math.pi * torch.arange(directions, dtype=DTYPE) / directions
    size, place, turn = torch.meshgrid(torch.tensor(sizes, dtype=DTYPE), torch.tensor(places, dtype=DTYPE), turns, indexing="ij")
    return torch.stack([size * turn.cos(), size * turn.sin()], -1).flatten(0, 2), torch.logit(place).flatten()


def logit(t: float) -> float:
    """The inverse of the sigmoid."""
    return math.log(t / (1 - t))
