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

struct Filter {
    Table mean, precision;  // of the prior: (n), or a row per sample
    const double* Q;        // (n)
    double step, decrement, share, settled, gain;  // Limits of estimation/filter.py
    // In and out, (B, n), (B, n, n), (B, n), (B), (B); then out: (B) whether converged.
    double *x, *Sigma, *before, *cap;
    const double* Sigma0;  // (B, n, n)
    uint8_t* done;
};

// The numbers of `advance` for the lanes: room of 4 n^2 + 7 n.
inline void advance(const Filter& f, const Lanes& lanes, int64_t n, const Normal& N, V* room) {
    V *A = room, *Lambda = A + n * n, *Sigma = Lambda + n * n, *factor = Sigma + n * n;
    V *g = factor + n * n + n, *x = g + n, *step = x + n, *middle = step + n, *precision = middle + n, *pull = precision + n;
    auto entry = [&](const double* data, int64_t k, int64_t stride) { return fetch({data, stride}, lanes, k); };
    V cost = N.cost[0] + N.cost[1];
    for (int64_t i = 0; i < n; i++) {
        x[i] = entry(f.x, i, n);
        precision[i] = fetch(f.precision, lanes, i);
        const V off = fetch(f.mean, lanes, i) - x[i];
        pull[i] = precision[i] * off;
        cost += pull[i] * off;
        g[i] = N.g[0][i] + N.g[1][i] + pull[i];
    }
    Mask sound = finite(cost);
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j <= i; j++) {
            const int64_t k = i * n + j;
            A[k] = N.A[0][k] + N.A[1][k] + (i == j ? precision[i] : V{});
            sound &= finite(A[k]);
        }
    const V decrement = Factor(n, A, factor).square(g, middle);
    const Mask done = (decrement < larger(f.share * cost, splat(f.decrement))) & sound;

    // Residual-adaptive noise: `inflation` and `adapted_weights`.
    const V promised = select(decrement == decrement, decrement, V{}) / larger(N.seen, splat(1.0));
    const V cap = entry(f.cap, 0, 1), inflated = smaller(promised, cap), share = 1.0 / (1.0 + inflated);
    for (int64_t i = 0; i < n; i++) {
        g[i] = share * N.g[0][i] + N.g[1][i] + pull[i];
        for (int64_t j = 0; j <= i; j++) {
            const int64_t k = i * n + j;
            A[k] = share * N.A[0][k] + N.A[1][k] + (i == j ? precision[i] : V{});
            Sigma[k] = entry(f.Sigma, k, n * n) + (i == j ? splat(f.Q[i]) : V{});
        }
    }
    Inverse(n, Sigma, factor).whole(Lambda);
    for (int64_t k = 0; k < n * n; k++)
        if (k % n <= k / n) Lambda[k] += A[k];
    const Inverse final(n, Lambda, factor);
    final.times(g, step, middle);
    final.whole(Sigma);
    Mask fresh = sound;
    for (int64_t k = 0; k < n * n; k++) fresh &= finite(Sigma[k]);
    V gain = V{}, largest = splat(1e-300);
    for (int64_t i = 0; i < n; i++) {
        gain += g[i] * step[i];
        step[i] = select(finite(step[i]), step[i], V{});
        largest = larger(largest, larger(step[i], -step[i]));
    }
    const V shorten = smaller(f.step / largest, splat(1.0));
    for (int64_t l = 0; l < lanes.count; l++) {
        const int64_t b = lanes.sample[l];
        f.done[b] = done[l] != 0 || (sound[l] && gain[l] < f.gain);
        if (gain[l] < f.settled) f.cap[b] = 0.1 * inflated[l];
        for (int64_t i = 0; i < n; i++) {
            const double was = x[i][l], half = 0.5 * (was + f.before[b * n + i]);
            if (sound[l]) f.before[b * n + i] = was;
            f.x[b * n + i] = sound[l] ? was + step[i][l] * shorten[l] : half;
        }
        for (int64_t k = 0; k < n * n; k++) f.Sigma[b * n * n + k] = fresh[l] ? Sigma[k][l] : f.Sigma0[b * n * n + k];
    }
}

// The normal equations of samples: markers' and tip's A (B, 2, n, n), g (B, 2, n), cost (B, 2); r (B, Z), line (B, P, 3).
struct Sums {
    double *A, *g, *cost, *r, *line;
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
    for (int64_t z = 0; z < Z; z++) out.r[b * Z + z] = m.h(z)[lane];
    for (int64_t k = 0; k < 3 * P; k++) out.line[b * 3 * P + k] = m.line[k][lane];
}

// One iteration of the filter for the samples in the lanes, in place; the sums of those that are done.
inline void iterate(const Task& f, const Filter& filter, const Sums& out, const Lanes& lanes, Room& room, std::vector<V>& numbers) {
    const int64_t n = f.size;
    const Measured m = measure(f, lanes, [&](int64_t j) { return fetch({filter.x, n}, lanes, j); }, true, room);
    numbers.resize(6 * n * n + 9 * n);
    const Normal N = normal_equations(f, lanes, m, numbers.data());
    advance(filter, lanes, n, N, numbers.data() + 2 * n * n + 2 * n);
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
