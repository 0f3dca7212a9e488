"""The same estimator written by hand in other frameworks, to measure torchrod against.

A peer knows nothing of torchrod: a `Problem` holds plain numbers, and the equations are written out once more (docs/model.md).
All serve a passive rod of round section without weight, Gaussian loads in scaled coordinates and markers on the centre line:

    x = [(F_x, F_y, eta, log(c L^2)) per load, zeta, alpha]   ->   h(x) = [p_1 .. p_P, c]

Importing this package imports none of the frameworks; `PEERS` names the module and the class of each.
"""

import importlib
import importlib.util
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

PEERS = {
    "numba": ("studies.peers.numba_peer", "NumbaPeer", "numba"),
    "jax": ("studies.peers.jax_peer", "JaxPeer", "jax"),
    "jax, tuned": ("studies.peers.jax_peer", "TunedJaxPeer", "jax"),
    "scipy": ("studies.peers.scipy_peer", "ScipyPeer", "scipy"),
}
DECREMENT, DECREMENT_SHARE = 1e-3, 1e-6  # converged: a step promises to lower the cost by less than this, or this share of it
SETTLED = 1.0  # the problem with adapted weights is at its minimum when a step promises less than this
STEP_LIMIT = 0.6
TIP_EXACT = 100.0  # the covariance takes the tip residual's weight so many times larger
MAX_ITERATIONS = 100


@dataclass(frozen=True)
class Problem:
    """A rod, how it is discretized, what is unknown and what is measured. SI units.

    compliance (6,): 1 / K_se and 1 / K_bt along the axes. nodes (S + 1,): m. keep (P,): the node of each marker. force_scale,
    moment_scale, shift (m), turn (rad): what one unit of a force, of a moment and of zeta means. prior_mean, prior_precision (n,);
    noise: m; tip_precision (6,): 1 / variance of the tip residual.
    """

    loads: int
    registration: bool
    length: float
    compliance: np.ndarray
    nodes: np.ndarray
    keep: np.ndarray
    force_scale: float
    moment_scale: float
    shift: float
    turn: float
    prior_mean: np.ndarray
    prior_precision: np.ndarray
    noise: float
    tip_precision: np.ndarray

    @property
    def size(self) -> int:
        """The length of x."""
        return 4 * self.loads + 6 * self.registration + 6

    @property
    def marched(self) -> list[int]:
        """Which entries of x the march depends on: all but the registration."""
        return [*range(4 * self.loads), *range(self.size - 6, self.size)]

    @property
    def arc(self) -> np.ndarray:
        """Where the steps evaluate the loads, (2 S + 1,) m: nodes and midpoints."""
        middle = 0.5 * (self.nodes[:-1] + self.nodes[1:])
        return np.append(np.stack([self.nodes[:-1], middle], -1).ravel(), self.nodes[-1])

    @property
    def alpha_scale(self) -> np.ndarray:
        """(6,): N and N m."""
        return np.repeat([self.force_scale, self.moment_scale], 3)

    def weights(self, positions: np.ndarray) -> np.ndarray:
        """The diagonal of W, (B, 3 P + 6); zero where a marker is missing."""
        seen = np.repeat(np.isfinite(positions).all(-1), 3, -1) / self.noise**2
        return np.concatenate([seen, np.broadcast_to(self.tip_precision, (len(seen), 6))], -1)

    def save(self, path: Path, **more: np.ndarray) -> None:
        """As NPZ, with more arrays beside it."""
        arrays: dict[str, Any] = asdict(self) | more
        np.savez(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> tuple["Problem", dict[str, np.ndarray]]:
        """What was saved, and the arrays beside it."""
        with np.load(path) as file:
            arrays = dict(file)
        own = {name: arrays.pop(name) for name in cls.__dataclass_fields__}
        return cls(**{name: value if value.ndim else value.item() for name, value in own.items()}), arrays


@dataclass(frozen=True)
class Fit:
    """B finished estimates: x (B, n), covariance (B, n, n), force (B, K, 2) N, location (B, K) m, iterations, converged, cost."""

    x: np.ndarray
    covariance: np.ndarray
    force: np.ndarray
    location: np.ndarray
    iterations: np.ndarray
    converged: np.ndarray
    cost: np.ndarray


def make_fit(problem: Problem, x: np.ndarray, covariance: np.ndarray, *rest: np.ndarray) -> Fit:
    """With forces and locations read from x."""
    gamma = x[:, : 4 * problem.loads].reshape(len(x), problem.loads, 4)
    return Fit(x, covariance, problem.force_scale * gamma[..., :2], problem.length / (1 + np.exp(-gamma[..., 2])), *rest)


class Peer(Protocol):
    """What every peer supplies, for one problem. Arrays in and out are numpy's, float64, batch first."""

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """h (B, z) and H = dh/dx (B, z, n)."""
        ...

    def iterate(
        self, x: np.ndarray, Sigma: np.ndarray, cap: np.ndarray, positions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """One pass of the filter, h and H included: the next x, Sigma, cap (of the adaptive noise), and who has converged.

        In place or not, as comes naturally: what it is handed may be overwritten.
        """
        ...

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> Fit:
        """From a start to convergence."""
        ...


def installed(name: str) -> bool:
    """Whether a peer's framework is there."""
    return importlib.util.find_spec(PEERS[name][2]) is not None


def peer(name: str, problem: Problem) -> Any:
    """The peer of a name; its framework is imported here."""
    module, kind, _ = PEERS[name]
    return getattr(importlib.import_module(module), kind)(problem)
