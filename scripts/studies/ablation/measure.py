"""Run a case from its three starts, compare them sample by sample, and check that what converged has converged."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from studies.reproduction.cases import L
from studies.reproduction.study2 import force_error
from torchrod import Estimate, Origin, Problem, Settings, Start, Status, WarmStart, cold_start, estimate, find_warm_start
from torchrod.estimation import filter as ekf
from torchrod.estimation.at_rest import at_rest
from torchrod.estimation.evaluator import evaluator
from torchrod.estimation.solve import CHUNK, CHUNK_TORCH, Filter, linearize
from torchrod.estimation.starts import StartRule, challenged_by_cold, cold_from
from torchrod.kernel import available
from torchrod.learned.features import features
from torchrod.learned.warm_start import _costs
from torchrod.mechanics.loads import Load

from .cases import Case, Part

STARTS = ("cold", "warm", "oracle")
REPEATS = 2  # every start is timed so often, in turn, and the best counts
RESAMPLES = 1000
FURTHER = 60  # iterations after the estimator has stopped
SETTLED = 1e-7  # of cost: nothing more to gain
WORSE = 0.01  # of cost (chi^2): a fit that is dearer by more has ended elsewhere
TIMED_BATCH = 256


@dataclass(frozen=True)
class Run:
    """One start over the B samples of a case: iterations of all attempts, outcomes, cost, mean |error| of a sample's loads in
    location (m) and magnitude (N), and wall and CPU seconds for the whole batch.

    excess: what further iterations still take off the cost, NaN where the fit had not converged.
    """

    iterations: Tensor
    converged: Tensor
    accepted: Tensor
    warm_started: Tensor
    chi2: Tensor
    location: Tensor
    force: Tensor
    excess: Tensor
    seconds: tuple[float, float]


def starts(part: Part) -> dict[str, StartRule | Start]:
    """Where to start. Where no checkpoint serves the problem, warm is cold, as in the command line."""
    warm = find_warm_start(part.problem) or cold_start
    return {"cold": cold_start, "warm": warm, "oracle": Start.at(part.oracle, Origin.OTHER_FIT)}


def chunks(count: int) -> list[Tensor]:
    """Indices by the estimator's own chunks, whose working set is small enough."""
    return list(torch.arange(count).split(CHUNK if available() else CHUNK_TORCH))


def fitted(part: Part, start: StartRule | Start) -> Estimate:
    """All samples of a part from one start."""
    return estimate(part.problem, start=start)


def centroid(load: Load) -> Tensor:
    """Where a smooth load acts (m), weighted by its size per length."""
    s = torch.linspace(0, L, 201, dtype=torch.float64)
    density = load.density(s)
    assert density is not None
    weight = density[..., :2].norm(dim=-1).clamp(min=1e-300)
    return (weight * s).sum(-1) / weight.sum(-1)


def errors(part: Part, fit: Estimate) -> tuple[Tensor, Tensor]:
    """|error| per sample: location (m) and magnitude (N), contacts matched in the order of their locations.

    Study 2: of the centroid of the load, and RMS over s of the load carried up to s.
    """
    if not isinstance(part.truth, tuple):
        problem = part.problem
        (load,) = problem.unknowns.loads.loads(problem.state.loads.of(fit.x.nan_to_num(0.0)))
        return (centroid(load) - centroid(part.truth.load)).abs(), force_error(fit, part.truth, problem)
    force, location = part.truth
    order = fit.location.argsort(-1)
    off = fit.magnitude.gather(1, order) - force.norm(dim=-1)
    return (fit.location.gather(1, order) - location).abs().mean(-1), off.abs().mean(-1)


def fully_iterated(problem: Problem, x: Tensor) -> Tensor:
    """The cost (B,) after FURTHER iterations more from x: Gauss-Newton with Levenberg's damping, which can only go down.

    Not the filter, which would stop at once, and without its test. Samples with nothing more to gain drop out.
    """
    eye = torch.eye(problem.size, dtype=x.dtype)
    lowest, damping = torch.full_like(x[:, 0], torch.inf), torch.ones_like(x[:, 0])
    base, step = x.clone(), torch.zeros_like(x)
    live = torch.arange(len(x))
    for _ in range(FURTHER + 1):
        if not len(live):
            break
        onward = base[live] + step[live]
        at = linearize(problem.take(live), onward)
        assert at.tip is not None
        # A tip out of balance would look cheaper than it is: count by how far what is read has to move for c = 0.
        cost = at.cost + ekf.square(at.A, torch.nn.functional.pad(at.tip.d, (problem.size - ekf.BASE, 0)))
        lower = cost < lowest[live]
        done = lower & (at.decrement < SETTLED)
        lowest[live] = torch.where(lower, cost, lowest[live])
        # A step that went up is tried again from where it began, shorter; the next one is damped more.
        base[live] = torch.where(lower.unsqueeze(-1), onward, base[live])
        damping[live] = torch.where(lower, damping[live] / 4, damping[live] * 4)
        fresh = at.tip.solve(at.A + damping[live, None, None] * eye, at.g)[0].nan_to_num(0.0)
        step[live] = torch.where(lower.unsqueeze(-1), fresh, 0.25 * step[live])
        live = live[~done]
    return lowest


