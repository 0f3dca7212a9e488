// The filter: one iteration for the samples in the lanes, the compiled copy of `advance` in torchrod/estimation/filter.py, to which
// tests/test_fit.py holds it; and the loop from the first iteration to the last.
#pragma once

#include "sensors.h"

// Cholesky of A scaled to unit diagonal, L L^T: `solve_spd`. NaN where A is not positive definite.
struct Factor {
    int64_t n;
    V *L, *scale;  // lower triangle with 1 / L_jj on its diagonal; 1 / sqrt of A's diagonal
    Factor(int64_t n, const V* A, V* room) : n(n), L(room), scale(room + n * n) {
        for (int64_t i = 0; i < n; i++) scale[i] = 1.0 / root(A[i * n + i]);
        for (int64_t j = 0; j < n; j++) {
            V pivot = splat(1.0);
            for (int64_t k = 0; k < j; k++) pivot -= L[j * n + k] * L[j * n + k];
            const V inverse = 1.0 / root(select(pivot > 0, pivot, splat(std::numeric_limits<double>::quiet_NaN())));
            L[j * n + j] = inverse;
            for (int64_t i = j + 1; i < n; i++) {
                V sum = scale[i] * A[i * n + j] * scale[j];
                for (int64_t k = 0; k < j; k++) sum -= L[i * n + k] * L[j * n + k];
                L[i * n + j] = sum * inverse;
            }
        }
    }
    // g^T A^-1 g, by one substitution.
    V square(const V* g, V* middle) const {
        V sum = V{};
        for (int64_t i = 0; i < n; i++) {
            V next = scale[i] * g[i];
            for (int64_t k = 0; k < i; k++) next -= L[i * n + k] * middle[k];
            middle[i] = next * L[i * n + i];
            sum += middle[i] * middle[i];
        }
        return sum;
    }
};

// A^-1 through the factor's inverse, which takes its place.
struct Inverse : Factor {
    Inverse(int64_t n, const V* A, V* room) : Factor(n, A, room) {
        for (int64_t j = 0; j < n; j++)  // column by column
            for (int64_t i = j + 1; i < n; i++) {
                V sum = V{};
                for (int64_t k = j; k < i; k++) sum -= L[i * n + k] * L[k * n + j];
                L[i * n + j] = sum * L[i * n + i];
            }
    }
    void times(const V* b, V* x, V* middle) const {
        for (int64_t i = 0; i < n; i++) {
            middle[i] = V{};
            for (int64_t k = 0; k <= i; k++) middle[i] += L[i * n + k] * (scale[k] * b[k]);
        }
        for (int64_t i = 0; i < n; i++) {
            V sum = V{};
            for (int64_t k = i; k < n; k++) sum += L[k * n + i] * middle[k];
            x[i] = scale[i] * sum;
        }
    }
    void whole(V* out) const {  // A^-1, both triangles
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j <= i; j++) {
                V sum = V{};
                for (int64_t k = i; k < n; k++) sum += L[k * n + i] * L[k * n + j];
                out[i * n + j] = out[j * n + i] = scale[i] * scale[j] * sum;
            }
    }
};

// `TipCondition` of estimation/filter.py: c = 0 to first order, solved for the base wrench, the last PLAIN entries of x.
struct TipCondition {
    int64_t n, m;   // entries of x; of y, all but the base wrench
    V *T, *d, *U;   // (PLAIN, m), (PLAIN), and A_alpha,alpha T - A_alpha,y (PLAIN, m) of the last matrix that was reduced
    static int64_t size(int64_t n) { return 2 * PLAIN * (n - PLAIN) + PLAIN; }

