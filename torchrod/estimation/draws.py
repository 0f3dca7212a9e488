"""Draws of the posterior of x, where the ellipse about the fit does not do: importance sampling, and tempering where that fails.

The tip condition (17) holds exactly, so a draw is one of everything but the base wrench (estimation.chart), which equilibrium then
gives: by a walk from the tip, or a few where weight acts, else by Newton steps on the tip residual. The target is

    (1)  log pi(v) = -cost(x(v)) / 2 + log p(y) + log |det dy/dv|

with the cost of what was read alone, the prior p of estimation.chart, and (2) the weights w = pi / q of draws from q, Student's t
about the fit with the fit's covariance and about others along its valley (estimation.valley), Pareto-smoothed (estimation.pareto).
Where k-hat says that q is no proposal for pi, q is matched to the weighted mean and covariance of what was drawn so far, and all
draws count by the mixture they came from (adaptive multiple importance sampling, Cornuet et al. 2012). Where that does not help,
draws go from q to pi through q^(1 - b) pi^b with Metropolis steps in between, b as large as half of the draws survive (sequential
Monte Carlo, Del Moral et al. 2006).

The random numbers are always the same: equal fits have equal draws, whatever their batch.
"""

import itertools
import math
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..model.problem import TIP_ROWS, Problem
from ..util.precision import DTYPE
from ..util.status import Status
from ..util.threads import one_thread
from . import filter as ekf
from .chart import FAINT, Chart
from .elsewhere import across_strip, elsewhere, fits_elsewhere, marks
from .evaluator import Evaluator, Walked, evaluator
from .pareto import GOOD, effective_size, smoothed
from .proposal import Mixture, OnGrid, Proposal, Student, combinations
from .result import Estimate
from .solve import Settings, solver_of
from .valley import line_of, valley

DRAWS, FEWEST = 512, 32  # powers of two
ROWS = 32768  # draws evaluated at a time
AT_ONCE = 64  # samples with a valley, each of whose fits is compared with all others
PLAIN = Settings(restarts=(), basins=0, sized=False)
WIDEST = 2.5  # of eta: a place that may be anywhere has 1.8
STRAIGHT = 0.5  # of eta: what goes with a place less sure than that, to first order, goes astray
CELLS = {1: 96, 2: 48, 3: 24}  # along the rod, of the histogram of so many places
ANYWHERE, FLATTER = 0.1, 0.9  # the share of the histogram that is even, and its power of what is promised
SURELY = 5.0  # standard deviations
LEAST_SIZE = 1.5 * FAINT  # of forces and moments at the tip
SMALLER = (0.0, 0.5)  # of the way, in logarithms, from there to the fit's
FARTHEST = 4.0  # |eta| of the proposal's centre
MOST_OTHERS = 2  # fits of a sample
HARDLY = 0.02  # of the draws: of a fit with fewer nobody is told whether its weights can be trusted
ENOUGH = 0.1  # of the draws: a smaller effective size asks for another round,
ON_STRIP = 0.4  # and on a strip: forces across it and along its soft side trade along a curve, of which one end may be missed
PLENTY = 0.3  # with so many, a k-hat up to 1 will do
ROUNDS = 3  # of matched proposals
SURVIVE = 0.5  # of the draws, from one temperature to the next
MOVES = 3  # Metropolis steps at a temperature
LAST_MOVES = 8
MOST_TEMPERATURES = 40
FINE = 2.5e-4  # of the length: markers less exact than that cannot tell COARSE_STEPS from the fit's own
CLAMPED, LEAST_CLAMPED = 0.01, 1e-9  # by how much the base may miss its clamp: of the noise at the tip, rad
NEWTON = 6
SETTLED = 1.0  # of the tip's cost: from there one more Newton step is exact to second order
Prior = Literal["jeffreys", "normalized"]  # of pushes at unknown places


class Method(IntEnum):
    """How the draws of a sample were come by; `.label` names it."""

    NONE = 0
    IMPORTANCE = 1
    MATCHED = 2
    TEMPERED = 3

    @property
    def label(self) -> str:
        """For files."""
        return self.name.lower()


@dataclass(frozen=True)
class Draws:
    """D draws of x of B samples, in equilibrium, in the units of Problem.state.

    x (B, D, n), weight (B, D), which sum to 1. k_hat (B,): Pareto's shape of the weights; above 0.7 they are not to be trusted.
    ess (B,): to how many independent draws they amount. log_evidence (B,): log of the mean unnormalized weight, the marginal
    likelihood of the unknowns up to what all of a sample's hypotheses share: the larger, the better they explain it; NaN by
    Jeffreys' prior, which tells none. method (B,): Method codes. NaN throughout where the fit has not converged.
    """

    problem: Problem = field(repr=False)
    x: Float[Tensor, "B D n"]
    weight: Float[Tensor, "B D"]
    k_hat: Float[Tensor, " B"]
    ess: Float[Tensor, " B"]
    log_evidence: Float[Tensor, " B"]
    method: Int[Tensor, " B"]

    @property
    def has_pushes(self) -> bool:
        """Whether Jeffreys' prior is another than the normalized one."""
        return Chart(self.problem, self.x[:, 0], None).has_pushes

    def take(self, index: Int[Tensor, " b"]) -> "Draws":
        """The samples of an index."""
        own = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "problem"}
        return Draws(self.problem.take(index), **own)


