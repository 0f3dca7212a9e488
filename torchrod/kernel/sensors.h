// What the markers show of a rod, and the normal equations: the compiled copy of h(x) of torchrod/model, and of `normal_equations`
// and `student` in torchrod/estimation/filter.py.
#pragma once

#include "loads.h"

constexpr int PLAIN = 6;  // rows of the tip residual

// What is fitted: the robot on its grid, its loads, the unknowns and their units, and the measurements of all samples.
struct Task {
    Known known;
    Loads loads;
    int64_t size, tip, tensions, registration;  // entries of x in all, of the unknown wrench at the tip, of free tensions; flag
    double force_unit, moment_unit, length_unit, angle_unit, tension_unit, slack, leak;
    double robust;                  // degrees of freedom of Student's t, infinite for a normal distribution
    const double* offsets;          // (P, 3) or null
    Table active, weight;           // (S, 3, T) or none; (3) N/m: what hangs per metre, for nodes that move
    const double *positions, *w;    // (B, P, 3) with NaN where missing; (B, 3 P + 6)
};

// Rigid motion by zeta = [translation, rotation vector] and how R moves: lie.py, move. R = 1 + a hat(w) + b hat(w)^2.
struct Motion {
    V t[3], R[9], dR[3][9];
    Motion() {}
    Motion(const V* translation, const V* w) {
        const V square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
        V a = V{}, b = V{}, da = V{}, db = V{};  // of square, by which they are differentiated
        for (int i = 0; i < W; i++) coefficients(square[i], a[i], b[i], da[i], db[i]);
        const V hat[9] = {V{}, -w[2], w[1], w[2], V{}, -w[0], -w[1], w[0], V{}};
        for (int i = 0; i < 3; i++) {
            t[i] = translation[i];
            for (int j = 0; j < 3; j++) {
                const V twice = w[i] * w[j] - (i == j ? square : V{});
                R[3 * i + j] = (i == j ? splat(1.0) : V{}) + a * hat[3 * i + j] + b * twice;
                for (int k = 0; k < 3; k++) {
                    const double turn = (j - i + 3) % 3 == 1 && k == 3 - i - j ? -1 : (j - i + 3) % 3 == 2 && k == 3 - i - j ? 1 : 0;
                    V dtwice = (k == i ? w[j] : V{}) + (k == j ? w[i] : V{}) - (i == j ? 2.0 * w[k] : V{});
                    dR[k][3 * i + j] = 2.0 * w[k] * (da * hat[3 * i + j] + db * twice) + a * turn + b * dtwice;
                }
            }
        }
    }
    static void coefficients(double s, double& a, double& b, double& da, double& db) {
        if (s > 0.5) {
            const double angle = std::sqrt(s), sine = std::sin(angle), cosine = std::cos(angle);
            a = sine / angle, b = (1 - cosine) / s;
            da = (cosine - a) / (2 * s), db = (a - 2 * b) / (2 * s);
            return;
        }
        double term = 1;  // (-s)^k / (2 k)!
        a = b = da = db = 0;
        for (int k = 0; k < 12; k++) {
            const double p = term / (2 * k + 1), q = p / (2 * k + 2);
            a += p, b += q;
            if (k) da += k * p, db += k * q;
            term *= -s / ((2 * k + 1) * (2 * k + 2));
        }
        if (s != 0) da /= s, db /= s;
        else da = -1.0 / 6, db = -1.0 / 24;
    }
};

// Room for one group, kept from group to group.
struct Room {
    std::vector<V> local, moves, rows, line, tension, tangents, kappa, forced;
};

struct Measured {  // rows (Z, 1 + n): h, then dh/dx; line (P, 3): the centre line in the rod's own frame
    V *rows, *line;
    int64_t width, tip;  // the first row of c, the last six
    V& h(int64_t z) const { return rows[z * width]; }
    V* H(int64_t z) const { return rows + z * width + 1; }
};

