"""h(x) and dh/dx in numba, LANES samples at a time: loads, march, registration, and the normal equations they add up to."""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from .numba_loads import loads_along
from .numba_march import HOT, LANES, PARTS, STAGE, STATE, step_load_tangent, step_states, step_tangent
from .numba_update import GROUP, add_rows


class Constants(NamedTuple):
    """A `Problem` as numba wants it."""

    loads: int
    registration: int
    length: float
    compliance: np.ndarray
    h: np.ndarray
    arc: np.ndarray
    keep: np.ndarray
    force_scale: float
    alpha_scale: np.ndarray
    shift: float
    turn: float
    mean: np.ndarray
    precision: np.ndarray
    weight: float
    tip_weight: np.ndarray


class Work(NamedTuple):
    """What one block of lanes needs; the last dimension, or stride, is the lane. T tangents, n unknowns, P markers."""

    x: np.ndarray
    z: np.ndarray
    e: np.ndarray
    slope: np.ndarray
    ends: np.ndarray
    parts: np.ndarray
    total: np.ndarray
    amplitude: np.ndarray
    y: np.ndarray
    dy: np.ndarray
    st: np.ndarray
    p: np.ndarray
    dp: np.ndarray
    tip: np.ndarray
    dtip: np.ndarray
    turned: np.ndarray
    rows: np.ndarray
    r: np.ndarray
    A: np.ndarray
    g: np.ndarray
    tip_A: np.ndarray
    tip_g: np.ndarray
    sums: np.ndarray


@njit(**HOT)
def make_work(c):
    """Buffers for one thread."""
    n, nodes, P = len(c.mean), len(c.arc), len(c.keep)
    T = n - 6 * c.registration
    W = LANES
    return Work(
        np.zeros((n, W)),
        np.zeros((3 * P, W)),
        np.zeros((nodes, W)),
        np.zeros((nodes, W)),
        np.zeros((10, W)),
        np.zeros(c.loads * nodes * PARTS * W),
        np.zeros(nodes * 4 * W),
        np.zeros(4 * c.loads * 2 * W),
        np.zeros(STATE * W),
        np.zeros(T * STATE * W),
        np.zeros((4 * STAGE + 1) * W),
        np.zeros((3 * P, W)),
        np.zeros((3 * P, T, W)),
        np.zeros((6, W)),
        np.zeros((6, T, W)),
        np.zeros((18, W)),
        np.zeros((n, GROUP, W)),
        np.zeros((GROUP, W)),
        np.zeros((n, n, W)),
        np.zeros((n, W)),
        np.zeros((n, n, W)),
        np.zeros((n, W)),
        np.zeros((3, W)),
    )


@njit(**HOT)
def _start(lanes, c, w):
    """The state and its tangents at the base."""
    n, gamma, W = len(c.mean), 4 * c.loads, LANES
    w.y[:] = 0.0
    w.dy[:] = 0.0
    for lane in range(lanes):
        w.y[6 * W + lane] = 1.0
        for j in range(6):
            w.y[(7 + j) * W + lane] = c.alpha_scale[j] * w.x[n - 6 + j, lane]
            w.dy[((gamma + j) * STATE + 7 + j) * W + lane] = c.alpha_scale[j]