def _exactly(problem: Problem) -> Problem:
    """The problem on as many steps as its markers can tell."""
    markers = problem.markers
    if markers is None:
        return problem
    noise = markers.noise.min() if isinstance(markers.noise, Tensor) else markers.noise
    return problem.coarse if float(noise) > FINE * problem.robot.rod.length else problem


class _Target:
    """log pi of draws of the samples of a problem."""

    def __init__(self, problem: Problem, x: Float[Tensor, "B n"], C: Float[Tensor, "B n n"], nu: float, jeffreys: bool):
        self.problem, self.nu, self.x = _exactly(problem), nu, x
        self.valley = valley(self.problem, x, C, solver_of(PLAIN))
        self.chart = Chart.at(self.problem, x, jeffreys)
        m = self.chart.size
        each = self.valley.C.flatten(0, 1)
        follow = ekf.solve_spd(each[:, :m, :m], each[:, :m, m:]).mT if m else each.new_zeros(len(each), TIP_ROWS, 0)
        self.follow = follow.nan_to_num(0.0).unflatten(0, self.valley.sound.shape)  # d alpha / dy along the equilibria near each
        self._spread: tuple[Int[Tensor, " b"], int, Chart, Evaluator] | None = None
        state, robot = problem.state, problem.robot
        smooth = self.problem.on_grid.tendons.friction is None
        self.walks = not (state.tip.size or state.tension.size) and robot.gravity.ndim == 1 and smooth
        self.q_tip = None if robot.weightless or not self.walks else self._at_tip()
        markers = self.problem.markers
        plain = markers is not None and markers.isotropic and markers.offsets is None
        self.bare = plain and math.isinf(nu) and not (state.registration.size or state.parameters.size)
        least = float(self.problem.weights[:, :-TIP_ROWS].max()) ** -0.5 / robot.rod.length if plain else 0.0
        self.clamped = max(CLAMPED * least, LEAST_CLAMPED)

    def _at_tip(self) -> Float[Tensor, "B S 4"]:
        """How the tip of each fit of the valley is turned."""
        B, S = self.valley.sound.shape
        many = self.problem.take(torch.arange(B).repeat_interleave(S))
        return many.shape(self.valley.x.flatten(0, 1), differentiable=False).tip_q.unflatten(0, (B, S))

    def _of(self, index: Int[Tensor, " b"], count: int) -> tuple[Chart, Evaluator]:
        """The chart of samples of an index, and the evaluator of so many draws of each."""
        kept = self._spread
        if kept is None or kept[1] != count or not torch.equal(kept[0], index):
            spread = self.problem.take(index.repeat_interleave(count))
            self._spread = kept = (index, count, self.chart.take(index), evaluator(spread, self.nu))
        return kept[2:]

    def __call__(self, v: Float[Tensor, "b D m"], index: Int[Tensor, " b"]) -> tuple[Float[Tensor, "b D"], Float[Tensor, "b D n"]]:
        """log pi and x in equilibrium, of samples of an index."""
        b, D, _ = v.shape
        chart, evaluate = self._of(index, D)
        y, log_volume = chart.back(v)
        flat, rows = y.flatten(0, 1), index.repeat_interleave(D)
        by_walks = self.walks and isinstance(evaluate, Walked)
        cost, x = self._by_walks(evaluate, flat, rows) if by_walks else self._by_newton(evaluate, flat, rows)
        cost, x = cost.unflatten(0, (b, D)), x.unflatten(0, (b, D))
        if by_walks and not self.bare:
            cost = cost - chart.fitted_prior(x)
        for near, far in itertools.pairwise(chart.in_order.mT):  # the same loads in another order are no other explanation
            apart = y.gather(-1, far.expand(D, 1, b).movedim(-1, 0)) - y.gather(-1, near.expand(D, 1, b).movedim(-1, 0))
            log_volume = torch.where(apart.squeeze(-1) >= 0, log_volume, -torch.inf)
        log_pi = -0.5 * cost + chart.log_prior(y) + log_volume
        return log_pi.nan_to_num(-torch.inf, -torch.inf, -torch.inf), x

    def _by_walks(
        self, evaluate: Evaluator, y: Float[Tensor, "N m"], rows: Int[Tensor, " N"]
    ) -> tuple[Float[Tensor, " N"], Float[Tensor, "N n"]]:
        """The cost, by the forward solve from tip to base: one walk without weight. With the fit's prior, but where bare."""
        assert isinstance(evaluate, Walked)
        state, q_tip = self.problem.state, None if self.q_tip is None else self.q_tip[rows, self._nearest(y, rows)]
        x = torch.nn.functional.pad(y, (0, state.base.size))
        wrench, missed, line = evaluate.walk.balance(x, q_tip, 1, self.clamped)
        x = torch.cat([y, wrench / state.base.unit], -1)
        if not self.bare:
            return torch.where(missed <= self.clamped, evaluate.cost(x), torch.inf), x
        W, z = (v[:, :-TIP_ROWS].unsqueeze(1) for v in (self.problem.weights, self.problem.reading.nan_to_num(0.0)))
        each, many = rows.unique_consecutive(return_counts=True)
        off = line.reshape(len(each), int(many[0]), -1) - z[each]
        cost = (W[each] * off.square()).sum(-1).flatten()
        return torch.where(missed <= self.clamped, cost, torch.inf), x

    def _by_newton(
        self, evaluate: Evaluator, y: Float[Tensor, "N m"], rows: Int[Tensor, " N"]
    ) -> tuple[Float[Tensor, " N"], Float[Tensor, "N n"]]:
        """The cost without the prior, by Newton steps on the base wrench until the tip residual is nothing."""
        m = self.chart.size
        nearest = self._nearest(y, rows)
        near, follow = self.valley.x[rows, nearest], self.follow[rows, nearest]
        x = torch.cat([y, near[:, m:] + (follow @ (y - near[:, :m]).unsqueeze(-1)).squeeze(-1)], -1)
        cost = x.new_full((len(x),), torch.inf)
        live = torch.arange(len(x))
        for _ in range(NEWTON):
            part = evaluate.take(live) if len(live) < len(x) else evaluate
            found = part.sums(x[live])
            step = ekf.solve_spd(found.A[:, 1, m:, m:], found.g[:, 1, m:].unsqueeze(-1)).squeeze(-1).nan_to_num(0.0)
            A, g = found.A[:, 0, m:, m:], found.g[:, 0, m:]
            change = ((A @ step.unsqueeze(-1)).squeeze(-1) * step).sum(-1) - 2 * (g * step).sum(-1)
            done = found.cost[:, 1] < SETTLED
            cost[live[done]] = (found.cost[:, 0] + change)[done]
            x[live, m:] += step
            live = live[~done & torch.isfinite(found.cost[:, 1])]
            if not len(live):
                break
        return cost, x

    def _nearest(self, y: Float[Tensor, "N m"], rows: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """Which of the fits of its sample is nearest."""
        if self.valley.sound.shape[1] == 1:
            return torch.zeros_like(rows)
        away = (marks(self.problem, y).unsqueeze(1) - marks(self.problem, self.valley.x)[rows]).norm(dim=-1)
        return away.masked_fill(~self.valley.sound[rows], torch.inf).nan_to_num(torch.inf).argmin(-1)


def _matched(v: Float[Tensor, "b D m"], log_weight: Float[Tensor, "b D"]) -> Student:
    """From the weighted mean and covariance; where few draws have all of the weight, of weights to a small power."""
    m, power = v.shape[-1], log_weight.new_ones(len(v), 1)
    flat = log_weight.clamp(min=-1e4)
    for _ in range(8):
        weight = torch.softmax(power * flat, -1)
        few = 1 / weight.square().sum(-1, keepdim=True) < 4 * m + 4
        power = torch.where(few, 0.5 * power, power)
    weight = torch.softmax(power * flat, -1)
    centre = (weight.unsqueeze(-1) * v).sum(1)
    off = v - centre.unsqueeze(1)
    return Student.of(centre, 1.1 * (weight.unsqueeze(-1) * off).mT @ off)


def systematic(weight: Float[Tensor, "b D"], count: int) -> Int[Tensor, "b C"]:
    """Which draws to take for so many of equal weight."""
    at = (torch.arange(count, dtype=weight.dtype) + 0.5) / count
    ends = weight.cumsum(-1)
    return torch.searchsorted((ends / ends[:, -1:]).contiguous(), at.expand(len(weight), -1).contiguous()).clamp(
        max=weight.shape[-1] - 1
    )


def picked(values: Float[Tensor, "b D m"], index: Int[Tensor, "b C"]) -> Float[Tensor, "b C m"]:
    """The draws of an index of each sample."""
    return values.gather(1, index.unsqueeze(-1).expand(-1, -1, values.shape[-1]))


@dataclass
class _Found:
    """What has come of b samples."""

    x: Float[Tensor, "b D n"]
    log_weight: Float[Tensor, "b D"]
    k_hat: Float[Tensor, " b"]
    ess: Float[Tensor, " b"]
    log_evidence: Float[Tensor, " b"]
    method: Int[Tensor, " b"]

    def put(self, rows: Int[Tensor, " c"], other: "_Found") -> None:
        for f in fields(_Found):
            getattr(self, f.name)[rows] = getattr(other, f.name)

    def take(self, rows: Int[Tensor, " c"]) -> "_Found":
        return _Found(*(getattr(self, f.name)[rows] for f in fields(_Found)))


def _importance(target: _Target, first: list[tuple[Proposal, int]], count: int) -> _Found:
    """(2), with as many rounds of matched proposals as k-hat asks for, and tempering where that does not help.

    first: the proposals to begin with, and how many draws of each, `count` in all.
    """
    proposals = [p for p, _ in first]
    shares = [k for _, k in first]
    index, seen = torch.arange(len(target.x)), torch.cat([p.draw(k, i) for i, (p, k) in enumerate(first)], 1)
    log_pi, x = target(seen, index)
    found = _weighed(proposals, shares, seen, log_pi, x, Method.IMPORTANCE)
    enough = count * (ENOUGH if across_strip(target.problem.robot.rod) is None else ON_STRIP)
    some = torch.isfinite(found.log_weight).any(-1)  # of many loads none may be in their order: then nothing is known
    where = (_poor(found, enough) & some).nonzero().squeeze(-1)
    proposals, seen, log_pi, x = _of(where, proposals, seen, log_pi, x)
    log_weight = found.log_weight[where]
    for turn in range(ROUNDS):
        if not len(where):
            return found
        new = _matched(seen, log_weight)
        fresh = new.draw(count, 10 + turn)
        shares = [*shares, count]
        log_fresh, x_fresh = target(fresh, where)
        proposals, seen = [*proposals, new], torch.cat([seen, fresh], 1)
        log_pi, x = torch.cat([log_pi, log_fresh], 1), torch.cat([x, x_fresh], 1)
        again = _weighed(proposals, shares, seen, log_pi, x, Method.MATCHED)
        log_weight = again.log_weight
        poor = _poor(again, enough)
        if turn == ROUNDS - 1:  # many draws that count, and the largest of them not too large: as good as tempered ones
            poor = poor & ~((again.k_hat < 1) & (again.ess > PLENTY * count))
        fine = (~poor | (turn == ROUNDS - 1)).nonzero().squeeze(-1)
        pick = systematic(again.log_weight[fine].exp(), count)
        equal = log_weight.new_full((len(fine), count), -math.log(count))
        numbers = (again.k_hat[fine], again.ess[fine].clamp(max=count), again.log_evidence[fine], again.method[fine])
        found.put(where[fine], _Found(picked(x[fine], pick), equal, *numbers))
        rest = poor.nonzero().squeeze(-1)
        where, log_weight = where[rest], log_weight[rest]
        proposals, seen, log_pi, x = _of(rest, proposals, seen, log_pi, x)
    if len(where):
        found.put(where, _tempered(target, where, proposals[-1], count))
    return found


def _of(rows: Int[Tensor, " c"], proposals: list[Proposal], *tensors: Tensor) -> tuple:
    return [p.take(rows) for p in proposals], *(t[rows] for t in tensors)


def _poor(found: _Found, enough: float) -> Bool[Tensor, " b"]:
    return ~(found.k_hat <= GOOD) | (found.ess < enough)


def _weighed(
    proposals: list[Proposal],
    shares: list[int],
    v: Float[Tensor, "b D m"],
    log_pi: Float[Tensor, "b D"],
    x: Float[Tensor, "b D n"],
    method: Method,
) -> _Found:
    """Draws of a mixture of proposals, so many of each."""
    parts = [p.log_density(v) + math.log(k / sum(shares)) for p, k in zip(proposals, shares, strict=True)]
    raw = _difference(log_pi, torch.stack(parts).logsumexp(0))
    log_weight, k = smoothed(raw)
    evidence = raw.logsumexp(-1) - math.log(raw.shape[-1])
    return _Found(x, log_weight, k, effective_size(log_weight), evidence, torch.full((len(v),), int(method)))


@dataclass
class _Walkers:
    """Draws of c samples on their way from q to pi."""

    target: _Target
    index: Int[Tensor, " c"]
    q: Student
    v: Float[Tensor, "c D m"]
    log_pi: Float[Tensor, "c D"]
    x: Float[Tensor, "c D n"]
    reach: Float[Tensor, " c"]
    random: torch.Generator

    def __post_init__(self):
        self.log_q = self.q.log_density(self.v)

    def survive(self, share: Float[Tensor, " c"]) -> tuple[Float[Tensor, " c"], Float[Tensor, " c"]]:
        """Resample for b larger by `share`: the effective size of that, and the log of the mean weight."""
        log_weight = share.unsqueeze(-1) * _difference(self.log_pi, self.log_q)
        mean = log_weight.logsumexp(-1) - math.log(log_weight.shape[-1])
        weight = torch.softmax(log_weight, -1)
        pick = systematic(weight, weight.shape[-1])
        self.v, self.x = picked(self.v, pick), picked(self.x, pick)
        self.log_pi, self.log_q = self.log_pi.gather(1, pick), self.log_q.gather(1, pick)
        return 1 / weight.square().sum(-1), mean

    def move(self, b: Float[Tensor, " c"]) -> None:
        """A Metropolis step of every draw, alternately along the draws' covariance and along the difference of two of them."""
        _, D, m = self.v.shape
        off = self.v - self.v.mean(1, keepdim=True)
        L = Student.of(self.v[:, 0], off.mT @ off / D).L
        z = torch.randn(D, m, generator=self.random, dtype=DTYPE)
        i, j = (torch.randperm(D, generator=self.random) for _ in range(2))
        uniform, jump = torch.rand(D, generator=self.random, dtype=DTYPE), torch.rand(D, generator=self.random, dtype=DTYPE)
        by_one = (2.38 / math.sqrt(m) * self.reach)[:, None, None] * (z @ L.mT)
        size = torch.where(jump < 0.1, 1.0, 2.38 / math.sqrt(2 * m)) * self.reach.unsqueeze(-1)
        by_two = size.unsqueeze(-1) * (self.v[:, i] - self.v[:, j]) + 1e-3 * by_one
        v = self.v + torch.where((torch.arange(D) % 2 == 0)[None, :, None], by_one, by_two)
        log_pi, x = self.target(v, self.index)
        log_q = self.q.log_density(v)
        here, there = ((1 - b).unsqueeze(-1) * q + b.unsqueeze(-1) * p for q, p in ((self.log_q, self.log_pi), (log_q, log_pi)))
        taken = uniform.log() < _difference(there, here)
        self.v, self.x = (torch.where(taken.unsqueeze(-1), new, old) for new, old in ((v, self.v), (x, self.x)))
        self.log_pi, self.log_q = torch.where(taken, log_pi, self.log_pi), torch.where(taken, log_q, self.log_q)
        rate = taken.to(DTYPE).mean(-1)
        self.reach = (self.reach * torch.exp(2 * (rate - 0.25))).clamp(0.02, 2.0)


def _difference(a: Float[Tensor, "c D"], b: Float[Tensor, "c D"]) -> Float[Tensor, "c D"]:
    """a - b, -inf where a is."""
    return torch.where(torch.isneginf(a), -torch.inf, a - b).nan_to_num(torch.inf, torch.inf, -torch.inf)


def _next_share(log_ratio: Float[Tensor, "c D"], left: Float[Tensor, " c"]) -> Float[Tensor, " c"]:
    """The largest share of pi / q by which at least SURVIVE of the draws survive, by bisection; all that is left, if it does."""
    low, high = torch.zeros_like(left), left.clone()

    def lives(share: Float[Tensor, " c"]) -> Bool[Tensor, " c"]:
        weight = torch.softmax(share.unsqueeze(-1) * log_ratio, -1)
        return 1 / weight.square().sum(-1) >= SURVIVE * log_ratio.shape[-1]

    whole = lives(high)
    for _ in range(30):
        middle = 0.5 * (low + high)
        good = lives(middle)
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    return torch.where(whole, left, low.clamp(min=1e-6).minimum(left))


def _tempered(target: _Target, index: Int[Tensor, " c"], q: Student, count: int) -> _Found:
    """Sequential Monte Carlo from q to pi."""
    v = q.draw(count, 20)
    log_pi, x = target(v, index)
    c = len(index)
    walkers = _Walkers(target, index, q, v, log_pi, x, v.new_ones(c), torch.Generator().manual_seed(1))
    b, evidence, size = v.new_zeros(c), v.new_zeros(c), v.new_full((c,), float(count))
    for _ in range(MOST_TEMPERATURES):
        if bool((b >= 1).all()):
            break
        share = _next_share(_difference(walkers.log_pi, walkers.log_q).clamp(-1e6, 1e6), 1 - b)
        survived, mean = walkers.survive(share)
        size, evidence = torch.where(b < 1, torch.minimum(size, survived), size), evidence + mean
        b = (b + share).clamp(max=1.0)
        for _ in range(MOVES):
            walkers.move(b)
    for _ in range(LAST_MOVES):
        walkers.move(b)
    level = walkers.log_pi.new_full((c, count), -math.log(count))
    distinct = torch.tensor([len(row.unique()) for row in walkers.log_pi], dtype=DTYPE)
    k = torch.where(b >= 1, torch.full_like(b, 0.5), torch.inf)
    ess = torch.where(b >= 1, torch.minimum(size, distinct), torch.zeros_like(b))
    return _Found(walkers.x, level, k, ess, torch.where(b >= 1, evidence, torch.nan), torch.full((c,), int(Method.TEMPERED)))


def _about(target: _Target, C: Float[Tensor, "b n n"], count: int) -> list[tuple[Proposal, int]]:
    """The first proposals: the fit's covariance in the coordinates of the chart and, for some of the draws, places anywhere, and
    less at the tip.
    """
    chart, m = target.chart, target.chart.size
    y = target.x[:, :m].clone()
    for i in chart.places:
        y[:, i] = y[:, i].clamp(-FARTHEST, FARTHEST)
    near = chart.to(y.unsqueeze(1)).squeeze(1)
    J, K = chart.slope(y), len(chart.places)
    C_y = C[:, :m, :m]
    C = J @ C_y @ J.mT
    less = [
        Student.of(chart.to(centre.unsqueeze(1)).squeeze(1), J @ own @ J.mT) for centre, own in _less_at_the_tip(target, y, C_y)
    ]
    if chart.response is None:
        return _with_valley(target, _sharing([Student.of(near, C)], less, count))
    at, others = torch.tensor(chart.places), torch.tensor([i for i in range(m) if i not in chart.places])
    C_at, C_both = C[:, at][:, :, at], C[:, others][:, :, at]
    follow = ekf.solve_spd(C_at, C_both.mT).mT.nan_to_num(0.0)
    C_rest = C[:, others][:, :, others] - follow @ C_both.mT
    std = C_at.diagonal(dim1=-2, dim2=-1).sqrt()
    shrink = (WIDEST / std).clamp(max=1.0)
    C_at = C_at * shrink.unsqueeze(-1) * shrink.unsqueeze(-2)
    follow = torch.where((std > STRAIGHT).any(-1)[:, None, None], 0.0, follow)
    whole = torch.zeros_like(C)
    whole[:, at.unsqueeze(-1), at], whole[:, others.unsqueeze(-1), at] = C_at, follow @ C_at
    whole[:, at.unsqueeze(-1), others] = (follow @ C_at).mT
    whole[:, others.unsqueeze(-1), others] = C_rest + follow @ C_at @ follow.mT
    local = Student.of(near, whole)
    if K not in CELLS:
        return _sharing([local], less, count)
    cell, _ = combinations(CELLS[K], K)
    eta = torch.logit((cell.to(DTYPE) + 0.5) / CELLS[K])
    order = chart.in_order
    rank = (order.unsqueeze(-1) == at).long().argmax(1) if K > 1 else torch.zeros(len(y), 1, dtype=torch.int64)
    log_share = chart.log_marginal(eta[:, rank].movedim(1, 0))
    log_share = (log_share - torch.sigmoid(eta).mul(1 - torch.sigmoid(eta)).log().sum(-1)).nan_to_num(-torch.inf)
    share = (1 - ANYWHERE) * torch.softmax(FLATTER * log_share, -1) + ANYWHERE / len(cell)
    centre = near[:, others].clone()
    centre[:, [i for i, k in enumerate(others.tolist()) if k in chart.linear.tolist()]] = 0.0
    grid = OnGrid(Student.of(centre, C_rest), order, others, CELLS[K], share)
    return _with_valley(target, _sharing([local, grid], less, count))


def _with_valley(target: _Target, first: list[tuple[Proposal, int]]) -> list[tuple[Proposal, int]]:
    """Half of the draws to the fits along the valley, where there is one, each by what can be told of it beforehand."""
    if line_of(target.problem) is None:
        return first
    valley, chart, m = target.valley, target.chart, target.chart.size
    B, S = valley.sound.shape
    y = valley.x[..., :m].clone()
    y[..., chart.places] = y[..., chart.places].clamp(-FARTHEST, FARTHEST)
    v, parts = chart.to(y), []
    for j in range(S):
        slope = chart.slope(y[:, j])
        parts.append(Student.of(v[:, j], _no_wider(chart, slope @ valley.C[:, j, :m, :m] @ slope.mT)))
    log_size = torch.stack([part.L.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1) for part in parts], -1)
    log_pi, _ = target(v, torch.arange(B))
    log_share = (FLATTER * (log_pi + log_size)).masked_fill(~valley.sound, -torch.inf)
    even = valley.sound / valley.sound.sum(-1, keepdim=True)
    share = (1 - ANYWHERE) * torch.softmax(log_share, -1).nan_to_num(0.0) + ANYWHERE * even
    half = [(p, k // 2) for p, k in first]
    return [*half, (Mixture(parts, share / share.sum(-1, keepdim=True)), sum(k for _, k in first) - sum(k for _, k in half))]


def _no_wider(chart: Chart, C: Float[Tensor, "b m m"]) -> Float[Tensor, "b m m"]:
    """The covariance with places no less sure than WIDEST."""
    at = torch.tensor(chart.places, dtype=torch.int64)
    shrink = C.new_ones(C.shape[:2])
    shrink[:, at] = (WIDEST / C.diagonal(dim1=-2, dim2=-1)[:, at].sqrt()).clamp(max=1.0)
    return C * shrink.unsqueeze(-1) * shrink.unsqueeze(-2)


def _sharing(first: list[Proposal], less: list[Student], count: int) -> list[tuple[Proposal, int]]:
    """Half of the draws to those that are there always, where there are others."""
    main = count // 2 if less else count
    shared = [(p, main // len(first)) for p in first] + [(p, (count - main) // len(less)) for p in less]
    left = count - sum(k for _, k in shared)
    return [(shared[0][0], shared[0][1] + left), *shared[1:]]


def _less_at_the_tip(
    target: _Target, y: Float[Tensor, "b m"], C: Float[Tensor, "b m m"]
) -> list[tuple[Float[Tensor, "b m"], Float[Tensor, "b m m"]]]:
    """Centre and covariance of y where the force at the tip, or the moment, is of a given small size.

    The prior (2) of estimation.chart is a mixture of normal ones over their size, and so is the posterior; the fit has the widest
    alone. Of a sample whose force, or moment, is surely not small, the fit's own.
    """
    found, tip = [], target.problem.state.tip.at
    for first in range(tip.start, tip.stop, 3):
        at = slice(first, first + 2)  # across the base's axis
        block, own = y[:, at], C[:, at, at]
        small = (block * ekf.solve_spd(own, block.unsqueeze(-1)).squeeze(-1)).sum(-1) < SURELY**2
        size = (block.square().sum(-1) + own.diagonal(dim1=-2, dim2=-1).sum(-1)).div(2).sqrt()
        for share in SMALLER:
            sigma = LEAST_SIZE * (size / LEAST_SIZE).clamp(min=1.0) ** share
            gain = ekf.solve_spd(own + torch.diag_embed(sigma.square().unsqueeze(-1).expand(-1, 2)), C[:, at]).mT
            gain = torch.where(small[:, None, None], gain, 0.0)
            found.append((y - (gain @ block.unsqueeze(-1)).squeeze(-1), C - gain @ C[:, at]))
    return found


def _drawn(problem: Problem, x: Float[Tensor, "b n"], C: Float[Tensor, "b n n"], nu: float, draws: int, jeffreys: bool) -> _Found:
    """Draws about the fits x with covariances C, which hold other fits as well where there are such."""
    if elsewhere(problem) is not None:
        evaluate = evaluator(problem, nu)
        own, _ = evaluate.posterior(evaluate.sums(x), x)
        C = torch.where(torch.isfinite(own).flatten(1).all(-1)[:, None, None], own, C)
    target = _Target(problem, x, C, nu, jeffreys)
    return _importance(target, _about(target, C, draws), draws)


def _about_all_fits(
    problem: Problem, x: Float[Tensor, "b n"], C: Float[Tensor, "b n n"], nu: float, draws: int, jeffreys: bool
) -> _Found:
    """The same about all fits of samples that have several (estimation.elsewhere), each by the evidence of what was drawn about it.

    The equilibria about one fit are no branch of those about another: what is drawn about the one hardly finds the other. Where
    it does, a fit has its draws twice; the evidence counts of each run what is nearest to its own fit.
    """
    found = _drawn(problem, x, C, nu, draws, jeffreys)
    others = fits_elsewhere(problem, x, solver_of(Settings(restarts=(), basins=0, sized=False)))
    if others is None:
        return found
    fit, of = others
    turn = torch.arange(len(of)) - torch.searchsorted(of, of)  # 0 for the cheapest of each sample
    runs, centres = [found], [marks(problem, x)]
    for k in range(min(MOST_OTHERS, int(turn.max()) + 1)):
        rows = of[turn == k]
        own = fit.of((turn == k).nonzero().squeeze(-1), problem.size)
        run = found.take(torch.arange(len(x)))
        run.log_weight[:], run.log_evidence[:] = -math.inf, -math.inf  # of samples without another fit
        run.put(rows, _drawn(problem.take(rows), own.x, own.covariance, nu, draws, jeffreys))
        runs.append(run)
        centres.append(torch.full_like(centres[0], torch.inf).index_copy(0, rows, marks(problem, own.x)))
    evidence = torch.stack([run.log_evidence.nan_to_num(-math.inf) for run in runs], 1)
    log_weight = torch.cat([run.log_weight for run in runs], 1).unflatten(1, (len(runs), draws))
    many = torch.stack([run.x for run in runs], 1)
    away = (marks(problem, many).unsqueeze(3) - torch.stack(centres, 1)[:, None, None]).norm(dim=-1).nan_to_num(torch.inf)
    at_home = away.argmin(-1) == torch.arange(len(runs)).unsqueeze(-1)
    share = torch.where(at_home, log_weight.exp(), 0.0).sum(-1)
    total = torch.where(torch.isfinite(evidence).sum(1) > 1, (evidence + share.log()).logsumexp(1), evidence[:, 0])
    p = torch.softmax(evidence, 1)
    pick = systematic((p.unsqueeze(-1) * log_weight.exp()).flatten(1), draws)
    told = torch.stack([run.k_hat for run in runs], 1).masked_fill(p < HARDLY, -math.inf).amax(1)
    ess = 1 / (p.square() / torch.stack([run.ess for run in runs], 1)).sum(1)
    joined = _Found(
        picked(many.flatten(1, 2), pick),
        torch.full_like(found.log_weight, -math.log(draws)),
        told,
        ess.clamp(max=draws),
        total,
        torch.stack([run.method for run in runs], 1).amax(1),
    )
    several = of.unique()
    found.put(several, joined.take(several))
    return found


def posterior_draws(
    problem: Problem, estimate: Estimate, draws: int = DRAWS, nu: float = math.inf, prior: Prior = "jeffreys"
) -> Draws:
    """Draws of the posterior of x of every sample that has converged: see the module.

    problem: the one that was fitted. estimate: its fit. draws: how many of each sample, a power of two, at least FEWEST. nu:
    degrees of freedom of Student's t of a robust fit. prior: of pushes at unknown places, Jeffreys' (estimation.jeffreys), by which
    intervals hold the truth as often as they say, or the normalized (2) of estimation.chart, which tells the evidence. Costs 10 us
    a draw for a rod without weight, 30 to 100 for other robots (docs/coverage.md). Errors: ValueError for an estimate of other
    unknowns, or fewer draws. Source: Vehtari et al., JMLR 2024.
    """
    n, B = problem.size, problem.batch
    if draws < FEWEST:
        raise ValueError(f"draws is {draws}; the tail of their weights needs at least {FEWEST}")
    if estimate.x.shape != (B, n):
        raise ValueError(f"the estimate has x of shape {tuple(estimate.x.shape)}; this problem needs {(B, n)}")
    x = torch.full((B, draws, n), torch.nan, dtype=DTYPE)
    weight = torch.full((B, draws), torch.nan, dtype=DTYPE)
    k_hat, ess, evidence = (torch.full((B,), torch.nan, dtype=DTYPE) for _ in range(3))
    method = torch.zeros(B, dtype=torch.int64)
    fine = (estimate.status == int(Status.CONVERGED)) & torch.isfinite(estimate.covariance).flatten(1).all(-1)
    if not problem.state.base.at.start:  # nothing is unknown but what equilibrium gives
        known = fine.to(DTYPE).masked_fill(~fine, torch.nan)
        x, weight = estimate.x.unsqueeze(1).expand(B, draws, n), (known / draws).unsqueeze(-1).expand(B, draws)
        return Draws(problem, x, weight, 0 * known, draws * known, -0.5 * estimate.cost * known, fine * int(Method.IMPORTANCE))
    with torch.inference_mode(False), one_thread():
        most = ROWS // draws if line_of(problem) is None else min(ROWS // draws, AT_ONCE)
        for rows in fine.nonzero().squeeze(-1).split(max(1, most)):
            if not len(rows):
                continue
            part = replace(problem.take(rows)) if len(rows) == B else problem.take(rows)
            drawn = _drawn if elsewhere(part) is None or line_of(part) is not None else _about_all_fits
            found = drawn(part, estimate.x[rows], estimate.covariance[rows], nu, draws, prior == "jeffreys")
            x[rows], weight[rows] = found.x, found.log_weight.exp()
            chart = Chart(part, found.x[:, 0], None)
            alike = math.lgamma(len(chart.places) + 1)  # as many orders of the loads, of which the draws have one
            if prior == "jeffreys" and chart.has_pushes:
                alike = math.nan
            k_hat[rows], ess[rows], evidence[rows] = found.k_hat, found.ess, found.log_evidence + alike
            method[rows] = found.method
    return Draws(problem, x, weight, k_hat, ess, evidence, method)
