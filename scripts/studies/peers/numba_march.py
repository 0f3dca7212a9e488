"""The rod's march in numba: RK4 with the tangents of the discrete steps, LANES samples at a time.

Samples are innermost, so that every loop over lanes becomes vector instructions: values lie at [... * LANES + lane] of flat arrays,
whose constant strides let LLVM see that lanes do not touch. Only loads and base wrench are marched (a registration moves finished
points), and the loads' integrals are evaluated once per node and midpoint.
"""

# Types are checked where the bench extra is not installed, too.
# pyright: reportMissingImports=false

import math
from typing import Any

from numba import njit

LANES = 8
# Fused multiply-adds, but nothing that assumes finite numbers; no exceptions, which would keep loops from being vectorized.
HOT: dict[str, Any] = {"fastmath": {"contract", "arcp", "nsz"}, "error_model": "numpy", "cache": True}
STATE = 13
STAGE = 10  # q, N, M of a stage
PARTS = 6  # of one load at one arc length: torchrod's G per newton and its derivatives in eta and log c, then the same of G2


@njit(forceinline=True, **HOT)
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(forceinline=True, **HOT)
def _rates(k, qx, qy, qz, qw, nx, ny, nz, mx, my, mz, gx, gy):
    """dy/ds of the state, from q and the section's wrench N, M (loads included); k: the six compliances."""
    vx, vy, vz = k[0] * nx, k[1] * ny, 1.0 + k[2] * nz
    ux, uy, uz = k[3] * mx, k[4] * my, k[5] * mz
    tx, ty, tz = _cross(2.0 * qx, 2.0 * qy, 2.0 * qz, vx, vy, vz)
    rx, ry, rz = _cross(qx, qy, qz, tx, ty, tz)
    ax, ay, az = _cross(qx, qy, qz, ux, uy, uz)
    # N~ = N + G turns with u; G_z = 0
    fx, fy, fz = _cross(nx, ny, nz, ux, uy, uz)
    ex, ey, ez = _cross(mx, my, mz, ux, uy, uz)
    cx, cy, cz = _cross(nx, ny, nz, vx, vy, vz)
    size = qx * qx + qy * qy + qz * qz + qw * qw
    return (
        size * vx + qw * tx + rx,
        size * vy + qw * ty + ry,
        size * vz + qw * tz + rz,
        0.5 * (qw * ux + ax),
        0.5 * (qw * uy + ay),
        0.5 * (qw * uz + az),
        -0.5 * (qx * ux + qy * uy + qz * uz),
        fx,
        fy,
        fz,
        ex + cx + gy,
        ey + cy - gx,
        ez + cz,
    )


@njit(forceinline=True, **HOT)
def _rate_tangents(k, qx, qy, qz, qw, nx, ny, nz, mx, my, mz, dqx, dqy, dqz, dqw, dnx, dny, dnz, dmx, dmy, dmz, dgx, dgy):
    """The derivative of `_rates`; dn, dm are of N and M (loads included)."""
    vx, vy, vz = k[0] * nx, k[1] * ny, 1.0 + k[2] * nz
    ux, uy, uz = k[3] * mx, k[4] * my, k[5] * mz
    dvx, dvy, dvz = k[0] * dnx, k[1] * dny, k[2] * dnz
    dux, duy, duz = k[3] * dmx, k[4] * dmy, k[5] * dmz
    tx, ty, tz = _cross(2.0 * qx, 2.0 * qy, 2.0 * qz, vx, vy, vz)
    ax, ay, az = _cross(dqx, dqy, dqz, vx, vy, vz)
    bx, by, bz = _cross(qx, qy, qz, dvx, dvy, dvz)
    sx, sy, sz = 2.0 * (ax + bx), 2.0 * (ay + by), 2.0 * (az + bz)
    ax, ay, az = _cross(dqx, dqy, dqz, tx, ty, tz)
    bx, by, bz = _cross(qx, qy, qz, sx, sy, sz)
    cx, cy, cz = _cross(dqx, dqy, dqz, ux, uy, uz)
    ex, ey, ez = _cross(qx, qy, qz, dux, duy, duz)
    fx, fy, fz = _cross(dnx, dny, dnz, ux, uy, uz)
    gx, gy, gz = _cross(nx, ny, nz, dux, duy, duz)
    hx, hy, hz = _cross(dmx, dmy, dmz, ux, uy, uz)
    ix, iy, iz = _cross(mx, my, mz, dux, duy, duz)
    jx, jy, jz = _cross(dnx, dny, dnz, vx, vy, vz)
    lx, ly, lz = _cross(nx, ny, nz, dvx, dvy, dvz)
    size, growth = qx * qx + qy * qy + qz * qz + qw * qw, 2.0 * (qx * dqx + qy * dqy + qz * dqz + qw * dqw)
    return (
        size * dvx + growth * vx + dqw * tx + qw * sx + ax + bx,
        size * dvy + growth * vy + dqw * ty + qw * sy + ay + by,
        size * dvz + growth * vz + dqw * tz + qw * sz + az + bz,
        0.5 * (dqw * ux + qw * dux + cx + ex),
        0.5 * (dqw * uy + qw * duy + cy + ey),
        0.5 * (dqw * uz + qw * duz + cz + ez),
        -0.5 * (dqx * ux + dqy * uy + dqz * uz + qx * dux + qy * duy + qz * duz),
        fx + gx,
        fy + gy,
        fz + gz,
        hx + ix + jx + lx + dgy,
        hy + iy + jy + ly - dgx,
        hz + iz + jz + lz,
    )


