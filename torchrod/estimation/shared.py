"""A base frame whose error all samples share.

It is such an unknown (estimation.joint) where a camera stood still. Alone, a shape hardly tells it from a push near the base: with
it unknown, the Cramer-Rao bound of a push on Study 1 is four (location) to eight (magnitude) times wider (docs/trust.md). Together
ten shapes do.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mechanics.lie import matvec
from ..model.problem import Problem
from ..model.unknowns import Registration, Scope, Unknowns
from ..util.precision import DTYPE
from ..util.status import Status
from .joint import Shared, eliminated_at, fit_jointly
from .result import Estimate, load_covariance
from .solve import Progress, Settings, silent

Parts = Sequence[tuple[Unknowns, Int[Tensor, " b"]]]
STEPS = 5  # more than it takes
CHUNK = 256


@dataclass(frozen=True)
class BaseFrame:
    """The error of the base frame that all samples share: zeta (6,) [m, rad] as in torchrod.Estimate, and its covariance (6, 6)."""

    zeta: Float[Tensor, " 6"]
    covariance: Float[Tensor, "6 6"]

    def corrected(self, problem: Problem) -> Problem:
        """The readings in the rod's own frame."""
        import roma

        back = roma.rotvec_to_rotmat(self.zeta[3:]).T
        return problem.moved(back, -matvec(back, self.zeta[:3]))

    def moved_by(self, dz: Float[Tensor, " 6"]) -> Float[Tensor, " 6"]:
        """zeta after an error dz that is left in the corrected frame."""
        import roma

        R = roma.rotvec_to_rotmat(self.zeta[3:])
        return torch.cat([self.zeta[:3] + R @ dz[:3], roma.rotmat_to_rotvec(R @ roma.rotvec_to_rotmat(dz[3:]))])


def _chunks(index: Int[Tensor, " b"]) -> list[Int[Tensor, " c"]]:
    return [some for some in index.split(CHUNK) if len(some)]


def _without_frame(unknowns: Unknowns) -> Unknowns:
    return replace(unknowns, registration=None)


def shared_frame(problem: Problem, registration: Registration) -> Shared:
    """zeta (m, rad) of the base frame as entries that samples share."""
    block = replace(problem.unknowns, registration=registration).state(problem.robot).registration
    size, std = (tuple(values.tolist()) for values in (block.unit, block.unit * block.precision.rsqrt()))

    def frame(zeta: Float[Tensor, " 6"]) -> BaseFrame:
        return BaseFrame(zeta, torch.zeros(6, 6, dtype=DTYPE))

    return Shared(size, std, lambda p, zeta: frame(zeta).corrected(p), lambda z, dz: frame(z).moved_by(dz), registration)


def _first(problem: Problem, parts: Parts, fit: Estimate, used: Bool[Tensor, " B"]) -> BaseFrame:
    """The registrations of every sample by itself, each with the weight of its information beyond the prior."""
    block = problem.of(parts[0][0]).state.registration
    P = torch.diag(block.precision / block.unit**2)
    total, weighted = P.clone(), torch.zeros(6, dtype=DTYPE)
    assert fit.registration is not None
    for unknowns, index in parts:
        some = index[used[index]]
        if not len(some):  # of unknowns that no sample chose the kept fits may hold fewer entries than they have
            continue
        C = problem.of(unknowns).state.registration.covariance(fit.covariance[some])
        known = torch.linalg.inv(C) - P
        total, weighted = total + known.sum(0), weighted + (known @ fit.registration[some].unsqueeze(-1)).sum((0, 2))
    return BaseFrame(torch.linalg.solve(total, weighted), torch.linalg.inv(total))


def common_frame(
    problem: Problem, parts: Parts, fit: Estimate, settings: Settings | None = None, progress: Progress = silent
) -> BaseFrame:
    """The error of the base frame from all samples together, from a fit that gave each its own registration.

    parts: of the batch, each with the unknowns (with registration) it was fitted by. Samples that the fit does not explain have no
    say, unless that is so of all. Errors: ValueError where no sample has converged.
    """
    used = fit.accepted if bool(fit.accepted.any()) else fit.status == int(Status.CONVERGED)
    if not bool(used.any()):
        raise ValueError("no sample has converged, so none tells where the base frame is; check units, marker order and frame")
    registration = parts[0][0].registration
    assert registration is not None
    plain = [problem.of(_without_frame(unknowns)).take(index[used[index]]) for unknowns, index in parts if bool(used[index].any())]
    start, shared = _first(problem, parts, fit, used), [shared_frame(problem, registration)]
    found = fit_jointly(plain, shared, settings, STEPS, start.zeta, lambda _, __: progress(int(used.sum())))
    return BaseFrame(found.z, found.covariance())


def widened(problem: Problem, parts: Parts, registration: Registration, frame: BaseFrame, fit: Estimate) -> Estimate:
    """A fit in the corrected frame with what is left unknown of the frame, by (3) of estimation.joint.

    problem: as it was measured; parts: with the unknowns of the fit, which are without the registration.
    """
    covariance, loads = fit.covariance.clone(), fit.load_covariance.clone()
    for unknowns, index in parts:
        family = unknowns.loads
        for some in _chunks(index[fit.status[index] == int(Status.CONVERGED)]):
            part = problem.of(unknowns).take(some)
            n, at, x = part.size, part.state.loads.at, fit.x[some, : part.size]
            G = eliminated_at(part, [shared_frame(part, registration)], frame.zeta, x).G
            C = covariance[some, :n, :n] + G @ frame.covariance @ G.mT
            covariance[some, :n, :n] = C
            spread = load_covariance(family, x[:, at], C[:, at, at])
            loads[some, : spread.shape[1]] = spread
    return replace(fit, covariance=covariance, load_covariance=loads, registration=frame.zeta.expand(len(fit.x), 6).clone())


@dataclass(frozen=True)
class SharedFit:
    """A fit in a frame that all samples share: the estimate, the unknowns of each part (without the registration), the frame, and
    the problem in the corrected frame, likewise without.
    """

    estimate: Estimate
    parts: Parts
    frame: BaseFrame
    problem: Problem


def with_shared_frame(
    problem: Problem,
    fitted: Callable[[Problem], tuple[Estimate, Parts]],
    settings: Settings | None = None,
    progress: Progress = silent,
) -> SharedFit:
    """Fit a problem whose registration has scope SHARED.

    fitted: how to fit a problem, with the unknowns that each part of its samples ended with; it is called with the registration of
    every sample by itself, then in the corrected frame without registration.
    """
    registration = problem.unknowns.registration
    assert registration is not None
    alone = replace(problem, unknowns=replace(problem.unknowns, registration=replace(registration, scope=Scope.SAMPLE)))
    first, parts = fitted(alone)
    frame = common_frame(problem, parts, first, settings, progress)
    here = frame.corrected(problem).of(_without_frame(problem.unknowns))
    found, parts = fitted(here)
    return SharedFit(widened(problem, parts, registration, frame, found), parts, frame, here)