def excess(part: Part, fit: Estimate) -> Tensor:
    """By how much (B,) the answers of fits that converged lie above the cost they would reach; NaN where they did not converge."""
    x = torch.where(torch.isfinite(fit.x), fit.x, part.oracle)
    above = []
    for i in chunks(len(x)):
        problem = part.problem.take(i)
        above.append(evaluator(problem).cost(x[i]) - fully_iterated(problem, x[i]))
    return torch.where(fit.status == Status.CONVERGED, torch.cat(above), torch.nan)


def _joined(case: Case, fits: list[Estimate], seconds: tuple[float, float], check: bool) -> Run:
    """The fits of all parts as one run. check: whether to iterate on."""
    pairs = list(zip(case.parts, fits, strict=True))
    off = [errors(part, fit) for part, fit in pairs]
    beyond = [excess(part, fit) if check else torch.full_like(fit.chi2, torch.nan) for part, fit in pairs]
    return Run(
        iterations=torch.cat([fit.iterations for fit in fits]).double(),
        converged=torch.cat([fit.status == Status.CONVERGED for fit in fits]).double(),
        accepted=torch.cat([fit.accepted for fit in fits]).double(),
        warm_started=torch.cat([fit.warm_started for fit in fits]).double(),
        chi2=torch.cat([fit.chi2 for fit in fits]),
        location=torch.cat([location for location, _ in off]),
        force=torch.cat([force for _, force in off]),
        excess=torch.cat(beyond),
        seconds=seconds,
    )


def runs(case: Case, progress: Callable[[], object]) -> dict[str, Run]:
    """The case from every start, the starts in turn, so that a busy machine slows all alike."""
    by_part = [starts(part) for part in case.parts]
    fits: dict[str, list[Estimate]] = {}
    seconds = dict.fromkeys(STARTS, (float("inf"), float("inf")))
    for _ in range(REPEATS):
        for name in STARTS:
            wall, cpu = time.perf_counter(), time.process_time()
            fits[name] = [fitted(part, by_name[name]) for part, by_name in zip(case.parts, by_part, strict=True)]
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            seconds[name] = (min(seconds[name][0], wall), min(seconds[name][1], cpu))
            progress()
    return {name: _joined(case, fits[name], seconds[name], name != "oracle") for name in STARTS}


def start_times(part: Part) -> dict[str, float]:
    """CPU seconds for a batch of TIMED_BATCH: the guess with its check against a cold start; in it the reading of the markers, with
    the cold start that this needs, the forward solve under the guessed load, and network and check; a cold start alone; one filter
    iteration.
    """
    these = torch.arange(TIMED_BATCH) % len(part.oracle)
    problem, x, settings = part.problem.take(these), part.oracle[these], Settings()
    warm, Sigma0 = find_warm_start(problem) or cold_start, settings.initial_covariance(x)
    once = evaluator(problem).iteration(Filter(settings).init(problem, Start.at(x, Origin.OTHER_FIT)), ekf.Limits())

    def afresh() -> Problem:
        """As an estimate begins: nothing has been worked out yet."""
        return replace(problem)

    def better_of(problem: Problem) -> object:
        return challenged_by_cold(problem, warm(problem), Sigma0)

    found = {
        "start_s": best_of(lambda: better_of(afresh())),
        "cold_s": best_of(lambda: cold_start(afresh())),
        "iteration_s": best_of(lambda: once(torch.arange(len(x)))),
    }
    if not isinstance(warm, WarmStart):
        return found | {"read_s": 0.0, "solve_s": 0.0, "network_s": 0.0}
    guess = warm(problem)
    gamma, index = problem.state.loads.of(guess.x), guess.challenged.nonzero().squeeze(-1)
    loaded, read = problem.take(index), features(problem).take(index)
    rest = at_rest(loaded, gamma[index], read.q_tip)

    def network_and_check() -> None:
        warm.guess(loaded, read)
        states = torch.stack([guess.x[index], cold_from(loaded, read.alpha)], 1)
        _costs(loaded, states, torch.stack([rest.p, read.p0], 1))
        challenged_by_cold(problem, guess, Sigma0)

    return found | {
        "read_s": best_of(lambda: features(afresh())),
        "solve_s": best_of(lambda: at_rest(loaded, gamma[index], read.q_tip)),
        "network_s": best_of(network_and_check),
    }