@njit(forceinline=True, **HOT)
def _stage(st, s, lane, y, g):
    """Store q, N, M of stage s; y is the state there, g = G_x, G_y and their integrals."""
    values = (y[3], y[4], y[5], y[6], y[7] - g[0], y[8] - g[1], y[9], y[10] - g[3], y[11] + g[2], y[12])
    for c in range(STAGE):
        st[(s * STAGE + c) * LANES + lane] = values[c]
    return values


@njit(forceinline=True, **HOT)
def _along(y, f, h):
    """y + h f for tuples of thirteen."""
    return (
        y[0] + h * f[0],
        y[1] + h * f[1],
        y[2] + h * f[2],
        y[3] + h * f[3],
        y[4] + h * f[4],
        y[5] + h * f[5],
        y[6] + h * f[6],
        y[7] + h * f[7],
        y[8] + h * f[8],
        y[9] + h * f[9],
        y[10] + h * f[10],
        y[11] + h * f[11],
        y[12] + h * f[12],
    )


@njit(forceinline=True, **HOT)
def _row(a, first, lane):
    """Thirteen numbers of one lane."""
    i = first * LANES + lane
    w = LANES
    return (
        a[i],
        a[i + w],
        a[i + 2 * w],
        a[i + 3 * w],
        a[i + 4 * w],
        a[i + 5 * w],
        a[i + 6 * w],
        a[i + 7 * w],
        a[i + 8 * w],
        a[i + 9 * w],
        a[i + 10 * w],
        a[i + 11 * w],
        a[i + 12 * w],
    )


@njit(forceinline=True, **HOT)
def _four(a, first, lane):
    i = first * LANES + lane
    return a[i], a[i + LANES], a[i + 2 * LANES], a[i + 3 * LANES]


@njit(**HOT)
def step_states(lanes, k, h, y, st, g):
    """One RK4 step of every lane's state y; the four stages are left in st, with 1 / |q| behind them.

    g: G_x, G_y and their integrals at the start, the middle and the end.
    """
    for lane in range(lanes):
        y0 = _row(y, 0, lane)
        g0, g1, g2 = _four(g, 0, lane), _four(g, 4, lane), _four(g, 8, lane)
        a = _stage(st, 0, lane, y0, g0)
        k1 = _rates(k, a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], g0[0], g0[1])
        a = _stage(st, 1, lane, _along(y0, k1, 0.5 * h), g1)
        k2 = _rates(k, a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], g1[0], g1[1])
        a = _stage(st, 2, lane, _along(y0, k2, 0.5 * h), g1)
        k3 = _rates(k, a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], g1[0], g1[1])
        a = _stage(st, 3, lane, _along(y0, k3, h), g2)
        k4 = _rates(k, a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], g2[0], g2[1])
        z = _along(_along(_along(_along(y0, k1, h / 6), k2, h / 3), k3, h / 3), k4, h / 6)
        size = 1.0 / math.sqrt(z[3] * z[3] + z[4] * z[4] + z[5] * z[5] + z[6] * z[6])
        st[4 * STAGE * LANES + lane] = size
        for c in range(3):
            y[c * LANES + lane] = z[c]
        for c in range(3, 7):
            y[c * LANES + lane] = size * z[c]
        for c in range(7, 13):
            y[c * LANES + lane] = z[c]


