"""The estimator in JAX: jit, vmap over samples, jacfwd, scan over the steps; float64. As one writes it, and tuned.

Tuned, only loads and base wrench are differentiated through the march (a registration moves finished points), a batch goes through
in chunks whose tangents stay in the cache, and every core has a thread that takes them in turn.
"""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import erf

from . import DECREMENT, DECREMENT_SHARE, MAX_ITERATIONS, SETTLED, STEP_LIMIT, TIP_EXACT, Fit, Problem, make_fit

jax.config.update("jax_enable_x64", True)

# Samples to a call: a compilation for each. The tangents of the largest tuned one still fit the cache.
SIZES, TUNED_SIZES = (1, 16, 256, 1024, 4096), (1, 4, 16, 64)
ROOT_PI = np.sqrt(np.pi)
Array = Any


def rotate(q: Array, a: Array) -> Array:
    """q a q*."""
    t = 2.0 * jnp.cross(q[:3], a)
    return (q @ q) * a + q[3] * t + jnp.cross(q[:3], t)


def exponential(r: Array) -> Array:
    """The matrix of a rotation vector; the series near zero keeps derivatives exact."""
    square = r @ r
    small = square < 1e-6
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    s = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    a = jnp.where(small, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / safe)
    hat = jnp.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    return jnp.eye(3) + s * hat + a * (hat @ hat)


class Model:
    """h(x) of one sample, and its derivative."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.arc, self.h, self.keep = jnp.asarray(problem.arc), jnp.asarray(np.diff(problem.nodes)), np.asarray(problem.keep)
        self.compliance = jnp.asarray(problem.compliance)
        self.alpha_scale, self.marched = jnp.asarray(problem.alpha_scale), np.asarray(problem.marched)

    def loads(self, gamma: Array) -> Array:
        """[G_x, G_y, G2_x, G2_y] where the steps need them, (2 S + 1, 4)."""
        p, each = self.problem, gamma.reshape(-1, 4)
        mu, root = p.length * jax.nn.sigmoid(each[:, 2]), jnp.exp(0.5 * each[:, 3]) / p.length

        def twice(x: Array) -> Array:
            return x * erf(x) + jnp.exp(-x * x) / ROOT_PI

        x, x0 = root * (self.arc[:, None] - mu), -root * mu
        share = p.force_scale * each[:, :2] / (erf(root * (p.length - mu)) - erf(x0))[:, None]
        once = erf(x) - erf(x0)
        again = (twice(x) - twice(x0) - (x - x0) * erf(x0)) / root
        return jnp.concatenate([once @ share, again @ share], -1)

    def rates(self, y: Array, g: Array) -> Array:
        """dy/ds."""
        q, N, M = y[3:7], y[7:10] - jnp.array([g[0], g[1], 0.0]), y[10:] + jnp.array([-g[3], g[2], 0.0])
        v = self.compliance[:3] * N + jnp.array([0.0, 0.0, 1.0])
        u = self.compliance[3:] * M
        turned = 0.5 * jnp.append(q[3] * u + jnp.cross(q[:3], u), -(q[:3] @ u))
        moment = jnp.cross(M, u) + jnp.cross(N, v) + jnp.array([g[1], -g[0], 0.0])
        return jnp.concatenate([rotate(q, v), turned, jnp.cross(N, u), moment])

    def march(self, marched: Array) -> tuple[Array, Array]:
        """Markers (P, 3) in the rod's own frame, and the tip's residual (6,), from [gamma, alpha]."""
        g = self.loads(marched[:-6])
        base = jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

        def step(y: Array, at: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
            h, start, middle, end = at
            k1 = self.rates(y, start)
            k2 = self.rates(y + 0.5 * h * k1, middle)
            k3 = self.rates(y + 0.5 * h * k2, middle)
            k4 = self.rates(y + h * k3, end)
            y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
            q = y[3:7]
            y = jnp.concatenate([y[:3], q / jnp.sqrt(q @ q), y[7:]])
            return y, y[:3]

        y = jnp.concatenate([base, self.alpha_scale * marched[-6:]])
        y, p = lax.scan(step, y, (self.h, g[:-1:2], g[1::2], g[2::2]))
        tip = y[7:] + jnp.array([-g[-1, 0], -g[-1, 1], 0.0, -g[-1, 3], g[-1, 2], 0.0])
        return p[self.keep - 1], tip

    def placed(self, p: Array, zeta: Array) -> Array:
        """Points of the rod's own frame, moved by a registration."""
        return p @ exponential(self.problem.turn * zeta[3:]).T + self.problem.shift * zeta[:3]

    def linearized(self, x: Array) -> tuple[Array, Array]:
        """h (z,) and H (z, n)."""
        first = 4 * self.problem.loads

        def both(x: Array) -> tuple[Array, Array]:
            p, tip = self.march(x[self.marched])
            p = self.placed(p, x[first : first + 6]) if self.problem.registration else p
            h = jnp.append(p.ravel(), tip)
            return h, h

        H, h = jax.jacfwd(both, has_aux=True)(x)
        return h, H