def best_of(what: Callable[[], object], times: int = 9) -> float:
    """CPU seconds of the fastest of several calls: with one thread, what an idle machine would take."""
    taken = []
    for _ in range(times):
        begin = time.process_time()
        what()
        taken.append(time.process_time() - begin)
    return min(taken)


def resampled(values: Tensor, draws: int, seed: int = 0) -> Tensor:
    """Means (R, V) of paired measures (V, B) over R bootstrap resamples of the loads, `draws` neighbours each; NaN is left out."""
    by_load = values.unflatten(-1, (-1, draws)).nanmean(-1)
    n = by_load.shape[-1]
    index = torch.randint(n, (RESAMPLES, n), generator=torch.Generator().manual_seed(seed))
    return by_load[:, index].nanmean(-1).T


def interval(samples: Tensor) -> list[float]:
    """95 %, by percentiles."""
    return [float(v) for v in samples.nanquantile(torch.tensor([0.025, 0.975], dtype=samples.dtype))]


def start_row(run: Run, means: Tensor) -> dict[str, Any]:
    """The figures of one start. means: bootstrap means of its iterations."""
    return {
        "iterations_mean": float(run.iterations.mean()),
        "iterations_mean_95": interval(means),
        "iterations_median": float(run.iterations.median()),
        "iterations_95": float(run.iterations.quantile(0.95)),
        "converged": float(run.converged.mean()),
        "accepted": float(run.accepted.mean()),
        "location_m_mean": float(run.location.nanmean()),
        "force_N_mean": float(run.force.nanmean()),
        "wall_s": run.seconds[0],
        "cpu_s": run.seconds[1],
        "warm_started": float(run.warm_started.mean()),
    }


def compared(case: Case, by_start: dict[str, Run]) -> dict[str, Any]:
    """All figures of a case: each start's, the paired ratios and differences with intervals, and the check of convergence."""
    cold, warm = by_start["cold"], by_start["warm"]
    measures = [by_start[name].iterations for name in STARTS]
    measures += [warm.accepted - cold.accepted, warm.location - cold.location, warm.force - cold.force]
    values = torch.stack(measures)
    means = resampled(values, case.draws)
    figures: dict[str, Any] = {name: start_row(by_start[name], means[:, k]) for k, name in enumerate(STARTS)}
    iterations = values[:3].mean(-1)
    figures["ratio"] = {
        "warm_cold": float(iterations[1] / iterations[0]),
        "warm_cold_95": interval(means[:, 1] / means[:, 0]),
        "warm_oracle": float(iterations[1] / iterations[2]),
        "warm_oracle_95": interval(means[:, 1] / means[:, 2]),
    }
    figures["difference"] = {}
    for k, name in enumerate(("accepted", "location_m", "force_N"), 3):
        figures["difference"] |= {name: float(values[k].nanmean()), f"{name}_95": interval(means[:, k])}
    above = warm.chi2 - cold.chi2
    figures |= {"worse": float((above > WORSE).double().mean()), "better": float((above < -WORSE).double().mean())}
    same = above.abs() <= WORSE
    figures["same_minimum"] = {"share": float(same.double().mean())}
    for k, name in enumerate(("location_m", "force_N"), 4):
        figures["same_minimum"][name] = float(values[k][same].nanmean())
    figures["above_max"] = float(above.nan_to_num(0.0).max())
    figures["convergence"] = {name: remaining(by_start[name]) for name in ("cold", "warm")}
    return figures | {"cases": len(cold.chi2), "in_distribution": case.in_distribution, "bar": case.bar, "title": case.title}


def remaining(run: Run) -> dict[str, float | None]:
    """What further iterations take off the cost of converged fits: the largest, the 99 % point, and the largest of accepted ones.

    None where there are no such fits.
    """
    known = run.excess[torch.isfinite(run.excess)]
    accepted = run.excess[torch.isfinite(run.excess) & (run.accepted > 0)]
    most, usual = (float(known.max()), float(known.quantile(0.99))) if len(known) else (None, None)
    return {"max": most, "percentile_99": usual, "accepted_max": float(accepted.max()) if len(accepted) else None}
