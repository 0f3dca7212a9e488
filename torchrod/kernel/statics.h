// The base wrench that is in equilibrium with the loads of x, and the shape: the compiled copy of solve_shape in statics.py, without
// its damping, for loads and tensions that are known. tests/test_equilibrium.py holds it to that.
#pragma once

#include "sensors.h"

constexpr int MOST_TURNS = 12;         // of the tip; what has not settled by then is left to statics.py
constexpr double ON_THE_WAY = 1e-3;  // rad: enough before all of the load is on

struct Balanced {
    V wrench[PLAIN], missed;  // alpha = [n(0) (N), m(0) (N m)]; the angle by which the base misses its clamp (rad)
    const V* line;            // (P, 3) m
};

// q <- exp(w) q for a small w, a unit again: (w / 2, 1) q.
inline void turn_by(const V3& w, V* q) {
    const V3 a = splat(0.5) * w, v = part(q), turned = v + q[3] * a + cross(a, v);
    const V real = q[3] - dot(a, v);
    const V scale = 1.0 / root(dot(turned, turned) + real * real);
    for (int i = 0; i < 3; i++) q[i] = scale * turned.c[i];
    q[3] = scale * real;
}

// One walk from the tip, which carries no more than the loads that act on it, to the base; y is the state there.
inline void walk_to_base(const Task& f, const Group& g, const V* q, V* y, V* dy, V* line) {
    const V* beyond = g.local_at(3 * f.known.steps);
    for (int i = 0; i < STATE; i++) y[i] = V{};
    for (int i = 0; i < 4; i++) y[3 + i] = q[i];
    if (beyond) {  // N = M = 0 beyond the tip: N~ = G, M~ = -e3 x G2
        for (int i = 0; i < 3; i++) y[7 + i] = beyond[i];
        y[10] = beyond[4], y[11] = -beyond[3];
    }
    for (int64_t k = 0; k < g.tangents; k++) {  // dq = (e_k, 0) q / 2
        V* d = dy + k * STATE;
        for (int i = 0; i < STATE; i++) d[i] = V{};
        V3 half{};
        half.c[k] = splat(0.5);
        const V3 v = cross(half, part(q));
        for (int i = 0; i < 3; i++) d[3 + i] = v.c[i] + q[3] * half.c[i];
        d[6] = -0.5 * q[k];
    }
    walk(g, y, dy, true, [&](int64_t p, Mask here) {
        for (int i = 0; i < 3; i++) line[3 * p + i] = select(here, y[i], line[3 * p + i]);
    });
}

// q_tip: where to look for the tip's orientation (4), with all of the base frame's loads on, or null: from where it is without them,
// putting them on in so many increments.
template <class X>
Balanced balanced(const Task& f, const Lanes& lanes, X x, const V* q_tip, int64_t increments, double tolerance, Room& room) {
    Group g = group_of(f, lanes, x, false, room);
    const bool dead = f.known.Wn.data;
    V q[4] = {V{}, V{}, V{}, splat(1.0)}, y[STATE], dy[3 * STATE];
    room.line.assign(3 * f.known.outputs, V{});
    if (dead && q_tip)
        for (int i = 0; i < 4; i++) q[i] = q_tip[i];
    if (dead && !q_tip) {
        g.dead = 0;
        walk_to_base(f, g, q, y, dy, room.line.data());
        for (int i = 0; i < 4; i++) q[i] = i < 3 ? -y[3 + i] : y[6];
    }
    g.tangents = dead ? 3 : 0;
    Balanced b;
    int64_t on_now = 1;
    for (int turns = 0;; turns++) {
        g.dead = on_now / double(increments);
        walk_to_base(f, g, q, y, dy, room.line.data());
        const V sign = y[6] < 0 ? splat(-2.0) : splat(2.0);
        const V3 r = sign * part(y + 3);  // the rotation vector of a small rotation
        b.missed = dead ? root(dot(r, r)) : V{};
        const bool all_on = on_now == increments;
        const Mask on = b.missed > (all_on ? tolerance : ON_THE_WAY);
        if (all_on && (!any(on) || turns == MOST_TURNS)) break;
        if (!all_on && (!any(on) || turns == MOST_TURNS)) on_now++, turns = -1;
        V J[9], inverse[9];
        for (int k = 0; k < 3; k++)
            for (int i = 0; i < 3; i++) J[3 * i + k] = sign * dy[k * STATE + 3 + i];
        inverse3(J, inverse);
        V3 step = V3{} - matvec(inverse, r);
        const V size = root(dot(step, step)), share = select(size > 1, 1.0 / size, splat(1.0));
        step = select(on, share, V{}) * step;
        turn_by(step, q);
    }
    // In the frame of the base's own section, which is the base frame to within the tolerance.
    const V3 back = V3{} - part(y + 3);
    V3 n = part(y + 7);
    if (dead) n = n + turned(back, y[6], weight_at(g, 0));
    for (int i = 0; i < 3; i++) b.wrench[i] = n.c[i], b.wrench[3 + i] = y[10 + i];
    for (int64_t p = 0; p < f.known.outputs; p++) {
        const V3 at = turned(back, y[6], part(room.line.data() + 3 * p) - part(y));
        for (int i = 0; i < 3; i++) room.line[3 * p + i] = at.c[i];
    }
    b.line = room.line.data();
    return b;
}