template <class X> Group group_of(const Task& f, const Lanes& lanes, X x, bool slopes, Room& room) {
    const Known& m = f.known;
    const int64_t g = f.loads.size;
    room.tension.resize(f.tensions);
    for (int64_t t = 0; t < f.tensions; t++) room.tension[t] = f.tension_unit * x(g + f.tip + t);
    const int64_t parameters = slopes ? m.off.parameters : 0, tangents = slopes ? g + f.tensions + parameters + PLAIN : 0;
    Group group{&m, lanes, tangents, slopes ? g : 0, f.tensions, f.tension_unit, f.slack, f.leak, room.tension.data(), nullptr, nullptr, f.weight, f.active};
    group.turning = f.offsets || f.tip;
    if (const int64_t amounts = m.off.size()) {
        room.kappa.resize(amounts * (1 + m.off.parameters));
        for (int64_t k = 0; k < amounts; k++) room.kappa[k] = fetch(m.off.kappa, lanes, k);
        for (int64_t k = 0; slopes && k < amounts * m.off.parameters; k++) room.kappa[amounts + k] = fetch(m.off.dkappa, lanes, k);
        group.kappa = room.kappa.data(), group.dkappa = group.kappa + amounts;
        group.parameter_tangents = parameters;
        Stiffness K;
        if (!m.varying) stiffness_of(group, 0, K);
        for (int k = 0; k < 3 && !m.varying; k++) group.compliance[k] = K.se[4 * k], group.compliance[3 + k] = K.bt[4 * k];
        room.forced.resize(4 * parameters * FORCED);
        group.forced = room.forced.data();
    }
    if (f.loads.family == POINT && slopes) {
        room.moves.resize((m.steps + 1) * g);
        move_nodes(f.loads, group, x, room.moves.data());
        group.node_moves = room.moves.data();
    }
    if (f.loads.family != NONE) {
        room.local.resize((3 * m.steps + 1) * (1 + group.load_tangents) * PARTS);
        fill_local(f.loads, group, x, room.local.data());
        group.local = room.local.data();
    }
    return group;
}