@njit(forceinline=True, **HOT)
def _tangent_of(k, st, s, lane, d, gx, gy, g2x, g2y):
    """dy'/ds at stage s, for the state's tangent d + the loads'."""
    i = s * STAGE * LANES + lane
    w = LANES
    return _rate_tangents(
        k,
        st[i],
        st[i + w],
        st[i + 2 * w],
        st[i + 3 * w],
        st[i + 4 * w],
        st[i + 5 * w],
        st[i + 6 * w],
        st[i + 7 * w],
        st[i + 8 * w],
        st[i + 9 * w],
        d[3],
        d[4],
        d[5],
        d[6],
        d[7] - gx,
        d[8] - gy,
        d[9],
        d[10] - g2y,
        d[11] + g2x,
        d[12],
        gx,
        gy,
    )


@njit(forceinline=True, **HOT)
def _step_tangent(k, h, y, st, dy, lane, gx0, gy0, hx0, hy0, gx1, gy1, hx1, hy1, gx2, gy2, hx2, hy2):
    """One step of one tangent; g and h: how the loads' G and G2 move at the step's start, middle and end."""
    d = _row(dy, 0, lane)
    k1 = _tangent_of(k, st, 0, lane, d, gx0, gy0, hx0, hy0)
    k2 = _tangent_of(k, st, 1, lane, _along(d, k1, 0.5 * h), gx1, gy1, hx1, hy1)
    k3 = _tangent_of(k, st, 2, lane, _along(d, k2, 0.5 * h), gx1, gy1, hx1, hy1)
    k4 = _tangent_of(k, st, 3, lane, _along(d, k3, h), gx2, gy2, hx2, hy2)
    z = _along(_along(_along(_along(d, k1, h / 6), k2, h / 3), k3, h / 3), k4, h / 6)
    size = st[4 * STAGE * LANES + lane]
    qx, qy, qz, qw = _four(y, 3, lane)
    dot = qx * z[3] + qy * z[4] + qz * z[5] + qw * z[6]
    w = LANES
    dy[lane] = z[0]
    dy[lane + w] = z[1]
    dy[lane + 2 * w] = z[2]
    dy[lane + 3 * w] = size * (z[3] - qx * dot)
    dy[lane + 4 * w] = size * (z[4] - qy * dot)
    dy[lane + 5 * w] = size * (z[5] - qz * dot)
    dy[lane + 6 * w] = size * (z[6] - qw * dot)
    dy[lane + 7 * w] = z[7]
    dy[lane + 8 * w] = z[8]
    dy[lane + 9 * w] = z[9]
    dy[lane + 10 * w] = z[10]
    dy[lane + 11 * w] = z[11]
    dy[lane + 12 * w] = z[12]


@njit(**HOT)
def step_load_tangent(lanes, k, h, y, st, dy, parts, part, amplitude):
    """One step of the tangent of a load's number. parts: the load's at the step's three stages; amplitude: x then y (N).

    part: 0 for a force, 1 for eta, 2 for log c.
    """
    g, w = parts[part * LANES :], LANES
    for lane in range(lanes):
        ax, ay = amplitude[lane], amplitude[lane + w]
        g0, h0, g1, h1, g2, h2 = g[lane], g[lane + 3 * w], g[lane + 6 * w], g[lane + 9 * w], g[lane + 12 * w], g[lane + 15 * w]
        args = (ax * g0, ay * g0, ax * h0, ay * h0, ax * g1, ay * g1, ax * h1, ay * h1, ax * g2, ay * g2, ax * h2, ay * h2)
        _step_tangent(k, h, y, st, dy, lane, *args)


@njit(**HOT)
def step_tangent(lanes, k, h, y, st, dy):
    """One step of a tangent under which the loads stay."""
    for lane in range(lanes):
        _step_tangent(k, h, y, st, dy, lane, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
