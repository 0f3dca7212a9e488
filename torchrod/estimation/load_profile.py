"""The load per length along the rod, f(s), and its 95 % band.

The band is that of draws of the posterior, pointwise. A narrow load whose place is uncertain has a density that is far from linear
in it: the first-order band, +-1.96 sqrt(J C J^T) with J = df/dgamma, is nearly zero a few widths from the estimated place and
holds the truth there in 66 to 84 % of cases, not 95 (docs/trust.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.quasirandom import SobolEngine

from ..mechanics.loads import GaussianLoads
from ..model.load_families import LoadFamily
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from ..util.threads import one_thread

NODES = 101
DRAWS = 256  # half of them antithetic; a power of two
CHUNK = 8  # samples drawn at a time: what is sorted stays in cache
FADED = -30.0  # exp(FADED) of a bell's height is nothing; much less would be denormal, which takes ten times as long
LEVELS = (0.025, 0.975)


@dataclass(frozen=True)
class Profile:
    """f(s) of B samples in the section frame.

    s: (S,) m. f: (B, S, 2) N/m, at the estimate. band: (B, S, 3, 2) N/m, the 95 % interval, pointwise, of f_x, f_y and |f|; NaN
    where the fit has not converged. Of one sample (`of`) without the leading dimension.
    """

    s: Float[Tensor, " S"]
    f: Float[Tensor, "*B S 2"]
    band: Float[Tensor, "*B S 3 2"]

    def of(self, sample: int) -> "Profile":
        """One sample."""
        return Profile(self.s, self.f[sample], self.band[sample])


@cache
def _normal(size: int) -> Float[Tensor, "D n"]:
    """DRAWS points of a standard normal distribution in n dimensions, always the same: Sobol points, and their mirror images."""
    uniform = SobolEngine(size, scramble=True, seed=0).draw(DRAWS // 2, dtype=DTYPE)
    half = torch.special.ndtri(uniform.clamp(1e-9, 1 - 1e-9))
    return torch.cat([half, -half])


def _root(C: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
    """A with A A^T = C, of a covariance that may be singular."""
    d = C.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
    size, axes = torch.linalg.eigh(C / d.unsqueeze(-1) / d.unsqueeze(-2))
    return d.unsqueeze(-1) * axes * size.clamp(min=0).sqrt().unsqueeze(-2)


def _density(family: LoadFamily, gamma: Float[Tensor, "... n"], s: Float[Tensor, " S"]) -> Float[Tensor, "... S 2"] | None:
    """f (N/m) of all loads together; None where one of them is a point force."""
    parts = [load.density(s) for load in family.loads(gamma)]
    present = [part for part in parts if part is not None]
    return sum(present[1:], present[0])[..., :2] if len(present) == len(parts) else None


def _band(
    family: LoadFamily, gamma: Float[Tensor, "b g"], C: Float[Tensor, "b g g"], s: Float[Tensor, " S"]
) -> Float[Tensor, "b S 3 2"]:
    """Of draws of the normal posterior, along the curves on which it is most nearly one."""
    step = torch.einsum("bij,dj->bdi", _root(C), _normal(gamma.shape[-1]))
    std = C.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(1)
    return _quantiles(family, family.moved(gamma.unsqueeze(1), step, std), s)


def _values(family: LoadFamily, gamma: Float[Tensor, "b D g"], s: Float[Tensor, " S"]) -> Float[Tensor, "b 3 S D"]:
    """f_x, f_y and |f| of every draw, in single precision, which is sorted in half the time."""
    single = torch.float32
    found = torch.zeros(len(gamma), 3, len(s), gamma.shape[1], dtype=single)
    for load in family.loads(gamma):
        if isinstance(load, GaussianLoads):  # the same as its density, with the draws innermost: a fifth of the time
            for k in range(load.mu.shape[-1]):
                a_x, a_y, c = (v[..., k].to(single).unsqueeze(1) for v in (load.a[..., 0], load.a[..., 1], load.c))
                off = (s.unsqueeze(-1) - load.mu[..., k].unsqueeze(1)).to(single)
                bell = off.square_().mul_(-c).clamp_(min=FADED).exp_().sub_(math.exp(FADED))
                found[:, 0].addcmul_(a_x, bell)
                found[:, 1].addcmul_(a_y, bell)
        else:
            f = load.density(s)
            assert f is not None
            found[:, :2] += f[..., :2].permute(0, 3, 2, 1)
    x, y, size = found.unbind(1)
    torch.mul(x, x, out=size).addcmul_(y, y).sqrt_()
    return found


def _quantiles(family: LoadFamily, gamma: Float[Tensor, "b D g"], s: Float[Tensor, " S"]) -> Float[Tensor, "b S 3 2"]:
    """Pointwise quantiles of f_x, f_y, |f| over DRAWS draws; linear between the order statistics."""
    ordered = _values(family, gamma, s).numpy()
    ordered.sort(-1)
    ends = []
    for level in LEVELS:
        k, share = divmod(level * (DRAWS - 1), 1)
        near = ordered[..., int(k) : int(k) + 2].astype(np.float64)
        ends.append(near[..., 0] * (1 - share) + near[..., 1] * share)
    return torch.from_numpy(np.stack(ends, -1)).transpose(1, 2).contiguous()


def band_of_draws(family: LoadFamily, gamma: Float[Tensor, "B D g"], s: Float[Tensor, " S"]) -> Float[Tensor, "B S 3 2"] | None:
    """The band of DRAWS draws of equal weight that are there already; None for point loads."""
    if family.size == 0:
        return gamma.new_zeros(len(gamma), len(s), 3, 2)
    if _density(family, gamma[:1, :1], s) is None:
        return None
    return torch.cat([_quantiles(family, some, s) for some in gamma.split(CHUNK)])


def densities(family: LoadFamily, gamma: Float[Tensor, "b D g"], s: Float[Tensor, " S"]) -> Float[Tensor, "b 3 S D"] | None:
    """f_x, f_y and |f| (N/m) of draws, in single precision; None for point loads."""
    if family.size == 0:
        return torch.zeros(len(gamma), 3, len(s), gamma.shape[1])
    return None if _density(family, gamma[:1, :1], s) is None else _values(family, gamma, s)


def load_profile(
    problem: Problem, x: Float[Tensor, "B n"], covariance: Float[Tensor, "B n n"], nodes: int = NODES
) -> Profile | None:
    """f(s) at `nodes` evenly spaced places from base to tip, with its band; None for point loads, which have no density.

    x (B, n), covariance (B, n, n): of torchrod.Estimate, in the units of Problem.state. The draws are always the same: equal fits
    have equal bands, whatever their batch.
    """
    family, at, s = (
        problem.unknowns.loads,
        problem.state.loads.at,
        torch.linspace(0.0, problem.robot.rod.length, nodes, dtype=DTYPE),
    )
    gamma, C = x[:, at], covariance[:, at, at]
    if family.size == 0:
        return Profile(s, x.new_zeros(len(x), nodes, 2), x.new_zeros(len(x), nodes, 3, 2))
    f = _density(family, gamma, s)
    if f is None:
        return None
    band = f.new_full((len(f), nodes, 3, 2), torch.nan)
    known = (torch.isfinite(gamma).all(-1) & torch.isfinite(C).flatten(1).all(-1)).nonzero().squeeze(-1)
    with one_thread():
        for index in known.split(CHUNK):
            band[index] = _band(family, gamma[index], C[index], s)
    return Profile(s, f, band)


def joined_profile(
    problem: Problem,
    parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]],
    x: Float[Tensor, "B n"],
    covariance: Float[Tensor, "B n n"],
    nodes: int = NODES,
) -> Profile | None:
    """The same where samples have their own unknowns (analysis.count): parts of the batch, each with what it was fitted by."""
    s, f, band = None, x.new_full((len(x), nodes, 2), torch.nan), x.new_full((len(x), nodes, 3, 2), torch.nan)
    for unknowns, index in parts:
        if not len(index):
            continue
        own = problem.of(unknowns)
        profile = load_profile(own, x[index, : own.size], covariance[index, : own.size, : own.size], nodes)
        if profile is None:
            return None
        s, f[index], band[index] = profile.s, profile.f, profile.band
    return None if s is None else Profile(s, f, band)
