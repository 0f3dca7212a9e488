// The march of torchrod/step.py with its tangents, compiled: the same operations in the same order on a dual number that carries
// up to N tangents in SIMD lanes. The torch step is the definition; tests/test_fast.py holds this one to it, values and Jacobians.
//
// One sample at a time, all of its tangents at once: a batch of one is as fast per sample as a batch of a thousand.

#include <cmath>
#include <cstdint>
#include <functional>
#include <thread>
#include <vector>

namespace {

template <int N> struct Dual {
    typedef double Lanes __attribute__((vector_size(N * sizeof(double))));
    double v;
    Lanes d;
};
template <int N> Dual<N> constant(double v) { return {v, typename Dual<N>::Lanes{}}; }
template <int N> Dual<N> operator+(const Dual<N>& a, const Dual<N>& b) { return {a.v + b.v, a.d + b.d}; }
template <int N> Dual<N> operator-(const Dual<N>& a, const Dual<N>& b) { return {a.v - b.v, a.d - b.d}; }
template <int N> Dual<N> operator-(const Dual<N>& a) { return {-a.v, -a.d}; }
template <int N> Dual<N> operator*(const Dual<N>& a, const Dual<N>& b) { return {a.v * b.v, a.v * b.d + b.v * a.d}; }
template <int N> Dual<N> operator*(double a, const Dual<N>& b) { return {a * b.v, a * b.d}; }

template <int N> struct Vec {
    Dual<N> c[3];
};
template <int N> Vec<N> operator+(const Vec<N>& a, const Vec<N>& b) { return {a.c[0] + b.c[0], a.c[1] + b.c[1], a.c[2] + b.c[2]}; }
template <int N> Vec<N> operator-(const Vec<N>& a, const Vec<N>& b) { return {a.c[0] - b.c[0], a.c[1] - b.c[1], a.c[2] - b.c[2]}; }
template <int N> Vec<N> operator-(const Vec<N>& a) { return {-a.c[0], -a.c[1], -a.c[2]}; }
template <int N> Vec<N> operator*(const Dual<N>& s, const Vec<N>& a) { return {s * a.c[0], s * a.c[1], s * a.c[2]}; }
template <int N> Vec<N> cross(const Vec<N>& a, const Vec<N>& b) {
    return {a.c[1] * b.c[2] - a.c[2] * b.c[1], a.c[2] * b.c[0] - a.c[0] * b.c[2], a.c[0] * b.c[1] - a.c[1] * b.c[0]};
}
template <int N> Vec<N> known(const double* x) { return {constant<N>(x[0]), constant<N>(x[1]), constant<N>(x[2])}; }
template <int N> Vec<N> matvec(const double* A, const Vec<N>& x) {
    Vec<N> r;
    for (int i = 0; i < 3; i++) r.c[i] = A[3 * i] * x.c[0] + A[3 * i + 1] * x.c[1] + A[3 * i + 2] * x.c[2];
    return r;
}
template <int N> Vec<N> turned(const Vec<N>& q, const Dual<N>& w, const Vec<N>& a) {
    Vec<N> t = cross(q, a);
    for (auto& x : t.c) x = 2.0 * x;
    return a + w * t + cross(q, t);
}

void inverse3(const double* A, double* R) {  // rows of R: cofactors of the columns of A
    double c[9] = {A[4] * A[8] - A[7] * A[5], A[7] * A[2] - A[1] * A[8], A[1] * A[5] - A[4] * A[2],
                   A[5] * A[6] - A[8] * A[3], A[8] * A[0] - A[2] * A[6], A[2] * A[3] - A[5] * A[0],
                   A[3] * A[7] - A[6] * A[4], A[6] * A[1] - A[0] * A[7], A[0] * A[4] - A[3] * A[1]};
    double det = A[0] * c[0] + A[3] * c[1] + A[6] * c[2];
    for (int i = 0; i < 9; i++) R[i] = c[i] / det;
}

}  // namespace

