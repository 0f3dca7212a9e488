"""How large an unknown wrench at the tip is: the size of its prior, by its evidence.

Positions hardly tell a moment about the rod's axis, and of a force and a moment together little but a part: what fits best lies
anywhere along a valley, at forces of any size. Of all that explain the readings alike, a small wrench is the likelier one:

    (1)  p(F_x, F_y | sigma_F) = N(0, sigma_F^2 1),    p(M_x, M_y | sigma_M) = N(0, sigma_M^2 1),

log sigma even between LEAST and TIP_STD scales, which is (2) of estimation.chart. Of what acts along the base's axis a rod that is
hardly bent tells nothing: that force keeps its weak prior, and the moment has one of TORQUE_STD, beyond which torques wind it up.
Fits for a row of sizes, each begun from that of the next smaller ones, stay on the branch that leads to no wrench at all.
By Laplace's method

    (2)  log p(z | sigma) = -cost / 2 + log det C_yy / 2 - 2 log sigma_F - 2 log sigma_M + const

with the fit's covariance C_yy of everything but the base wrench. The fit of the best sizes is reported, and the covariance of all
of them about it, each weighted by (2). Source: MacKay, Neural Computation 4 (1992) 415.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..model.problem import Problem
from ..model.unknowns import TIP_STD
from ..util.status import Status
from .chart import TORQUE_STD
from .result import Estimate, limit, with_covariance
from .starts import Origin, Start, cold_start

LEAST = 0.015  # force and moment scales
SIZES = (LEAST, 0.08, 0.4, 2.0, TIP_STD)
PER_BLOCK, LATERAL = 3, 2  # entries of a force, and of a moment; of them across the base's axis
CHUNK = 512  # samples whose fits of all sizes are kept at a time
Fitting = Callable[[Problem, Start], Estimate]


def sized(problem: Problem, fit: Estimate, fitting: Fitting) -> Estimate:
    """The fit of the best sizes, of every sample that can be fitted.

    fit: by the weak prior; a problem with a prior of its own, or without an unknown moment at the tip, keeps it. fitting: a plain
    solver.
    """
    valid = (fit.status != int(Status.INVALID)).nonzero().squeeze(-1)
    if problem.state.tip.size < 2 * PER_BLOCK or problem.prior is not None or not len(valid):
        return fit
    for at in valid.split(CHUNK):
        part, given = problem.take(at), fit.of(at, problem.size)
        best = _mixture(part, given, _of_all_sizes(part, fitting))
        fit = fit.merged(best, at, torch.isfinite(best.cost))
    return fit


Weighed = tuple[Estimate, Float[Tensor, " B"]]


def _of_all_sizes(problem: Problem, fitting: Fitting) -> list[Weighed]:
    """Fits of force and moment of every size, with (2)."""
    found: list[Weighed] = []
    x = cold_start(problem).x
    for k in range(len(SIZES)):
        found += _fitted(problem, [(k, k)], x, fitting)
        x = found[-1][0].x.nan_to_num(0.0)
        found += _fitted(problem, [sizes for smaller in range(k) for sizes in ((smaller, k), (k, smaller))], x, fitting)
    return found


def _fitted(problem: Problem, of_sizes: list[tuple[int, int]], x: Float[Tensor, "B n"], fitting: Fitting) -> list[Weighed]:
    """Fits of some sizes of force and moment, all begun at x, with the cost and the verdict of the weak prior, which the readings
    do not feel.
    """
    at, B, parts = problem.state.tip.at, problem.batch, []
    for force, moment in of_sizes:
        precision = problem.precision.clone()
        across = ([SIZES[k] ** -2] * LATERAL for k in (force, moment))
        precision[at] = torch.tensor([*next(across), TIP_STD**-2, *next(across), TORQUE_STD**-2], dtype=x.dtype)
        parts.append(precision)
    if not parts:
        return []
    many = problem.take(torch.arange(B).repeat(len(parts)))
    precision = torch.stack(parts).repeat_interleave(B, 0)
    fit = fitting(replace(many, prior=(many.mean.expand_as(precision), precision)), Start.at(x.repeat(len(parts), 1), Origin.COLD))
    each = torch.tensor([[SIZES[k] for k in sizes] for sizes in of_sizes], dtype=x.dtype).repeat_interleave(B, 0)
    log_evidence = _log_evidence(problem, fit, each)
    extra = ((precision - problem.precision)[:, at] * fit.x[:, at] ** 2).sum(-1)
    cost, chi2 = fit.cost - extra, fit.chi2 - extra
    explained = chi2 < torch.tensor([limit(k) for k in fit.dof.tolist()], dtype=x.dtype)
    accepted = fit.accepted | (explained & (fit.status == int(Status.CONVERGED)) & ~fit.outlier.any(-1))
    fit = replace(fit, cost=cost, chi2=chi2, accepted=accepted)
    return [(fit.of(rows, problem.size), log_evidence[rows]) for rows in torch.arange(len(precision)).split(B)]


def _log_evidence(problem: Problem, fit: Estimate, sizes: Float[Tensor, "B 2"]) -> Float[Tensor, " B"]:
    """(2) with sigma_F and sigma_M of each fit; -inf where it has not converged. cost: as the fit itself has it."""
    m = problem.state.base.at.start
    C = fit.covariance[:, :m, :m]
    unit = C.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
    L = torch.linalg.cholesky_ex(C / unit.unsqueeze(-1) / unit.unsqueeze(-2))[0].diagonal(dim1=-2, dim2=-1)
    value = -0.5 * fit.cost + (L.log() + unit.log()).sum(-1) - LATERAL * sizes.log().sum(-1)
    sound = (fit.status == int(Status.CONVERGED)) & torch.isfinite(value)
    return torch.where(sound, value, -torch.inf)


def _mixture(problem: Problem, given: Estimate, tried: list[Weighed]) -> Estimate:
    """The fit of the largest (2), with the covariance of all about it; the given one where none has converged."""
    log_evidence = torch.stack([one for _, one in tried])
    best, everyone = log_evidence.argmax(0), torch.arange(problem.batch)
    known = torch.isfinite(log_evidence).any(0)
    fit = given
    for k, (other, _) in enumerate(tried):
        fit = fit.merged(other, everyone, known & (best == k))
    weight = torch.softmax(log_evidence, 0).nan_to_num(0.0)[..., None, None]
    off = torch.stack([other.x for other, _ in tried]) - fit.x
    spread = torch.stack([other.covariance for other, _ in tried]) + off.unsqueeze(-1) * off.unsqueeze(-2)
    covariance = torch.where(weight > 0, weight * spread, 0.0).sum(0)
    return with_covariance(problem, fit, torch.where(known[:, None, None], covariance, fit.covariance))
