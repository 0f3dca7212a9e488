// The walk along the rod with a block of tangents, for the W samples of one group: the compiled copy of torchrod/march.py.
#pragma once

#include "section.h"

constexpr int PARTS = 5;  // of a local load: G_x, G_y, G_z, G2_x, G2_y

// One group of samples. Tangents are ordered [loads | tensions | the rest]; only the first two move what is known along the rod.
struct Group {
    const Known* known;
    Lanes lanes;
    int64_t load_tangents, tension_tangents;
    double tension_unit;   // N, of one unit of a tension tangent
    const V* tension;      // (tension_tangents), what the tensions' unknowns add (N)
    const V* local;        // (3 S + 1, 1 + load_tangents, PARTS): the stages of every step, then beyond the tip; or null
    const V* node_moves;   // (S + 1, load_tangents): how the nodes move; null where they do not
    Table weight;          // (3) N/m, the slope -dWn/ds where nodes move
    Table active;          // (S, 3, T), 1 where a tendon pulls; unless tensions are free there is none
    Balance* balance;      // (4 S) or null
};

template <int K> INLINE Dual<K> node_move(const Group& g, int64_t node, int64_t first, V value) {
    Dual<K> r = constant<K>(value);
    for (int j = 0; j < K; j++)
        if (first + j < g.load_tangents) r.d[j] = g.node_moves[node * g.load_tangents + first + j];
    return r;
}

// The local loads of one row of the table.
template <int K> INLINE void local_of(const Group& g, int64_t row, int64_t first, Stage<K>& s) {
    if (!g.local) {
        s.G = {constant<K>(V{}), constant<K>(V{}), constant<K>(V{})};
        s.G2x = s.G2y = constant<K>(V{});
        return;
    }
    const V* at = g.local + row * (1 + g.load_tangents) * PARTS;
    s.G = {constant<K>(at[0]), constant<K>(at[1]), constant<K>(at[2])};
    s.G2x = constant<K>(at[3]), s.G2y = constant<K>(at[4]);
    for (int j = 0; j < K; j++)
        if (first + j < g.load_tangents) {
            const V* d = at + (1 + first + j) * PARTS;
            s.G.c[0].d[j] = d[0], s.G.c[1].d[j] = d[1], s.G.c[2].d[j] = d[2], s.G2x.d[j] = d[3], s.G2y.d[j] = d[4];
        }
}

template <int K> __attribute__((noinline)) void stage_of(const Group& g, int64_t i, int64_t k, int64_t first, Stage<K>& s) {
    const Known& m = *g.known;
    const int64_t row = 3 * i + k;
    s.Gm_there = m.Gm.data, s.Wn_there = m.Wn.data, s.Wm_there = m.Wm.data;
    local_of(g, row, first, s);
    for (int c = 0; c < 3; c++) {
        if (s.Gm_there) s.Gm[c] = fetch(m.Gm, g.lanes, 3 * row + c);
        if (s.Wm_there) s.Wm[c] = fetch(m.Wm, g.lanes, 3 * row + c);
        if (s.Wn_there) s.Wn.c[c] = constant<K>(fetch(m.Wn, g.lanes, 3 * row + c));
        s.u_star[c] = fetch(m.u_star, g.lanes, 3 * row + c);
    }
    if (s.Wn_there && g.node_moves) {
        const Dual<K> from = node_move<K>(g, i, first, V{}), to = node_move<K>(g, i + 1, first, V{});
        const Dual<K> moves = (1 - 0.5 * k) * from + (0.5 * k) * to;
        for (int c = 0; c < 3; c++) s.Wn.c[c] = s.Wn.c[c] - fetch(g.weight, g.lanes, c) * moves;
    }
    for (int64_t x = 0; x < 18 * m.tendons; x++) s.L[x] = fetch(m.L, g.lanes, row * 18 * m.tendons + x);
    for (int64_t x = 0; x < 3 * m.tendons; x++) s.dr[x] = fetch(m.dr, g.lanes, row * 3 * m.tendons + x);
    for (int64_t t = 0; t < m.tendons; t++) {
        s.tau[t] = fetch(m.tau, g.lanes, row * m.tendons + t);
        V unit = V{};
        if (t < g.tension_tangents) {  // tau = max(reading + unknown, 0) where the tendon pulls at all
            const Mask on = fetch(g.active, g.lanes, row * m.tendons + t) > 0;
            const V pull = s.tau[t] + g.tension[t];
            s.tau[t] = select(on, larger(pull, V{}), V{});
            unit = select(on & (pull > 0), splat(g.tension_unit), V{});
        }
        for (int j = 0; j < K; j++) s.dtau[t][j] = first + j - g.load_tangents == t ? unit : V{};
    }
}

