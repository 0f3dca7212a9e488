// The filter from its first iteration to its last, and what is kept of it.
#pragma once

#include "filter.h"

// The normal equations of samples: markers' and tip's A (B, 2, n, n), g (B, 2, n), cost (B, 2); r (B, Z), line (B, P, 3).
struct Sums {
    double *A, *g, *cost, *r, *line;
};

inline void keep(const Fit& f, int64_t b, int64_t lane, const Measured& m, const Normal& N, const Sums& out) {
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
inline void iterate(const Fit& f, const Filter& filter, const Sums& out, const Lanes& lanes, Room& room, std::vector<V>& numbers) {
    const int64_t n = f.size;
    const Measured m = measure(f, lanes, [&](int64_t j) { return fetch({filter.x, n}, lanes, j); }, true, room);
    numbers.resize(6 * n * n + 7 * n);
    const Normal N = normal_equations(f, lanes, m, numbers.data());
    advance(filter, lanes, n, N, numbers.data() + 2 * n * n + 2 * n);
    for (int64_t l = 0; l < lanes.count; l++)
        if (filter.done[lanes.sample[l]]) keep(f, lanes.sample[l], l, m, N, out);
}

// Iterations until every sample has converged or has had `most`: by the coarse model until it is near, then by the fine one.
// estimator.py, _Course.step_by_step. near (B): in and out; converged, iterations (B): out.
struct Course {
    const Fit *coarse, *fine;
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
