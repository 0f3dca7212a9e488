// One arc-length step: the same operations as torchrod/step.py and torchrod/tendons.py on dual numbers. The torch step is the
// definition; tests/test_fast.py holds this copy to it, values and Jacobians.
#pragma once

#include "known.h"

constexpr int MOST_TENDONS = 16;

// All that is known at one stage, for the samples in the lanes. Wn may move with a node; dtau is what frees a tension.
template <int K> struct Stage {
    bool Gm_there, Wn_there, Wm_there;
    Vec<K> G, Wn;
    Dual<K> G2x, G2y;
    V Gm[3], Wm[3], u_star[3];
    V L[MOST_TENDONS * 18], dr[MOST_TENDONS * 3], tau[MOST_TENDONS], dtau[MOST_TENDONS][K ? K : 1];
};

INLINE void inverse3(const V* A, V* R) {  // rows of R: cofactors of the columns of A
    V c[9] = {A[4] * A[8] - A[7] * A[5], A[7] * A[2] - A[1] * A[8], A[1] * A[5] - A[4] * A[2],
              A[5] * A[6] - A[8] * A[3], A[8] * A[0] - A[2] * A[6], A[2] * A[3] - A[5] * A[0],
              A[3] * A[7] - A[6] * A[4], A[6] * A[1] - A[0] * A[7], A[0] * A[4] - A[3] * A[1]};
    V one = 1.0 / (A[0] * c[0] + A[3] * c[1] + A[6] * c[2]);
    for (int i = 0; i < 9; i++) R[i] = c[i] * one;
}
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

// tendons.py, balanced_strains: the values.
template <int K> void balance(const Known& m, const Stage<K>& at, const V* w, Balance& b) {
    const V star[6] = {V{}, V{}, splat(1.0), at.u_star[0], at.u_star[1], at.u_star[2]};
    for (int i = 0; i < 6; i++) b.x[i] = star[i];
    for (int iteration = 0; iteration <= m.newton; iteration++) {
        V misfit[6], J[36];
        for (int i = 0; i < 36; i++) J[i] = V{};
        for (int i = 0; i < 3; i++) {
            misfit[i] = w[i], misfit[3 + i] = w[3 + i];
            for (int j = 0; j < 3; j++) {
                misfit[i] -= m.K_se[3 * i + j] * (b.x[j] - star[j]);
                misfit[3 + i] -= m.K_bt[3 * i + j] * (b.x[3 + j] - star[3 + j]);
                J[6 * i + j] = splat(m.K_se[3 * i + j]), J[6 * (3 + i) + 3 + j] = splat(m.K_bt[3 * i + j]);
            }
        }
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
            for (int j = 0; j < 6; j++) misfit[j] -= at.tau[t] * g[j];
            if (iteration == m.newton) continue;
            V weight = at.tau[t] / stretch;
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

// Strains of the whole section's wrench. The tangents of the last Newton step are inverse (dw - sum dtau g). `settled`: the values
// are those of an earlier block of tangents.
template <int K>
INLINE void strains(const Known& m, const Stage<K>& at, const Vec<K>& N, const Vec<K>& M, Balance* kept, bool settled, Vec<K>& v,
                    Vec<K>& u) {
    if (m.tendons) {
        if (!settled) {
            const V w[6] = {N.c[0].v, N.c[1].v, N.c[2].v, M.c[0].v, M.c[1].v, M.c[2].v};
            balance(m, at, w, *kept);
        }
        for (int i = 0; i < 6; i++) (i < 3 ? v.c[i] : u.c[i - 3]) = constant<K>(kept->x[i]);
        for (int j = 0; j < K; j++) {
            V dw[6] = {N.c[0].d[j], N.c[1].d[j], N.c[2].d[j], M.c[0].d[j], M.c[1].d[j], M.c[2].d[j]};
            for (int64_t t = 0; t < m.tendons; t++)
                for (int i = 0; i < 6; i++) dw[i] -= at.dtau[t][j] * kept->g[6 * t + i];
            for (int i = 0; i < 6; i++) {
                V d = V{};
                for (int k = 0; k < 6; k++) d += kept->inverse[6 * i + k] * dw[k];
                (i < 3 ? v.c[i] : u.c[i - 3]).d[j] = d;
            }
        }
    } else if (m.diagonal) {
        for (int i = 0; i < 3; i++) v.c[i] = m.K_se_inverse[4 * i] * N.c[i], u.c[i] = m.K_bt_inverse[4 * i] * M.c[i] + at.u_star[i];
        v.c[2].v += 1.0;
    } else {
        for (int i = 0; i < 3; i++) {
            const double *A = m.K_se_inverse + 3 * i, *B = m.K_bt_inverse + 3 * i;
            v.c[i] = A[0] * N.c[0] + A[1] * N.c[1] + A[2] * N.c[2];
            u.c[i] = B[0] * M.c[0] + B[1] * M.c[1] + B[2] * M.c[2] + at.u_star[i];
        }
        v.c[2].v += 1.0;
    }
}

// step.py, derivative: (1)-(4). The parts of the wrench that turn with the section come first; what keeps its direction in the
// base frame is added to them. No aggregate is copied: the compiler would call memmove.
template <int K> __attribute__((noinline)) void derivative(const Known& m, const Dual<K>* y, const Stage<K>& at, Balance* kept, bool settled, Dual<K>* dy) {
    const Vec<K>& q = *reinterpret_cast<const Vec<K>*>(y + 3);
    const Vec<K>& N_tilde = *reinterpret_cast<const Vec<K>*>(y + 7);
    const Vec<K>& M_tilde = *reinterpret_cast<const Vec<K>*>(y + 10);
    const Dual<K>& w = y[6];
    Vec<K> N_turning = N_tilde - at.G, M_turning, dead_force, dead_moment, v, u;
    M_turning.c[0] = M_tilde.c[0] - at.G2y;  // e3 x G2 = (-G2_y, G2_x, 0)
    M_turning.c[1] = M_tilde.c[1] + at.G2x;
    M_turning.c[2] = M_tilde.c[2] + V{};
    if (at.Gm_there)
        for (int i = 0; i < 3; i++) M_turning.c[i] = M_turning.c[i] - at.Gm[i];
    const Vec<K>*N = &N_turning, *M = &M_turning;
    if (at.Wn_there) dead_force = N_turning + turned(-q, w, at.Wn), N = &dead_force;
    if (at.Wm_there) {
        const Vec<K> Wm{constant<K>(at.Wm[0]), constant<K>(at.Wm[1]), constant<K>(at.Wm[2])};
        dead_moment = M_turning + turned(-q, w, Wm), M = &dead_moment;
    }
    strains(m, at, *N, *M, kept, settled, v, u);
    // dp = R v, dq = q (u, 0) / 2, dN~ = -u x (N~ - G), dM~ = -u x (M - R^T Wm) - v x N - e3 x G
    const Vec<K> p_rate = turned(q, w, v), q_rate = cross(q, u), N_rate = cross(N_turning, u), M_rate = cross(M_turning, u),
                 couple = cross(*N, v);
    for (int i = 0; i < 3; i++) {
        dy[i] = p_rate.c[i];
        dy[3 + i] = 0.5 * (w * u.c[i] + q_rate.c[i]);
        dy[7 + i] = N_rate.c[i];
        dy[10 + i] = M_rate.c[i] + couple.c[i];
    }
    dy[10] = dy[10] + at.G.c[1];
    dy[11] = dy[11] - at.G.c[0];
    dy[6] = -0.5 * (q.c[0] * u.c[0] + q.c[1] * u.c[1] + q.c[2] * u.c[2]);
}
