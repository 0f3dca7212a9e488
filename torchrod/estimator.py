"""Estimate loads from markers: iterate the filter on a batch until every sample has settled."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from . import ekf
from .checks import check, usable
from .coordinates import PaperCoordinates
from .errors import InputError
from .fast import Sums, iterate_all
from .measurement import Markers, Model
from .precision import DTYPE
from .prepared import Prepared, served
from .result import Estimate, make_estimate
from .starts import Start, StartRule, better_start, cold_start, in_equilibrium
from .status import Learned, Status
from .threads import one_thread

CHUNK = 4096  # samples per pass: what is done once per pass and iteration no longer counts, and memory stays small
FEW = 1024  # samples for which torch's own share is done sooner on one thread
CHUNK_TORCH = 256  # the same without the compiled kernel, whose working set is larger
NEAR = 10.0  # near: the next step promises to lower the cost by less than this
PAPER_GAIN = 1e-3  # of chi^2: what the paper calls converged is not printed
PAPER_SIZES, PAPER_ALPHA = (50.0, 50.0, 0.03, 10.0), (3.0, 0.07)  # of [a_x, a_y (N/m), eta, c (1/m^2)] and of [N, N m]
PAPER_RATIO = 2.0  # square root of Sigma_0 over Q
RESTART_ITERATIONS = 50  # a restart that helps does so within about 30


@dataclass(frozen=True)
class Settings:
    """How the filter is run. Sigma0, Q: the variances (per entry of x) it starts from and adds at every iteration (4).

    step_limit: the largest change of any entry in one iteration. adaptive: residual-adaptive noise.
    coarse: begin with measurement.COARSE_STEPS steps along the rod and end, where the fit is near, with the model's own.
    robust: degrees of freedom of Student's t, by which the fit goes on from where the normal distribution's has ended; markers far
    off then weigh little (torchrod.ekf (6)), and those beyond the 99.9 % point are called outliers. inf: the normal one alone.
    restarts: a sample whose fit is not accepted is tried again from its loads times each of these factors, for at most
    RESTART_ITERATIONS each, and the fit of least cost is kept: a strong push near the tip has a second minimum at a quarter of
    its force.
    gain: a sample has converged, too, when the step that the filter takes promises to lower the cost by less than this; 0: only
    when a full Gauss-Newton step does (torchrod.ekf.Limits).
    """

    Sigma0: float | Float[Tensor, " n"] = 1.0
    Q: float | Float[Tensor, " n"] = 1.0
    step_limit: float = 0.6
    adaptive: bool = True
    coarse: bool = True
    max_iterations: int = 100
    restarts: tuple[float, ...] = (4.0, 2.0, 8.0)
    robust: float = math.inf
    gain: float = 0.0

    def initial_covariance(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "n n"]:
        """Sigma0 as a matrix."""
        return torch.diag(self.Sigma0 * x.new_ones(x.shape[-1]))


def paper_settings(model: Model, Q: float = 1.0, Sigma0: float = 1.0) -> Settings:
    """The paper's plain recursion (4): no step limit, no adaptive noise, no restart; `model` has PaperCoordinates and alpha in SI.

    Q and Sigma0 multiply the tuning, which the paper does not print: ours did best of those that scripts/paper_search.py tried,
    with coordinates that start 6 mm wide and a range of 4 mm beyond the rod, and tip_std = (2e-3 N, 2e-3 N m).
    Errors: InputError for a model with other coordinates.
    """
    if not isinstance(model.coordinates, PaperCoordinates):
        raise InputError(f"paper_settings: the model has {type(model.coordinates).__name__}; give it PaperCoordinates")
    size = torch.ones(model.size, dtype=DTYPE)  # square roots of Q's diagonal
    size[: model.coordinates.size] = torch.tensor(PAPER_SIZES, dtype=DTYPE).repeat(model.coordinates.count)
    size[-6:-3], size[-3:] = PAPER_ALPHA
    return Settings(
        Sigma0=Sigma0 * PAPER_RATIO**2 * size**2,
        Q=Q * size**2,
        step_limit=math.inf,
        adaptive=False,
        coarse=False,
        max_iterations=500,
        restarts=(),
        gain=PAPER_GAIN,
    )


@dataclass(frozen=True)
class Linearized:
    """One evaluation of the model at x: residual, Jacobian, information of data and prior, cost, decrement."""

    r: Float[Tensor, "B z"]
    H: Float[Tensor, "B z n"]
    A: Float[Tensor, "B n n"]
    g: Float[Tensor, "B n"]
    cost: Float[Tensor, " B"]
    decrement: Float[Tensor, " B"]


def linearize(model: Model, x: Float[Tensor, "B n"], markers: Markers, w: Float[Tensor, "B z"]) -> Linearized:
    """r = z - h(x) (zero where a marker is missing), H = dh/dx, and the cost r^T W r + (x0 - x)^T P (x0 - x) of (3)."""
    h, H = model.linearized(x, markers)
    r = Prepared(model, markers, w).residual(h)
    A, g = ekf.information(H, r, w, x, *model.prior())
    mean, precision = model.prior()
    cost = (w * r * r).sum(-1) + (precision * (mean - x) ** 2).sum(-1)
    return Linearized(r, H, A, g, cost, ekf.decrement(A, g))


def _silent(_: int) -> None:
    """No progress bar."""


@dataclass(frozen=True)
class _Course:
    """Iterations on the samples `live`, at most `most` each: those far from the data by the coarse model, the rest by the fine one.

    state: the iterate, Sigma0, Q and the sums, which change in place. rough, fine: a model made ready, and when it has arrived.
    """

    state: tuple[ekf.Iterate, Float[Tensor, "B n n"], Float[Tensor, " n"], Sums]
    rough: tuple[Prepared, ekf.Limits]
    fine: tuple[Prepared, ekf.Limits]
    live: Int[Tensor, " b"]
    near: Bool[Tensor, " B"]
    most: int

    def at_once(self) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]]:
        """Which samples have converged, and their iterations: step_by_step in one call of the kernel."""
        at, Sigma0, Q, sums = self.state
        calls = [(p.compiled_iteration(at, Sigma0, Q, limits, sums), p.tables(at.x)) for p, limits in (self.rough, self.fine)]
        return iterate_all(calls[0], calls[1], self.live, self.near, self.most)

    def step_by_step(self) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]]:
        """The same: samples leave the batch when they have converged; a failed one never touches its neighbours."""
        at, Sigma0, Q, sums = self.state
        rough_once, once = (p.iteration(at, Sigma0, Q, limits, sums) for p, limits in (self.rough, self.fine))
        near, live, B = self.near, self.live, len(self.near)
        converged, iterations = torch.zeros(B, dtype=torch.bool), torch.zeros(B, dtype=torch.int64)
        for iteration in range(self.most):
            if not len(live):
                break
            iterations[live] += 1
            far, close = live[~near[live]], live[near[live]]
            if len(far):
                rough_once(far)
                near[far] = at.done[far] | (2 * iteration >= self.most)
            if len(close):
                once(close)
                done = at.done[close]
                converged[close[done]] = True
                live = torch.cat([far, close[~done]]).sort().values
        return converged, iterations


def _filter(
    model: Model, markers: Markers, noise: float, settings: Settings, start: Start, progress: Callable[[int], object]
) -> Estimate:
    """Iterate one chunk."""
    prepared = Prepared(model, markers, model.weights(markers, noise), settings.robust)
    x = start.x.clone()
    Sigma0 = settings.initial_covariance(x).expand(len(x), -1, -1) if start.Sigma0 is None else start.Sigma0
    Sigma0, Q = Sigma0.contiguous(), settings.Q * x.new_ones(model.size)
    cap = x.new_full((len(x),), torch.inf if settings.adaptive else 0.0)
    at = ekf.Iterate(x, Sigma0.clone(), x.clone(), cap, torch.zeros(len(x), dtype=torch.bool))
    ok = usable(model, markers)
    status = torch.where(ok, int(Status.NOT_CONVERGED), int(Status.INVALID))
    live = ok.nonzero().squeeze(-1)
    sums = Sums.room(len(x), model.size, len(markers.s))
    limits = ekf.Limits(step=settings.step_limit, gain=settings.gain)
    rough = replace(prepared, model=model.coarse), limits._replace(decrement=NEAR)
    near = torch.full((len(x),), not settings.coarse or model.coarse is model)
    course = _Course((at, Sigma0, Q, sums), rough, (prepared, limits), live, near, settings.max_iterations)
    converged, iterations = course.at_once() if prepared.at_once else course.step_by_step()
    status[converged] = int(Status.CONVERGED)
    progress(len(x))
    rest = (status != int(Status.CONVERGED)).nonzero().squeeze(-1)
    if len(rest):
        sums.put(rest, prepared.take(rest).sums(at.x[rest]))
    evaluated = torch.where(converged.unsqueeze(-1), at.before, at.x)
    return make_estimate(prepared, at.x, evaluated, sums, status, iterations, start.warm)


@dataclass(frozen=True)
class _Chunk:
    """Some samples, and how they are to be fitted."""

    model: Model
    markers: Markers
    noise: float
    settings: Settings

    def take(self, index: Int[Tensor, " b"]) -> "_Chunk":
        return replace(self, markers=self.markers.take(index))

    def filtered(self, start: Start, progress: Callable[[int], object] = _silent) -> Estimate:
        """The filter; on with Student's t from where the normal distribution's fit has ended, if so wished.

        Markers far off can lead that fit so far astray that Student's t ends in another minimum (5 % of two contacts): where there
        are outliers, once more from a fit without them, and the one of less cost is kept.
        """
        normal = replace(self.settings, robust=math.inf)
        fit = _filter(self.model, self.markers, self.noise, normal, start, progress)
        if math.isinf(self.settings.robust):
            return fit
        onward = self.onward(fit)
        index = onward.outlier.any(-1).nonzero().squeeze(-1)
        if not len(index):
            return onward
        part = self.take(index)
        kept = part.markers.positions.masked_fill(onward.outlier[index].unsqueeze(-1), torch.nan)
        trimmed = replace(part, markers=replace(part.markers, positions=kept), settings=normal)
        return onward.improved_by(part.onward(trimmed.cold()), index)

    def onward(self, fit: Estimate) -> Estimate:
        """Student's t from where a fit has ended."""
        again = Start(fit.x.nan_to_num(0.0), None, fit.warm_started)
        onward = _filter(self.model, self.markers, self.noise, self.settings, again, _silent)
        return replace(onward, iterations=fit.iterations + onward.iterations)

    def cold(self) -> Estimate:
        """From no load."""
        return self.filtered(cold_start(self.model, self.markers, self.noise))

    def restarted(self, fit: Estimate, wanted: Bool[Tensor, " B"] | bool = True) -> Estimate:
        """The fit, and where it is not accepted (and a restart wanted) again from other magnitudes."""
        hasty = replace(self.settings, max_iterations=min(self.settings.max_iterations, RESTART_ITERATIONS))
        coordinates = self.model.coordinates
        for factor in self.settings.restarts if coordinates.size else ():
            index = (~fit.accepted & torch.isfinite(fit.x).all(-1) & wanted).nonzero().squeeze(-1)
            if not len(index):
                break
            part = replace(self.take(index), settings=hasty)
            gamma = coordinates.rescaled(fit.x[index, : coordinates.size], factor)
            x = in_equilibrium(self.model, gamma, part.markers)
            fit = fit.improved_by(part.filtered(Start.known(x)), index)
        return fit


