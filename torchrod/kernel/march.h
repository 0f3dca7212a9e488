// The walk along the rod with all tangents, for the W samples of one group: the compiled copy of torchrod/mechanics/integrate.py.
#pragma once

#include <vector>

#include "section_local.h"

// What rk4_step leaves for its tangents: every evaluation's slope and value, the state before q is made a unit again.
struct Trace {
    Slope slope[4];
    V k[4][MOST_STATE], unscaled[4], h, inverse;
    int64_t row[4];
    Stiffness K[3];  // at the stages in the order of the walk; the first where it does not vary
};

// section.py, rk4_step: step i of the values.
inline void rk4_step(const Group& g, V* y, int64_t i, bool reverse, Trace& t) {
    const Known& m = *g.known;
    Stage stage;
    V z[MOST_STATE];
    const int64_t width = m.width();
    t.h = fetch(m.h, g.lanes, i);
    if (reverse) t.h = -t.h;
    const int64_t order[4] = {reverse ? 2 : 0, 1, 1, reverse ? 0 : 2};
    for (int c = 0; c < STATE; c++) z[c] = y[c];
    for (int64_t c = STATE; c < width; c++) z[c] = y[c];
    for (int e = 0; e < 4; e++) {
        t.row[e] = 3 * i + order[e];
        if (e != 2) stage_of(g, t.row[e], stage);  // the middle serves twice
        const int64_t section = m.varying ? (e + 1) / 2 : 0;
        if (m.varying && e != 2) stiffness_of(g, t.row[e], t.K[section]);
        t.slope[e].K = &t.K[section];
        derivative(m, z, stage, t.k[e], t.slope[e]);
        if (g.parameter_tangents) forced_by(g, t.row[e], z, stage, t.slope[e], g.forced + e * g.parameter_tangents * FORCED);
        if (e == 3) break;
        const V reach = (e < 2 ? 0.5 : 1.0) * t.h;
        for (int c = 0; c < STATE; c++) z[c] = y[c] + reach * t.k[e][c];
        for (int64_t c = STATE; c < width; c++) z[c] = y[c] + reach * t.k[e][c];
    }
    auto add = [&](int64_t c) { y[c] += t.h * (1.0 / 6) * (t.k[0][c] + 2.0 * (t.k[1][c] + t.k[2][c]) + t.k[3][c]); };
    for (int c = 0; c < STATE; c++) add(c);
    for (int64_t c = STATE; c < width; c++) add(c);
    V square = V{};
    for (int c = 0; c < 4; c++) t.unscaled[c] = y[3 + c], square += y[3 + c] * y[3 + c];
    t.inverse = 1.0 / root(square);
    for (int c = 3; c < 7; c++) y[c] *= t.inverse;
}

// And of tangent j, dy.
template <bool Plain, bool Moving, bool Rubbing> __attribute__((noinline)) void rk4_tangent(const Group& g, const Trace& t, int64_t j, V* dy) {
    const Known& m = *g.known;
    constexpr int room = Rubbing ? MOST_STATE : STATE;
    const int64_t width = Rubbing ? m.width() : STATE;
    V z[room], sum[room], dk[room], dh = V{};
    const bool moved = Moving && j < g.load_tangents;
    auto node = [&](int64_t n) { return g.node_moves[n * g.load_tangents + j]; };
    const int64_t i = t.row[1] / 3;
    if (moved) dh = node(i + 1) - node(i);
    for (int c = 0; c < STATE; c++) z[c] = dy[c], sum[c] = V{};
    for (int64_t c = STATE; c < width; c++) z[c] = dy[c], sum[c] = V{};
    for (int e = 0; e < 4; e++) {
        Moves moves{g.local_slope(t.row[e], j), nullptr, -1, nullptr};
        V3 dWn;
        if (moved && m.Wn.data) {
            const double share = 0.5 * (t.row[e] % 3);
            const V ds = (1 - share) * node(i) + share * node(i + 1);
            const V3 w{fetch(g.weight, g.lanes, 0) * ds, fetch(g.weight, g.lanes, 1) * ds, fetch(g.weight, g.lanes, 2) * ds};
            dWn = V3{} - turned(V3{} - t.slope[e].q, t.slope[e].w, w);
            moves.Wn = &dWn;
        }
        if (j >= g.load_tangents && j < g.load_tangents + g.tension_tangents) moves.tension = j - g.load_tangents;
        if (g.is_parameter(j)) moves.forced = g.forced + (e * g.parameter_tangents + j - g.first_parameter()) * FORCED;
        slope<Plain, Rubbing>(m, t.slope[e], z, moves, dk);
        const double weight = e == 0 || e == 3 ? 1 : 2, reach = e < 2 ? 0.5 : 1;
        auto go = [&](int64_t c) {
            sum[c] += weight * dk[c];
            if (e < 3) z[c] = dy[c] + reach * t.h * dk[c];
            if (moved && e < 3) z[c] += reach * dh * t.k[e][c];
        };
        for (int c = 0; c < STATE; c++) go(c);
        for (int64_t c = STATE; c < width; c++) go(c);
    }
    auto add = [&](int64_t c) {
        dy[c] += t.h * (1.0 / 6) * sum[c];
        if (moved) dy[c] += dh * (1.0 / 6) * (t.k[0][c] + 2.0 * (t.k[1][c] + t.k[2][c]) + t.k[3][c]);
    };
    for (int c = 0; c < STATE; c++) add(c);
    for (int64_t c = STATE; c < width; c++) add(c);
    V along = V{};  // of q / |q|
    for (int c = 0; c < 4; c++) along += t.unscaled[c] * dy[3 + c];
    along *= t.inverse * t.inverse;
    for (int c = 0; c < 4; c++) dy[3 + c] = t.inverse * (dy[3 + c] - along * t.unscaled[c]);
}