// Writes what one output shows: rows of h, and of dh/dx for every tangent, the j-th of which is column(j) of x.
template <class X> struct Show {
    const Task& f;
    const Group& g;
    X x;
    const Motion& motion;
    const Measured& to;
    const V *y, *dy;

    int64_t column(int64_t j) const {
        const int64_t fixed = f.loads.size + f.tensions + g.parameter_tangents;
        return j < f.loads.size ? j : j < fixed ? f.tip + j : f.size - PLAIN + j - fixed;
    }
    void put(Mask here, int64_t z, const V3& value) const {
        for (int i = 0; i < 3; i++) to.h(z + i) = select(here, value.c[i], to.h(z + i));
    }
    void put(Mask here, int64_t z, int64_t at, const V3& value) const {
        for (int i = 0; i < 3; i++) to.H(z + i)[at] = select(here, value.c[i], to.H(z + i)[at]);
    }
    void marker(int64_t p, Mask here) const {
        const V3 q = part(y + 3);
        V3 r = part(y);
        V J[12];
        for (int i = 0; i < 3; i++) to.line[3 * p + i] = select(here, r.c[i], to.line[3 * p + i]);
        if (f.offsets) {
            const V3 offset{splat(f.offsets[3 * p]), splat(f.offsets[3 * p + 1]), splat(f.offsets[3 * p + 2])};
            r = r + turned(q, y[6], offset);
            turning(q, y[6], 1, offset, J);
        }
        for (int64_t j = 0; j < g.tangents; j++) {
            const V* d = dy + j * f.known.width();
            V3 dr = part(d);
            if (f.offsets) dr = dr + matvec4(J, d + 3);
            put(here, 3 * p, column(j), f.registration ? matvec(motion.R, dr) : dr);
        }
        if (!f.registration) return put(here, 3 * p, r);
        put(here, 3 * p, matvec(motion.R, r) + part(motion.t));
        for (int64_t k = 0; g.tangents && k < 3; k++) {
            V3 shift{};
            shift.c[k] = splat(f.length_unit);
            put(here, 3 * p, f.size - 2 * PLAIN + k, shift);
            put(here, 3 * p, f.size - 2 * PLAIN + 3 + k, splat(f.angle_unit) * matvec(motion.dR[k], r));
        }
    }
    // The section's own state, of which torch works out what other sensors read.
    void state(int64_t p, Mask here) const {
        const int64_t width = f.known.width();
        for (int64_t c = 0; c < width; c++) {
            const int64_t z = width * p + c;
            to.h(z) = select(here, y[c], to.h(z));
            for (int64_t j = 0; j < g.tangents; j++) {
                V& at = to.H(z)[column(j)];
                at = select(here, dy[j * width + c], at);
            }
        }
    }
    void tip(Mask here) const {
        const V* l = g.local_at(3 * f.known.steps);
        const V3 q = part(y + 3), back = V3{} - q;
        for (int half = 0; half < 2; half++) {
            const int64_t z = to.tip + 3 * half;
            V3 c = part(y + 7 + 3 * half), unknown{};
            V J[12];
            if (l) c = c - (half ? V3{l[4], -l[3], V{}} : part(l));
            const bool free = f.tip > 3 * half;
            for (int k = 0; free && k < 3; k++) {
                const int64_t at = f.loads.size + 3 * half + k;
                V3 axis{};
                axis.c[k] = splat(half ? f.moment_unit : f.force_unit);
                unknown.c[k] = (half ? f.moment_unit : f.force_unit) * x(at);
                if (g.tangents) put(here, z, at, V3{} - turned(back, y[6], axis));
            }
            if (free) c = c - turned(back, y[6], unknown), turning(q, y[6], -1, unknown, J);
            put(here, z, c);
            for (int64_t j = 0; j < g.tangents; j++) {
                const V *d = dy + j * f.known.width(), *dl = g.local_slope(3 * f.known.steps, j);
                V3 dc = part(d + 7 + 3 * half);
                if (dl) dc = dc - (half ? V3{dl[4], -dl[3], V{}} : part(dl));
                if (free) dc = dc - matvec4(J, d + 3);
                put(here, z, column(j), dc);
            }
        }
    }
};

// How many rows there are: three for each marker, or the states at every output and at the tip, and c.
inline int64_t rows_of(const Task& f, bool states) {
    return (states ? f.known.width() * f.known.outputs : 3 * (f.known.outputs - 1)) + PLAIN;
}

// h and H of the samples in the lanes. x(j): entry j of their states. Without `slopes` h alone. states: instead of the markers, the
// states of the sections, in the rod's own frame.
template <class X> Measured measure(const Task& f, const Lanes& lanes, X x, bool slopes, Room& room, bool states = false) {
    const Known& m = f.known;
    const int64_t n = f.size, P = m.outputs - 1;
    const int64_t width = slopes ? 1 + n : 1;
    const int64_t Z = rows_of(f, states);
    room.rows.assign(Z * width, V{});
    room.line.assign(3 * P, V{});
    const Measured to{room.rows.data(), room.line.data(), width, Z - PLAIN};
    Group g = group_of(f, lanes, x, slopes, room);
    g.turning |= states;
    Motion motion;
    if (f.registration && !states) {
        V translation[3], turn[3];
        for (int i = 0; i < 3; i++) {
            translation[i] = f.length_unit * x(n - 2 * PLAIN + i);
            turn[i] = f.angle_unit * x(n - PLAIN - 3 + i);
        }
        motion = Motion(translation, turn);
    }
    V y[MOST_STATE] = {};
    y[6] = splat(1.0);
    const int64_t stride = m.width();
    room.tangents.assign(g.tangents * stride, V{});
    const V3 weight = m.Wn.data ? weight_at(g, 0) : V3{};
    for (int i = 0; i < 6; i++) {
        const double unit = i < 3 ? f.force_unit : f.moment_unit;
        y[7 + i] = unit * x(n - PLAIN + i);
        if (i < 3) y[7 + i] -= weight.c[i];
        if (slopes) room.tangents[(g.tangents - PLAIN + i) * stride + 7 + i] = splat(unit);
    }
    for (int64_t k = 0; m.off.hanging && k < g.parameter_tangents; k++) {
        const V3 more = weight_slope(g, 0, k);
        for (int c = 0; c < 3; c++) room.tangents[(g.first_parameter() + k) * stride + 7 + c] = V{} - more.c[c];
    }
    const Show<X> show{f, g, x, motion, to, y, room.tangents.data()};
    walk(g, y, room.tangents.data(), false, [&](int64_t p, Mask here) {
        if (states) show.state(p, here);
        else if (p < P) show.marker(p, here);
        if (p == P) show.tip(here);
    });
    return to;
}