@njit(**HOT)
def march(lanes, c, w):
    """Positions at the markers, the tip's residual, and the tangents of both."""
    W, gamma, nodes = LANES, 4 * c.loads, len(c.arc)
    loads_along(
        lanes,
        c,
        w.x,
        w.e,
        w.slope,
        w.ends,
        w.parts.reshape(c.loads, nodes, PARTS, W),
        w.total.reshape(nodes, 4, W),
        w.amplitude.reshape(gamma, 2, W),
    )
    _start(lanes, c, w)
    at, T, s = 0, gamma + 6, c.compliance
    k = (s[0], s[1], s[2], s[3], s[4], s[5])
    for i in range(len(c.h)):
        h = c.h[i]
        step_states(lanes, k, h, w.y, w.st, w.total[8 * i * W : (8 * i + 12) * W])
        for t in range(T):
            dy = w.dy[t * STATE * W : (t + 1) * STATE * W]
            if t < gamma:
                first = ((t // 4) * nodes + 2 * i) * PARTS
                parts, amplitude = w.parts[first * W : (first + 3 * PARTS) * W], w.amplitude[2 * t * W : 2 * (t + 1) * W]
                step_load_tangent(lanes, k, h, w.y, w.st, dy, parts, max(t % 4 - 1, 0), amplitude)
            else:
                step_tangent(lanes, k, h, w.y, w.st, dy)
        while at < len(c.keep) and c.keep[at] == i + 1:
            for a in range(3):
                for lane in range(lanes):
                    w.p[3 * at + a, lane] = w.y[a * W + lane]
                for t in range(T):
                    for lane in range(lanes):
                        w.dp[3 * at + a, t, lane] = w.dy[(t * STATE + a) * W + lane]
            at += 1
    _tip(lanes, c, w)


@njit(**HOT)
def _tip(lanes, c, w):
    """c = [N~ - G, M~ + e3 x G2] at the tip, and its tangents."""
    W, gamma, nodes = LANES, 4 * c.loads, len(c.arc)
    end = w.total[4 * (nodes - 1) * W :]
    for j in range(6):
        for lane in range(lanes):
            w.tip[j, lane] = w.y[(7 + j) * W + lane]
        for t in range(gamma + 6):
            for lane in range(lanes):
                w.dtip[j, t, lane] = w.dy[(t * STATE + 7 + j) * W + lane]
    for lane in range(lanes):
        w.tip[0, lane] -= end[lane]
        w.tip[1, lane] -= end[lane + W]
        w.tip[3, lane] -= end[lane + 3 * W]
        w.tip[4, lane] += end[lane + 2 * W]
    for t in range(gamma):
        first = ((t // 4) * nodes + nodes - 1) * PARTS + max(t % 4 - 1, 0)
        g, g2 = w.parts[first * W : (first + 1) * W], w.parts[(first + 3) * W : (first + 4) * W]
        a = w.amplitude[2 * t * W : 2 * (t + 1) * W]
        for lane in range(lanes):
            w.dtip[0, t, lane] -= a[lane] * g[lane]
            w.dtip[1, t, lane] -= a[lane + W] * g[lane]
            w.dtip[3, t, lane] -= a[lane + W] * g2[lane]
            w.dtip[4, t, lane] += a[lane] * g2[lane]


@njit(**HOT)
def turn(lanes, c, w):
    """R of the registration's rotation vector, and (exp's left Jacobian) how it turns with it, into `turned`, row by row."""
    first = 4 * c.loads + 3
    for lane in range(lanes):
        x, y, z = c.turn * w.x[first, lane], c.turn * w.x[first + 1, lane], c.turn * w.x[first + 2, lane]
        square = x * x + y * y + z * z
        angle = math.sqrt(square)
        s, a, b = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
        if angle > 1e-3:
            s, a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (angle * square)
        for first_row, one, two in ((0, s, a), (9, a, b)):
            w.turned[first_row, lane] = 1.0 - two * (y * y + z * z)
            w.turned[first_row + 1, lane] = two * x * y - one * z
            w.turned[first_row + 2, lane] = two * x * z + one * y
            w.turned[first_row + 3, lane] = two * x * y + one * z
            w.turned[first_row + 4, lane] = 1.0 - two * (x * x + z * z)
            w.turned[first_row + 5, lane] = two * y * z - one * x
            w.turned[first_row + 6, lane] = two * x * z - one * y
            w.turned[first_row + 7, lane] = two * y * z + one * x
            w.turned[first_row + 8, lane] = 1.0 - two * (x * x + y * y)


@njit(**HOT)
def marker_rows(lanes, c, w, j, rows, h):
    """Marker j as it is measured, h[3, lane], and its rows[n, 3, lane] of H."""
    gamma = 4 * c.loads
    p, dp, R = w.p[3 * j : 3 * j + 3], w.dp[3 * j : 3 * j + 3], w.turned
    if c.registration == 0:
        for a in range(3):
            for lane in range(lanes):
                h[a, lane] = p[a, lane]
        for t in range(gamma + 6):
            for a in range(3):
                for lane in range(lanes):
                    rows[t, a, lane] = dp[a, t, lane]
        return
    for lane in range(lanes):
        x, y, z = p[0, lane], p[1, lane], p[2, lane]
        for a in range(3):
            h[a, lane] = R[3 * a, lane] * x + R[3 * a + 1, lane] * y + R[3 * a + 2, lane] * z
    for i in range(3):
        for lane in range(lanes):
            kx, ky, kz = c.turn * R[9 + i, lane], c.turn * R[12 + i, lane], c.turn * R[15 + i, lane]
            rows[gamma + 3 + i, 0, lane] = ky * h[2, lane] - kz * h[1, lane]
            rows[gamma + 3 + i, 1, lane] = kz * h[0, lane] - kx * h[2, lane]
            rows[gamma + 3 + i, 2, lane] = kx * h[1, lane] - ky * h[0, lane]
    for a in range(3):
        for lane in range(lanes):
            h[a, lane] += c.shift * w.x[gamma + a, lane]
            rows[gamma, a, lane] = rows[gamma + 1, a, lane] = rows[gamma + 2, a, lane] = 0.0
            rows[gamma + a, a, lane] = c.shift
    for t in range(gamma + 6):
        column = t if t < gamma else t + 6
        for lane in range(lanes):
            x, y, z = dp[0, t, lane], dp[1, t, lane], dp[2, t, lane]
            rows[column, 0, lane] = R[0, lane] * x + R[1, lane] * y + R[2, lane] * z
            rows[column, 1, lane] = R[3, lane] * x + R[4, lane] * y + R[5, lane] * z
            rows[column, 2, lane] = R[6, lane] * x + R[7, lane] * y + R[8, lane] * z


@njit(**HOT)
def tip_rows(lanes, c, w, rows):
    """The tip residual's rows[n, 6, lane] of H."""
    gamma = 4 * c.loads
    rows[:, :6] = 0.0
    for j in range(6):
        for t in range(gamma + 6):
            column = t if t < gamma else t + 6 * c.registration
            for lane in range(lanes):
                rows[column, j, lane] = w.dtip[j, t, lane]


@njit(**HOT)
def normal_equations(lanes, c, w):
    """Of the markers with weight 1 (A, g), of the tip with its own (tip_A, tip_g), and the sums r^T r, tip's r^T W r, markers."""
    markers = GROUP // 3
    w.A[:] = 0.0
    w.g[:] = 0.0
    w.tip_A[:] = 0.0
    w.tip_g[:] = 0.0
    w.sums[:] = 0.0
    for first in range(0, len(c.keep), markers):
        w.rows[:] = 0.0
        w.r[:] = 0.0
        for j in range(first, min(first + markers, len(c.keep))):
            at = 3 * (j - first)
            rows, r = w.rows[:, at : at + 3], w.r[at : at + 3]
            marker_rows(lanes, c, w, j, rows, r)
            for lane in range(lanes):
                seen = math.isfinite(w.z[3 * j, lane] + w.z[3 * j + 1, lane] + w.z[3 * j + 2, lane])
                w.sums[2, lane] += 1.0 if seen else 0.0
                for a in range(3):
                    r[a, lane] = w.z[3 * j + a, lane] - r[a, lane] if seen else 0.0
                    w.sums[0, lane] += r[a, lane] ** 2
                    if not seen:
                        for i in range(len(rows)):
                            rows[i, a, lane] = 0.0
        add_rows(w.rows, w.r, w.A, w.g)
    w.rows[:] = 0.0
    w.r[:] = 0.0
    tip_rows(lanes, c, w, w.rows)
    for j in range(6):
        size = math.sqrt(c.tip_weight[j])
        for lane in range(lanes):
            w.r[j, lane] = -size * w.tip[j, lane]
            w.sums[1, lane] += w.r[j, lane] ** 2
        for i in range(len(c.mean)):
            for lane in range(lanes):
                w.rows[i, j, lane] *= size
    add_rows(w.rows, w.r, w.tip_A, w.tip_g)
