"""Samples fitted together: parameters z that all of them share, beside the unknowns x that each has of its own.

With A and g the information and gradient of [x, z] at a fit of x alone, in equilibrium, eliminating every x from the joint
Gauss-Newton step leaves

    (1)  S = A_zz - A_zx A_xx^-1 A_xz,   q = g_z - A_zx A_xx^-1 g_x     per sample
    (2)  (P + sum S) dz = sum q + P (z0 - z)                             P: the prior's precision about z0
    (3)  x of a fit at the new z moves by -A_xx^-1 A_xz dz, and its covariance grows by what that does to (P + sum S)^-1

so the samples are fitted at z, each by itself, z moves by (2), and so on, until a step promises nothing (variable projection, Golub
& Pereyra 1973). A step that loses samples or raises the cost is halved. dh/dz is by central differences of what the sensors read.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..model.problem import Problem
from ..model.unknowns import Registration
from ..util.precision import DTYPE
from ..util.status import Status
from . import filter as ekf
from .evaluator import evaluator
from .result import Estimate
from .solve import Filter, Settings, estimate_each
from .starts import Origin, Start

DIFFERENCE = 1e-4  # of a parameter's size, each way
HALVINGS = 8
CHUNK = 256  # samples whose slopes are held at a time
ARRIVED, SHARE = 1e-3, 1e-6  # of the cost that a step promises: nothing, or nothing beside what no parameter explains
FARTHEST = 1.0  # of a parameter's size, in one step


@dataclass(frozen=True)
class Eliminated:
    """(1) for B samples: G = A_xx^-1 A_xz (B, n, k), S (B, k, k), q (B, k); step (B, n): A_xx^-1 g_x, of x where z stays."""

    G: Float[Tensor, "B n k"]
    S: Float[Tensor, "B k k"]
    q: Float[Tensor, "B k"]
    step: Float[Tensor, "B m"]


def eliminated(A: Float[Tensor, "B m m"], g: Float[Tensor, "B m"], shared: Int[Tensor, " k"]) -> Eliminated:
    """What the samples say of the entries `shared` of [x, z], with all others eliminated."""
    own = torch.ones(A.shape[-1], dtype=torch.bool).index_fill(0, shared, False).nonzero().squeeze(-1)
    A_xz = A[:, own][:, :, shared]
    both = (
        ekf.solve_spd(A[:, own][:, :, own], torch.cat([A_xz, g[:, own].unsqueeze(-1)], -1))
        if len(own)
        else A.new_zeros(len(A), 0, len(shared) + 1)
    )
    S = A[:, shared][:, :, shared] - A_xz.mT @ both[..., :-1]
    q = g[:, shared] - (A_xz.mT @ both[..., -1:]).squeeze(-1)
    return Eliminated(both[..., :-1], S, q, both[..., -1])


@dataclass(frozen=True)
class Shared:
    """Entries of z that go together.

    size (m,): how large a change of each shows but does not upset the robot. std (m,): of the prior about zero; inf: none.
    change: the problem with the entries at values (m,); those of several blocks follow one another in their order. plus: the
    entries after a further change of the problem by others; their sum where nothing else is said. registration: where they are
    the error of the base frame, which is moved with the readings, but whose slopes are those of what is read of the model: slopes
    of the readings themselves would count their noise as information.
    """

    size: tuple[float, ...]
    std: tuple[float, ...]
    change: Callable[[Problem, Float[Tensor, " m"]], Problem]
    plus: Callable[[Tensor, Tensor], Tensor] = torch.add
    registration: Registration | None = None


@dataclass(frozen=True)
class Joint:
    """What came of it. z (k,), its covariance (k, k) with the stated noise, and the information S of every problem's samples.

    problems: with z applied; fits: of each. used: which samples had a say. cost: of those, with the prior of z.
    """

    z: Float[Tensor, " k"]
    information: Float[Tensor, "k k"]
    prior: Float[Tensor, "k k"]
    problems: tuple[Problem, ...]
    fits: tuple[Estimate, ...]
    used: tuple[Bool[Tensor, " B"], ...]
    cost: float
    iterations: int
    status: Status

    @property
    def count(self) -> int:
        """How many samples had a say."""
        return sum(int(some.sum()) for some in self.used)

    def covariance(self, excess: float = 1.0) -> Float[Tensor, "k k"]:
        """(P + sum S / excess)^-1: with the stated variances of the sensors multiplied by `excess`."""
        A = self.prior + self.information / excess
        return ekf.inverse(A.unsqueeze(0))[0]


@dataclass(frozen=True)
class _Trial:
    z: Float[Tensor, " k"]
    problems: tuple[Problem, ...]
    fits: tuple[Estimate, ...]
    used: tuple[Bool[Tensor, " B"], ...]
    cost: float

    @property
    def count(self) -> int:
        return sum(int(some.sum()) for some in self.used)


def changed(problem: Problem, shared: Sequence[Shared], z: Float[Tensor, " k"]) -> Problem:
    """The problem with all parameters at z."""
    for block, values in zip(shared, z.split([len(block.size) for block in shared]), strict=True):
        problem = block.change(problem, values) if bool(values.any()) else problem
    return problem


def moved(shared: Sequence[Shared], z: Float[Tensor, " k"], dz: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """z after a step."""
    parts = [len(block.size) for block in shared]
    return torch.cat([block.plus(a, b) for block, a, b in zip(shared, z.split(parts), dz.split(parts), strict=True)])


def sizes(shared: Sequence[Shared]) -> Float[Tensor, " k"]:
    """Of all entries of z."""
    return torch.tensor([size for block in shared for size in block.size], dtype=DTYPE)


def precisions(shared: Sequence[Shared]) -> Float[Tensor, " k"]:
    """Of the prior of all entries of z."""
    return torch.tensor([std for block in shared for std in block.std], dtype=DTYPE) ** -2


@dataclass(frozen=True)
class _Search:
    problems: Sequence[Problem]
    shared: Sequence[Shared]
    settings: Settings

    def trial(self, z: Float[Tensor, " k"], before: _Trial | None) -> _Trial:
        """Every sample fitted at z, from where it was before."""
        problems = tuple(changed(problem, self.shared, z) for problem in self.problems)
        fits = []
        for i, problem in enumerate(problems):
            if before is None:
                fits.append(estimate_each(problem, self.settings))
            else:
                known = before.fits[i].x.nan_to_num(0.0)
                fits.append(Filter(self.settings)(problem, Start.at(known, Origin.OTHER_FIT)))
        used = tuple((fit.status == int(Status.CONVERGED)) & (p.seen > 0) for fit, p in zip(fits, problems, strict=True))
        cost = sum(float(fit.cost[some].sum()) for fit, some in zip(fits, used, strict=True))
        return _Trial(z, problems, tuple(fits), used, cost + float((precisions(self.shared) * z**2).sum()))

    def normal(self, at: _Trial) -> tuple[Float[Tensor, "k k"], Float[Tensor, " k"]]:
        """sum S and sum q of (2)."""
        k = len(at.z)
        total, pull = torch.zeros(k, k, dtype=DTYPE), torch.zeros(k, dtype=DTYPE)
        for i, (fit, used) in enumerate(zip(at.fits, at.used, strict=True)):
            for index in used.nonzero().squeeze(-1).split(CHUNK):
                found = eliminated_at(self.problems[i].take(index), self.shared, at.z, fit.x[index])
                total, pull = total + found.S.sum(0), pull + found.q.sum(0)
        return total, pull


def eliminated_at(problem: Problem, shared: Sequence[Shared], z: Float[Tensor, " k"], x: Float[Tensor, "B n"]) -> Eliminated:
    """(1) at x, in equilibrium, of samples fitted at z; problem: without z. G: of all of x, the base wrench included."""
    here, k = changed(problem, shared, z), len(z)
    first, (h, H) = here.state.base.at.start, evaluator(here).linearized(x)
    slopes = torch.cat(
        [
            _frame_slopes(here, x, block.registration)
            if block.registration is not None
            else _slopes(problem, here, shared, z, x, torch.arange(k).split([len(b.size) for b in shared])[i])
            for i, block in enumerate(shared)
        ],
        -1,
    )
    N = ekf.normal_equations(torch.cat([H[..., :first], slopes, H[..., first:]], -1), _residual(here, h), here.weights, here.groups)
    tip = N.tip
    assert tip is not None

    def wide(values: Tensor) -> Tensor:
        return torch.cat([values[..., :first], values.new_zeros(*values.shape[:-1], k), values[..., first:]], -1)

    A, g, _ = N.readings.whole(wide(x), wide(here.mean), wide(here.precision))
    found = eliminated(*tip.reduced(A, g), torch.arange(first, first + k))
    follows = tip.T[..., first:] - tip.T[..., :first] @ found.G
    return replace(found, G=torch.cat([found.G, follows], 1))


def _slopes(
    problem: Problem,
    here: Problem,
    shared: Sequence[Shared],
    z: Float[Tensor, " k"],
    x: Float[Tensor, "B n"],
    entries: Int[Tensor, " m"],
) -> Float[Tensor, "B z m"]:
    """dh/dz of some entries, by central differences."""
    found = []
    for step in torch.diag(DIFFERENCE * sizes(shared))[entries]:
        ends = []
        for at in (z + step, z - step):
            off = changed(problem, shared, at)
            vars(off)["state"] = here.state
            ends.append(evaluator(off).h(x))
        found.append((ends[0] - ends[1]) / (2 * step.sum()))
    return torch.stack(found, -1)


def _frame_slopes(here: Problem, x: Float[Tensor, "B n"], registration: Registration) -> Float[Tensor, "B z 6"]:
    """dh/dzeta at zeta = 0, per m and rad."""
    wide = here.of(replace(here.unknowns, registration=registration))
    block = wide.state.registration
    full = torch.cat([x[:, : block.at.start], x.new_zeros(len(x), block.size), x[:, block.at.start :]], -1)
    return evaluator(wide).linearized(full)[1][..., block.at] / block.unit


def _residual(problem: Problem, h: Float[Tensor, "B z"]) -> Float[Tensor, "B z"]:
    return torch.where(problem.weights > 0, problem.reading - h, 0.0)


def fit_jointly(
    problems: Sequence[Problem],
    shared: Sequence[Shared],
    settings: Settings | None = None,
    most: int = 100,
    start: Float[Tensor, " k"] | None = None,
    progress: Callable[[int, float], object] = lambda _, __: None,
) -> Joint:
    """Parameters that the samples of several problems share, and the fit of each sample at them.

    problems: with the unknowns that are each sample's own; several where samples differ in what is known (gravity, known loads).
    A sample that cannot be fitted has no say. settings: of the fits of the samples. most: steps of z. start: z; zero where it is
    not given. progress: called with the number of iterations and the cost. Non-convergence is a status. Errors: ValueError where no
    sample can be fitted at the start.
    """
    search = _Search(problems, shared, settings or Settings())
    P, size = precisions(shared), sizes(shared)
    at = search.trial(torch.zeros_like(size) if start is None else start, None)
    if not at.count:
        raise ValueError("no sample has markers, finite tensions and an equilibrium")
    status, iteration = Status.NOT_CONVERGED, 0
    S, q = search.normal(at)
    while iteration < most:
        iteration += 1
        progress(iteration, at.cost)
        pull = q - P * at.z
        step = ekf.solve_spd((S + torch.diag(P)).unsqueeze(0), pull[None, :, None])[0, :, 0]
        promised = float((pull * step).sum())
        if not math.isfinite(promised):
            break
        if promised < max(ARRIVED, SHARE * at.cost):
            status = Status.CONVERGED
            break
        step = step * min(1.0, FARTHEST / float((step / size).abs().max()))
        onward = _shorter(search, at, step)
        if onward is None:  # no way down: a minimum where the cost has a kink, as at a tendon that goes slack
            status = Status.CONVERGED
            break
        at = onward
        S, q = search.normal(at)
    return Joint(at.z, S, torch.diag(P), at.problems, at.fits, at.used, at.cost, iteration, status)


def _shorter(search: _Search, at: _Trial, step: Float[Tensor, " k"]) -> _Trial | None:
    """The first of the step, half of it, .. that lowers the cost and loses no sample; None: none does."""
    unsure = ARRIVED * at.count  # of the cost, which comes of as many fits, each with as much left to gain
    for halving in range(HALVINGS):
        onward = search.trial(moved(search.shared, at.z, step * 0.5**halving), at)
        more = onward.count > at.count
        if more or (onward.count == at.count and onward.cost < at.cost + (0.0 if halving else unsure)):
            return onward
    return None