// H^T W H and H^T W r of the markers and of the tip residual apart, and the cost r^T W r of each.
struct Normal {
    V *A[2], *g[2], cost[2];
    V seen;  // marker coordinates that were seen
};

INLINE void accumulate(const Measured& m, int64_t z, int64_t rows, const V* w, const V* r, int64_t n, V* A, V* g) {
    for (int64_t i = 0; i < n; i++) {
        V weighted[3];
        for (int64_t k = 0; k < rows; k++) weighted[k] = w[k] * m.H(z + k)[i], g[i] += weighted[k] * r[k];
        for (int64_t j = 0; j <= i; j++) {
            V sum = A[i * n + j];
            for (int64_t k = 0; k < rows; k++) sum += weighted[k] * m.H(z + k)[j];
            A[i * n + j] = sum;
        }
    }
}

// r = z - h of three rows, zero where a marker is missing, and their weights. Returns r^T W r.
INLINE V residual(const Task& f, const Lanes& lanes, const Measured& m, int64_t z, V* w, V* r) {
    const int64_t P = f.known.outputs - 1, Z = 3 * P + PLAIN;
    V square = V{};
    for (int k = 0; k < 3; k++) {
        w[k] = fetch({f.w, Z}, lanes, z + k);
        const V at = z < 3 * P ? fetch({f.positions, 3 * P}, lanes, z + k) : V{};
        r[k] = select(w[k] > 0, at - m.h(z + k), V{});
        square += w[k] * r[k] * r[k];
    }
    return square;
}

INLINE V robust_cost(const Task& f, V square) {
    if (!std::isfinite(f.robust)) return square;
    return (f.robust + 3) * each(square / f.robust, [](double a) { return std::log1p(a); });
}

// r takes the place of h. With Student's t of `robust` degrees of freedom each marker's weight is multiplied by
// (nu + 3) / (nu + s), s = r^T W r of that marker, and its cost is (nu + 3) log(1 + s / nu): `student` in estimation/filter.py.
inline Normal normal_equations(const Task& f, const Lanes& lanes, const Measured& m, V* room) {
    const int64_t n = f.size, P = f.known.outputs - 1, Z = 3 * P + PLAIN;
    Normal N{{room, room + n * n}, {room + 2 * n * n, room + 2 * n * n + n}, {V{}, V{}}, V{}};
    for (int64_t i = 0; i < 2 * n * n + 2 * n; i++) room[i] = V{};
    for (int64_t z = 0; z < Z; z += 3) {
        V w[3], r[3];
        const V square = residual(f, lanes, m, z, w, r);
        const bool marker = z < 3 * P;
        for (int k = 0; k < 3; k++) {
            m.h(z + k) = r[k];
            if (marker) N.seen += select(w[k] > 0, splat(1.0), V{});
        }
        if (marker && std::isfinite(f.robust)) {
            const V factor = (f.robust + 3) / (f.robust + square);
            for (auto& x : w) x *= factor;
        }
        N.cost[!marker] += marker ? robust_cost(f, square) : square;
        accumulate(m, z, 3, w, r, n, N.A[!marker], N.g[!marker]);
    }
    return N;
}
