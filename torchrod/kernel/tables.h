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

// How the robot of every sample is off, and what that adds to the tables below: T(s) + sum_m kappa_m T_m(s), (1) of
// torchrod/model/deviations.py, with so many amounts kappa of each kind, in this order.
struct Deviations {
    int64_t parameters, stiffness, curvature, hanging, pulls, frictions, places;  // parameters: theta. hanging: by three each
    Table kappa, dkappa;  // (m), (m, parameters), by theta
    Table K_off;          // (stiffness, rows, 18): K_se, K_bt; rows: 3 S where the section varies, else 1
    Table u_off;          // (curvature, S, 3, 3)
    Table hangs;          // (hanging, S, 3) kg
    Table pulling;        // (S, 3, T), 1 where a tendon pulls

    int64_t of_curvature() const { return stiffness; }
    int64_t of_weight() const { return stiffness + curvature; }
    int64_t of_pull() const { return of_weight() + 3 * hanging; }
    int64_t of_friction() const { return of_pull() + pulls; }
    int64_t of_place() const { return of_friction() + frictions; }
    int64_t size() const { return of_place() + 2 * places; }
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
    Deviations off;

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

// All that is known at one stage, for the samples in the lanes.
struct Stage {
    bool Wn_there, Wm_there;
    V3 G, Gm, Wn, Wm, u_star;
    V G2x, G2y, L[MOST_TENDONS * 18], dr[MOST_TENDONS * 3], ddr[MOST_TENDONS * 3], chord[MOST_TENDONS * 4], tau[MOST_TENDONS], tau_unit[MOST_TENDONS],
        mu[MOST_TENDONS];
};

// One group of samples. Tangents are ordered [loads | tensions | parameters | the rest]; the rest moves nothing that is known along the
// rod.
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
    const V *kappa = nullptr, *dkappa = nullptr;  // of Deviations, where the robot is off
    V compliance[6];                              // of those, where the section is diagonal and does not vary
    int64_t parameter_tangents = 0;
    V* forced = nullptr;      // room (4, parameter_tangents, FORCED) of a step

    int64_t first_parameter() const { return load_tangents + tension_tangents; }
    bool is_parameter(int64_t j) const { return j >= first_parameter() && j < first_parameter() + parameter_tangents; }

    bool in_own_frame() const {  // whether section_local.h serves
        return known->diagonal && !known->tendons && !known->Wn.data && !known->Wm.data && !node_moves && !stretching;
    }
    const V* local_at(int64_t row) const { return local ? local + row * (1 + load_tangents) * PARTS : nullptr; }
    const V* local_slope(int64_t row, int64_t j) const {
        return local && j < load_tangents ? local_at(row) + (1 + j) * PARTS : nullptr;
    }
};

// A section's stiffness: with tendons K_se and K_bt, without their inverses; K_bt itself where the robot is off.
struct Stiffness {
    V se[9], bt[9], K_bt[9];
};
INLINE void inverse3(const V* A, V* R) {  // rows of R: cofactors of the columns of A
    V c[9] = {A[4] * A[8] - A[7] * A[5], A[7] * A[2] - A[1] * A[8], A[1] * A[5] - A[4] * A[2],
              A[5] * A[6] - A[8] * A[3], A[8] * A[0] - A[2] * A[6], A[2] * A[3] - A[5] * A[0],
              A[3] * A[7] - A[6] * A[4], A[6] * A[1] - A[0] * A[7], A[0] * A[4] - A[3] * A[1]};
    V one = 1.0 / (A[0] * c[0] + A[3] * c[1] + A[6] * c[2]);
    for (int i = 0; i < 9; i++) R[i] = c[i] * one;
}
INLINE V off_stiffness(const Group& g, int64_t m, int64_t row, int64_t x) {  // entry x of K_se and K_bt
    const Known& k = *g.known;
    const int64_t rows = k.varying ? 3 * k.steps : 1;
    return fetch(k.off.K_off, g.lanes, (m * rows + (k.varying ? row : 0)) * 18 + x);
}
inline void stiffness_of(const Group& g, int64_t row, Stiffness& K) {
    const Known& m = *g.known;
    const int64_t at = m.varying ? 9 * row : 0;
    const bool off = g.kappa, inverse = !m.tendons && !off;
    const Table &se = inverse ? m.K_se_inverse : m.K_se, &bt = inverse ? m.K_bt_inverse : m.K_bt;
    for (int64_t x = 0; x < 9; x++) K.se[x] = fetch(se, g.lanes, at + x), K.bt[x] = fetch(bt, g.lanes, at + x);
    if (!off) return;
    for (int64_t k = 0; k < m.off.stiffness; k++)
        for (int64_t x = 0; x < 9; x++) K.se[x] += g.kappa[k] * off_stiffness(g, k, row, x), K.bt[x] += g.kappa[k] * off_stiffness(g, k, row, 9 + x);
    for (int64_t x = 0; x < 9; x++) K.K_bt[x] = K.bt[x];
    if (m.tendons) return;
    const Stiffness own = K;
    inverse3(own.se, K.se), inverse3(own.bt, K.bt);
}

