"""Normal equations and the filter's update in numba, eight lanes at a time.

Loops over eight lanes with so little in them gain nothing from LLVM's loop vectorizer, which must first test whether arrays
overlap. Here the lanes are written out, and the vectorizer of straight code, off in numba by default, packs them: a sum stays in
one vector register over a whole loop. (It would spoil the march, so it is on for these functions only.) Indices are unsigned, so
that none needs a test for being negative. What cannot be factored turns to NaN, in its own lane only, and is seen by the caller.
"""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import config as numba_config
from numba import njit

from .numba_march import HOT, LANES

GROUP = 12  # rows of H that are taken in one go
ONE = np.uintp(1)


def packed(signature: str) -> Callable[[Callable[..., None]], Any]:
    """Compile at once for a signature, with LLVM's vectorizer of straight code."""

    def compiled(function: Callable[..., None]) -> Any:
        config: Any = numba_config
        before, config.SLP_VECTORIZE = config.SLP_VECTORIZE, 1
        try:
            return njit(signature, **HOT)(function)
        finally:
            config.SLP_VECTORIZE = before

    return compiled


@njit(forceinline=True, **HOT)
def _at(i, j, n):
    """Where the lanes of entry (i, j) of a matrix with n columns begin."""
    return np.uintp((i * n + j) * LANES)


@njit(forceinline=True, **HOT)
def _load(a, i):
    """Eight lanes."""
    i1, i2, i4 = i + ONE, i + ONE + ONE, i + ONE + ONE + ONE + ONE
    return a[i], a[i1], a[i2], a[i2 + ONE], a[i4], a[i4 + ONE], a[i4 + ONE + ONE], a[i4 + ONE + ONE + ONE]


@njit(forceinline=True, **HOT)
def _store(a, i, s):
    i1, i2, i4 = i + ONE, i + ONE + ONE, i + ONE + ONE + ONE + ONE
    a[i], a[i1], a[i2], a[i2 + ONE] = s[0], s[1], s[2], s[3]
    a[i4], a[i4 + ONE], a[i4 + ONE + ONE], a[i4 + ONE + ONE + ONE] = s[4], s[5], s[6], s[7]


@njit(forceinline=True, **HOT)
def _times(a, b):
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2], a[3] * b[3], a[4] * b[4], a[5] * b[5], a[6] * b[6], a[7] * b[7])


@njit(forceinline=True, **HOT)
def _plus(s, a, b):
    """s + a b."""
    return (
        s[0] + a[0] * b[0],
        s[1] + a[1] * b[1],
        s[2] + a[2] * b[2],
        s[3] + a[3] * b[3],
        s[4] + a[4] * b[4],
        s[5] + a[5] * b[5],
        s[6] + a[6] * b[6],
        s[7] + a[7] * b[7],
    )


@njit(forceinline=True, **HOT)
def _minus(s, a, b):
    """s - a b."""
    return (
        s[0] - a[0] * b[0],
        s[1] - a[1] * b[1],
        s[2] - a[2] * b[2],
        s[3] - a[3] * b[3],
        s[4] - a[4] * b[4],
        s[5] - a[5] * b[5],
        s[6] - a[6] * b[6],
        s[7] - a[7] * b[7],
    )


@njit(forceinline=True, **HOT)
def _inverse_root(s):
    return (
        1.0 / math.sqrt(s[0]),
        1.0 / math.sqrt(s[1]),
        1.0 / math.sqrt(s[2]),
        1.0 / math.sqrt(s[3]),
        1.0 / math.sqrt(s[4]),
        1.0 / math.sqrt(s[5]),
        1.0 / math.sqrt(s[6]),
        1.0 / math.sqrt(s[7]),
    )


ZERO = (0.0,) * LANES