    explicit TipCondition(int64_t n) : n(n), m(n - PLAIN), T(), d(), U() {}
    // From C = dc/dx and r = -c by c(k, j), j = n for r: Householder's reflections of C_alpha.
    template <class Entry> TipCondition(int64_t n, Entry c, V* numbers) : n(n), m(n - PLAIN), T(numbers), d(T + PLAIN * m), U(d + PLAIN) {
        V a[PLAIN][PLAIN];
        auto right = [&](int64_t k, int64_t j) -> V& { return j < m ? T[k * m + j] : d[k]; };
        for (int64_t k = 0; k < PLAIN; k++) {
            for (int64_t l = 0; l < PLAIN; l++) a[k][l] = c(k, m + l);
            for (int64_t j = 0; j <= m; j++) right(k, j) = c(k, j < m ? j : n);
        }
        for (int64_t k = 0; k < PLAIN; k++) {
            V square = V{};
            for (int64_t i = k; i < PLAIN; i++) square += a[i][k] * a[i][k];
            const V length = root(square), end = select(a[k][k] > 0, -length, length), beta = 1.0 / (square - end * a[k][k]);
            a[k][k] -= end;
            auto reflect = [&](auto entry) {
                V sum = V{};
                for (int64_t i = k; i < PLAIN; i++) sum += a[i][k] * entry(i);
                for (int64_t i = k; i < PLAIN; i++) entry(i) -= beta * sum * a[i][k];
            };
            for (int64_t l = k + 1; l < PLAIN; l++) reflect([&](int64_t i) -> V& { return a[i][l]; });
            for (int64_t j = 0; j <= m; j++) reflect([&](int64_t i) -> V& { return right(i, j); });
            a[k][k] = end;
        }
        for (int64_t j = 0; j <= m; j++)
            for (int64_t k = PLAIN - 1; k >= 0; k--) {
                V sum = right(k, j);
                for (int64_t l = k + 1; l < PLAIN; l++) sum -= a[k][l] * right(l, j);
                right(k, j) = sum / a[k][k];
            }
    }
    // (8): information (lower triangle) and gradient of y.
    void reduce(const V* A, const V* g, V* A_y, V* g_y) const {
        auto alpha = [&](int64_t k, int64_t l) { return A[(m + (k < l ? l : k)) * n + m + (k < l ? k : l)]; };
        for (int64_t i = 0; i < m; i++) {
            V sum = g[i];
            for (int64_t k = 0; k < PLAIN; k++) {
                V u = -A[(m + k) * n + i];
                for (int64_t l = 0; l < PLAIN; l++) u += alpha(k, l) * T[l * m + i];
                U[k * m + i] = u;
                sum += u * d[k] - T[k * m + i] * g[m + k];
            }
            g_y[i] = sum;
        }
        for (int64_t i = 0; i < m; i++)
            for (int64_t j = 0; j <= i; j++) {
                V sum = A[i * n + j];
                for (int64_t k = 0; k < PLAIN; k++) sum += T[k * m + i] * U[k * m + j] - A[(m + k) * n + i] * T[k * m + j];
                A_y[i * m + j] = sum;
            }
    }
    // The step dx, and dx^T A dx; A_y, g_y: room.
    template <class F> V solve(const V* A, const V* g, V* A_y, V* g_y, V* factor, V* middle, V* step, F keep) const {
        reduce(A, g, A_y, g_y);
        const Inverse inverse(m, A_y, factor);
        inverse.times(g_y, step, middle);
        for (int64_t k = 0; k < PLAIN; k++) {
            V sum = d[k];
            for (int64_t j = 0; j < m; j++) sum -= T[k * m + j] * step[j];
            step[m + k] = sum;
        }
        keep(inverse);
        V sum = V{};
        for (int64_t i = 0; i < n; i++) {
            V half = 0.5 * A[i * n + i] * step[i];
            for (int64_t j = 0; j < i; j++) half += A[i * n + j] * step[j];
            sum += 2.0 * step[i] * half;
        }
        return sum;
    }
    // Z C Z^T (n, n), both triangles, from (Z^T A Z)^-1; C (m, m): room.
    void spread(const Inverse& inverse, V* C, V* out) const {
        inverse.whole(C);
        for (int64_t k = 0; k < PLAIN; k++)
            for (int64_t j = 0; j < m; j++) {
                V sum = V{};
                for (int64_t i = 0; i < m; i++) sum -= T[k * m + i] * C[i * m + j];
                out[(m + k) * n + j] = out[j * n + m + k] = sum;
            }
        for (int64_t k = 0; k < PLAIN; k++)
            for (int64_t l = 0; l <= k; l++) {
                V sum = V{};
                for (int64_t j = 0; j < m; j++) sum -= out[(m + k) * n + j] * T[l * m + j];
                out[(m + k) * n + m + l] = out[(m + l) * n + m + k] = sum;
            }
        for (int64_t i = 0; i < m; i++)
            for (int64_t j = 0; j < m; j++) out[i * n + j] = C[i * m + j];
    }
};

struct Filter {
    Table mean, precision;  // of the prior: (n), or a row per sample
    const double* Q;        // (n)
    double step, decrement, share, settled, gain;  // Limits of estimation/filter.py
    int64_t exact;
    // In and out, (B, n), (B, n, n), (B, n), (B), (B), (B); then out: (B) whether converged.
    double *x, *Sigma, *before, *cap, *reach;
    const double* Sigma0;  // (B, n, n)
    uint8_t* done;
};

constexpr double TURN = 0.1;  // of estimation/filter.py

