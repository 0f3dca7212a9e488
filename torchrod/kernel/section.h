// One arc-length step's right-hand side and its slope: the same operations as torchrod/mechanics/section.py and
// torchrod/mechanics/tendons.py, and their derivative. The torch step is the definition; tests/test_fast.py and test_fit.py hold this
// copy to it, values and Jacobians.
#pragma once

#include "tables.h"

INLINE void product3(const V* P, const V* Q, V* R) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) R[3 * i + j] = P[3 * i] * Q[j] + P[3 * i + 1] * Q[3 + j] + P[3 * i + 2] * Q[6 + j];
}

// tendons.py, balance_inverse: by blocks [[A, B], [B^T, C]] with the Schur complement of A.
INLINE void balance_inverse(const V* J, V* inverse) {
    V A[9], B[9], S[9], Ainv[9], AinvB[9], D[9], E[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) A[3 * i + j] = J[6 * i + j], B[3 * i + j] = J[6 * i + 3 + j], S[3 * i + j] = J[6 * (3 + i) + 3 + j];
    inverse3(A, Ainv);
    product3(Ainv, B, AinvB);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 3; k++) S[3 * i + j] -= B[3 * k + i] * AinvB[3 * k + j];
    inverse3(S, D);
    product3(AinvB, D, E);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            V top = Ainv[3 * i + j];
            for (int k = 0; k < 3; k++) top += E[3 * i + k] * AinvB[3 * j + k];
            inverse[6 * i + j] = top;
            inverse[6 * i + 3 + j] = inverse[6 * (3 + j) + i] = -E[3 * i + j];
            inverse[6 * (3 + i) + 3 + j] = D[3 * i + j];
        }
}

// The strains x that balance the wrench, the matrix of their last Newton step, and each tendon's wrench of unit tension.
struct Balance {
    V x[6], inverse[36], g[MOST_TENDONS * 6];
};

// What the strains x leave of the section's wrench w, and minus its derivative, without the tendons' share.
INLINE void without_tendons(const Stiffness& K, const V* star, const V* x, const V* w, V* misfit, V* J) {
    for (int i = 0; i < 36; i++) J[i] = V{};
    for (int i = 0; i < 3; i++) {
        misfit[i] = w[i], misfit[3 + i] = w[3 + i];
        for (int j = 0; j < 3; j++) {
            misfit[i] -= K.se[3 * i + j] * (x[j] - star[j]);
            misfit[3 + i] -= K.bt[3 * i + j] * (x[3 + j] - star[3 + j]);
            J[6 * i + j] = K.se[3 * i + j], J[6 * (3 + i) + 3 + j] = K.bt[3 * i + j];
        }
    }
}

// tendons.py, balanced_strains: the values.
inline void balance(const Known& m, const Stiffness& K, const Stage& at, const V* tau, const V* w, Balance& b) {
    const V star[6] = {V{}, V{}, splat(1.0), at.u_star.c[0], at.u_star.c[1], at.u_star.c[2]};
    for (int i = 0; i < 6; i++) b.x[i] = star[i];
    for (int iteration = 0; iteration <= m.newton; iteration++) {
        V misfit[6], J[36];
        without_tendons(K, star, b.x, w, misfit, J);
        for (int64_t t = 0; t < m.tendons; t++) {
            const V* L = at.L + 18 * t;
            V along[3], *g = b.g + 6 * t, square = V{};
            for (int i = 0; i < 3; i++) {
                along[i] = at.dr[3 * t + i];
                for (int j = 0; j < 6; j++) along[i] += L[6 * i + j] * b.x[j];
                square += along[i] * along[i];
            }
            V stretch = root(square);
            for (int j = 0; j < 6; j++) g[j] = (L[j] * along[0] + L[6 + j] * along[1] + L[12 + j] * along[2]) / stretch;
            for (int j = 0; j < 6; j++) misfit[j] -= tau[t] * g[j];
            if (iteration == m.newton) continue;
            V weight = tau[t] / stretch;
            for (int i = 0; i < 6; i++)
                for (int j = 0; j < 6; j++)
                    J[6 * i + j] += weight * (L[i] * L[j] + L[6 + i] * L[6 + j] + L[12 + i] * L[12 + j] - g[i] * g[j]);
        }
        if (iteration < m.newton) balance_inverse(J, b.inverse);
        V step[6];
        for (int i = 0; i < 6; i++) {
            step[i] = V{};
            for (int j = 0; j < 6; j++) step[i] += b.inverse[6 * i + j] * misfit[j];
        }
        for (int i = 0; i < 6; i++) b.x[i] += step[i];
    }
}