@packed("void(float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1])")
def add_rows(rows, r, A, g):
    """A += rows^T rows (lower triangle) and g += rows^T r, for rows[n, GROUP, lane] and r[GROUP, lane]."""
    n, flat, residual, matrix, vector = len(rows), rows.ravel(), r.ravel(), A.ravel(), g.ravel()
    for i in range(n):
        s = _load(vector, _at(0, i, n))
        for k in range(GROUP):
            s = _plus(s, _load(flat, _at(i, k, GROUP)), _load(residual, _at(0, k, GROUP)))
        _store(vector, _at(0, i, n), s)
        for j in range(i + 1):
            s = _load(matrix, _at(i, j, n))
            for k in range(GROUP):
                s = _plus(s, _load(flat, _at(i, k, GROUP)), _load(flat, _at(j, k, GROUP)))
            _store(matrix, _at(i, j, n), s)


@packed("void(float64[:,:,::1], float64[:,:,::1], float64[:,::1])")
def factor(A, L, d):
    """The Cholesky factor of A scaled to unit diagonal: A = diag(1/d) L L^T diag(1/d); L's diagonal is stored inverted."""
    n, matrix, lower, scale = len(A), A.ravel(), L.ravel(), d.ravel()
    for i in range(n):
        _store(scale, _at(0, i, n), _inverse_root(_load(matrix, _at(i, i, n))))
    for i in range(n):
        for j in range(i + 1):
            both = _times(_load(scale, _at(0, i, n)), _load(scale, _at(0, j, n)))
            s = _times(_load(matrix, _at(i, j, n)), both)
            for k in range(j):
                s = _minus(s, _load(lower, _at(i, k, n)), _load(lower, _at(j, k, n)))
            if i == j:
                _store(lower, _at(i, i, n), _inverse_root(s))
            else:
                _store(lower, _at(i, j, n), _times(s, _load(lower, _at(j, j, n))))


@packed("void(float64[:,:,::1], float64[:,::1], float64[:,::1], float64[:,::1])")
def forward(L, d, g, y):
    """y = L^-1 diag(d) g."""
    n, lower, out = len(L), L.ravel(), y.ravel()
    for i in range(n):
        s = _times(_load(d.ravel(), _at(0, i, n)), _load(g.ravel(), _at(0, i, n)))
        for k in range(i):
            s = _minus(s, _load(lower, _at(i, k, n)), _load(out, _at(0, k, n)))
        _store(out, _at(0, i, n), _times(s, _load(lower, _at(i, i, n))))


@packed("void(float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1])")
def inverse(L, d, scratch, X):
    """X (lower triangle) = A^-1 from the factor: with scratch = L^-1, X = diag(d) scratch^T scratch diag(d)."""
    n, lower, scale, w, out = len(L), L.ravel(), d.ravel(), scratch.ravel(), X.ravel()
    for j in range(n):
        _store(w, _at(j, j, n), _load(lower, _at(j, j, n)))
        for i in range(j + 1, n):
            s = ZERO
            for k in range(j, i):
                s = _minus(s, _load(lower, _at(i, k, n)), _load(w, _at(k, j, n)))
            _store(w, _at(i, j, n), _times(s, _load(lower, _at(i, i, n))))
    for i in range(n):
        for j in range(i + 1):
            s = ZERO
            for k in range(i, n):
                s = _plus(s, _load(w, _at(k, i, n)), _load(w, _at(k, j, n)))
            both = _times(_load(scale, _at(0, i, n)), _load(scale, _at(0, j, n)))
            _store(out, _at(i, j, n), _times(s, both))


@packed("void(float64[:,:,::1], float64[:,::1], float64[:,::1])")
def times(X, g, y):
    """y = X g for symmetric X given by its lower triangle."""
    n, matrix, vector, out = len(X), X.ravel(), g.ravel(), y.ravel()
    for i in range(n):
        s = ZERO
        for j in range(n):
            s = _plus(s, _load(matrix, _at(max(i, j), min(i, j), n)), _load(vector, _at(0, j, n)))
        _store(out, _at(0, i, n), s)