// Room that `advance` needs.
inline int64_t room_of_advance(int64_t n) { return 5 * n * n + 8 * n + TipCondition::size(n); }

// The numbers of `advance` for the lanes.
inline void advance(const Filter& f, const Lanes& lanes, int64_t n, const Measured& m, const Normal& N, V* room) {
    V *A = room, *Lambda = A + n * n, *Sigma = Lambda + n * n, *factor = Sigma + n * n, *reduced = factor + n * n + n;
    V *g = reduced + n * n, *x = g + n, *step = x + n, *middle = step + n, *precision = middle + n, *pull = precision + n, *g_y = pull + n;
    const bool exact = f.exact;
    auto entry = [&](const double* data, int64_t k, int64_t stride) { return fetch({data, stride}, lanes, k); };
    V cost = exact ? N.cost[0] : N.cost[0] + N.cost[1];
    for (int64_t i = 0; i < n; i++) {
        x[i] = entry(f.x, i, n);
        precision[i] = fetch(f.precision, lanes, i);
        const V off = fetch(f.mean, lanes, i) - x[i];
        pull[i] = precision[i] * off;
        cost += pull[i] * off;
    }
    Mask sound = finite(cost);
    // Information and gradient with the markers' part multiplied by `share`.
    auto whole = [&](V share) {
        for (int64_t i = 0; i < n; i++) {
            g[i] = share * N.g[0][i] + pull[i];
            if (!exact) g[i] += N.g[1][i];
            for (int64_t j = 0; j <= i; j++) {
                const int64_t k = i * n + j;
                A[k] = share * N.A[0][k] + (i == j ? precision[i] : V{});
                if (!exact) A[k] += N.A[1][k];
            }
        }
    };
    whole(splat(1.0));
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j <= i; j++) sound &= finite(A[i * n + j]) & finite(N.A[1][i * n + j]);
    const auto condition = [&](int64_t k, int64_t j) { return j < n ? m.H(m.tip + k)[j] : m.h(m.tip + k); };
    const TipCondition tip = exact ? TipCondition(n, condition, g_y + n) : TipCondition(n);
    const auto nothing = [](const Inverse&) {};
    const V decrement = exact ? tip.solve(A, g, reduced, g_y, factor, middle, step, nothing) : Factor(n, A, factor).square(g, middle);
    const Mask done = (decrement < larger(f.share * cost, splat(f.decrement))) & sound;

    // Residual-adaptive noise: `inflation` and `adapted_weights`.
    const V promised = select(decrement == decrement, decrement, V{}) / larger(N.seen, splat(1.0));
    const V cap = entry(f.cap, 0, 1), inflated = smaller(promised, cap);
    whole(1.0 / (1.0 + inflated));
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j <= i; j++) Sigma[i * n + j] = entry(f.Sigma, i * n + j, n * n) + (i == j ? splat(f.Q[i]) : V{});
    Inverse(n, Sigma, factor).whole(Lambda);
    for (int64_t k = 0; k < n * n; k++)
        if (k % n <= k / n) Lambda[k] += A[k];
    V gain = V{};
    if (exact) {
        gain = tip.solve(Lambda, g, reduced, g_y, factor, middle, step, [&](const Inverse& inverse) { tip.spread(inverse, reduced, Sigma); });
    } else {
        const Inverse final(n, Lambda, factor);
        final.times(g, step, middle);
        final.whole(Sigma);
        for (int64_t i = 0; i < n; i++) gain += g[i] * step[i];
    }
    Mask fresh = sound;
    for (int64_t k = 0; k < n * n; k++) fresh &= finite(Sigma[k]);
    V largest = splat(1e-300), came = V{};  // the largest entry's size, and what it did last, counted along what it does now
    for (int64_t i = 0; i < n; i++) {
        step[i] = select(finite(step[i]), step[i], V{});
        const V size = larger(step[i], -step[i]), last = x[i] - entry(f.before, i, n);
        came = select(size > largest, select(step[i] > 0, last, -last), came);
        largest = larger(largest, size);
    }
    const V could = entry(f.reach, 0, 1), turns = -came - TURN * smaller(largest, f.step * could);
    const V reach = select(turns > 0, 0.5 * could, smaller(1.2 * could, splat(1.0)));  // `reached`
    const V shorten = smaller(f.step * reach / largest, splat(1.0));
    for (int64_t l = 0; l < lanes.count; l++) {
        const int64_t b = lanes.sample[l];
        f.done[b] = done[l] != 0 || (sound[l] && gain[l] < f.gain);
        if (gain[l] < f.settled) f.cap[b] = 0.1 * inflated[l];
        f.reach[b] = reach[l];
        for (int64_t i = 0; i < n; i++) {
            const double was = x[i][l], half = 0.5 * (was + f.before[b * n + i]);
            if (sound[l]) f.before[b * n + i] = was;
            f.x[b * n + i] = sound[l] ? was + step[i][l] * shorten[l] : half;
        }
        for (int64_t k = 0; k < n * n; k++) f.Sigma[b * n * n + k] = fresh[l] ? Sigma[k][l] : f.Sigma0[b * n * n + k];
    }
}