class TunedModel(Model):
    """The same with the tangents marched only where they need it."""

    def linearized(self, x: Array) -> tuple[Array, Array]:
        """h (z,) and H (z, n)."""
        problem, first = self.problem, 4 * self.problem.loads

        def both(marched: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
            out = self.march(marched)
            return out, out

        (dp, dtip), (p, tip) = jax.jacfwd(both, has_aux=True)(x[self.marched])
        columns = jnp.zeros((p.size, problem.size))
        if problem.registration:
            zeta = x[first : first + 6]
            dp = jnp.einsum("ab,pbt->pat", exponential(problem.turn * zeta[3:]), dp)
            columns = columns.at[:, first : first + 6].set(jax.jacfwd(self.placed, 1)(p, zeta).reshape(-1, 6))
            p = self.placed(p, zeta)
        columns = columns.at[:, self.marched].set(dp.reshape(p.size, -1))
        return jnp.append(p.ravel(), tip), jnp.concatenate([columns, jnp.zeros((6, problem.size)).at[:, self.marched].set(dtip)])


def solved(A: Array, b: Array) -> Array:
    """L^-1 D b for A = D^-1 L L^T D^-1, with D such that D A D has a unit diagonal; NaN where A is not positive definite.

    Elimination column by column, in place of LAPACK's: its batched calls block the threads that they run on, and two of them at
    once wait for each other for ever.
    """
    d = lax.rsqrt(jnp.diagonal(A))
    below = jnp.arange(len(A))

    def eliminate(j: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        A, b = state
        pivot = lax.rsqrt(A[j, j])
        column = jnp.where(below > j, A[:, j] * pivot, 0.0)
        row = b[j] * pivot
        return A - jnp.outer(column, column), jnp.where((below == j)[:, None], row, b - jnp.outer(column, row))

    return lax.fori_loop(0, len(A), eliminate, (A * d * d[:, None], d[:, None] * b))[1]


def inverse(A: Array) -> Array:
    """A^-1 of a symmetric positive definite matrix; NaN where it is not one."""
    W = solved(A, jnp.eye(len(A)))
    return W.T @ W


class JaxPeer:
    """The estimator of one problem, as one writes it; every shape is compiled on first use."""

    kind: type[Model] = Model
    sizes, threads = SIZES, 1

    def __init__(self, problem: Problem):
        self.problem, self.model = problem, self.kind(problem)
        self.mean, self.precision = jnp.asarray(problem.prior_mean), jnp.asarray(problem.prior_precision)
        self._linearize = jax.jit(jax.vmap(self.model.linearized))
        self._iterate = jax.jit(jax.vmap(self._pass))
        self._covariance = jax.jit(jax.vmap(self._posterior))

    def _information(self, x: Array, h: Array, H: Array, z: Array, w: Array) -> tuple[Array, Array, Array]:
        """A, g and the cost."""
        r = jnp.where(w > 0, z - h, 0.0)
        WH = w[:, None] * H
        off = self.mean - x
        cost = (w * r * r).sum() + (self.precision * off * off).sum()
        return H.T @ WH + jnp.diag(self.precision), r @ WH + self.precision * off, cost

    def _pass(self, x: Array, Sigma: Array, cap: Array, z: Array, w: Array) -> tuple[Array, Array, Array, Array, Array]:
        """The next x, Sigma and cap of one sample, whether it has converged, and its cost."""
        h, H = self.model.linearized(x)
        A, g, cost = self._information(x, h, H, z, w)
        decrement = (solved(A, g[:, None]) ** 2).sum()
        finite = jnp.isfinite(cost) & jnp.isfinite(A).all()
        done = finite & (decrement < jnp.maximum(DECREMENT, DECREMENT_SHARE * cost))
        inflated = jnp.minimum(jnp.nan_to_num(decrement, nan=0.0) / jnp.maximum((w[:-6] > 0).sum(), 1), cap)
        A, g, _ = self._information(x, h, H, z, w.at[:-6].divide(1.0 + inflated))
        Sigma = inverse(inverse(Sigma + jnp.eye(len(x))) + A)
        step = Sigma @ g
        cap = jnp.where((g @ step) < SETTLED, 0.1 * inflated, cap)
        fresh = jnp.isfinite(Sigma).all() & finite
        step = jnp.where(fresh, step * jnp.minimum(1.0, STEP_LIMIT / jnp.abs(step).max()), 0.0)
        return x + step, jnp.where(fresh, Sigma, jnp.eye(len(x))), cap, done, cost

    def _posterior(self, x: Array, z: Array, w: Array) -> Array:
        """The covariance of one finished sample."""
        h, H = self.model.linearized(x)
        return inverse(self._information(x, h, H, z, w.at[-6:].multiply(TIP_EXACT))[0])

    def _in_chunks(self, function: Any, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        """A compiled function over all samples; every thread takes chunks in turn. The last chunk is filled up."""
        B = len(arrays[0])
        size = next((size for size in self.sizes if size >= B), self.sizes[-1])
        parts = [tuple(a[i : i + size] for a in arrays) for i in range(0, B, size)]
        parts = [tuple(np.concatenate([a, np.repeat(a[:1], size - len(a), 0)]) for a in part) for part in parts]
        with ThreadPoolExecutor(self.threads) as pool:
            done = list(pool.map(lambda part: [np.asarray(a) for a in function(*part)], parts))
        return tuple(np.concatenate(outs)[:B] for outs in zip(*done, strict=True))

    def _data(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z and the diagonal of W."""
        return np.pad(positions.reshape(len(positions), -1), ((0, 0), (0, 6))), self.problem.weights(positions)

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        h, H = self._in_chunks(self._linearize, x)
        return h, H

    def iterate(
        self, x: np.ndarray, Sigma: np.ndarray, cap: np.ndarray, positions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `peers.Peer`."""
        x, Sigma, cap, done, _ = self._in_chunks(self._iterate, x, Sigma, cap, *self._data(positions))
        return x, Sigma, cap, done

    def estimate(self, x: np.ndarray, positions: np.ndarray) -> Fit:
        """See `peers.Peer`."""
        z, w = self._data(positions)
        B, n = x.shape
        x, Sigma, cap = x.copy(), np.tile(np.eye(n), (B, 1, 1)), np.full(B, np.inf)
        iterations, converged, cost = np.zeros(B, dtype=np.int64), np.zeros(B, dtype=bool), np.full(B, np.inf)
        live = np.arange(B)
        for _ in range(MAX_ITERATIONS):
            state = self._in_chunks(self._iterate, x[live], Sigma[live], cap[live], z[live], w[live])
            x[live], Sigma[live], cap[live], converged[live], cost[live] = state
            iterations[live] += 1
            live = live[~state[3]]
            if not len(live):
                break
        (covariance,) = self._in_chunks(lambda *part: [self._covariance(*part)], x, z, w)
        return make_fit(self.problem, x, covariance, iterations, converged, cost)


class TunedJaxPeer(JaxPeer):
    """The same, made as fast as we know how."""

    kind = TunedModel
    sizes, threads = TUNED_SIZES, len(os.sched_getaffinity(0))