// tendons.py, chords: the wrench (6) of unit tension of tendon t, and, unless null, how it moves with the strains x, (6, 6).
inline void chord(const Stage& at, int64_t t, const V* x, V* g, V* dg) {
    const V *L = at.L + 18 * t, *c = at.chord + 4 * t;
    const V3 u = part(x + 3), dr = part(at.dr + 3 * t), r{L[11], -L[5], V{}};
    V3 T = dr;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 6; j++) T.c[i] += L[6 * i + j] * x[j];
    const V3 turning = T + dr, a = cross(u, turning) + part(at.ddr + 3 * t), b = cross(u, a);
    const V3 along = T + c[1] * a + c[2] * b, q = r + c[0] * a + c[3] * b;
    const V per = 1.0 / root(dot(along, along));
    const V3 d = per * along, arm = cross(q, d);
    for (int i = 0; i < 3; i++) g[i] = d.c[i], g[3 + i] = arm.c[i];
    for (int j = 0; dg && j < 6; j++) {
        const V3 dT{L[j], L[6 + j], L[12 + j]};
        V3 da = cross(u, dT), db{};
        V3 axis{};
        if (j >= 3) axis.c[j - 3] = splat(1.0), da = da + cross(axis, turning), db = cross(axis, a);
        db = db + cross(u, da);
        const V3 d_along = dT + c[1] * da + c[2] * db, dq = c[0] * da + c[3] * db;
        const V3 dd = per * (d_along - dot(d, d_along) * d), d_arm = cross(dq, d) + cross(q, dd);
        for (int i = 0; i < 3; i++) dg[6 * i + j] = dd.c[i], dg[6 * (3 + i) + j] = d_arm.c[i];
    }
}

// How the wrench of unit tension moves (6) where the tendon's place r does by `shift`, at given strains x. Zero chord: it follows the rod.
INLINE void shifted(const Stage& at, int64_t t, bool chords, const V* x, const V3& shift, V* dg) {
    const V* L = at.L + 18 * t;
    const V3 u = part(x + 3), dr = part(at.dr + 3 * t), r{L[11], -L[5], V{}};
    V3 T = dr;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 6; j++) T.c[i] += L[6 * i + j] * x[j];
    const V3 dT = cross(u, shift);
    V3 along = T, q = r, d_along = dT, dq = shift;
    if (chords) {
        const V* c = at.chord + 4 * t;
        const V3 a = cross(u, T + dr) + part(at.ddr + 3 * t), b = cross(u, a), da = cross(u, dT), db = cross(u, da);
        along = along + c[1] * a + c[2] * b, q = q + c[0] * a + c[3] * b;
        d_along = d_along + c[1] * da + c[2] * db, dq = dq + c[0] * da + c[3] * db;
    }
    const V per = 1.0 / root(dot(along, along));
    const V3 d = per * along, dd = per * (d_along - dot(d, d_along) * d), d_arm = cross(dq, d) + cross(q, dd);
    for (int i = 0; i < 3; i++) dg[i] = dd.c[i], dg[3 + i] = d_arm.c[i];
}

