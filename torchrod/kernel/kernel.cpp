// The library's entry points: each shares its samples among threads, in groups of W.

#include "layout.h"
#include "statics.h"
#include "thread_pool.h"

namespace {

// work(lanes, room, numbers) for groups of W samples.
template <class Work> void in_groups(int64_t count, const int64_t* index, int64_t threads, Work work) {
    in_parts((count + W - 1) / W, threads, [&](int64_t from, int64_t to) {
        static thread_local Room room;  // its memory serves the next call, too
        static thread_local std::vector<V> numbers;
        for (int64_t g = from; g < to; g++) {
            Lanes lanes;
            lanes.count = count - g * W < W ? count - g * W : W;
            for (int64_t l = 0; l < W; l++) {
                const int64_t i = g * W + (l < lanes.count ? l : 0);
                lanes.sample[l] = index ? index[i] : i;
            }
            work(lanes, room, numbers);
        }
    });
}

}  // namespace

extern "C" {

void torchrod_march(const March* m, int64_t threads) {
    const Known& known = m->known;
    const int64_t n = m->tangents, g = m->load_tangents, points = 3 * known.steps;
    in_groups(m->batch, nullptr, threads, [&](const Lanes& lanes, Room& room, std::vector<V>&) {
        Group group{&known, lanes, n, g, 0, 0, 0, 0, nullptr, nullptr, nullptr, {}, {}};
        group.stretching = true;  // whoever calls may ask for any tangent
        if (m->local) {
            room.local.resize((points + 1) * (1 + g) * PARTS);
            for (int64_t p = 0; p < points; p++)
                for (int part = 0; part < PARTS; part++) {
                    const int64_t at = p * 6 + part;
                    V* to = room.local.data() + p * (1 + g) * PARTS + part;
                    to[0] = fetch({m->local, points * 6}, lanes, at);
                    for (int64_t j = 0; j < g; j++) to[(1 + j) * PARTS] = fetch({m->dlocal, points * 6 * g}, lanes, at * g + j);
                }
            group.local = room.local.data();
        }
        const int64_t width = known.width();
        V y[MOST_STATE];
        room.tangents.resize(n * width);
        for (int64_t c = 0; c < width; c++) {
            y[c] = fetch({m->y0, width}, lanes, c);
            for (int64_t j = 0; j < n; j++) room.tangents[j * width + c] = fetch({m->dy0, width * n}, lanes, c * n + j);
        }
        walk(group, y, room.tangents.data(), m->reverse, [&](int64_t p, Mask here) {
            for (int64_t l = 0; l < lanes.count; l++) {
                if (!here[l]) continue;
                const int64_t to = (lanes.sample[l] * known.outputs + p) * width;
                for (int64_t c = 0; c < width; c++) {
                    m->out[to + c] = y[c][l];
                    for (int64_t j = 0; j < n; j++) m->dout[(to + c) * n + j] = room.tangents[j * width + c][l];
                }
            }
        });
    });
}

// The normal equations of samples at x (b, n).
void torchrod_normal(const Task* f, const double* x, int64_t count, const Sums* out, int64_t threads) {
    const int64_t n = f->size;
    in_groups(count, nullptr, threads, [&](const Lanes& lanes, Room& room, std::vector<V>& numbers) {
        const Measured m = measure(*f, lanes, [&](int64_t j) { return fetch({x, n}, lanes, j); }, true, room);
        numbers.resize(2 * n * n + 2 * n);
        const Normal N = normal_equations(*f, lanes, m, numbers.data());
        for (int64_t l = 0; l < lanes.count; l++) keep(*f, lanes.sample[l], l, m, N, *out);
    });
}

// h (b, Z) of samples at x (b, n), and with H not null dh/dx (b, Z, n): of the markers or, where `states` is not 0, of the sections.
void torchrod_measure(const Task* f, const double* x, int64_t count, int64_t states, double* h, double* H, int64_t threads) {
    const int64_t n = f->size, Z = rows_of(*f, states);
    in_groups(count, nullptr, threads, [&](const Lanes& lanes, Room& room, std::vector<V>&) {
        const Measured m = measure(*f, lanes, [&](int64_t j) { return fetch({x, n}, lanes, j); }, H != nullptr, room, states);
        for (int64_t l = 0; l < lanes.count; l++)
            for (int64_t z = 0; z < Z; z++) {
                const int64_t to = lanes.sample[l] * Z + z;
                h[to] = m.h(z)[l];
                for (int64_t j = 0; H && j < n; j++) H[to * n + j] = m.H(z)[j][l];
            }
    });
}

// From sums at x (b, n), with residuals of `rows` numbers: `Normal.posterior` of estimation/filter.py, covariance (b, n, n) and cost (b).
// mean and precision: of the prior, (n) or a row per sample.
void torchrod_posterior(const Sums* sums, const double* x, const Table* mean, const Table* precision, int64_t n, int64_t rows, int64_t exact,
                        int64_t count, double* covariance, double* cost, int64_t threads) {
    in_groups(count, nullptr, threads, [&](const Lanes& lanes, Room&, std::vector<V>& numbers) {
        numbers.resize(4 * n * n + 5 * n + TipCondition::size(n));
        V *A = numbers.data(), *found = A + n * n, *reduced = found + n * n, *factor = reduced + n * n;
        V *g = factor + n * n + n, *g_y = g + n, *middle = g_y + n, *step = middle + n, *room = step + n;
        V total = fetch({sums->cost, 2}, lanes, 0);
        Mask sound = finite(V{});
        for (int64_t i = 0; i < n; i++) {
            const V P = fetch(*precision, lanes, i), off = fetch(*mean, lanes, i) - fetch({x, n}, lanes, i);
            total += P * off * off;
            g[i] = fetch({sums->g, 2 * n}, lanes, i) + P * off;
            for (int64_t j = 0; j <= i; j++) {
                A[i * n + j] = fetch({sums->A, 2 * n * n}, lanes, i * n + j) + (i == j ? P : V{});
                sound &= finite(A[i * n + j]) & finite(fetch({sums->A, 2 * n * n}, lanes, n * n + i * n + j));
            }
        }
        const auto condition = [&](int64_t k, int64_t j) {
            return j < n ? fetch({sums->C, PLAIN * n}, lanes, k * n + j) : fetch({sums->r, rows}, lanes, rows - PLAIN + k);
        };
        const TipCondition tip(n, condition, room);
        V onward = total + tip.solve(A, g, reduced, g_y, factor, middle, step, [&](const Inverse& inverse) { tip.spread(inverse, reduced, found); });
        for (int64_t i = 0; i < n; i++) onward -= 2.0 * g[i] * step[i];
        if (exact) total = select(finite(onward) & (onward >= 0.0), onward, total);
        else total += fetch({sums->cost, 2}, lanes, 1);
        for (int64_t l = 0; l < lanes.count; l++) {
            const int64_t b = lanes.sample[l];
            cost[b] = total[l];
            for (int64_t k = 0; k < n * n; k++)
                covariance[b * n * n + k] = sound[l] ? found[k][l] : std::numeric_limits<double>::quiet_NaN();
        }
    });
}

// One iteration of the filter for the samples `index`.
void torchrod_iterate(const Task* f, const Filter* filter, const Sums* out, const int64_t* index, int64_t count, int64_t threads) {
    in_groups(count, index, threads,
              [&](const Lanes& lanes, Room& room, std::vector<V>& numbers) { iterate(*f, *filter, *out, lanes, room, numbers); });
}

// Its iterations, all of them, for the samples `index`.
void torchrod_filter(const Course* c, const int64_t* index, int64_t count, int64_t threads) {
    sharing(count, W, threads, [&](auto take) { run(*c, index, take); });
}

// The base wrench (b, 6) in equilibrium with the loads of x (b, n), how far it is from that (b), the centre line (b, P, 3) and the
// base. q_tip (b, 4) or null.
void torchrod_balance(const Task* f, const double* x, const double* q_tip, int64_t increments, int64_t count, double tolerance,
                      double* wrench, double* missed, double* line, int64_t threads) {
    const int64_t n = f->size, numbers_of_line = 3 * f->known.outputs;
    in_groups(count, nullptr, threads, [&](const Lanes& lanes, Room& room, std::vector<V>&) {
        V q[4];
        for (int i = 0; q_tip && i < 4; i++) q[i] = fetch({q_tip, 4}, lanes, i);
        const auto entry = [&](int64_t j) { return fetch({x, n}, lanes, j); };
        const Balanced b = balanced(*f, lanes, entry, q_tip ? q : nullptr, increments, tolerance, room);
        for (int64_t l = 0; l < lanes.count; l++) {
            const int64_t to = lanes.sample[l];
            for (int i = 0; i < PLAIN; i++) wrench[to * PLAIN + i] = b.wrench[i][l];
            for (int64_t k = 0; k < numbers_of_line; k++) line[to * numbers_of_line + k] = b.line[k][l];
            missed[to] = b.missed[l];
        }
    });
}

// A perceptron's output (b, last size) from its input (b, first size).
void torchrod_perceptron(const Perceptron* p, const float* x, int64_t count, float* y, int64_t threads) {
    const int64_t in = p->sizes[0], out = p->sizes[p->depth], block = FLOATS * BLOCK, blocks = (count + block - 1) / block;
    const int64_t widest = *std::max_element(p->sizes, p->sizes + p->depth + 1);
    in_parts(blocks, threads, [&](int64_t from, int64_t to) {
        std::vector<F> numbers(2 * widest * BLOCK);
        for (int64_t first = from * block; first < to * block; first += block) {
            const int64_t here = count - first < block ? count - first : block;
            for (int64_t l = 0; l < block; l++)
                for (int64_t i = 0; i < in; i++)
                    numbers[i * BLOCK + l / FLOATS][l % FLOATS] = x[(first + (l < here ? l : 0)) * in + i];
            const F* found = perceptron(*p, numbers.data(), widest);
            for (int64_t l = 0; l < here; l++)
                for (int64_t o = 0; o < out; o++) y[(first + l) * out + o] = found[o * BLOCK + l / FLOATS][l % FLOATS];
        }
    });
}

// The cost r^T W r at x (b, n) with the prior's.
void torchrod_cost(const Task* f, const double* x, const Table* mean, const Table* precision, int64_t count, double* cost,
                   int64_t threads) {
    const int64_t n = f->size, P = f->known.outputs - 1, Z = 3 * P + PLAIN;
    in_groups(count, nullptr, threads, [&](const Lanes& lanes, Room& room, std::vector<V>&) {
        const auto entry = [&](int64_t j) { return fetch({x, n}, lanes, j); };
        const Measured m = measure(*f, lanes, entry, false, room);
        V sum = V{};
        for (int64_t z = 0; z < Z; z += 3) {
            V w[3], r[3];
            const V square = residual(*f, lanes, m, z, w, r);
            sum += z < 3 * P ? robust_cost(*f, square) : square;
        }
        for (int64_t i = 0; i < n; i++) {
            const V off = fetch(*mean, lanes, i) - entry(i);
            sum += fetch(*precision, lanes, i) * off * off;
        }
        for (int64_t l = 0; l < lanes.count; l++) cost[lanes.sample[l]] = sum[l];
    });
}

int64_t torchrod_lanes() { return W; }

// layout.h, and what each function takes. bindings.py compares the text with its own.
const char* torchrod_layout() {
    static const std::string text = structures_and_constants() + FUNCTION(torchrod_march) + FUNCTION(torchrod_normal) + FUNCTION(torchrod_measure) +
                                    FUNCTION(torchrod_posterior) + FUNCTION(torchrod_iterate) + FUNCTION(torchrod_filter) +
                                    FUNCTION(torchrod_balance) + FUNCTION(torchrod_perceptron) + FUNCTION(torchrod_cost);
    return text.c_str();
}
}