extern "C" {
struct March {
    int64_t batch, steps, tangents, load_tangents, tendons, outputs, newton, reverse, own_grid;
    const double *K_se, *K_bt, *K_se_inverse, *K_bt_inverse;  // 9 each
    const double* h;                                          // (S), or (B, S) with own_grid, which also puts B first in
    const double *y0, *dy0;                                   // (B, 13), (B, 13, n)
    const double *local, *dlocal;                             // (B, S, 3, 6) = [G, G2], (B, S, 3, 6, load_tangents)
    const double *Gm, *Wn, *Wm;                               // (B, S, 3, 3) or null
    const double* u_star;                                     // u_star, L, dr and at
    const double *L, *dr, *tau;                               // (S, 3, T, 18), (S, 3, T, 3), (B, S, 3, T) or null
    const int64_t* at;                                        // (P) nodes to be kept
    double *out, *dout;                                       // (B, P, 13), (B, P, 13, n)
};
}

namespace {

// One stage's knowns for one sample.
template <int N> struct Stage {
    bool loaded;
    Vec<N> G, G2;
    const double *Gm, *Wn, *Wm, *u_star, *L, *dr, *tau;
};

// tendons.py, balanced_strains: Newton on the values; the tangents of the last step are inverse * dw.
template <int N> void balanced_strains(const March& m, const Stage<N>& at, const Vec<N>& Nf, const Vec<N>& Mf, Vec<N>& v, Vec<N>& u) {
    double w[6], x[6] = {0, 0, 1, at.u_star[0], at.u_star[1], at.u_star[2]}, inverse[36];
    const double star[6] = {x[0], x[1], x[2], x[3], x[4], x[5]};
    for (int i = 0; i < 3; i++) w[i] = Nf.c[i].v, w[3 + i] = Mf.c[i].v;
    for (int iteration = 0; iteration <= m.newton; iteration++) {
        double misfit[6], J[36] = {};
        for (int i = 0; i < 3; i++) {
            misfit[i] = w[i], misfit[3 + i] = w[3 + i];
            for (int j = 0; j < 3; j++) {
                misfit[i] -= m.K_se[3 * i + j] * (x[j] - star[j]);
                misfit[3 + i] -= m.K_bt[3 * i + j] * (x[3 + j] - star[3 + j]);
                J[6 * i + j] = m.K_se[3 * i + j], J[6 * (3 + i) + 3 + j] = m.K_bt[3 * i + j];
            }
        }
        for (int t = 0; t < m.tendons; t++) {
            const double* L = at.L + 18 * t;
            double along[3], g[6] = {}, square = 0;
            for (int i = 0; i < 3; i++) {
                along[i] = at.dr[3 * t + i];
                for (int j = 0; j < 6; j++) along[i] += L[6 * i + j] * x[j];
                square += along[i] * along[i];
            }
            double stretch = std::sqrt(square);
            for (int i = 0; i < 3; i++)
                for (int j = 0; j < 6; j++) g[j] += L[6 * i + j] * (along[i] / stretch);
            for (int j = 0; j < 6; j++) misfit[j] -= at.tau[t] * g[j];
            if (iteration == m.newton) continue;
            for (int i = 0; i < 6; i++)
                for (int j = 0; j < 6; j++) {
                    double LtL = L[i] * L[j] + L[6 + i] * L[6 + j] + L[12 + i] * L[12 + j];
                    J[6 * i + j] += at.tau[t] / stretch * (LtL - g[i] * g[j]);
                }
        }
        if (iteration < m.newton) {  // by blocks [[A, B], [B^T, C]] with the Schur complement of A
            double A[9], B[9], S[9], Ainv[9], AinvB[9], D[9], E[9];
            for (int i = 0; i < 3; i++)
                for (int j = 0; j < 3; j++) A[3 * i + j] = J[6 * i + j], B[3 * i + j] = J[6 * i + 3 + j], S[3 * i + j] = J[6 * (3 + i) + 3 + j];
            inverse3(A, Ainv);
            auto product = [](const double* P, const double* Q, double* R) {
                for (int i = 0; i < 3; i++)
                    for (int j = 0; j < 3; j++) R[3 * i + j] = P[3 * i] * Q[j] + P[3 * i + 1] * Q[3 + j] + P[3 * i + 2] * Q[6 + j];
            };
            product(Ainv, B, AinvB);
            for (int i = 0; i < 3; i++)
                for (int j = 0; j < 3; j++)
                    for (int k = 0; k < 3; k++) S[3 * i + j] -= B[3 * k + i] * AinvB[3 * k + j];
            inverse3(S, D);
            product(AinvB, D, E);
            for (int i = 0; i < 3; i++)
                for (int j = 0; j < 3; j++) {
                    double top = Ainv[3 * i + j];
                    for (int k = 0; k < 3; k++) top += E[3 * i + k] * AinvB[3 * j + k];
                    inverse[6 * i + j] = top;
                    inverse[6 * i + 3 + j] = inverse[6 * (3 + j) + i] = -E[3 * i + j];
                    inverse[6 * (3 + i) + 3 + j] = D[3 * i + j];
                }
        }
        double step[6];
        for (int i = 0; i < 6; i++) {
            step[i] = 0;
            for (int j = 0; j < 6; j++) step[i] += inverse[6 * i + j] * misfit[j];
        }
        for (int i = 0; i < 6; i++) x[i] += step[i];
    }
    for (int i = 0; i < 6; i++) {
        typename Dual<N>::Lanes d{};
        for (int j = 0; j < 3; j++) d += inverse[6 * i + j] * Nf.c[j].d + inverse[6 * i + 3 + j] * Mf.c[j].d;
        (i < 3 ? v.c[i] : u.c[i - 3]) = {x[i], d};
    }
}

// step.py, derivative: (1)-(4).
template <int N> void derivative(const March& m, const Dual<N>* y, const Stage<N>& at, Dual<N>* dy) {
    const Vec<N> q{y[3], y[4], y[5]}, N_tilde{y[7], y[8], y[9]}, M_tilde{y[10], y[11], y[12]};
    const Dual<N>& w = y[6];
    Vec<N> force = N_tilde, moment = M_tilde, v, u;
    if (at.loaded) {
        force = force - at.G;
        moment.c[0] = moment.c[0] - at.G2.c[1];  // e3 x G2 = (-G2_y, G2_x, 0)
        moment.c[1] = moment.c[1] + at.G2.c[0];
    }
    if (at.Gm) moment = moment - known<N>(at.Gm);
    Vec<N> back{-q.c[0], -q.c[1], -q.c[2]};
    if (at.Wn) force = force + turned(back, w, known<N>(at.Wn));
    Vec<N> dead;
    if (at.Wm) dead = turned(back, w, known<N>(at.Wm)), moment = moment + dead;
    if (at.tau) {
        balanced_strains(m, at, force, moment, v, u);
    } else {
        v = matvec(m.K_se_inverse, force);
        v.c[2].v += 1.0;
        u = matvec(m.K_bt_inverse, moment) + known<N>(at.u_star);
    }
    Vec<N> couple = cross(v, force), force_turning = N_tilde, moment_turning = moment;
    if (at.loaded) {
        force_turning = N_tilde - at.G;
        couple.c[0] = couple.c[0] - at.G.c[1];
        couple.c[1] = couple.c[1] + at.G.c[0];
    }
    if (at.Wm) moment_turning = moment - dead;
    Vec<N> p_rate = turned(q, w, v), q_rate = w * u + cross(q, u);
    Dual<N> w_rate = q.c[0] * u.c[0] + q.c[1] * u.c[1] + q.c[2] * u.c[2];
    Vec<N> N_rate = -cross(u, force_turning), M_rate = -cross(u, moment_turning) - couple;
    for (int i = 0; i < 3; i++) dy[i] = p_rate.c[i], dy[3 + i] = 0.5 * q_rate.c[i], dy[7 + i] = N_rate.c[i], dy[10 + i] = M_rate.c[i];
    dy[6] = -0.5 * w_rate;
}

template <int N> Stage<N> stage_of(const March& m, int64_t b, int64_t i, int k, int64_t first, int64_t lanes) {
    Stage<N> s;
    int64_t own = (b * m.steps + i) * 3 + k, shared = m.own_grid ? own : i * 3 + k;
    s.loaded = m.local != nullptr;
    if (s.loaded) {
        const double *value = m.local + own * 6, *slope = m.dlocal + own * 6 * m.load_tangents;
        int64_t n = m.load_tangents - first < lanes ? m.load_tangents - first : lanes;
        for (int c = 0; c < 6; c++) {
            Dual<N> x = constant<N>(value[c]);
            for (int64_t j = 0; j < n; j++) x.d[j] = slope[c * m.load_tangents + first + j];
            (c < 3 ? s.G.c[c] : s.G2.c[c - 3]) = x;
        }
    }
    s.Gm = m.Gm ? m.Gm + own * 3 : nullptr;
    s.Wn = m.Wn ? m.Wn + own * 3 : nullptr;
    s.Wm = m.Wm ? m.Wm + own * 3 : nullptr;
    s.u_star = m.u_star + shared * 3;
    s.L = m.tau ? m.L + shared * m.tendons * 18 : nullptr;
    s.dr = m.tau ? m.dr + shared * m.tendons * 3 : nullptr;
    s.tau = m.tau ? m.tau + own * m.tendons : nullptr;
    return s;
}

// step.py, rk4_step.
template <int N> void rk4_step(const March& m, Dual<N>* y, const Stage<N>* at, double h) {
    Dual<N> k1[13], k2[13], k3[13], k4[13], z[13];
    derivative(m, y, at[0], k1);
    for (int i = 0; i < 13; i++) z[i] = y[i] + (0.5 * h) * k1[i];
    derivative(m, z, at[1], k2);
    for (int i = 0; i < 13; i++) z[i] = y[i] + (0.5 * h) * k2[i];
    derivative(m, z, at[1], k3);
    for (int i = 0; i < 13; i++) z[i] = y[i] + h * k3[i];
    derivative(m, z, at[2], k4);
    for (int i = 0; i < 13; i++) y[i] = y[i] + (h / 6) * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
    Dual<N> square = y[3] * y[3] + y[4] * y[4] + y[5] * y[5] + y[6] * y[6];
    double size = std::sqrt(square.v);
    Dual<N> inverse{1.0 / size, (-0.5 / (size * square.v)) * square.d};
    for (int i = 3; i < 7; i++) y[i] = inverse * y[i];
}

// One sample, the tangents first .. first + lanes - 1.
template <int N> void march_sample(const March& m, int64_t b, int64_t first, int64_t lanes) {
    Dual<N> y[13];
    for (int c = 0; c < 13; c++) {
        y[c] = constant<N>(m.y0[b * 13 + c]);
        for (int64_t j = 0; j < lanes; j++) y[c].d[j] = m.dy0[(b * 13 + c) * m.tangents + first + j];
    }
    auto keep = [&](int64_t node) {
        for (int64_t p = 0; p < m.outputs; p++) {
            if (m.at[(m.own_grid ? b * m.outputs : 0) + p] != node) continue;
            for (int c = 0; c < 13; c++) {
                int64_t to = (b * m.outputs + p) * 13 + c;
                m.out[to] = y[c].v;
                for (int64_t j = 0; j < lanes; j++) m.dout[to * m.tangents + first + j] = y[c].d[j];
            }
        }
    };
    Stage<N> at[3];
    keep(m.reverse ? m.steps : 0);
    for (int64_t n = 0; n < m.steps; n++) {
        int64_t i = m.reverse ? m.steps - 1 - n : n;
        for (int k = 0; k < 3; k++) at[k] = stage_of<N>(m, b, i, m.reverse ? 2 - k : k, first, lanes);
        double h = m.h[(m.own_grid ? b * m.steps : 0) + i];
        rk4_step(m, y, at, m.reverse ? -h : h);
        keep(m.reverse ? i : i + 1);
    }
}

void march_some(const March& m, int64_t from, int64_t to) {
    for (int64_t b = from; b < to; b++) {
        if (m.tangents == 0) march_sample<1>(m, b, 0, 0);
        for (int64_t first = 0; first < m.tangents;) {
            int64_t left = m.tangents - first;
            if (left > 8) {
                march_sample<16>(m, b, first, left < 16 ? left : 16);
                first += 16;
            } else {
                march_sample<8>(m, b, first, left);
                first += 8;
            }
        }
    }
}

}  // namespace

extern "C" void torchrod_march(const March* m, int64_t threads) {
    if (threads > m->batch) threads = m->batch;
    if (threads <= 1) return march_some(*m, 0, m->batch);
    std::vector<std::thread> pool;
    for (int64_t t = 0; t < threads; t++)
        pool.emplace_back(march_some, std::cref(*m), m->batch * t / threads, m->batch * (t + 1) / threads);
    for (auto& thread : pool) thread.join();
}