// tendons.py, chord_inverse: of a matrix that need not be symmetric, by blocks [[A, B], [C, D]].
INLINE void chord_inverse(const V* J, V* inverse) {
    V A[9], B[9], C[9], D[9], Ainv[9], left[9], right[9], S[9], both[9], top[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            A[3 * i + j] = J[6 * i + j], B[3 * i + j] = J[6 * i + 3 + j];
            C[3 * i + j] = J[6 * (3 + i) + j], D[3 * i + j] = J[6 * (3 + i) + 3 + j];
        }
    inverse3(A, Ainv);
    product3(C, Ainv, left), product3(Ainv, B, right), product3(C, right, both);
    for (int i = 0; i < 9; i++) D[i] -= both[i];
    inverse3(D, S);
    product3(S, left, both), product3(right, both, top), product3(right, S, A);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            inverse[6 * i + j] = Ainv[3 * i + j] + top[3 * i + j], inverse[6 * i + 3 + j] = -A[3 * i + j];
            inverse[6 * (3 + i) + j] = -both[3 * i + j], inverse[6 * (3 + i) + 3 + j] = S[3 * i + j];
        }
}

// tendons.py, balanced_strains, where tendons run from disc to disc.
inline void balance_chords(const Known& m, const Stiffness& K, const Stage& at, const V* tau, const V* w, Balance& b) {
    const V star[6] = {V{}, V{}, splat(1.0), at.u_star.c[0], at.u_star.c[1], at.u_star.c[2]};
    for (int i = 0; i < 6; i++) b.x[i] = star[i];
    for (int iteration = 0; iteration <= m.newton; iteration++) {
        V misfit[6], J[36], dg[36], step[6];
        without_tendons(K, star, b.x, w, misfit, J);
        const bool last = iteration == m.newton;
        for (int64_t t = 0; t < m.tendons; t++) {
            V* g = b.g + 6 * t;
            chord(at, t, b.x, g, last ? nullptr : dg);
            for (int j = 0; j < 6; j++) misfit[j] -= tau[t] * g[j];
            for (int k = 0; !last && k < 36; k++) J[k] += tau[t] * dg[k];
        }
        if (!last) chord_inverse(J, b.inverse);
        for (int i = 0; i < 6; i++) {
            step[i] = V{};
            for (int j = 0; j < 6; j++) step[i] += b.inverse[6 * i + j] * misfit[j];
        }
        for (int i = 0; i < 6; i++) b.x[i] += step[i];
    }
}

// tendons.py, turning_rate: Theta' of tendon t, how it moves with the strains x, (6), and with where it is, (2).
inline V turning_rate(const Stage& at, int64_t t, const V* x, V pull, double floor, V* slope, V* by_place) {
    const V* L = at.L + 18 * t;
    const V3 u = part(x + 3), dr = part(at.dr + 3 * t), change = cross(u, dr) + part(at.ddr + 3 * t);
    V3 along = dr;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 6; j++) along.c[i] += L[6 * i + j] * x[j];
    const V per = 1.0 / root(dot(along, along));
    const V3 d = per * along;
    const V ahead = dot(d, change);
    const V3 aside = change - ahead * d, turn = cross(u, d) + per * aside;
    const V rate = root(dot(turn, turn) + floor * floor), there = select(pull > 0, splat(1.0), V{}), per_rate = there / rate;
    // turn is normal to d, so that only what moves d across itself counts, and what stretches `along`.
    const V3 by_d = cross(turn, u) - (per * ahead) * turn, by_u = cross(d, turn) + per * cross(dr, turn);
    const V3 by_along = per * (by_d - dot(d, by_d) * d) - (per * per * dot(turn, aside)) * d;
    for (int j = 0; j < 6; j++) {
        V sum = j < 3 ? V{} : by_u.c[j - 3];
        for (int i = 0; i < 3; i++) sum += L[6 * i + j] * by_along.c[i];
        slope[j] = per_rate * sum;
    }
    const V3 by_r = cross(by_along, u);  // along moves by u x dr
    by_place[0] = per_rate * by_r.c[0], by_place[1] = per_rate * by_r.c[1];
    return there * rate;
}

