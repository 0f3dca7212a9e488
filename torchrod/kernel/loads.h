// Integrals of the loads and how they move with gamma: the compiled copy of torchrod/mechanics/loads.py under the unknowns of
// torchrod/model/load_families.
#pragma once

#include "march.h"

enum Family : int64_t { NONE = 0, GAUSSIAN = 1, PAPER = 2, POINT = 3, LINEAR = 4 };

struct Loads {
    int64_t family, count, per_load, size;  // size: entries of gamma
    int64_t axial;             // whether the last entry of every load is its force along the rod
    double length, force_scale;
    double eps, beta1, beta2;  // PAPER: of its sigmoid
    double friction, faint;    // along_rod
    const double* locations;  // (count) m where they are known, else null
    const double* basis;      // LINEAR: (3 S + 1, size, PARTS), what one unit of each entry of gamma adds
    Table s;                  // (3 S) m, the stages
    Table inside;             // (3 S) m, a point of the same step
    Places node;              // POINT: (count) the node that each load is
};

// int_0^s exp(-c (t - mu)^2) dt, its integral, and both differentiated by mu and by c. loads.py, GaussianLoads.integrals.
struct Bump {
    V once, once_mu, once_c, again, again_mu, again_c;
};
INLINE V bell(V x) {  // exp(-x^2), but never so small that it is no longer a normal number
    return exponential(-smaller(x * x, splat(700.0)));
}
struct BumpAt {
    V mu, r, x0, E0, X0, per_r, per_2c;  // r = sqrt(c), x0 = -r mu, E0 = erf(x0), X0 = exp(-x0^2), 1 / r, 1 / (2 c)
    BumpAt(V mu, V c) : mu(mu), r(root(c)), x0(-r * mu), per_r(1.0 / r), per_2c(0.5 / c) {
        X0 = bell(x0);
        E0 = error_function(x0, X0);
    }
    Bump operator()(V s) const {
        const double half = 0.5 * std::sqrt(M_PI);
        const V x = r * (s - mu), area = half * per_r;
        const V X = bell(x), E = error_function(x, X);
        Bump b;
        b.once = area * (E - E0);
        b.again = area * per_r * (x * E - x0 * E0 + (X - X0) * (0.5 / half) - (x - x0) * E0);
        b.once_mu = X0 - X;
        b.again_mu = s * X0 - b.once;
        b.once_c = ((X * x - X0 * x0) * per_r - b.once) * per_2c;
        b.again_c = ((0.5 * (X0 - X) * per_r - X0 * x0 * s) * per_r - b.again) * per_2c;
        return b;
    }
};

INLINE V sigmoid(V x) {
    return each(x, [](double a) { return 1.0 / (1.0 + std::exp(-a)); });
}

// Where a Gaussian sits, and how that moves with its entry eta.
struct Centre {
    V mu, slope;
};
INLINE Centre logistic_centre(const Loads& l, V eta) {  // coordinates/gaussian.py
    const V share = sigmoid(eta), mu = l.length * share;
    return {mu, mu * (1.0 - share)};
}
INLINE Centre algebraic_centre(const Loads& l, V eta) {  // coordinates/paper.py, the paper's (11)
    const double half = 0.5 * (l.beta2 - l.beta1), middle = 0.5 * (l.beta2 + l.beta1);
    const V square = l.eps + eta * eta, r = 1.0 / root(square);
    return {half * eta * r + middle, half * l.eps * r / square};
}

// The force of one load along the rod (force scales), and how it moves with [F_x, F_y] (force scales) and xi: `along_rod` of
// load_families/family.py.
struct Along {
    V value, by[2], by_xi;
};
INLINE Along along_rod(const Loads& l, V x, V y, V xi) {
    if (!std::isfinite(l.friction)) return {xi, {V{}, V{}}, splat(1.0)};
    const V size = root(x * x + y * y + splat(l.faint * l.faint)), rate = l.friction * xi / size;
    return {l.friction * size * xi, {rate * x, rate * y}, l.friction * size};
}