// The normal equations of samples: markers' and tip's A (B, 2, n, n), g (B, 2, n), cost (B, 2); dc/dx C (B, 6, n); r (B, Z), line (B, P, 3).
struct Sums {
    double *A, *g, *cost, *C, *r, *line;
};

inline void keep(const Task& f, int64_t b, int64_t lane, const Measured& m, const Normal& N, const Sums& out) {
    const int64_t n = f.size, P = f.known.outputs - 1, Z = 3 * P + PLAIN;
    for (int64_t part = 0; part < 2; part++) {
        out.cost[2 * b + part] = N.cost[part][lane];
        for (int64_t i = 0; i < n; i++) {
            out.g[(2 * b + part) * n + i] = N.g[part][i][lane];
            for (int64_t j = 0; j < n; j++) out.A[((2 * b + part) * n + i) * n + j] = N.A[part][i < j ? j * n + i : i * n + j][lane];
        }
    }
    for (int64_t k = 0; k < PLAIN * n; k++) out.C[b * PLAIN * n + k] = m.H(m.tip + k / n)[k % n][lane];
    for (int64_t z = 0; z < Z; z++) out.r[b * Z + z] = m.h(z)[lane];
    for (int64_t k = 0; k < 3 * P; k++) out.line[b * 3 * P + k] = m.line[k][lane];
}

// One iteration of the filter for the samples in the lanes, in place; the sums of those that are done.
inline void iterate(const Task& f, const Filter& filter, const Sums& out, const Lanes& lanes, Room& room, std::vector<V>& numbers) {
    const int64_t n = f.size;
    const Measured m = measure(f, lanes, [&](int64_t j) { return fetch({filter.x, n}, lanes, j); }, true, room);
    numbers.resize(2 * n * n + 2 * n + room_of_advance(n));
    const Normal N = normal_equations(f, lanes, m, numbers.data());
    advance(filter, lanes, n, m, N, numbers.data() + 2 * n * n + 2 * n);
    for (int64_t l = 0; l < lanes.count; l++)
        if (filter.done[lanes.sample[l]]) keep(f, lanes.sample[l], l, m, N, out);
}

// Iterations until every sample has converged or has had `most`: by the coarse model until it is near, then by the fine one.
// near (B): in and out; converged, iterations (B): out.
struct Course {
    const Task *coarse, *fine;
    const Filter *rough, *filter;
    const Sums* out;
    int64_t most;
    uint8_t *near, *converged;
    int64_t* iterations;
};

// The share of one thread: it takes further samples when what it has does not fill its lanes.
template <class Take> void run(const Course& c, const int64_t* index, Take take) {
    std::vector<int64_t> queue[2];  // far, near
    static thread_local Room room;  // its memory serves the next call, too
    static thread_local std::vector<V> numbers;
    for (;;) {
        for (int64_t i, end; queue[0].size() < W && queue[1].size() < W && take(i, end);)
            for (; i < end; i++) queue[c.near[index[i]] != 0].push_back(index[i]);
        const bool fine = queue[0].empty() || queue[1].size() >= W;
        auto& from = queue[fine];
        if (from.empty()) return;
        Lanes lanes;
        lanes.count = from.size() < W ? from.size() : W;
        for (int64_t l = 0; l < lanes.count; l++) lanes.sample[l] = from.back(), from.pop_back();
        for (int64_t l = lanes.count; l < W; l++) lanes.sample[l] = lanes.sample[0];
        const Filter& filter = fine ? *c.filter : *c.rough;
        iterate(fine ? *c.fine : *c.coarse, filter, *c.out, lanes, room, numbers);
        for (int64_t l = 0; l < lanes.count; l++) {
            const int64_t b = lanes.sample[l], had = c.iterations[b]++;
            if (fine && filter.done[b]) c.converged[b] = 1;
            else if (had + 1 < c.most) {
                if (!fine) c.near[b] = filter.done[b] || 2 * had >= c.most;
                queue[c.near[b] != 0].push_back(b);
            }
        }
    }
}
