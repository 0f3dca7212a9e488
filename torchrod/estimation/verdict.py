"""Whether a fit explains the markers."""

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from scipy.special import chdtri
from torch import Tensor

from ..kernel import Sums
from ..util.precision import DTYPE
from .evaluator import Prepared

ACCEPT = 0.999  # accepted: chi^2 below this quantile of its distribution


@lru_cache(maxsize=4096)
def limit(dof: int) -> float:
    """The 99.9 % point of chi^2."""
    return float(chdtri(max(dof, 1), 1 - ACCEPT))


@lru_cache(maxsize=64)
def _limits(most: int) -> Float[Tensor, " K"]:
    """That of 0 to so many degrees of freedom."""
    return torch.tensor([limit(dof) for dof in range(most + 1)], dtype=DTYPE)


def verdict(
    prepared: Prepared, sums: Sums, cost: Float[Tensor, " B"]
) -> tuple[Bool[Tensor, "B P"], Float[Tensor, " B"], Int[Tensor, " B"], Bool[Tensor, " B"]]:
    """outlier, chi2 and dof of Estimate, and whether the fit explains the markers: one that leaves most aside does not."""
    model, present = prepared.model, prepared.markers.present
    outlier, inside, chi2 = torch.zeros_like(present), present, cost.clone()
    if math.isfinite(prepared.nu):
        square = (prepared.w * sums.r**2)[:, :-6].unflatten(-1, (-1, 3)).sum(-1)
        outlier = present & (square > limit(3))
        inside = present & ~outlier
        chi2 = cost - sums.cost[:, 0] + (square * inside).sum(-1)
    dof = 3 * inside.sum(-1) + 6 + model.coordinates.informative_priors + model.tension_size - model.size
    most = 3 * present.shape[-1] + 6 + model.size
    return outlier, chi2, dof, (chi2 < _limits(most)[dof.clamp(min=0)]) & (2 * inside.sum(-1) > present.sum(-1))