// Wn (N) of the robot as it is.
INLINE V3 weight_at(const Group& g, int64_t row) {
    const Known& m = *g.known;
    V3 w;
    for (int c = 0; c < 3; c++) w.c[c] = fetch(m.Wn, g.lanes, 3 * row + c);
    for (int64_t k = 0; g.kappa && k < m.off.hanging; k++) w = w + fetch(m.off.hangs, g.lanes, k * 3 * m.steps + row) * part(g.kappa + m.off.of_weight() + 3 * k);
    return w;
}
// And how it moves with parameter k.
INLINE V3 weight_slope(const Group& g, int64_t row, int64_t k) {
    const Deviations& d = g.known->off;
    V3 w{};
    for (int64_t n = 0; n < d.hanging; n++) {
        const V hangs = fetch(d.hangs, g.lanes, n * 3 * g.known->steps + row);
        for (int c = 0; c < 3; c++) w.c[c] += hangs * g.dkappa[(d.of_weight() + 3 * n + c) * d.parameters + k];
    }
    return w;
}

// What the errors add to a stage.
inline void move_off(const Group& g, int64_t row, Stage& s) {
    const Known& m = *g.known;
    const Deviations& d = m.off;
    const V *u = g.kappa + d.of_curvature(), *pull = g.kappa + d.of_pull(), *mu = g.kappa + d.of_friction(), *r = g.kappa + d.of_place();
    for (int64_t k = 0; k < d.curvature; k++)
        for (int c = 0; c < 3; c++) s.u_star.c[c] += u[k] * fetch(d.u_off, g.lanes, (k * 3 * m.steps + row) * 3 + c);
    for (int64_t t = 0; t < d.pulls; t++) s.tau[t] += pull[t] * fetch(d.pulling, g.lanes, row * m.tendons + t);
    for (int64_t t = 0; t < d.frictions; t++) s.mu[t] += mu[t];
    for (int64_t t = 0; t < d.places; t++) {  // L = [I, -hat(r)]
        V* L = s.L + 18 * t;
        L[5] -= r[2 * t + 1], L[11] += r[2 * t], L[15] += r[2 * t + 1], L[16] -= r[2 * t];
    }
}

inline void stage_of(const Group& g, int64_t row, Stage& s) {
    const Known& m = *g.known;
    const V* l = g.local_at(row);
    s.G = l ? part(l) : V3{}, s.G2x = l ? l[3] : V{}, s.G2y = l ? l[4] : V{};
    s.Wn_there = m.Wn.data, s.Wm_there = m.Wm.data;
    for (int c = 0; c < 3; c++) {
        s.Gm.c[c] = m.Gm.data ? fetch(m.Gm, g.lanes, 3 * row + c) : V{};
        if (s.Wm_there) s.Wm.c[c] = g.dead * fetch(m.Wm, g.lanes, 3 * row + c);
        s.u_star.c[c] = fetch(m.u_star, g.lanes, 3 * row + c);
    }
    if (s.Wn_there) s.Wn = splat(g.dead) * weight_at(g, row);
    for (int64_t x = 0; x < 18 * m.tendons; x++) s.L[x] = fetch(m.L, g.lanes, row * 18 * m.tendons + x);
    for (int64_t x = 0; x < 3 * m.tendons; x++) s.dr[x] = fetch(m.dr, g.lanes, row * 3 * m.tendons + x);
    for (int64_t x = 0; m.chord.data && x < 4 * m.tendons; x++) s.chord[x] = fetch(m.chord, g.lanes, row * 4 * m.tendons + x);
    for (int64_t x = 0; m.ddr.data && x < 3 * m.tendons; x++) s.ddr[x] = fetch(m.ddr, g.lanes, row * 3 * m.tendons + x);
    for (int64_t t = 0; t < m.tendons; t++) {
        s.tau[t] = fetch(m.tau, g.lanes, row * m.tendons + t);
        s.tau_unit[t] = V{};
        if (m.friction) s.mu[t] = splat(m.friction[t]);
        if (t >= g.tension_tangents) continue;  // else the eased max(reading + unknown, 0) where the tendon pulls at all
        const Mask on = fetch(g.active, g.lanes, row * m.tendons + t) > 0;
        const V pull = s.tau[t] + g.tension[t];
        const V above = larger(pull + g.slack, V{});
        const Mask eased = pull < g.slack;
        const double share = 1 - g.leak;
        s.tau[t] = select(on, select(eased, above * above * (share * 0.25 / g.slack) + g.leak * pull, pull), V{});
        s.tau_unit[t] = select(on, g.tension_unit * select(eased, above * (share * 0.5 / g.slack) + g.leak, splat(1.0)), V{});
    }
    if (g.kappa) move_off(g, row, s);
}
