"""torchrod itself, behind the peers' interface. Which of its paths runs is a matter of the environment (`paths`)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from peers import Fit, Problem

import torchrod
from torchrod import Estimate, Markers, Model, Settings, cold_start, ekf, estimate, fast, find_warm_start
from torchrod.estimator import CHUNK, linearize

from .cases import Case

SETTINGS = Settings()
Filtered = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def one_iteration(
    model: Model, markers: Markers, noise: float, x: torch.Tensor, Sigma: torch.Tensor, cap: torch.Tensor
) -> Filtered:
    """One pass of the filter as torchrod.estimator does it: the next x, Sigma, cap, and who has converged.

    This is what the tables call an iteration: h, H, the normal equations and the update.
    """
    w, markers_seen = model.weights(markers, noise), 3 * len(markers.s)
    at = linearize(model, x, markers, w)
    inflated = torch.minimum(ekf.inflation(w, markers_seen, at.decrement), cap)
    A, g = ekf.information(at.H, at.r, ekf.adapted_weights(w, markers_seen, inflated), x, *model.prior())
    step, Sigma = ekf.update(ekf.predict(Sigma, torch.ones_like(x[0])), A, g)
    cap = torch.where((g * step).sum(-1) < 1.0, 0.1 * inflated, cap)
    done = at.decrement < (1e-6 * at.cost).clamp(min=1e-3)
    x = torch.where(done.unsqueeze(-1), x, x + ekf.limited(step, SETTINGS.step_limit))
    return x, Sigma, cap, done


class TorchrodPeer:
    """torchrod on one case."""

    def __init__(self, problem: Problem):
        self.case = Case(problem.loads, problem.registration, len(problem.keep), _steps(problem), problem.noise)
        self.model, self.s = self.case.model(), self.case.markers_at()

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
        parts = []
        for first in range(0, len(x), CHUNK):
            here = slice(first, first + CHUNK)
            state = [torch.from_numpy(a[here]) for a in (x, Sigma, cap)]
            parts.append(one_iteration(self.model, self.markers(positions[here]), self.case.noise, *state))
        return tuple(torch.cat(part).numpy() for part in zip(*parts, strict=True))

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> Fit:
        """See `peers.Peer`; torchrod chooses its own cold start, which is x on this rod."""
        return as_fit(self.fitted("cold", positions))

    def fitted(self, start: str, positions: np.ndarray) -> Estimate:
        """Markers to loads with covariance, everything included, from a "cold" or a "warm" start."""
        rule = (find_warm_start(self.model) if start == "warm" else None) or cold_start
        return estimate(self.model, self.markers(positions), self.case.noise, start=rule)

    def frame_estimator(self) -> Callable[[np.ndarray], Any] | None:
        """One frame (P, 3) to its estimate, warm-started from what was before; None while torchrod has no such thing."""
        kind: Any = getattr(torchrod, "Estimator", None)
        if kind is None:
            return None
        estimator = kind(self.model, s=self.s, noise=self.case.noise)
        return lambda positions: estimator(torch.from_numpy(positions))


def kernel_seconds() -> float | None:
    """Seconds spent in the compiled kernel so far; None where torchrod does not count them."""
    count = getattr(fast, "seconds", None)
    return None if count is None else float(count())


def as_fit(fit: Estimate) -> Fit:
    """As the peers report it."""
    parts = (fit.x, fit.covariance, fit.force, fit.location, fit.iterations, fit.status == 0, fit.chi2)
    return Fit(*(part.numpy() for part in parts))


def _steps(problem: Problem) -> int:
    """The number of steps asked for: a node at every marker and no step longer than L / steps."""
    return round(problem.length / float(np.diff(problem.nodes).max()))
