"""The estimator in numba: RK4 with analytic tangents of the discrete steps, all cores, eight samples to a vector."""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import math
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from . import MAX_ITERATIONS, Fit, Problem, make_fit
from .numba_filter import advance, make_filter, posterior
from .numba_march import HOT, LANES
from .numba_model import Constants, make_work, march, marker_rows, tip_rows, turn

FREE: dict[str, Any] = HOT | {
    "nogil": True
}  # for threads of our own: numba's parallel loops compile for twice as long and are no faster
CORES = len(os.sched_getaffinity(0))
LARGEST_TASK = 512
FULL_BLOCK = 3  # from so many samples on, eight lanes cost no more than as many single ones


@njit(**HOT)
def enter(lane, sample, x, z, w, f, held):
    """Put a sample into a lane."""
    held[lane], f.cap[lane] = sample, np.inf
    for i in range(len(w.z)):
        w.z[i, lane] = z[sample, i]
    for i in range(len(w.x)):
        w.x[i, lane] = f.before[i, lane] = x[sample, i]
        for j in range(i):
            f.Sigma[i, j, lane] = 0.0
        f.Sigma[i, i, lane] = 1.0


@njit(**HOT)
def move(source, lane, w, f, held):
    """Put the sample of another lane into a lane."""
    held[lane], f.cap[lane] = held[source], f.cap[source]
    for i in range(len(w.z)):
        w.z[i, lane] = w.z[i, source]
    for i in range(len(w.x)):
        w.x[i, lane], f.before[i, lane] = w.x[i, source], f.before[i, source]
        for j in range(i + 1):
            f.Sigma[i, j, lane] = f.Sigma[i, j, source]


@njit(**FREE)
def linearize_task(c, first, stop, x, h, H):
    """h and H of the samples of one task."""
    P, n, w = len(c.keep), x.shape[1], make_work(c)
    for start in range(first, stop, LANES):
        lanes = min(LANES, stop - start)
        for lane in range(lanes):
            for i in range(n):
                w.x[i, lane] = x[start + lane, i]
        if c.registration:
            turn(lanes, c, w)
        march(lanes, c, w)
        for j in range(P + 2):
            row = 3 * j
            if j < P:
                marker_rows(lanes, c, w, j, w.rows, w.r)
            elif j == P:
                tip_rows(lanes, c, w, w.rows)
            for a in range(3):
                k = a + 3 if j == P + 1 else a
                for lane in range(lanes):
                    h[start + lane, row + a] = w.r[a, lane] if j < P else w.tip[k, lane]
                    for i in range(n):
                        H[start + lane, row + a, i] = w.rows[i, k, lane]


@njit(**FREE)
def iterate_task(c, first, stop, x, Sigma, cap, z, done):
    """One pass of the filter over the samples of one task."""
    n = x.shape[1]
    w, f, sums, held = make_work(c), make_filter(n), np.zeros((2, LANES)), np.zeros(LANES, dtype=np.int64)
    for start in range(first, stop, LANES):
        lanes = min(LANES, stop - start)
        for lane in range(lanes):
            b = start + lane
            enter(lane, b, x, z, w, f, held)
            f.cap[lane] = cap[b]
            for i in range(n):
                for j in range(i + 1):
                    f.Sigma[i, j, lane] = Sigma[b, i, j]
        advance(lanes, c, w, f, sums)
        for lane in range(lanes):
            b = start + lane
            cap[b], done[b] = f.cap[lane], f.done[lane]
            for i in range(n):
                x[b, i] = w.x[i, lane]
                for j in range(i + 1):
                    Sigma[b, i, j] = Sigma[b, j, i] = f.Sigma[i, j, lane]


@njit(**FREE)
def estimate_task(c, first, stop, x, z, covariance, iterations, converged, cost):
    """The samples of one task to convergence. A lane whose sample has converged takes the next one."""
    n = x.shape[1]
    w, f, one, sums = make_work(c), make_filter(n), make_filter(n), np.zeros((2, LANES))
    held, live, following = np.zeros(LANES, dtype=np.int64), 0, first
    while live < LANES and following < stop:
        enter(live, following, x, z, w, f, held)
        live, following = live + 1, following + 1
    while live > 0:
        advance(live if live < FULL_BLOCK else LANES, c, w, f, sums)
        for lane in range(live - 1, -1, -1):
            sample = held[lane]
            iterations[sample] += 1
            if not f.done[lane] and iterations[sample] < MAX_ITERATIONS:
                continue
            converged[sample], cost[sample] = f.done[lane], f.cost[lane]
            for i in range(n):
                x[sample, i] = w.x[i, lane]
            posterior(lane, c, w, f, one, covariance[sample])
            if following < stop:
                enter(lane, following, x, z, w, f, held)
                following += 1
            else:
                live -= 1
                move(live, lane, w, f, held)


def in_tasks(task: Any, constants: Constants, samples: int, *arrays: np.ndarray) -> None:
    """A task over all samples, shared out to the cores: whole blocks, and no task so large that a core could be left waiting."""
    size = min(LARGEST_TASK, LANES * math.ceil(samples / CORES / LANES))
    parts = [(first, min(first + size, samples)) for first in range(0, samples, size)]
    if len(parts) == 1:
        task(constants, *parts[0], *arrays)
        return
    for done in [pool().submit(task, constants, *part, *arrays) for part in parts]:
        done.result()


@cache
def pool() -> ThreadPoolExecutor:
    """A thread for every core: the tasks do not hold the interpreter's lock."""
    return ThreadPoolExecutor(CORES)


class NumbaPeer:
    """The estimator of one problem, compiled by numba on first use and cached on disk."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.constants = Constants(
            problem.loads,
            int(problem.registration),
            problem.length,
            problem.compliance,
            np.diff(problem.nodes),
            problem.arc,
            problem.keep.astype(np.int64),
            problem.force_scale,
            problem.alpha_scale,
            problem.shift,
            problem.turn,
            problem.prior_mean,
            problem.prior_precision,
            problem.noise**-2,
            problem.tip_precision,
        )

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        z = 3 * len(self.problem.keep) + 6
        h, H = np.empty((len(x), z)), np.empty((len(x), z, x.shape[1]))
        in_tasks(linearize_task, self.constants, len(x), x, h, H)
        return h, H

    def iterate(
        self, x: np.ndarray, Sigma: np.ndarray, cap: np.ndarray, positions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        done = np.zeros(len(x), dtype=np.bool_)
        in_tasks(iterate_task, self.constants, len(x), x, Sigma, cap, positions.reshape(len(x), -1), done)
        return x, Sigma, cap, done

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> Fit:
        """See `peers.Peer`."""
        B, n = x.shape
        x, covariance, iterations = x.copy(), np.empty((B, n, n)), np.zeros(B, dtype=np.int64)
        converged, cost = np.zeros(B, dtype=np.bool_), np.empty(B)
        in_tasks(estimate_task, self.constants, B, x, positions.reshape(B, -1), covariance, iterations, converged, cost)
        return make_fit(self.problem, x, covariance, iterations, converged, cost)
