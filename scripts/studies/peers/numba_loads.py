"""The closed-form integrals of Gaussian loads and their derivatives, in numba; layout as in `numba_march`.

With r = sqrt(c), X(s) = r (s - mu), E = erf(X), T = X erf(X) + exp(-X^2) / sqrt(pi), and D = E(L) - E(0) for the part on the rod,

    g(s) = (E - E(0)) / D,    g2(s) = (T - T(0) - (X - X(0)) E(0)) / (r D),    G = F g,    G2 = F g2
"""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import math

from numba import njit

from .numba_march import HOT

ROOT_PI = math.sqrt(math.pi)
FAR = 6.0  # beyond, erf is 1 and exp(-X^2) is 0 to double precision


@njit(**HOT)
def _erf_and_slope(x):
    """erf(x) and its derivative; most of a rod lies far from a narrow load, where both are constant."""
    if x > FAR:
        return 1.0, 0.0
    if x < -FAR:
        return -1.0, 0.0
    return math.erf(x), 2.0 / ROOT_PI * math.exp(-x * x)


@njit(**HOT)
def _values(lanes, c, x, load, e, slope):
    """erf and its slope at all arc lengths: the part that is not vectorized."""
    for lane in range(lanes):
        mu = c.length / (1.0 + math.exp(-x[4 * load + 2, lane]))
        root = math.exp(0.5 * x[4 * load + 3, lane]) / c.length
        for i in range(len(c.arc)):
            e[i, lane], slope[i, lane] = _erf_and_slope(root * (c.arc[i] - mu))


@njit(**HOT)
def _parts(lanes, c, x, load, e, slope, ends, parts):
    """g, g_eta, g_logc, g2, g2_eta, g2_logc at all arc lengths into parts[node, part, lane]; ends: what belongs to 0 and L."""
    last = len(c.arc) - 1
    for lane in range(lanes):
        t = 1.0 / (1.0 + math.exp(-x[4 * load + 2, lane]))
        root = math.exp(0.5 * x[4 * load + 3, lane]) / c.length
        mu, mu_eta = c.length * t, c.length * t * (1.0 - t)
        x0, x1 = -root * mu, root * (c.length - mu)
        e0, s0 = e[0, lane], slope[0, lane]
        d = 1.0 / (e[last, lane] - e0)
        ends[0, lane], ends[1, lane], ends[2, lane] = mu, root, -root * mu_eta
        ends[3, lane], ends[4, lane], ends[5, lane], ends[6, lane] = x0, e0, s0, d
        ends[7, lane] = x0 * e0 + s0 / 2.0
        ends[8, lane] = -(slope[last, lane] - s0) * root * mu_eta * d
        ends[9, lane] = 0.5 * (slope[last, lane] * x1 - s0 * x0) * d
    for i in range(len(c.arc)):
        s = c.arc[i]
        for lane in range(lanes):
            root, x_eta, x0, e0, s0, d = (ends[1, lane], ends[2, lane], ends[3, lane], ends[4, lane], ends[5, lane], ends[6, lane])
            d_eta, d_logc = ends[8, lane], ends[9, lane]
            z, once = root * (s - ends[0, lane]), e[i, lane] - e0
            share, away = 1.0 / root * d, z - x0
            g = once * d
            g2 = (z * e[i, lane] + 0.5 * slope[i, lane] - ends[7, lane] - away * e0) * share
            parts[i, 0, lane] = g
            parts[i, 1, lane] = (slope[i, lane] - s0) * x_eta * d - g * d_eta
            parts[i, 2, lane] = 0.5 * (slope[i, lane] * z - s0 * x0) * d - g * d_logc
            parts[i, 3, lane] = g2
            parts[i, 4, lane] = (once - away * s0) * x_eta * share - g2 * d_eta
            parts[i, 5, lane] = 0.5 * (once * z - away * s0 * x0) * share - g2 * (0.5 + d_logc)


@njit(**HOT)
def loads_along(lanes, c, x, e, slope, ends, parts, total, amplitude):
    """Of every load: parts[load, node, part, lane] and the amplitudes (N) of its four tangents; their sum total[node, :, lane]."""
    total[:] = 0.0
    for load in range(c.loads):
        _values(lanes, c, x, load, e, slope)
        _parts(lanes, c, x, load, e, slope, ends, parts[load])
        for lane in range(lanes):
            fx, fy = c.force_scale * x[4 * load, lane], c.force_scale * x[4 * load + 1, lane]
            for j in range(4):
                amplitude[4 * load + j, 0, lane], amplitude[4 * load + j, 1, lane] = fx, fy
            amplitude[4 * load, 0, lane], amplitude[4 * load, 1, lane] = c.force_scale, 0.0
            amplitude[4 * load + 1, 0, lane], amplitude[4 * load + 1, 1, lane] = 0.0, c.force_scale
        fx, fy = amplitude[4 * load + 2, 0], amplitude[4 * load + 2, 1]
        for i in range(len(c.arc)):
            for lane in range(lanes):
                g, g2 = parts[load, i, 0, lane], parts[load, i, 3, lane]
                total[i, 0, lane] += fx[lane] * g
                total[i, 1, lane] += fy[lane] * g
                total[i, 2, lane] += fx[lane] * g2
                total[i, 3, lane] += fy[lane] * g2
