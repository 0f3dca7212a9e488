"""torchrod itself, behind the peers' interface. Which of its paths runs is a matter of the environment (`paths`)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from studies.peers import Fit, Problem
from torchrod import Estimate, Estimator, Markers, Settings, cold_start, estimate, find_warm_start, kernel
from torchrod.estimation import filter as ekf
from torchrod.estimation.evaluator import Prepared
from torchrod.estimation.solve import CHUNK

from .cases import Case


class TorchrodPeer:
    """torchrod on one case."""

    def __init__(self, problem: Problem):
        self.case = Case(problem.loads, problem.registration, len(problem.keep), _steps(problem), problem.noise)
        self.model, self.s = self.case.model(), self.case.markers_at()
        self._given: tuple[np.ndarray, ...] = ()  # the arrays that `iterate` was made ready for, and what it then calls
        self._calls: list[Callable[[], object]] = []
        self._before = self._done = np.empty(0)

    def markers(self, positions: np.ndarray) -> Markers:
        """Of some samples."""
        return Markers(self.s, torch.from_numpy(positions))

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        nowhere = torch.zeros(len(x), len(self.s), 3, dtype=torch.float64)
        h, H = self.model.linearized(torch.from_numpy(x), Markers(self.s, nowhere))
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
        markers, n = self.markers(positions), self.model.size
        at = ekf.Iterate(*(torch.from_numpy(a) for a in state))
        Sigma0, sums = torch.eye(n, dtype=torch.float64).repeat(len(at.x), 1, 1), kernel.Sums.room(len(at.x), n, len(self.s))
        prepared = Prepared(self.model, markers, self.model.weights(markers, self.case.noise))
        once, index = prepared.iteration(at, Sigma0, torch.ones_like(at.x[0]), ekf.Limits(), sums), torch.arange(len(at.x))
        return lambda: once(index)

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> Fit:
        """See `peers.Peer`, for the comparison of answers: all steps fine, as the peers', so that the iterations are the same.

        torchrod chooses its own cold start, which is x on this rod.
        """
        return as_fit(estimate(self.model, self.markers(positions), self.case.noise, Settings(coarse=False)))

    def fitted(self, start: str, positions: np.ndarray) -> Estimate:
        """Markers to loads with covariance, everything included, from a "cold" or a "warm" start."""
        rule = (find_warm_start(self.model) if start == "warm" else None) or cold_start
        return estimate(self.model, self.markers(positions), self.case.noise, start=rule)

    def frame_estimator(self) -> Callable[[np.ndarray], Any]:
        """One frame (P, 3) to its estimate, warm-started from what was before."""
        estimator = Estimator(self.model, self.s, self.case.noise)
        return lambda positions: estimator(torch.from_numpy(positions))


def kernel_seconds() -> float:
    """Seconds spent in the compiled kernel so far."""
    return kernel.seconds()


def as_fit(fit: Estimate) -> Fit:
    """As the peers report it."""
    parts = (fit.x, fit.covariance, fit.force, fit.location, fit.iterations, fit.status == 0, fit.chi2)
    return Fit(*(part.numpy() for part in parts))


def _steps(problem: Problem) -> int:
    """The number of steps asked for: a node at every marker and no step longer than L / steps."""
    return round(problem.length / float(np.diff(problem.nodes).max()))