// What the derivative of one evaluation of (1)-(4) needs of its values. Jv (3, 4): of R v by q; Jn, Jm: of R^T Wn and R^T Wm.
struct Slope {
    V R[9], Jv[12], Jn[12], Jm[12], w, tau_unit[MOST_TENDONS], tau[MOST_TENDONS], fall[MOST_TENDONS], turn[MOST_TENDONS * 6], left[MOST_TENDONS],
        aside[MOST_TENDONS * 2];
    V3 q, u, v, N, N_turning, M_turning;
    bool Jn_there, Jm_there;
    const Stiffness* K;
    Balance balance;
};

// section.py, derivative: (1)-(4). The parts of the wrench that turn with the section come first; what keeps its direction in the
// base frame is added to them.
inline void derivative(const Known& m, const V* y, const Stage& at, V* dy, Slope& s) {
    s.q = part(y + 3), s.w = y[6];
    s.N_turning = part(y + 7) - at.G;
    s.M_turning = part(y + 10) - at.Gm;
    s.M_turning.c[0] -= at.G2y;  // e3 x G2 = (-G2_y, G2_x, 0)
    s.M_turning.c[1] += at.G2x;
    const V3 back = V3{} - s.q;
    s.N = s.N_turning, s.Jn_there = at.Wn_there, s.Jm_there = at.Wm_there;
    V3 M = s.M_turning;
    if (at.Wn_there) s.N = s.N + turned(back, s.w, at.Wn), turning(s.q, s.w, -1, at.Wn, s.Jn);
    if (at.Wm_there) M = M + turned(back, s.w, at.Wm), turning(s.q, s.w, -1, at.Wm, s.Jm);
    if (m.tendons) {
        const V w[6] = {s.N.c[0], s.N.c[1], s.N.c[2], M.c[0], M.c[1], M.c[2]};
        for (int64_t t = 0; t < m.tendons; t++) s.tau[t] = at.tau[t], s.tau_unit[t] = at.tau_unit[t];
        for (int64_t t = 0; m.friction && t < m.tendons; t++) {
            s.left[t] = exponential(larger(smaller(-at.mu[t] * y[STATE + t], splat(700.0)), splat(-700.0)));
            s.tau[t] *= s.left[t], s.tau_unit[t] *= s.left[t], s.fall[t] = at.mu[t] * s.tau[t];
        }
        if (m.chord.data) balance_chords(m, *s.K, at, s.tau, w, s.balance);
        else balance(m, *s.K, at, s.tau, w, s.balance);
        s.v = part(s.balance.x), s.u = part(s.balance.x + 3);
        for (int64_t t = 0; m.friction && t < m.tendons; t++)
            dy[STATE + t] = turning_rate(at, t, s.balance.x, s.tau[t], m.friction[m.tendons], s.turn + 6 * t, s.aside + 2 * t);
    } else {
        s.v = matvec(s.K->se, s.N), s.u = at.u_star + matvec(s.K->bt, M);
        s.v.c[2] += 1.0;
    }
    for (int k = 0; k < 3; k++) {
        V3 axis{};
        axis.c[k] = splat(1.0);
        const V3 column = turned(s.q, s.w, axis);
        for (int i = 0; i < 3; i++) s.R[3 * i + k] = column.c[i];
    }
    turning(s.q, s.w, 1, s.v, s.Jv);
    // dp = R v, dq = q (u, 0) / 2, dN~ = -u x (N~ - G), dM~ = -u x (M - R^T Wm) - v x N - e3 x G
    const V3 p = matvec(s.R, s.v), q = s.w * s.u + cross(s.q, s.u), N = cross(s.N_turning, s.u),
             couple = cross(s.M_turning, s.u) + cross(s.N, s.v);
    for (int i = 0; i < 3; i++) dy[i] = p.c[i], dy[3 + i] = 0.5 * q.c[i], dy[7 + i] = N.c[i], dy[10 + i] = couple.c[i];
    dy[10] += at.G.c[1], dy[11] -= at.G.c[0];
    dy[6] = -0.5 * dot(s.q, s.u);
}

