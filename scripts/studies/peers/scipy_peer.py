"""The estimator with scipy: `least_squares` sample by sample, on an RK4 march in numpy.

The march takes many states at once: all the differences of a Jacobian (2-point) are one call, which numpy's overhead makes about n
times faster than one after another.
"""

from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import erf, expit

from . import MAX_ITERATIONS, TIP_EXACT, Fit, Problem, make_fit

STEP = 1e-7  # of a difference: entries of x are of order one; between truncation and round-off
TOLERANCE = 1e-6  # of the cost: a little tighter than the filter's test
ROOT_PI = np.sqrt(np.pi)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b along the first axis: several times faster than numpy's own."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def exponential(r: np.ndarray) -> np.ndarray:
    """The matrices (B, 3, 3) of rotation vectors (B, 3)."""
    angle = np.linalg.norm(r, axis=-1)[:, None, None]
    x, y, z = r.T
    hat = np.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], -1).reshape(-1, 3, 3)
    # sinc(t / pi) = sin(t) / t, and 1 - cos(t) = 2 sin(t / 2)^2
    return np.eye(3) + np.sinc(angle / np.pi) * hat + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * (hat @ hat)


class ScipyPeer:
    """The estimator of one problem."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.h_steps, self.arc = np.diff(problem.nodes), problem.arc

    def loads(self, gamma: np.ndarray) -> np.ndarray:
        """[G_x, G_y, G2_x, G2_y] where the steps need them, (2 S + 1, 4, B)."""
        p = self.problem
        each = gamma.reshape(len(gamma), p.loads, 4).transpose(1, 2, 0)
        mu, root = p.length * expit(each[:, 2]), np.exp(0.5 * each[:, 3]) / p.length
        x, x0 = root * (self.arc[:, None, None] - mu), -root * mu
        e, e0 = erf(x), erf(x0)
        share = p.force_scale * each[:, :2] / (erf(root * (p.length - mu)) - e0)[:, None]
        twice = x * e + np.exp(-x * x) / ROOT_PI - x0 * e0 - np.exp(-x0 * x0) / ROOT_PI - (x - x0) * e0
        return np.concatenate([np.einsum("skb,kab->sab", e - e0, share), np.einsum("skb,kab->sab", twice / root, share)], 1)

    def rates(self, y: np.ndarray, g: np.ndarray) -> np.ndarray:
        """dy/ds for y (13, B)."""
        k, q, N, M = self.problem.compliance[:, None], y[3:7], y[7:10].copy(), y[10:].copy()
        N[:2] -= g[:2]
        M[0] -= g[3]
        M[1] += g[2]
        v, u = k[:3] * N, k[3:] * M
        v[2] += 1.0
        t = 2.0 * cross(q[:3], v)
        moment = cross(M, u) + cross(N, v)
        moment[0] += g[1]
        moment[1] -= g[0]
        turned = 0.5 * np.concatenate([q[3] * u + cross(q[:3], u), -(q[:3] * u).sum(0, keepdims=True)])
        return np.concatenate([(q * q).sum(0) * v + q[3] * t + cross(q[:3], t), turned, cross(N, u), moment])

    def h(self, x: np.ndarray) -> np.ndarray:
        """h(x), (B, z)."""
        p, B = self.problem, len(x)
        g = self.loads(x[:, : 4 * p.loads])
        y = np.zeros((13, B))
        y[6], y[7:] = 1.0, (p.alpha_scale * x[:, -6:]).T
        states = np.empty((len(p.nodes), 3, B))
        for i, h in enumerate(self.h_steps):
            start, middle, end = g[2 * i], g[2 * i + 1], g[2 * i + 2]
            k1 = self.rates(y, start)
            k2 = self.rates(y + 0.5 * h * k1, middle)
            k3 = self.rates(y + 0.5 * h * k2, middle)
            k4 = self.rates(y + h * k3, end)
            y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
            y[3:7] /= np.sqrt((y[3:7] ** 2).sum(0))
            states[i + 1] = y[:3]
        tip = y[7:] + np.stack([-g[-1, 0], -g[-1, 1], 0 * g[-1, 0], -g[-1, 3], g[-1, 2], 0 * g[-1, 0]])
        points = states[p.keep].transpose(2, 0, 1)
        if p.registration:
            zeta = x[:, 4 * p.loads : 4 * p.loads + 6]
            points = points @ exponential(p.turn * zeta[:, 3:]).transpose(0, 2, 1) + p.shift * zeta[:, None, :3]
        return np.concatenate([points.reshape(B, -1), tip.T], -1)

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `peers.Peer`; H by forward differences."""
        B, n = x.shape
        moved = np.concatenate([x[:, None], x[:, None] + STEP * np.eye(n)], 1)
        h = self.h(moved.reshape(-1, n)).reshape(B, n + 1, -1)
        return h[:, 0], ((h[:, 1:] - h[:, :1]) / STEP).transpose(0, 2, 1)

    def solve(self, x: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, bool, float]:
        """One sample from x (n,): x, covariance, Jacobians evaluated, converged, cost."""
        p = self.problem
        w = p.weights(positions[None])[0]
        z, root, prior = np.append(np.nan_to_num(positions.ravel()), np.zeros(6)), np.sqrt(w), np.sqrt(p.prior_precision)

        def residual(x: np.ndarray) -> np.ndarray:
            return np.concatenate([root * (self.h(x[None])[0] - z), prior * (x - p.prior_mean)])

        def jacobian(x: np.ndarray) -> np.ndarray:
            return np.concatenate([root[:, None] * self.linearize(x[None])[1][0], np.diag(prior)])

        stop: dict[str, Any] = {"jac": jacobian, "ftol": TOLERANCE, "xtol": 1e-10, "gtol": None, "max_nfev": 5 * MAX_ITERATIONS}
        done = least_squares(residual, x, method="trf", **stop)
        H = self.linearize(done.x[None])[1][0]
        exact = np.append(w[:-6], TIP_EXACT * w[-6:])
        covariance = np.linalg.inv(H.T @ (exact[:, None] * H) + np.diag(p.prior_precision))
        return done.x, covariance, done.njev, done.success, 2.0 * done.cost

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> Fit:
        """See `peers.Peer`; the iterations are evaluations of the Jacobian."""
        fits = [self.solve(one, seen) for one, seen in zip(x, positions, strict=True)]
        return make_fit(self.problem, *(np.array(values) for values in zip(*fits, strict=True)))
