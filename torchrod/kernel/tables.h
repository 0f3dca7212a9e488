// What is known before a march: tables that the batch shares or that have one row per sample, the samples of one group, and what is
// known at a stage of a step for them.
#pragma once

#include "simd.h"

constexpr int MOST_TENDONS = 16;
constexpr int STATE = 13, MOST_STATE = STATE + MOST_TENDONS, PARTS = 5;  // of the state p, q, N~, M~, with Theta; of a local load: G_x, G_y, G_z, G2_x, G2_y

struct Table {  // null where there is none; stride 0: shared, else numbers per sample
    const double* data;
    int64_t stride;
};

struct Places {  // integers, likewise
    const int64_t* data;
    int64_t stride;
};

struct Known {
    int64_t steps, tendons, newton, diagonal, varying;
    Table K_se, K_bt, K_se_inverse, K_bt_inverse;  // (9); where the section varies, (S, 3, 9)
    Table h;                                       // (S)
    Table Gm, Wn, Wm, u_star;                      // (S, 3, 3)
    Table L, dr, tau;                              // (S, 3, T, 18), (S, 3, T, 3), (S, 3, T)
    Table ddr;                                     // (S, 3, T, 3), where tendons rub or run from disc to disc
    Table chord;                                   // (S, 3, T, 4), where tendons run from disc to disc; or null
    const double* friction;                        // (T + 1): of every tendon, and the floor of their turning; or null
    Places at;                                     // (P) nodes of the outputs
    int64_t outputs;

    int64_t width() const { return STATE + (friction ? tendons : 0); }  // of the state: with Theta of every tendon where they rub
};

// The samples in the lanes; lanes beyond `count` repeat the first sample and are not stored.
struct Lanes {
    int64_t sample[W], count;
};

INLINE V fetch(const Table& t, const Lanes& lanes, int64_t k) {
    if (t.stride == 0) return splat(t.data[k]);
    V r;
    for (int i = 0; i < W; i++) r[i] = t.data[lanes.sample[i] * t.stride + k];
    return r;
}
INLINE Mask reached(const Places& t, const Lanes& lanes, int64_t k, int64_t node) {
    Mask r;
    for (int i = 0; i < W; i++) r[i] = t.data[lanes.sample[i] * t.stride + k] == node ? -1 : 0;
    return r;
}
INLINE bool any(Mask m) {
    int64_t r = 0;
    for (int i = 0; i < W; i++) r |= m[i];
    return r != 0;
}

// A section's stiffness: with tendons K_se and K_bt, without their inverses.
struct Stiffness {
    V se[9], bt[9];
};
inline void stiffness_of(const Known& m, const Lanes& lanes, int64_t row, Stiffness& K) {
    const int64_t at = m.varying ? 9 * row : 0;
    const Table &se = m.tendons ? m.K_se : m.K_se_inverse, &bt = m.tendons ? m.K_bt : m.K_bt_inverse;
    for (int64_t x = 0; x < 9; x++) K.se[x] = fetch(se, lanes, at + x), K.bt[x] = fetch(bt, lanes, at + x);
}

// All that is known at one stage, for the samples in the lanes.
struct Stage {
    bool Wn_there, Wm_there;
    V3 G, Gm, Wn, Wm, u_star;
    V G2x, G2y, L[MOST_TENDONS * 18], dr[MOST_TENDONS * 3], ddr[MOST_TENDONS * 3], chord[MOST_TENDONS * 4], tau[MOST_TENDONS], tau_unit[MOST_TENDONS];
};

// One group of samples. Tangents are ordered [loads | tensions | the rest]; only the first two move what is known along the rod.
struct Group {
    const Known* known;
    Lanes lanes;
    int64_t tangents, load_tangents, tension_tangents;
    double tension_unit;  // N, of one unit of a tension tangent
    double slack, leak;   // N, within which of zero a tension has no kink, and the slope that is left below
    const V* tension;     // (tension_tangents), what the tensions' unknowns add (N)
    const V* local;       // (3 S + 1, 1 + load_tangents, PARTS): the stages of every step, then beyond the tip; or null
    const V* node_moves;  // (S + 1, load_tangents): how the nodes move; null where they do not
    Table weight;         // (3) N/m, the slope -dWn/ds where nodes move
    Table active;         // (S, 3, T), 1 where a tendon pulls; unless tensions are free there is none
    double dead = 1;      // the part of Wn and Wm that is on
    bool stretching = false;  // whether a first tangent may change |q|, which only the step in the base frame can carry
    bool turning = true;      // whether anybody asks how q moves at the outputs

    bool in_own_frame() const {  // whether section_local.h serves
        return known->diagonal && !known->tendons && !known->Wn.data && !known->Wm.data && !node_moves && !stretching;
    }
    const V* local_at(int64_t row) const { return local ? local + row * (1 + load_tangents) * PARTS : nullptr; }
    const V* local_slope(int64_t row, int64_t j) const {
        return local && j < load_tangents ? local_at(row) + (1 + j) * PARTS : nullptr;
    }
};

inline void stage_of(const Group& g, int64_t row, Stage& s) {
    const Known& m = *g.known;
    const V* l = g.local_at(row);
    s.G = l ? part(l) : V3{}, s.G2x = l ? l[3] : V{}, s.G2y = l ? l[4] : V{};
    s.Wn_there = m.Wn.data, s.Wm_there = m.Wm.data;
    for (int c = 0; c < 3; c++) {
        s.Gm.c[c] = m.Gm.data ? fetch(m.Gm, g.lanes, 3 * row + c) : V{};
        if (s.Wn_there) s.Wn.c[c] = g.dead * fetch(m.Wn, g.lanes, 3 * row + c);
        if (s.Wm_there) s.Wm.c[c] = g.dead * fetch(m.Wm, g.lanes, 3 * row + c);
        s.u_star.c[c] = fetch(m.u_star, g.lanes, 3 * row + c);
    }
    for (int64_t x = 0; x < 18 * m.tendons; x++) s.L[x] = fetch(m.L, g.lanes, row * 18 * m.tendons + x);
    for (int64_t x = 0; x < 3 * m.tendons; x++) s.dr[x] = fetch(m.dr, g.lanes, row * 3 * m.tendons + x);
    for (int64_t x = 0; m.chord.data && x < 4 * m.tendons; x++) s.chord[x] = fetch(m.chord, g.lanes, row * 4 * m.tendons + x);
    for (int64_t x = 0; m.ddr.data && x < 3 * m.tendons; x++) s.ddr[x] = fetch(m.ddr, g.lanes, row * 3 * m.tendons + x);
    for (int64_t t = 0; t < m.tendons; t++) {
        s.tau[t] = fetch(m.tau, g.lanes, row * m.tendons + t);
        s.tau_unit[t] = V{};
        if (t >= g.tension_tangents) continue;  // else the eased max(reading + unknown, 0) where the tendon pulls at all
        const Mask on = fetch(g.active, g.lanes, row * m.tendons + t) > 0;
        const V pull = s.tau[t] + g.tension[t];
        const V above = larger(pull + g.slack, V{});
        const Mask eased = pull < g.slack;
        const double share = 1 - g.leak;
        s.tau[t] = select(on, select(eased, above * above * (share * 0.25 / g.slack) + g.leak * pull, pull), V{});
        s.tau_unit[t] = select(on, g.tension_unit * select(eased, above * (share * 0.5 / g.slack) + g.leak, splat(1.0)), V{});
    }
}