// What moves with one tangent at one stage, beside the state: the local loads [G, G2_x, G2_y], Wn, the tension of one tendon, and what
// a parameter of the robot adds.
struct Moves {
    const V* local;   // (5) or null
    const V3* Wn;     // or null
    int64_t tension;  // whose unknown this tangent is, or -1
    const V* forced;  // (FORCED) or null
};

// What a parameter adds at one stage, by itself: to the section's wrench that the strains balance (6), to R^T Wn (3), to every Theta'.
constexpr int FORCED = 9 + MOST_TENDONS;

// For all parameters, (parameter_tangents, FORCED): the wrench of every amount kappa by the amount's own slopes. y: the state there.
inline void forced_by(const Group& g, int64_t row, const V* y, const Stage& at, const Slope& s, V* to) {
    const Known& m = *g.known;
    const Deviations& d = m.off;
    const int64_t n = g.parameter_tangents;
    for (int64_t i = 0; i < n * FORCED; i++) to[i] = V{};
    const auto add = [&](int64_t amount, const V* wrench) {
        for (int64_t k = 0; k < n; k++) {
            const V by = g.dkappa[amount * n + k];
            if (any(by != 0.0))
                for (int i = 0; i < 6; i++) to[k * FORCED + i] += by * wrench[i];
        }
    };
    const V x[6] = {s.v.c[0], s.v.c[1], s.v.c[2], s.u.c[0], s.u.c[1], s.u.c[2]};
    const V bent[6] = {x[0], x[1], x[2] - 1.0, x[3] - at.u_star.c[0], x[4] - at.u_star.c[1], x[5] - at.u_star.c[2]};
    V f[6];
    for (int64_t k = 0; k < d.stiffness; k++) {  // what is stiffer bears more
        for (int i = 0; i < 6; i++) {
            f[i] = V{};
            for (int j = 0; j < 3; j++) f[i] -= off_stiffness(g, k, row, 3 * i + j) * bent[i < 3 ? j : 3 + j];
        }
        add(k, f);
    }
    for (int64_t k = 0; k < d.curvature; k++) {
        V u[3];
        for (int c = 0; c < 3; c++) u[c] = fetch(d.u_off, g.lanes, (k * 3 * m.steps + row) * 3 + c), f[c] = V{};
        const V* K = s.K->K_bt;
        for (int i = 0; i < 3; i++) f[3 + i] = K[3 * i] * u[0] + K[3 * i + 1] * u[1] + K[3 * i + 2] * u[2];
        add(d.of_curvature() + k, f);
    }
    if (d.hanging) {
        const V3 back = V3{} - s.q;
        for (int64_t k = 0; k < n; k++) {
            const V3 w = turned(back, s.w, splat(g.dead) * weight_slope(g, row, k));
            for (int c = 0; c < 3; c++) to[k * FORCED + 6 + c] = w.c[c];
        }
    }
    for (int64_t t = 0; t < m.tendons; t++) {
        const V* unit = s.balance.g + 6 * t;
        if (d.pulls) {
            const V more = fetch(d.pulling, g.lanes, row * m.tendons + t) * (m.friction ? s.left[t] : splat(1.0));
            for (int i = 0; i < 6; i++) f[i] = -more * unit[i];
            add(d.of_pull() + t, f);
        }
        if (d.frictions) {
            const V more = y[STATE + t] * s.tau[t];
            for (int i = 0; i < 6; i++) f[i] = more * unit[i];
            add(d.of_friction() + t, f);
        }
        for (int axis = 0; d.places && axis < 2; axis++) {
            V3 shift{};
            shift.c[axis] = splat(1.0);
            shifted(at, t, m.chord.data, x, shift, f);
            for (int i = 0; i < 6; i++) f[i] *= -s.tau[t];
            const int64_t amount = d.of_place() + 2 * t + axis;
            add(amount, f);
            for (int64_t k = 0; m.friction && k < n; k++) to[k * FORCED + 9 + t] += g.dkappa[amount * n + k] * s.aside[2 * t + axis];
        }
    }
}

