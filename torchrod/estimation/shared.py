"""Unknowns that all samples share, eliminated by the Schur complement.

With x the unknowns of one sample, z those that all share, A and g the information and gradient of [x, z] at a fit of x alone,
eliminating every x from the joint Gauss-Newton step leaves

    (1)  S = A_zz - A_zx A_xx^-1 A_xz,   q = g_z - A_zx A_xx^-1 g_x     per sample
    (2)  (P + sum S) dz = sum q + P (z0 - z)                             P: the prior's precision about z0
    (3)  x of a fit at the new z moves by -A_xx^-1 A_xz dz, and its covariance grows by what that does to (P + sum S)^-1

The base frame's error is such an unknown where a camera stood still. Alone, a shape hardly tells it from a push near the base: with
it unknown, the Cramer-Rao bound of a push on Study 1 is four (location) to eight (magnitude) times wider (docs/trust.md). Together
ten shapes do. Mass, stiffness and load-cell offsets of a robot are others (analysis.calibration).
"""

import math
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
from . import filter as ekf
from .result import Estimate, load_covariance
from .solve import Progress, Settings, estimate_each, linearize, silent

Parts = Sequence[tuple[Unknowns, Int[Tensor, " b"]]]
STEPS = 3
CHUNK = 256


@dataclass(frozen=True)
class Eliminated:
    """(1) for B samples: G = A_xx^-1 A_xz (B, n, k), S (B, k, k), q (B, k)."""

    G: Float[Tensor, "B n k"]
    S: Float[Tensor, "B k k"]
    q: Float[Tensor, "B k"]


def eliminated(A: Float[Tensor, "B m m"], g: Float[Tensor, "B m"], shared: Int[Tensor, " k"]) -> Eliminated:
    """What the samples say of the entries `shared` of [x, z], with all others eliminated."""
    own = torch.ones(A.shape[-1], dtype=torch.bool).index_fill(0, shared, False).nonzero().squeeze(-1)
    A_xz = A[:, own][:, :, shared]
    both = ekf.solve_spd(A[:, own][:, :, own], torch.cat([A_xz, g[:, own].unsqueeze(-1)], -1))
    S = A[:, shared][:, :, shared] - A_xz.mT @ both[..., :-1]
    q = g[:, shared] - (A_xz.mT @ both[..., -1:]).squeeze(-1)
    return Eliminated(both[..., :-1], S, q)


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


def _frame_eliminated(problem: Problem, unknowns: Unknowns, x: Float[Tensor, "b n"]) -> Eliminated:
    """(1) at x of samples fitted without registration; z in m and rad. unknowns: with the registration."""
    wide = problem.of(unknowns)
    block = wide.state.registration
    at = torch.arange(block.at.start, block.at.stop)
    full = torch.cat([x[:, : block.at.start], x.new_zeros(len(x), block.size), x[:, block.at.start :]], -1)
    here = linearize(wide, full, exact=True)
    assert here.tip is not None
    unit = torch.ones(wide.size, dtype=DTYPE).index_copy(0, at, block.unit.reciprocal())
    held = torch.zeros(wide.size, dtype=DTYPE).index_copy(0, at, block.precision)  # (2) has the prior once for all samples
    A, g = here.tip.reduced(here.A - torch.diag(held), here.g)
    found = eliminated(A * unit[: -ekf.BASE] * unit[: -ekf.BASE].unsqueeze(-1), g * unit[: -ekf.BASE], at)
    own = torch.ones(A.shape[-1], dtype=torch.bool).index_fill(0, at, False)
    follows = here.tip.T[..., at] * unit[at] - here.tip.T[..., own] @ found.G
    return replace(found, G=torch.cat([found.G, follows], 1))


def _prior(problem: Problem) -> Float[Tensor, "6 6"]:
    """P of (2), in m and rad: the prior that a registration of one sample has."""
    block = problem.state.registration
    return torch.diag(block.precision / block.unit**2)


def _first(problem: Problem, parts: Parts, fit: Estimate, used: Bool[Tensor, " B"]) -> BaseFrame:
    """The registrations of every sample by itself, each with the weight of its information beyond the prior."""
    P = _prior(problem.of(parts[0][0]))
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
    """The error of the base frame from all samples together, by (1)-(2), from a fit that gave each its own registration.

    parts: of the batch, each with the unknowns (with registration) it was fitted by. Samples that the fit does not explain have no
    say, unless that is so of all. Errors: ValueError where no sample has converged.
    """
    used = fit.accepted if bool(fit.accepted.any()) else fit.status == int(Status.CONVERGED)
    if not bool(used.any()):
        raise ValueError("no sample has converged, so none tells where the base frame is; check units, marker order and frame")
    frame, P, settings = _first(problem, parts, fit, used), _prior(problem.of(parts[0][0])), settings or Settings()
    for _ in range(STEPS):
        here = frame.corrected(problem)
        total, pull = P.clone(), -P @ frame.zeta
        for unknowns, index in parts:
            plain = here.of(_without_frame(unknowns))
            for some in _chunks(index[used[index]]):
                part = plain.take(some)
                again = estimate_each(part, settings, progress=progress)
                good = (again.status == int(Status.CONVERGED)).nonzero().squeeze(-1)
                found = _frame_eliminated(part.take(good), unknowns, again.x[good])
                total, pull = total + found.S.sum(0), pull + found.q.sum(0)
        step = torch.linalg.solve(total, pull)
        step = step * min(1.0, math.radians(10) / max(float(step[3:].norm()), 1e-12))
        frame = BaseFrame(frame.moved_by(step), torch.linalg.inv(total))
    return frame


def widened(problem: Problem, parts: Parts, registration: Registration, frame: BaseFrame, fit: Estimate) -> Estimate:
    """A fit in the corrected frame with what is left unknown of the frame (3).

    problem: corrected; parts: with the unknowns of the fit, which are without the registration.
    """
    covariance, loads = fit.covariance.clone(), fit.load_covariance.clone()
    for unknowns, index in parts:
        family = unknowns.loads
        for some in _chunks(index[fit.status[index] == int(Status.CONVERGED)]):
            part = problem.of(unknowns).take(some)
            n, at, x = part.size, part.state.loads.at, fit.x[some, : part.size]
            G = _frame_eliminated(part, replace(unknowns, registration=registration), x).G
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
    return SharedFit(widened(here, parts, registration, frame, found), parts, frame, here)