// One Gaussian's share of the table. x(j): entry j of gamma. coordinates/gaussian.py and coordinates/paper.py.
template <class Gamma> void add_gaussian(const Loads& l, const Group& g, int64_t k, Gamma x, V* local) {
    const int64_t first = k * l.per_load, row = (1 + g.load_tangents) * PARTS, points = 3 * g.known->steps;
    const bool slopes = g.load_tangents, net = l.family == GAUSSIAN, placed = l.locations, axial = l.axial;
    const int64_t width = placed ? 2 : 3;
    const V L = splat(l.length), last = x(first + width);
    const Centre centre = placed ? Centre{splat(l.locations[k]), V{}}
                          : net  ? logistic_centre(l, x(first + 2))
                                 : algebraic_centre(l, x(first + 2));
    const V mu = centre.mu, dmu = centre.slope;
    const V c = net ? each(last, [](double a) { return std::exp(a); }) / (L * L) : last, dc = net ? c : splat(1.0);
    const BumpAt at(mu, c);
    const Bump whole = at(L);
    // net: G = F once / S with S = once(L), so that F stays what the rod feels; paper: G = a once.
    const V S = net ? whole.once : splat(1.0), S_mu = net ? whole.once_mu : V{}, S_c = net ? whole.once_c : V{};
    const V per_S = 1.0 / S;
    const double unit = net ? l.force_scale : 1.0;
    const V F[2] = {unit * x(first), unit * x(first + 1)};
    const Along z = axial ? along_rod(l, x(first), x(first + 1), x(first + width + 1)) : Along{};
    V previous = splat(std::numeric_limits<double>::quiet_NaN());
    Bump b{};
    for (int64_t p = 0; p <= points; p++) {
        const V s = p < points ? fetch(l.s, g.lanes, p) : L;
        if (any(~(s == previous))) b = at(s);  // a step begins where the last one ended
        previous = s;
        const V q[2] = {b.once * per_S, b.again * per_S};
        V* to = local + p * row;
        for (int axis = 0; axis < 2; axis++)
            for (int o = 0; o < 2; o++) to[axis + 3 * o] += F[axis] * q[o];  // G, then G2
        if (axial) to[2] += unit * z.value * q[0];
        if (!slopes) continue;
        const V q_mu[2] = {(b.once_mu - q[0] * S_mu) * per_S * dmu, (b.again_mu - q[1] * S_mu) * per_S * dmu};
        const V q_c[2] = {(b.once_c - q[0] * S_c) * per_S * dc, (b.again_c - q[1] * S_c) * per_S * dc};
        for (int axis = 0; axis < 2; axis++)
            for (int o = 0; o < 2; o++) {
                const int part = axis + 3 * o;
                to[(1 + first + axis) * PARTS + part] = unit * q[o];
                if (!placed) to[(1 + first + 2) * PARTS + part] = F[axis] * q_mu[o];
                to[(1 + first + width) * PARTS + part] = F[axis] * q_c[o];
            }
        if (!axial) continue;
        for (int axis = 0; axis < 2; axis++) to[(1 + first + axis) * PARTS + 2] = unit * z.by[axis] * q[0];
        if (!placed) to[(1 + first + 2) * PARTS + 2] = unit * z.value * q_mu[0];
        to[(1 + first + width) * PARTS + 2] = unit * z.value * q_c[0];
        to[(2 + first + width) * PARTS + 2] = unit * z.by_xi * q[0];
    }
}