// The derivative of `derivative` along one tangent z of the state. Plain: no tendons and no loads of the base frame.
// Rubbing: tendons with friction, whose Theta come behind the rest of the state.
template <bool Plain, bool Rubbing> INLINE void slope(const Known& m, const Slope& s, const V* z, const Moves& moves, V* dk) {
    V3 dNt = part(z + 7), dMt = part(z + 10), shear{};
    if (moves.local) {
        const V* l = moves.local;
        dNt = dNt - V3{l[0], l[1], l[2]};
        dMt.c[0] -= l[4], dMt.c[1] += l[3];
        shear = {l[1], -l[0], V{}};
    }
    V3 dN = dNt, dM = dMt, dv, du;
    if (!Plain) {
        if (moves.Wn) dN = dN + *moves.Wn;
        if (moves.forced) dN = dN + part(moves.forced + 6);
        if (s.Jn_there) dN = dN + matvec4(s.Jn, z + 3);
        if (s.Jm_there) dM = dM + matvec4(s.Jm, z + 3);
    }
    if (!Plain && m.tendons) {
        V dw[6] = {dN.c[0], dN.c[1], dN.c[2], dM.c[0], dM.c[1], dM.c[2]}, dx[6];
        if (moves.tension >= 0)
            for (int i = 0; i < 6; i++) dw[i] -= s.tau_unit[moves.tension] * s.balance.g[6 * moves.tension + i];
        for (int i = 0; moves.forced && i < 6; i++) dw[i] += moves.forced[i];
        for (int64_t t = 0; Rubbing && t < m.tendons; t++) {
            const V less = s.fall[t] * z[STATE + t];
            for (int i = 0; i < 6; i++) dw[i] += less * s.balance.g[6 * t + i];
        }
        for (int i = 0; i < 6; i++) {
            dx[i] = V{};
            for (int k = 0; k < 6; k++) dx[i] += s.balance.inverse[6 * i + k] * dw[k];
        }
        dv = part(dx), du = part(dx + 3);
        for (int64_t t = 0; Rubbing && t < m.tendons; t++) {
            V rate = V{};
            for (int i = 0; i < 6; i++) rate += s.turn[6 * t + i] * dx[i];
            dk[STATE + t] = moves.forced ? rate + moves.forced[9 + t] : rate;
        }
    } else {
        V3 n = dN, b = dM;
        if (moves.forced) n = n + part(moves.forced), b = b + part(moves.forced + 3);
        if (m.diagonal) {
            for (int i = 0; i < 3; i++) dv.c[i] = s.K->se[4 * i] * n.c[i], du.c[i] = s.K->bt[4 * i] * b.c[i];
        } else {
            dv = matvec(s.K->se, n), du = matvec(s.K->bt, b);
        }
    }
    const V3 dq = part(z + 3), p = matvec(s.R, dv) + matvec4(s.Jv, z + 3), q = s.w * du + z[6] * s.u + cross(dq, s.u) + cross(s.q, du),
             N = cross(dNt, s.u) + cross(s.N_turning, du),
             M = cross(dMt, s.u) + cross(s.M_turning, du) + cross(dN, s.v) + cross(s.N, dv) + shear;
    for (int i = 0; i < 3; i++) dk[i] = p.c[i], dk[3 + i] = 0.5 * q.c[i], dk[7 + i] = N.c[i], dk[10 + i] = M.c[i];
    dk[6] = -0.5 * (dot(dq, s.u) + dot(s.q, du));
}