// As `walk`, where section_local.h serves: tangents are carried in the section's own frame and shown in the base frame.
template <class Arrive> void walk_in_own_frame(const Group& g, V* y, V* dy, bool reverse, Arrive arrive) {
    const int64_t steps = g.known->steps;
    static thread_local std::vector<V> carried;
    static thread_local BodyStep step;
    carried.resize(g.tangents * CARRIED);
    V R[9];
    rotation(y, R);
    for (int64_t j = 0; j < g.tangents; j++) to_own_frame(y, R, dy + j * STATE, carried.data() + j * CARRIED);
    arrive(reverse ? steps : 0, [] {});
    for (int64_t n = 0; n < steps; n++) {
        const int64_t i = reverse ? steps - 1 - n : n;
        body_step(g, y, i, reverse, step);
        for (int64_t j = 0; j < g.tangents; j++) {
            V* tangent = carried.data() + j * CARRIED;
            if (j < g.load_tangents) body_tangent<true, false>(g, step, j, tangent);
            else if (g.is_parameter(j)) body_tangent<false, true>(g, step, j, tangent);
            else body_tangent<false, false>(g, step, j, tangent);
        }
        arrive(reverse ? i : i + 1, [&] {
            rotation(y, R);
            for (int64_t j = 0; j < g.tangents; j++) to_base_frame(y, R, carried.data() + j * CARRIED, g.turning, dy + j * STATE);
        });
    }
}

// From y at one end to the other, with dy (tangents, width). sink(p, mask) is told of every output p as the lanes of `mask` arrive at
// its node.
template <class Sink> void walk(const Group& g, V* y, V* dy, bool reverse, Sink sink) {
    const Known& m = *g.known;
    auto arrive = [&](int64_t node, auto before) {
        bool ready = false;
        for (int64_t p = 0; p < m.outputs; p++) {
            if (m.at.stride == 0 && m.at.data[p] != node) continue;
            const Mask here = reached(m.at, g.lanes, p, node);
            if (!any(here)) continue;
            if (!ready) before();
            ready = true;
            sink(p, here);
        }
    };
    if (g.in_own_frame()) return walk_in_own_frame(g, y, dy, reverse, arrive);
    const bool plain = !m.tendons && !m.Wn.data && !m.Wm.data;
    static thread_local Trace trace;
    if (!m.varying) stiffness_of(g, 0, trace.K[0]);
    arrive(reverse ? m.steps : 0, [] {});
    for (int64_t n = 0; n < m.steps; n++) {
        const int64_t i = reverse ? m.steps - 1 - n : n;
        rk4_step(g, y, i, reverse, trace);
        for (int64_t j = 0; j < g.tangents; j++) {
            V* tangent = dy + j * m.width();
            if (m.friction && g.node_moves) rk4_tangent<false, true, true>(g, trace, j, tangent);
            else if (m.friction) rk4_tangent<false, false, true>(g, trace, j, tangent);
            else if (g.node_moves) rk4_tangent<false, true, false>(g, trace, j, tangent);
            else if (plain) rk4_tangent<true, false, false>(g, trace, j, tangent);
            else rk4_tangent<false, false, false>(g, trace, j, tangent);
        }
        arrive(reverse ? i : i + 1, [] {});
    }
}

// States at the outputs and their tangents, of which the first load_tangents also move the local loads by dlocal.
struct March {
    Known known;
    int64_t batch, tangents, load_tangents, reverse;
    const double *y0, *dy0;        // (B, width), (B, width, n)
    const double *local, *dlocal;  // (B, S, 3, 6) = [G, G2], (B, S, 3, 6, load_tangents), or null
    double *out, *dout;            // (B, P, width), (B, P, width, n)
};
