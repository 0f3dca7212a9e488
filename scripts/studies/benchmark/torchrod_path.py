"""torchrod itself, behind the peers' interface. Which of its paths runs is a matter of the environment (`paths`)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from studies import peers
from studies.reproduction.cases import steel_rod
from torchrod import Estimate, Origin, Problem, Settings, Start, Tracker, cold_start, estimate, find_warm_start, kernel
from torchrod.estimation import filter as ekf
from torchrod.estimation.evaluator import evaluator
from torchrod.estimation.solve import CHUNK, Filter

from .cases import Case


class TorchrodPeer:
    """torchrod on one case."""

    def __init__(self, problem: peers.Problem):
        self.case = Case(problem.loads, problem.registration, len(problem.keep), _steps(problem), problem.noise)
        self._given: tuple[np.ndarray, ...] = ()  # the arrays that `iterate` was made ready for, and what it then calls
        self._calls: list[Callable[[], object]] = []
        self._before = self._done = np.empty(0)

    def problem(self, positions: np.ndarray) -> Problem:
        """Of some samples."""
        return self.case.problem(torch.from_numpy(positions))

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        h, H = self.problem(np.zeros((len(x), self.case.markers, 3))).linearized(torch.from_numpy(x))
        return h.numpy(), H.numpy()

    def iterate(self, x: np.ndarray, Sigma: np.ndarray, cap: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `peers.Peer`; in place, in the estimator's own chunks, which are made ready once for the same arrays."""
        given = x, Sigma, cap, positions
        if len(self._given) != len(given) or any(a is not b for a, b in zip(self._given, given, strict=True)):
            self._given, self._before, self._done = given, x.copy(), np.zeros(len(x), dtype=np.bool_)
            parts = [slice(k, k + CHUNK) for k in range(0, len(x), CHUNK)]
            state = x, Sigma, self._before, cap, self._done
            self._calls = [self._once(positions[p], [a[p] for a in state]) for p in parts]
        for once in self._calls:
            once()
        return x, Sigma, cap, self._done

    def _once(self, positions: np.ndarray, state: list[np.ndarray]) -> Callable[[], object]:
        """One pass of the filter as torchrod.estimate does it, in place, on one chunk.

        This is what the tables call an iteration: h, H, the normal equations and the update. What is prepared once for all
        iterations of a fit is not in it.
        """
        problem = self.problem(positions)
        x, Sigma, before, cap, done = (torch.from_numpy(a) for a in state)
        at = ekf.Iterate(x, Sigma, before, cap, torch.ones_like(cap), done)
        run = replace(Filter(Settings()).init(problem, Start.at(at.x, Origin.OTHER_FIT)), at=at)
        once, index = evaluator(problem).iteration(run, ekf.Limits()), torch.arange(len(at.x))
        return lambda: once(index)

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> peers.Fit:
        """See `peers.Peer`, for the comparison of answers: all steps fine, as the peers', so that the iterations are the same.

        torchrod chooses its own cold start, which is x on this rod.
        """
        return as_fit(estimate(self.problem(positions), Settings(coarse=False)))

    def fitted(self, start: str, positions: np.ndarray) -> Estimate:
        """Markers to loads with covariance, everything included, from a "cold" or a "warm" start."""
        problem = self.problem(positions)
        return estimate(problem, start=(find_warm_start(problem) if start == "warm" else None) or cold_start)

    def frame_estimator(self) -> Callable[[np.ndarray], Any]:
        """One frame (P, 3) to its estimate, warm-started from what was before."""
        tracker = Tracker(steel_rod(), self.case.unknowns(), self.case.markers_at(), self.case.noise)
        return lambda positions: tracker(torch.from_numpy(positions))


def kernel_seconds() -> float:
    """Seconds spent in the compiled kernel so far."""
    return kernel.seconds()


def as_fit(fit: Estimate) -> peers.Fit:
    """As the peers report it."""
    parts = (fit.x, fit.covariance, fit.force, fit.location, fit.iterations, fit.status == 0, fit.chi2)
    return peers.Fit(*(part.numpy() for part in parts))


def _steps(problem: peers.Problem) -> int:
    """The number of steps asked for: a node at every marker and no step longer than L / steps."""
    return round(problem.length / float(np.diff(problem.nodes).max()))
