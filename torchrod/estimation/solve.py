"""Estimate: iterate the filter on a batch until every sample has settled, and what wraps it where one run is not enough.

A solver maps a problem and a start to an estimate. `Filter` is the plain one: init, step, terminate. The strategies each wrap one:
`Robust` goes on with Student's t, `Basins` looks elsewhere where a fit is plainly wrong, `Restarts` tries other magnitudes where it
is not accepted, `Challenged` drops a start that is no nearer to the data than a cold one and follows one that fails by a cold one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .. import kernel
from ..model.load_families import PaperCoordinates
from ..model.problem import Problem
from ..util.errors import InputError
from ..util.precision import DTYPE
from ..util.status import Status
from ..util.threads import one_thread
from . import checks
from . import filter as ekf
from .elsewhere import cheapest
from .evaluator import Evaluator, Run, evaluator
from .result import Estimate, limit, make_estimate
from .starts import Fate, Origin, Start, StartRule, challenged_by_cold, cold_start, in_equilibrium
from .tip_size import sized
from .walk import kernel_serves

CHUNK = 4096  # samples per pass: what is done once per pass and iteration no longer counts, and memory stays small
FEW = 1024  # samples for which torch's own share is done sooner on one thread
CHUNK_TORCH = 256  # the same without the compiled kernel, whose working set is larger
NEAR = 10.0  # near: the next step promises to lower the cost by less than this
ARRIVED = 7e-4  # the same, for a fit that has arrived: a little less than 1e-3, to which curved valleys then keep as well
PAPER_GAIN = 1e-3  # of chi^2: what the paper calls converged is not printed
PAPER_SIZES, PAPER_ALPHA = (50.0, 50.0, 0.03, 10.0), (3.0, 0.07)  # of [a_x, a_y (N/m), eta, c (1/m^2)] and of [N, N m]
PAPER_RATIO = 2.0  # square root of Sigma_0 over Q
BASINS = 3  # starts elsewhere that are tried; the best is nearly always the first
WRONG = 10.0  # times the 99.9 % point of chi^2: more than noise that is stated too small, or a model that is slightly off
LOWERED = 0.9  # of chi^2: what finer steps must bring a fit that is not accepted before still finer ones are tried
RESTART_ITERATIONS = 50  # a restart that helps does so within about 30
Progress = Callable[[int], object]


def silent(_: int) -> None:
    """No progress bar."""


@dataclass(frozen=True)
class Settings:
    """How the filter is run. Sigma0, Q: the variances (per entry of x) it starts from and adds at every iteration (4).

    step_limit: the largest change of any entry in one iteration. adaptive: residual-adaptive noise.
    coarse: begin with model.problem.COARSE_STEPS steps along the rod and end, where the fit is near, with the problem's own.
    robust: degrees of freedom of Student's t, by which the fit goes on from where the normal distribution's has ended; markers far
    off then weigh little (estimation.filter (6)), and those beyond the 99.9 % point are called outliers. inf: the normal one alone.
    basins: a sample whose fit has not converged, or leaves WRONG times what is accepted, is tried again from so many others of the
    load family's starts (`LoadFamily.elsewhere`), those of least cost: the shape of a rod that a strong push has wrapped around is
    one of several with the same residual at first.
    restarts: a sample whose fit is not accepted is tried again from its loads times each of these factors, for at most
    RESTART_ITERATIONS each, and the fit of least cost is kept: a strong push near the tip has a second minimum at a quarter of
    its force.
    sized: a wrench at the tip is taken to be no larger than the readings ask for (estimation.tip_size); False: of any size.
    gain: a sample has converged, too, when the step that the filter takes promises to lower the cost by less than this; 0: only
    when a full Gauss-Newton step does (estimation.filter.Limits).
    Errors: ValueError for numbers that no filter can be run with.
    """

    Sigma0: float | Float[Tensor, " n"] = 1.0
    Q: float | Float[Tensor, " n"] = 1.0
    step_limit: float = 0.6
    adaptive: bool = True
    coarse: bool = True
    max_iterations: int = 100
    restarts: tuple[float, ...] = (4.0, 2.0, 8.0)
    basins: int = BASINS
    robust: float = math.inf
    sized: bool = True
    gain: float = 0.0

    def __post_init__(self):
        for name, least in (("Sigma0", "above"), ("Q", "at least")):
            value = getattr(self, name)
            values = value.flatten().tolist() if isinstance(value, Tensor) else [value]
            if not all((v > 0 or (v == 0 and name == "Q")) and v < math.inf for v in values):
                raise ValueError(f"Settings.{name} must be finite and {least} 0")
        if not self.step_limit > 0:
            raise ValueError(f"Settings.step_limit is {self.step_limit}; it must be positive")
        if not self.robust > 0:
            raise ValueError(f"Settings.robust is {self.robust}; it must be positive (degrees of freedom), or inf")
        if self.max_iterations < 1:
            raise ValueError(f"Settings.max_iterations is {self.max_iterations}; it must be at least 1")
        if not all(0 < factor < math.inf for factor in self.restarts):
            raise ValueError(f"Settings.restarts is {self.restarts}; every factor must be positive and finite")

    def initial_covariance(self, x: Float[Tensor, "*B n"]) -> Float[Tensor, "n n"]:
        """Sigma0 as a matrix."""
        return torch.diag(self.Sigma0 * x.new_ones(x.shape[-1]))


def paper_settings(problem: Problem, Q: float = 1.0, Sigma0: float = 1.0) -> Settings:
    """The paper's plain recursion (4): no step limit, no adaptive noise, no restart; for PaperCoordinates and alpha in SI.

    Q and Sigma0 multiply the tuning, which the paper does not print: ours did best of those that scripts/paper_search.py tried,
    with coordinates that start 6 mm wide and a range of 4 mm beyond the rod, and tip_std = (2e-3 N, 2e-3 N m).
    Errors: InputError for a problem with other coordinates.
    """
    loads = problem.unknowns.loads
    if not isinstance(loads, PaperCoordinates):
        raise InputError(f"paper_settings: the problem has {type(loads).__name__}; give it PaperCoordinates")
    size = torch.ones(problem.size, dtype=DTYPE)  # square roots of Q's diagonal
    size[: loads.size] = torch.tensor(PAPER_SIZES, dtype=DTYPE).repeat(loads.count)
    size[-6:-3], size[-3:] = PAPER_ALPHA
    return Settings(
        Sigma0=Sigma0 * PAPER_RATIO**2 * size**2,
        Q=Q * size**2,
        step_limit=math.inf,
        adaptive=False,
        coarse=False,
        max_iterations=500,
        restarts=(),
        basins=0,
        gain=PAPER_GAIN,
    )


@dataclass(frozen=True)
class Linearized:
    """One evaluation of the model at x: residual r, Jacobian H, information A, gradient g and cost of the readings and the prior.

    tip: the tip condition to first order; None where the tip residual is weighed instead and counts in A, g and cost.
    """

    r: Float[Tensor, "B z"]
    H: Float[Tensor, "B z n"]
    A: Float[Tensor, "B n n"]
    g: Float[Tensor, "B n"]
    cost: Float[Tensor, " B"]
    tip: ekf.TipCondition | None

    @property
    def decrement(self) -> Float[Tensor, " B"]:
        """What a full Gauss-Newton step promises: see estimation.filter.Limits."""
        return ekf.decrement(self.A, self.g) if self.tip is None else ekf.square(self.A, self.tip.solve(self.A, self.g)[0])


def linearize(problem: Problem, x: Float[Tensor, "B n"], exact: bool | None = None) -> Linearized:
    """r = z - h(x) (zero where nothing was read), H = dh/dx, and the cost r^T W r + (x0 - x)^T P (x0 - x) of (3).

    exact: whether the tip residual is a condition instead of rows with a weight; None: as at the problem's answer.
    """
    h, H = problem.linearized(x)
    r = torch.where(problem.weights > 0, problem.reading - h, 0.0)
    N = ekf.normal_equations(H, r, problem.weights, problem.groups)
    exact = problem.exact_tip if exact is None else exact
    A, g, cost = (N.readings if exact else N).whole(x, problem.mean, problem.precision)
    return Linearized(r, H, A, g, cost, N.tip if exact else None)


@runtime_checkable
class Solver(Protocol):
    """What turns a problem and a start into an estimate."""

    def __call__(self, problem: Problem, start: Start, progress: Progress = silent) -> Estimate:
        """The fit of every sample. progress: called as samples finish, with their number."""
        ...


@dataclass(frozen=True)
class Filter:
    """The recursion (4) on a batch: samples far from the data by a coarse model whose tip may be out of balance, the rest
    by the problem's own, in equilibrium.
    """

    settings: Settings
    nu: float = math.inf

    def init(self, problem: Problem, start: Start) -> Run:
        """The state before the first iteration."""
        settings, x = self.settings, start.x
        Sigma0 = settings.initial_covariance(x).expand(len(x), -1, -1) if start.Sigma0 is None else start.Sigma0
        Sigma0, Q = Sigma0.contiguous(), settings.Q * x.new_ones(problem.size)
        at = ekf.Iterate.start(x, Sigma0, torch.inf if settings.adaptive else 0.0)
        sums = kernel.Sums.room(len(x), problem.size, problem.weights.shape[-1], len(problem.s))
        near = torch.full((len(x),), not problem.exact_tip and (not settings.coarse or problem.coarse is problem))
        return Run(at, Sigma0, Q, sums, near)

    def step(
        self, models: tuple[Evaluator, Evaluator], run: Run, live: Int[Tensor, " b"]
    ) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]]:
        """Iterate the samples `live`, in place, until they are done: which have converged, and how many iterations each has had.

        Samples leave the batch when they have converged; a failed one never touches its neighbours.
        """
        rough, fine = models
        limits = ekf.Limits(step=self.settings.step_limit, gain=self.settings.gain)
        both = limits._replace(decrement=NEAR), limits._replace(exact=models[1].problem.exact_tip, decrement=ARRIVED)
        most = self.settings.max_iterations
        at_once = rough.iterate_all(fine, run, both, live, most)
        if at_once is not None:
            return at_once
        rough_once, once = (model.iteration(run, own) for model, own in zip(models, both, strict=True))
        near, done, B = run.near, run.at.done, len(run.near)
        converged, iterations = torch.zeros(B, dtype=torch.bool), torch.zeros(B, dtype=torch.int64)
        for iteration in range(most):
            if not len(live):
                break
            iterations[live] += 1
            far, close = live[~near[live]], live[near[live]]
            if len(far):
                rough_once(far)
                near[far] = done[far] | (2 * iteration >= most)
            if len(close):
                once(close)
                settled = done[close]
                converged[close[settled]] = True
                live = torch.cat([far, close[~settled]]).sort().values
        return converged, iterations

    def __call__(self, problem: Problem, start: Start, progress: Progress = silent) -> Estimate:
        """See Solver."""
        fine = evaluator(problem, self.nu)
        rough = evaluator(problem.coarse, self.nu) if self.settings.coarse and problem.coarse is not problem else fine
        run = self.init(problem, start)
        ok = problem.usable
        status = torch.where(ok, int(Status.NOT_CONVERGED), int(Status.INVALID))
        converged, iterations = self.step((rough, fine), run, ok.nonzero().squeeze(-1))
        status[converged] = int(Status.CONVERGED)
        progress(len(status))
        rest = (~converged).nonzero().squeeze(-1)
        if len(rest):
            run.sums.put(rest, fine.take(rest).sums(run.at.x[rest]))
        evaluated = torch.where(converged.unsqueeze(-1), run.at.before, run.at.x)
        return make_estimate(fine, run.at.x, evaluated, run.sums, status, iterations, start.origin)


@dataclass(frozen=True)
class Robust:
    """On with Student's t of nu degrees of freedom from where the normal distribution's fit has ended.

    Markers far off can lead that fit so far astray that Student's t ends in another minimum (5 % of two contacts): where there are
    outliers, once more from a fit without them, and the one of less cost is kept.
    """

    normal: Filter
    nu: float

    def __call__(self, problem: Problem, start: Start, progress: Progress = silent) -> Estimate:
        """See Solver."""
        onward = self._onward(problem, self.normal(problem, start, progress))
        index = onward.outlier.any(-1).nonzero().squeeze(-1)
        if not len(index):
            return onward
        part = problem.take(index)
        trimmed = self.normal(part.without(onward.outlier[index]), cold_start(part))
        return onward.improved_by(self._onward(part, trimmed), index)

    def _onward(self, problem: Problem, fit: Estimate) -> Estimate:
        again = Start.at(fit.x.nan_to_num(0.0), fit.origin)
        onward = replace(self.normal, nu=self.nu)(problem, again)
        return replace(onward, iterations=fit.iterations + onward.iterations)


@dataclass(frozen=True)
class Basins:
    """The solver's fit; where that is plainly wrong a hasty one's from the starts elsewhere that cost least, `most` of them."""

    solver: Solver
    hasty: Callable[[], Solver]
    most: int

    def __call__(self, problem: Problem, start: Start, progress: Progress = silent) -> Estimate:
        """See Solver."""
        return self.improve(problem, self.solver(problem, start, progress))

    def improve(self, problem: Problem, fit: Estimate, wanted: Bool[Tensor, " B"] | bool = True) -> Estimate:
        """A fit that is there already, looked for elsewhere where it is plainly wrong and that is wanted."""
        if bool(fit.accepted.all()):
            return fit
        elsewhere = getattr(problem.unknowns.loads, "elsewhere", None)  # a family of a user's own need not have it
        if not self.most or elsewhere is None or not len(gammas := elsewhere(problem.robot.rod.sides)):
            return fit
        limits = torch.tensor([WRONG * limit(dof) for dof in fit.dof.tolist()], dtype=DTYPE)
        wrong = problem.usable & wanted & ~((fit.status == int(Status.CONVERGED)) & (fit.chi2 < limits))
        index = wrong.nonzero().squeeze(-1)
        if not len(index):
            return fit
        begin = torch.stack([self._cheapest(problem.take(i), gammas) for i in index.split(1)], 1)
        for x in begin:
            left = ~fit.accepted[index]
            if not bool(left.any()):
                break
            part = problem.take(index[left])
            fit = fit.improved_by(self.hasty()(part, Start.at(x[left], Origin.ELSEWHERE)), index[left])
        return fit

    def _cheapest(self, one: Problem, gammas: Float[Tensor, "C g"]) -> Float[Tensor, "most n"]:
        """The states of least cost of a problem of one sample."""
        many = one.take(torch.zeros(len(gammas), dtype=torch.int64))
        x = in_equilibrium(many, gammas)
        cost = evaluator(many.coarse).cost(x).nan_to_num(torch.inf)
        return x[cost.argsort()[: self.most]]


@dataclass(frozen=True)
class Restarts:
    """The solver's fit, and where it is not accepted a hasty one's from its loads times each of the factors."""

    solver: Basins
    hasty: Callable[[], Solver]
    factors: tuple[float, ...]

    def __call__(self, problem: Problem, start: Start, progress: Progress = silent) -> Estimate:
        """See Solver."""
        return self.improve(problem, self.solver.solver(problem, start, progress))

    def improve(self, problem: Problem, fit: Estimate, wanted: Bool[Tensor, " B"] | bool = True) -> Estimate:
        """A fit that is there already, looked for elsewhere and restarted where it is not accepted and that is wanted."""
        fit = self.solver.improve(problem, fit, wanted)
        loads, at = problem.unknowns.loads, problem.state.loads.at
        for factor in self.factors if loads.size else ():
            index = (~fit.accepted & torch.isfinite(fit.x).all(-1) & wanted).nonzero().squeeze(-1)
            if not len(index):
                break
            part = problem.take(index)
            x = in_equilibrium(part, loads.rescaled(fit.x[index][:, at], factor))
            fit = fit.improved_by(self.hasty()(part, Start.at(x, Origin.OTHER_FIT)), index)
        return fit


@dataclass(frozen=True)
class Challenged:
    """From a start that costs less than a cold one; where no accepted fit comes of it, all that would come of a cold start."""

    solver: Restarts
    settings: Settings

    def __call__(self, problem: Problem, start: Start, progress: Progress = silent) -> Estimate:
        """See Solver."""
        chosen, dropped = challenged_by_cold(problem, start, self.settings.initial_covariance(start.x))
        fit = self.solver.solver.solver(problem, chosen, progress)
        failed = chosen.challenged & ~fit.accepted & problem.usable
        fate = torch.zeros_like(start.origin)
        fate[dropped], fate[failed] = int(Fate.DROPPED), int(Fate.RETRIED)
        fit = replace(fit, guess=start.origin.clone(), fate=fate)
        index = failed.nonzero().squeeze(-1)
        if len(index):
            part = problem.take(index)
            fit = fit.improved_by(self.solver(part, cold_start(part)), index)
        return self.solver.improve(problem, fit, ~failed)


def solver_of(settings: Settings) -> Solver:
    """The solver that the settings describe: Challenged(Restarts(Robust(Filter)))."""

    def base(settings: Settings) -> Solver:
        plain = Filter(settings)
        return plain if math.isinf(settings.robust) else Robust(plain, settings.robust)

    def hasty() -> Solver:
        return base(replace(settings, max_iterations=min(settings.max_iterations, RESTART_ITERATIONS)))

    return Challenged(Restarts(Basins(base(settings), hasty, settings.basins), hasty, settings.restarts), settings)


def estimate_each(
    problem: Problem, settings: Settings | None = None, start: StartRule | Start = cold_start, progress: Progress = silent
) -> Estimate:
    """Fit every sample by itself, whatever the scope of its unknowns: see torchrod.estimate, which adds what samples share."""
    with torch.inference_mode(False):  # what is kept from call to call must serve outside of inference mode, too
        problem = replace(problem)  # of this call: what it works out from tensors must not outlive a change of them
        problem.check()
    if problem.robot.gravity.ndim != 1:
        raise ValueError("an estimate takes one gravity (3,) for all samples; estimate those of each gravity by themselves")
    parts, compiled, B = [], kernel_serves(problem), problem.batch
    size = CHUNK if compiled else CHUNK_TORCH
    settings = settings or Settings()
    solve, plain = solver_of(settings), solver_of(replace(settings, restarts=(), basins=0))
    # What is kept from call to call, and the answer, must serve outside of inference mode, too.
    with torch.inference_mode(False), one_thread(compiled and B <= FEW):
        for first in range(0, B, size):
            index = torch.arange(first, min(first + size, B))
            chunk = problem if len(index) == B else problem.take(index)
            fit = solve(chunk, _begin(start, chunk, index, B), progress)
            fit = sized(chunk, fit, plain) if settings.sized else fit
            fit = cheapest(chunk, fit, plain) if settings.basins else fit
            parts.append(_stable(chunk, _followed(chunk, fit, settings)))
    return Estimate.cat(parts)


def _followed(problem: Problem, fit: Estimate, settings: Settings) -> Estimate:
    """The fit, repeated with twice the steps as long as they move what is read; what even MOST_STEPS do not follow is said.

    A fit that is not accepted may be kept from its load by the steps: it is repeated as long as that lowers chi^2. Where finer
    steps than it began with are needed and it is not accepted with them, all that would come of a cold start with these.
    """
    if bool(fit.accepted.all()) and checks.all_follow(problem, fit.x):
        return fit
    hasty, thorough = solver_of(replace(settings, restarts=(), basins=0)), solver_of(settings)

    def asked(problem: Problem, fit: Estimate) -> tuple[Bool[Tensor, " B"], Bool[Tensor, " B"]]:
        """Whose readings finer steps would move, and which fits they may improve."""
        valid = fit.status != int(Status.INVALID)
        return ~checks.follows(problem, fit.x, valid), valid & ~fit.accepted & checks.in_the_way(problem, fit.x)

    moved, hope = asked(problem, fit)
    at = (moved | hope).nonzero().squeeze(-1)
    part, moved = problem.take(at), moved[at]
    while len(at) and part.steps < checks.MOST_STEPS:
        part = part.with_steps(min(2 * part.steps, checks.MOST_STEPS))
        again = hasty(part, Start.at(fit.x[at], Origin.OTHER_FIT))
        better = moved | again.accepted | (again.chi2 < LOWERED * fit.chi2[at])
        moved, hope = asked(part, again)
        lost = (better & ~again.accepted & ~(moved | hope)).nonzero().squeeze(-1)
        if len(lost):
            anew = part.take(lost)
            again = again.improved_by(thorough(anew, cold_start(anew)), lost)
        kept = {name: getattr(fit, name) for name in ("origin", "guess", "fate", "restarts")}
        fit = replace(fit.merged(again, at, better), **kept)
        rest = (moved | (hope & better)).nonzero().squeeze(-1)
        part, at, moved = part.take(rest), at[rest], moved[rest]
    at = at[moved]
    return replace(fit, coarse=fit.coarse.index_fill(0, at, True), accepted=fit.accepted.index_fill(0, at, False))


def _stable(problem: Problem, fit: Estimate) -> Estimate:
    """The fit, with a word on equilibria in which no rod stays."""
    if problem.robot.weightless and not problem.state.tip.size:
        return fit
    index = (fit.status == int(Status.CONVERGED)).nonzero().squeeze(-1)
    falls = index[~checks.stable(problem.take(index), fit.x[index])] if len(index) else index
    pushed = problem.state.external.stop > 0  # a contact is no dead load: it may hold the rod as well
    return replace(
        fit,
        unstable=fit.unstable.index_fill(0, falls, True),
        accepted=fit.accepted if pushed else fit.accepted.index_fill(0, falls, False),
    )


def _begin(start: StartRule | Start, chunk: Problem, index: Int[Tensor, " b"], count: int) -> Start:
    """Where the samples `index` of `count`, which are the chunk, start."""
    begin = start if isinstance(start, Start) else start(chunk)
    wanted = (count if begin is start else len(index), chunk.size)
    if tuple(begin.x.shape) != wanted:
        raise ValueError(f"start.x has shape {tuple(begin.x.shape)}; these measurements and unknowns need {wanted}")
    return begin.take(index) if begin is start else begin
