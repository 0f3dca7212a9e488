"""torchrod itself, behind the peers' interface. Which of its paths runs is a matter of the environment (`paths`)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from peers import Fit, Problem

from torchrod import Estimate, Estimator, Markers, Settings, cold_start, ekf, estimate, fast, find_warm_start
from torchrod.estimator import CHUNK
from torchrod.prepared import Prepared

from .cases import Case


def one_iteration(prepared: Prepared, sums: fast.Sums, at: ekf.Iterate, Sigma0: torch.Tensor) -> None:
    """One pass of the filter as torchrod.estimate does it, in place.

    This is what the tables call an iteration: h, H, the normal equations and the update. What is prepared once for all iterations
    of a fit is not in it.
    """
    prepared.iteration(at, Sigma0, torch.ones_like(at.x[0]), ekf.Limits(), sums)(torch.arange(len(at.x)))


class TorchrodPeer:
    """torchrod on one case."""

    def __init__(self, problem: Problem):
        self.case = Case(problem.loads, problem.registration, len(problem.keep), _steps(problem), problem.noise)
        self.model, self.s = self.case.model(), self.case.markers_at()
        self._ready: tuple[np.ndarray | None, list[tuple[Prepared, fast.Sums]]] = (None, [])

    def markers(self, positions: np.ndarray) -> Markers:
        """Of some samples."""
        return Markers(self.s, torch.from_numpy(positions))

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        nowhere = torch.zeros(len(x), len(self.s), 3, dtype=torch.float64)
        h, H = self.model.linearized(torch.from_numpy(x), Markers(self.s, nowhere))
        return h.numpy(), H.numpy()

    def iterate(self, x: np.ndarray, Sigma: np.ndarray, cap: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `peers.Peer`; in the estimator's own chunks."""
        if self._ready[0] is not positions:
            self._ready = (positions, [self._prepared(positions[k : k + CHUNK]) for k in range(0, len(x), CHUNK)])
        after, before = (x.copy(), Sigma.copy(), x.copy(), cap.copy(), np.zeros(len(x), dtype=np.bool_)), torch.from_numpy(Sigma)
        for k, (prepared, sums) in enumerate(self._ready[1]):
            here = slice(k * CHUNK, (k + 1) * CHUNK)
            one_iteration(prepared, sums, ekf.Iterate(*(torch.from_numpy(a[here]) for a in after)), before[here])
        return after[0], after[1], after[3], after[4]

    def _prepared(self, positions: np.ndarray) -> tuple[Prepared, fast.Sums]:
        markers = self.markers(positions)
        prepared = Prepared(self.model, markers, self.model.weights(markers, self.case.noise))
        return prepared, fast.Sums.room(len(positions), self.model.size, len(self.s))

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
    return fast.seconds()


def as_fit(fit: Estimate) -> Fit:
    """As the peers report it."""
    parts = (fit.x, fit.covariance, fit.force, fit.location, fit.iterations, fit.status == 0, fit.chi2)
    return Fit(*(part.numpy() for part in parts))


def _steps(problem: Problem) -> int:
    """The number of steps asked for: a node at every marker and no step longer than L / steps."""
    return round(problem.length / float(np.diff(problem.nodes).max()))