// step.py, rk4_step: step i, whose length moves with its nodes where `Moving`.
template <int K, bool Moving>
__attribute__((noinline)) void rk4_step(const Group& g, Dual<K>* y, int64_t i, int64_t first, bool reverse) {
    const Known& m = *g.known;
    const bool settled = first > 0;
    Balance* kept = g.balance ? g.balance + 4 * i : nullptr;
    Dual<K> h = constant<K>(fetch(m.h, g.lanes, i));
    if constexpr (Moving) h = h + (node_move<K>(g, i + 1, first, V{}) - node_move<K>(g, i, first, V{}));
    if (reverse) h = -h;
    Dual<K> k[13], z[13], sum[13];
    auto times = [](double factor, const Dual<K>& h, const Dual<K>& x) {
        if constexpr (Moving) return (factor * h) * x;
        else return (factor * h.v) * x;
    };
    {
        Stage<K> s;
        stage_of(g, i, reverse ? 2 : 0, first, s);
        derivative(m, y, s, kept, settled, k);
    }
    for (int i = 0; i < 13; i++) sum[i] = k[i], z[i] = y[i] + times(0.5, h, k[i]);
    {
        Stage<K> s;
        stage_of(g, i, 1, first, s);
        derivative(m, z, s, kept + 1, settled, k);
        for (int i = 0; i < 13; i++) sum[i] = sum[i] + 2.0 * k[i], z[i] = y[i] + times(0.5, h, k[i]);
        derivative(m, z, s, kept + 2, settled, k);
    }
    for (int i = 0; i < 13; i++) sum[i] = sum[i] + 2.0 * k[i], z[i] = y[i] + times(1.0, h, k[i]);
    {
        Stage<K> s;
        stage_of(g, i, reverse ? 0 : 2, first, s);
        derivative(m, z, s, kept + 3, settled, k);
    }
    for (int i = 0; i < 13; i++) y[i] = y[i] + times(1.0 / 6, h, sum[i] + k[i]);
    Dual<K> square = y[3] * y[3] + y[4] * y[4] + y[5] * y[5] + y[6] * y[6], inverse;
    inverse.v = 1.0 / root(square.v);
    V slope = -0.5 * inverse.v / square.v;
    for (int j = 0; j < K; j++) inverse.d[j] = slope * square.d[j];
    for (int i = 3; i < 7; i++) y[i] = inverse * y[i];
}

// From y at one end to the other. sink(p, mask, y) is told of every output p as the lanes of `mask` arrive at its node.
template <int K, bool Moving, class Sink> void walk(const Group& g, Dual<K>* y, int64_t first, bool reverse, Sink sink) {
    const Known& m = *g.known;
    auto arrive = [&](int64_t node) {
        for (int64_t p = 0; p < m.outputs; p++) {
            const Mask here = reached(m.at, g.lanes, p, node);
            if (any(here)) sink(p, here, y);
        }
    };
    arrive(reverse ? m.steps : 0);
    for (int64_t n = 0; n < m.steps; n++) {
        const int64_t i = reverse ? m.steps - 1 - n : n;
        rk4_step<K, Moving>(g, y, i, first, reverse);
        arrive(reverse ? i : i + 1);
    }
}

constexpr int BLOCK = 2;  // tangents at a time; measured: with more, the numbers no longer fit into registers

// Calls run(K, first) for blocks of at most BLOCK tangents.
template <class Run> INLINE void in_blocks(int64_t tangents, Run run) {
    const int64_t blocks = (tangents + BLOCK - 1) / BLOCK;
    for (int64_t b = 0, first = 0; b < blocks; b++) {
        const int64_t size = (tangents - first + blocks - b - 1) / (blocks - b);
        if (size == 1) run(std::integral_constant<int, 1>{}, first);
        if (size == 2) run(std::integral_constant<int, 2>{}, first);
        first += size;
    }
}
