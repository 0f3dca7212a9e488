"""One pass of the filter in numba, over a block of lanes."""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from . import DECREMENT, DECREMENT_SHARE, SETTLED, STEP_LIMIT, TIP_EXACT
from .numba_march import HOT, LANES
from .numba_model import march, normal_equations, turn
from .numba_update import factor, forward, inverse, times


class Filter(NamedTuple):
    """The filter's state and scratch of a block: lower triangles [n, n, lane], vectors [n, lane], numbers [lane]."""

    Sigma: np.ndarray
    cap: np.ndarray
    before: np.ndarray
    information: np.ndarray
    g: np.ndarray
    L: np.ndarray
    d: np.ndarray
    scratch: np.ndarray
    y: np.ndarray
    cost: np.ndarray
    done: np.ndarray


@njit(**HOT)
def make_filter(n):
    """Buffers for one thread."""
    return Filter(
        np.zeros((n, n, LANES)),
        np.zeros(LANES),
        np.zeros((n, LANES)),
        np.zeros((n, n, LANES)),
        np.zeros((n, LANES)),
        np.zeros((n, n, LANES)),
        np.zeros((n, LANES)),
        np.zeros((n, n, LANES)),
        np.zeros((n, LANES)),
        np.zeros(LANES),
        np.zeros(LANES, dtype=np.bool_),
    )


@njit(**HOT)
def weigh(lanes, c, w, f, weight, tip_factor):
    """Information of markers (weight per lane), tip and prior into f.information, and its gradient into f.g."""
    for i in range(len(c.mean)):
        for lane in range(lanes):
            f.g[i, lane] = weight[lane] * w.g[i, lane] + tip_factor * w.tip_g[i, lane] + c.precision[i] * (c.mean[i] - w.x[i, lane])
        for j in range(i + 1):
            for lane in range(lanes):
                f.information[i, j, lane] = weight[lane] * w.A[i, j, lane] + tip_factor * w.tip_A[i, j, lane]
        for lane in range(lanes):
            f.information[i, i, lane] += c.precision[i]


@njit(**HOT)
def advance(lanes, c, w, f, sums):
    """One pass of the filter over a block: w.x, f.Sigma, f.cap onward, f.cost and f.done said of where it was.

    sums: scratch (2, LANES).
    """
    n = len(c.mean)
    if c.registration:
        turn(lanes, c, w)
    march(lanes, c, w)
    normal_equations(lanes, c, w)
    weight, inflated = sums[0], sums[1]
    for lane in range(lanes):
        f.cost[lane] = c.weight * w.sums[0, lane] + w.sums[1, lane]
        for i in range(n):
            f.cost[lane] += c.precision[i] * (c.mean[i] - w.x[i, lane]) ** 2
        weight[lane] = c.weight
    weigh(lanes, c, w, f, weight, 1.0)
    factor(f.information, f.L, f.d)
    forward(f.L, f.d, f.g, f.y)
    for lane in range(lanes):
        decrement = 0.0
        for i in range(n):
            decrement += f.y[i, lane] ** 2
        f.done[lane] = decrement < max(DECREMENT, DECREMENT_SHARE * f.cost[lane])
        each = decrement / max(3.0 * w.sums[2, lane], 1.0)
        inflated[lane] = min(each if math.isfinite(each) else 0.0, f.cap[lane])
        weight[lane] = c.weight / (1.0 + inflated[lane])
    weigh(lanes, c, w, f, weight, 1.0)
    update(lanes, f)
    onward(lanes, w, f, inflated)


@njit(**HOT)
def update(lanes, f):
    """Lambda = (Sigma + Q)^-1 + information with Q = 1: the step into f.y and Lambda^-1 into f.Sigma."""
    n = len(f.g)
    for i in range(n):
        for lane in range(lanes):
            f.Sigma[i, i, lane] += 1.0
    factor(f.Sigma, f.L, f.d)
    inverse(f.L, f.d, f.scratch, f.Sigma)
    for i in range(n):
        for j in range(i + 1):
            for lane in range(lanes):
                f.information[i, j, lane] += f.Sigma[i, j, lane]
    factor(f.information, f.L, f.d)
    inverse(f.L, f.d, f.scratch, f.Sigma)
    times(f.Sigma, f.g, f.y)


@njit(**HOT)
def onward(lanes, w, f, inflated):
    """Take the step where the sample has not converged; half way back where the model overflowed."""
    n = len(f.g)
    for lane in range(lanes):
        gain, largest, fresh, finite = 0.0, 1e-300, True, math.isfinite(f.cost[lane])
        for i in range(n):
            gain += f.g[i, lane] * f.y[i, lane]
            largest = max(largest, abs(f.y[i, lane]))
            for j in range(i + 1):
                fresh = fresh and math.isfinite(f.Sigma[i, j, lane])
        f.done[lane] = f.done[lane] and finite
        if gain < SETTLED:
            f.cap[lane] = 0.1 * inflated[lane]
        share = min(1.0, STEP_LIMIT / largest)
        for i in range(n):
            here = w.x[i, lane]
            if not finite:
                w.x[i, lane] = 0.5 * (here + f.before[i, lane])
                continue
            f.before[i, lane] = here
            if fresh:
                w.x[i, lane] = here + share * f.y[i, lane]
        if not (fresh and finite):
            for i in range(n):
                for j in range(i + 1):
                    f.Sigma[i, j, lane] = 1.0 if i == j else 0.0


@njit(**HOT)
def posterior(lane, c, w, f, one, out):
    """(H^T W H + P)^-1 of one lane with the tip's exact weight, into out (n, n). one: the filter's scratch."""
    n = len(c.mean)
    for i in range(n):
        for j in range(i + 1):
            one.information[i, j, 0] = c.weight * w.A[i, j, lane] + TIP_EXACT * w.tip_A[i, j, lane]
        one.information[i, i, 0] += c.precision[i]
    factor(one.information, one.L, one.d)
    inverse(one.L, one.d, one.scratch, one.Sigma)
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = out[j, i] = one.Sigma[i, j, 0]