def _fitted(chunk: _Chunk, start: Start, progress: Callable[[int], object]) -> Estimate:
    """From a guess that costs less than a cold start; where no accepted fit comes of it, all that would come of a cold start."""
    model, markers, settings = chunk.model, chunk.markers, chunk.settings
    chosen, dropped = better_start(model, markers, chunk.noise, start, settings.initial_covariance(start.x))
    fit = chunk.filtered(chosen, progress)
    failed = chosen.warm & ~fit.accepted & usable(model, markers)
    learned = torch.where(start.warm, int(Learned.USED), int(Learned.NONE))
    learned[dropped], learned[failed] = int(Learned.DROPPED), int(Learned.RETRIED)
    fit = replace(fit, learned=learned)
    index = failed.nonzero().squeeze(-1)
    if len(index):
        again = chunk.take(index)
        fit = fit.improved_by(again.restarted(again.cold()), index)
    return chunk.restarted(fit, ~failed)


def estimate(
    model: Model,
    markers: Markers,
    noise: float,
    settings: Settings | None = None,
    start: StartRule | Start = cold_start,
    progress: Callable[[int], object] = _silent,
) -> Estimate:
    """Fit loads, registration and base wrench to the markers of every sample: the weighted least squares (1) of the residual (3),
    iterated by (4).

    noise: standard deviation of a marker coordinate (m), where markers.sigma does not have one for each sample.
    start: where to start, or a rule that says so from (model, markers, noise) of some of the samples; a guess that is no nearer to
    the data than a cold start is dropped, and one that leads to no accepted fit is followed by a cold start.
    progress: called as samples finish, with their number. A sample's answer does not depend on its batch.
    Errors: ValueError for markers or a start that do not fit the robot; a sample that cannot be estimated has a status for it.
    Source: the paper, section II; docs/model.md.
    """
    check(model, markers, noise)
    if model.robot.gravity.ndim != 1:
        raise ValueError("an estimate takes one gravity (3,) for all samples; estimate those of each gravity by themselves")
    parts, compiled = [], served(model, markers.positions)
    size = CHUNK if compiled else CHUNK_TORCH
    # What is kept from call to call, and the answer, must serve outside of inference mode, too.
    with torch.inference_mode(False), one_thread(compiled and len(markers.positions) <= FEW):
        for first in range(0, len(markers.positions), size):
            index = torch.arange(first, min(first + size, len(markers.positions)))
            chunk = _Chunk(model, markers.take(index), noise, settings or Settings())
            parts.append(_fitted(chunk, _begin(start, chunk, index, len(markers.positions)), progress))
    return Estimate.cat(parts)


def _begin(start: StartRule | Start, chunk: _Chunk, index: Int[Tensor, " b"], count: int) -> Start:
    """Where the samples `index` of `count`, which are the chunk, start."""
    begin = start if isinstance(start, Start) else start(chunk.model, chunk.markers, chunk.noise)
    wanted = (count if begin is start else len(index), chunk.model.size)
    if tuple(begin.x.shape) != wanted:
        raise ValueError(f"start.x has shape {tuple(begin.x.shape)}; these markers and this model need {wanted}")
    return begin.take(index) if begin is start else begin