// One point force at an unknown place, which is a node and carries its neighbours' stages along. coordinates/point.py.
template <class Gamma> void add_point(const Loads& l, const Group& g, int64_t k, Gamma x, V* local) {
    const int64_t first = k * l.per_load, row = (1 + g.load_tangents) * PARTS, points = 3 * g.known->steps;
    const V share = sigmoid(x(first + 2)), mu = l.length * share, dmu = mu * (1.0 - share);
    const V F[2] = {l.force_scale * x(first), l.force_scale * x(first + 1)};
    const Along z = l.axial ? along_rod(l, x(first), x(first + 1), x(first + 3)) : Along{};
    for (int64_t p = 0; p <= points; p++) {
        const V s = p < points ? fetch(l.s, g.lanes, p) : splat(l.length);
        const V on = p < points ? select(fetch(l.inside, g.lanes, p) > mu, splat(1.0), V{}) : splat(1.0);
        const V ramp = on * (s - mu);
        V* to = local + p * row;
        if (l.axial) {
            to[2] += l.force_scale * z.value * on;
            for (int axis = 0; g.load_tangents && axis < 2; axis++) to[(1 + first + axis) * PARTS + 2] = l.force_scale * z.by[axis] * on;
            if (g.load_tangents) to[(4 + first) * PARTS + 2] = l.force_scale * z.by_xi * on;
        }
        for (int axis = 0; axis < 2; axis++) {
            to[axis] += F[axis] * on, to[3 + axis] += F[axis] * ramp;
            if (!g.load_tangents) continue;
            to[(1 + first + axis) * PARTS + axis] = l.force_scale * on;
            to[(1 + first + axis) * PARTS + 3 + axis] = l.force_scale * ramp;
            for (int64_t j = 0; j < l.size; j++) {  // the ramp's foot moves with this load, its head with any load's node
                V ds = V{};
                if (p < points) {
                    const int64_t i = p / 3, stage = p % 3;
                    ds = (1 - 0.5 * stage) * g.node_moves[i * l.size + j] + 0.5 * stage * g.node_moves[(i + 1) * l.size + j];
                }
                if (j == first + 2) ds -= dmu;
                to[(1 + j) * PARTS + 3 + axis] += F[axis] * on * ds;
            }
        }
    }
}

template <class Gamma> void move_nodes(const Loads& l, const Group& g, Gamma x, V* moves) {
    for (int64_t i = 0; i < (g.known->steps + 1) * l.size; i++) moves[i] = V{};
    for (int64_t k = 0; k < l.count; k++) {
        const V share = sigmoid(x(k * l.per_load + 2)), dmu = l.length * share * (1.0 - share);
        for (int64_t i = 0; i <= g.known->steps; i++) {
            V& to = moves[i * l.size + k * l.per_load + 2];
            to = select(reached(l.node, g.lanes, k, i), dmu, to);
        }
    }
}

// LINEAR, whose basis holds F_z = xi of every load: what is different where that depends on F.
template <class Gamma> void bend_along(const Loads& l, const Group& g, Gamma x, V* local) {
    const int64_t row = (1 + g.load_tangents) * PARTS, rows = 3 * g.known->steps + 1;
    for (int64_t k = 0; k < l.count; k++) {
        const int64_t first = k * l.per_load, xi = first + l.per_load - 1;
        const Along z = along_rod(l, x(first), x(first + 1), x(xi));
        for (int64_t p = 0; p < rows; p++) {
            const double unit = l.basis[(p * l.size + xi) * PARTS + 2];
            V* to = local + p * row;
            to[2] += unit * (z.value - x(xi));
            for (int axis = 0; g.load_tangents && axis < 2; axis++) to[(1 + first + axis) * PARTS + 2] += unit * z.by[axis];
            if (g.load_tangents) to[(1 + xi) * PARTS + 2] = unit * z.by_xi;
        }
    }
}

// The whole table, (3 S + 1, 1 + load_tangents, PARTS): slopes for all entries of gamma, or none.
template <class Gamma> void fill_local(const Loads& l, const Group& g, Gamma x, V* local) {
    const int64_t row = (1 + g.load_tangents) * PARTS, rows = 3 * g.known->steps + 1;
    for (int64_t i = 0; i < rows * row; i++) local[i] = V{};
    for (int64_t k = 0; k < l.count; k++) {
        if (l.family == GAUSSIAN || l.family == PAPER) add_gaussian(l, g, k, x, local);
        if (l.family == POINT) add_point(l, g, k, x, local);
    }
    if (l.family == LINEAR)
        for (int64_t p = 0; p < rows; p++)
            for (int64_t j = 0; j < l.size; j++)
                for (int part = 0; part < PARTS; part++) {
                    const V unit = splat(l.basis[(p * l.size + j) * PARTS + part]);
                    if (g.load_tangents) local[p * row + (1 + j) * PARTS + part] = unit;
                    local[p * row + part] += x(j) * unit;
                }
    if (l.family == LINEAR && l.axial && std::isfinite(l.friction)) bend_along(l, g, x, local);
}
