// One arc-length step in the frame of the section at its beginning: where nothing acts in the base frame and the section is round
// (no tendons, no weight, diagonal stiffness), half the work of the tangents of section.h, to the same numbers.
//
// (1) Within a step from q (|q| = 1) write the orientation of stage i as q e_i. section.py's rate q' = q (u, 0) / 2 is linear in q, and
//     its R(q e) = R(q) R(e), so that for the classical Runge-Kutta step of length h, with u_i as quaternions of no real part,
//         e_1 = 1,  e_2 = 1 + h/4 e_1 u_1,  e_3 = 1 + h/4 e_2 u_2,  e_4 = 1 + h/2 e_3 u_3,
//         E = 1 + h/12 (e_1 u_1 + 2 e_2 u_2 + 2 e_3 u_3 + e_4 u_4),   P = h/6 sum w_i e_i v_i e_i*,   w = (1, 2, 2, 1),
//         q+ = q E / |E|,   p+ = p + R(q) P,
//     and N~, M~ do not see the orientation at all.
// (2) A tangent moves q by q (theta, 0) / 2 and p by R(q) pi. With Q = R(E / |E|)^T and Im the vector part,
//         theta+ = Q theta + 2 Im(E* dE) / |E|^2,   pi+ = Q (pi + theta x P + dP).
// (3) dE and dP are linear in du_i and dv_i. Going back from the last stage (d e_4 = h/2 (d e_3 u_3 + e_3 du_3), and so on),
//         dE = sum e_i du_i g_i:       g_4 = h/12,  g_3 = h/6 + h/2 u_4 g_4,  g_2 = h/6 + h/4 u_3 g_3,  g_1 = h/12 + h/4 u_2 g_2
//         dP = sum Im(e_i du_i b_i) + h/6 w_i R(e_i) dv_i:
//                                      b_4 = 0,     b_3 = h/2 m_4,            b_2 = h/4 (m_3 + u_3 b_3),  b_1 = h/4 (m_2 + u_2 b_2)
//     with m_i = h/3 w_i v_i e_i*, because d(e v e*) = 2 Im(de v e*).
// (4) A step of N~, M~ as z_2 = y + h/2 k_1, z_3 = y + h/2 k_2, z_4 = y + h k_3, y+ = (z_2 + 2 z_3 + z_4 - y) / 3 + h/6 k_4 lets
//     every tangent's k be a product with a matrix that has its share of h in it.
#pragma once

#include "section.h"

constexpr int CARRIED = 12;  // of a tangent in the section's own frame: dN~, dM~, theta, pi

struct Quaternion {
    V3 v;
    V w;
};
INLINE Quaternion operator*(const Quaternion& a, const Quaternion& b) {
    return {a.w * b.v + b.w * a.v + cross(a.v, b.v), a.w * b.w - dot(a.v, b.v)};
}
INLINE Quaternion operator*(const Quaternion& a, const V3& u) { return {a.w * u + cross(a.v, u), V{} - dot(a.v, u)}; }
INLINE Quaternion operator*(const V3& u, const Quaternion& b) { return {b.w * u + cross(u, b.v), V{} - dot(u, b.v)}; }
INLINE Quaternion operator*(V s, const Quaternion& a) { return {s * a.v, s * a.w}; }
INLINE Quaternion operator+(const Quaternion& a, const Quaternion& b) { return {a.v + b.v, a.w + b.w}; }
INLINE Quaternion plus(V s, const Quaternion& a) { return {a.v, s + a.w}; }
INLINE Quaternion conjugate(const Quaternion& a) { return {V3{} - a.v, a.w}; }

// The matrix (3, 3) of d -> Im(a d g), its columns multiplied by k.
INLINE void between(const Quaternion& a, const Quaternion& g, const V3& k, V* C) {
    const V even = a.w * g.w + dot(a.v, g.v);
    const V3 t = g.w * a.v - a.w * g.v;
    const V hat[9] = {even, -t.c[2], t.c[1], t.c[2], even, -t.c[0], -t.c[1], t.c[0], even};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) C[3 * i + j] = k.c[j] * (hat[3 * i + j] - (a.v.c[i] * g.v.c[j] + g.v.c[i] * a.v.c[j]));
}

// The matrix of d -> d x turn + along x (k d), which has no diagonal: its six other entries, times a.
INLINE void skewed(V a, const V3& turn, const V3& along, const V3& k, V* S) {
    S[0] = a * (turn.c[2] - along.c[2] * k.c[1]), S[1] = a * (along.c[1] * k.c[2] - turn.c[1]);
    S[2] = a * (along.c[2] * k.c[0] - turn.c[2]), S[3] = a * (turn.c[0] - along.c[0] * k.c[2]);
    S[4] = a * (turn.c[1] - along.c[1] * k.c[0]), S[5] = a * (along.c[0] * k.c[1] - turn.c[0]);
}
INLINE void add_skewed(const V* S, const V* d, V* to) {
    to[0] += S[0] * d[1] + S[1] * d[2], to[1] += S[2] * d[0] + S[3] * d[2], to[2] += S[4] * d[0] + S[5] * d[1];
}

// What a step leaves for its tangents. Of every stage, by dN and dM of the section's wrench: dk of (4) in blocks NN, NM, MN, MM;
// C dM of theta+, D dM + F dN of dP.
struct BodyStep {
    struct Stage {
        V NN[6], NM[6], MN[6], MM[6], C[9], D[9], F[9], share;
        V3 u, v;
        int64_t row;
    } at[4];
    V Q[9];
    V3 P;
};

// A section's compliances, whose stiffness is diagonal.
INLINE void compliance_of(const Group& g, int64_t row, V3& S, V3& B) {
    const Known& m = *g.known;
    if (g.kappa && !m.varying) {
        S = part(g.compliance), B = part(g.compliance + 3);
        return;
    }
    Stiffness K;
    if (g.kappa) stiffness_of(g, row, K);
    for (int k = 0; k < 3; k++) {
        const int64_t at = 4 * k + (m.varying ? 9 * row : 0);
        S.c[k] = g.kappa ? K.se[4 * k] : fetch(m.K_se_inverse, g.lanes, at);
        B.c[k] = g.kappa ? K.bt[4 * k] : fetch(m.K_bt_inverse, g.lanes, at);
    }
}

// What the parameters add to the wrench that the strains v, u balance, (parameter_tangents, FORCED), of whose numbers the first six:
// `forced_by` of section.h where K is diagonal and nothing else is off.
inline void forced_in_own_frame(const Group& g, int64_t row, const V3& v, const V3& u, const V3& u_star, const V3& B, V* to) {
    const Known& m = *g.known;
    const Deviations& d = m.off;
    const int64_t n = g.parameter_tangents;
    const V bent[6] = {v.c[0], v.c[1], v.c[2] - 1.0, u.c[0] - u_star.c[0], u.c[1] - u_star.c[1], u.c[2] - u_star.c[2]};
    for (int64_t j = 0; j < n; j++)
        for (int i = 0; i < 6; i++) to[j * FORCED + i] = V{};
    for (int64_t k = 0; k < d.stiffness; k++)
        for (int i = 0; i < 6; i++) {
            const V f = off_stiffness(g, k, row, 4 * (i % 3) + 9 * (i / 3)) * bent[i];
            for (int64_t j = 0; j < n; j++) to[j * FORCED + i] -= g.dkappa[k * n + j] * f;
        }
    for (int64_t k = 0; k < d.curvature; k++)
        for (int c = 0; c < 3; c++) {
            const V f = fetch(d.u_off, g.lanes, (k * 3 * m.steps + row) * 3 + c) / B.c[c];
            for (int64_t j = 0; j < n; j++) to[j * FORCED + 3 + c] += g.dkappa[(d.of_curvature() + k) * n + j] * f;
        }
}

// The four stages' values: the section's wrench and strains, the orientations e_i, and the wrench at the end.
struct Stages {
    V3 N[4], M[4], u[4], v[4];
    Quaternion e[4];
};

INLINE void body_stages(const Group& g, V* y, const int64_t* row, V h, const V3* S, const V3* B, Stages& s) {
    Stage at;
    V z[6], sum[6];
    for (int c = 0; c < 6; c++) z[c] = y[7 + c], sum[c] = V{};
    for (int i = 0; i < 4; i++) {
        if (i != 2) stage_of(g, row[i], at);  // the middle serves twice
        s.N[i] = part(z) - at.G;
        s.M[i] = part(z + 3) - at.Gm;
        s.M[i].c[0] -= at.G2y, s.M[i].c[1] += at.G2x;
        for (int k = 0; k < 3; k++) {
            s.v[i].c[k] = S[i].c[k] * s.N[i].c[k] + (k == 2 ? 1.0 : 0.0);
            s.u[i].c[k] = B[i].c[k] * s.M[i].c[k] + at.u_star.c[k];
        }
        if (const int64_t n = g.parameter_tangents) forced_in_own_frame(g, row[i], s.v[i], s.u[i], at.u_star, B[i], g.forced + i * n * FORCED);
        const V3 dN = cross(s.N[i], s.u[i]);
        V3 dM = cross(s.M[i], s.u[i]) + cross(s.N[i], s.v[i]);
        dM.c[0] += at.G.c[1], dM.c[1] -= at.G.c[0];
        const double weight = i == 0 || i == 3 ? 1 : 2;
        const V reach = (i < 2 ? 0.5 : 1.0) * h;
        for (int c = 0; c < 3; c++) {
            sum[c] += weight * dN.c[c], sum[3 + c] += weight * dM.c[c];
            z[c] = y[7 + c] + reach * dN.c[c], z[3 + c] = y[10 + c] + reach * dM.c[c];
        }
    }
    for (int c = 0; c < 6; c++) y[7 + c] += h * (1.0 / 6) * sum[c];
}

// (1)-(3): step i of the values y, and what its tangents need.
inline void body_step(const Group& g, V* y, int64_t i, bool reverse, BodyStep& b) {
    const Known& m = *g.known;
    const V h = (reverse ? -1.0 : 1.0) * fetch(m.h, g.lanes, i);
    const int64_t first = reverse ? 2 : 0, row[4] = {3 * i + first, 3 * i + 1, 3 * i + 1, 3 * i + 2 - first};
    V3 S[4], B[4];
    for (int e = 0; e < 4; e++) {
        if (e != 2 && (!e || m.varying)) compliance_of(g, row[e], S[e], B[e]);
        else S[e] = S[e - 1], B[e] = B[e - 1];
    }
    Stages s;
    body_stages(g, y, row, h, S, B, s);
    const V half = 0.5 * h, quarter = 0.25 * h, sixth = (1.0 / 6) * h, one = splat(1.0);
    const Quaternion c1{s.u[0], V{}};
    s.e[0] = {V3{}, one}, s.e[1] = plus(one, quarter * c1);
    const Quaternion c2 = s.e[1] * s.u[1];
    s.e[2] = plus(one, quarter * c2);
    const Quaternion c3 = s.e[2] * s.u[2];
    s.e[3] = plus(one, half * c3);
    const Quaternion E = plus(one, 0.5 * sixth * (c1 + splat(2.0) * (c2 + c3) + s.e[3] * s.u[3]));
    const V square = dot(E.v, E.v) + E.w * E.w, inverse = 1.0 / root(square);
    const Quaternion g4{V3{}, 0.5 * sixth}, g3 = plus(sixth, half * (s.u[3] * g4)), g2 = plus(sixth, quarter * (s.u[2] * g3)),
                     g1 = plus(0.5 * sixth, quarter * (s.u[1] * g2)), back = (2.0 * inverse * inverse) * conjugate(E);
    Quaternion moved[4], b1, b2, b3;
    const Quaternion g_[4] = {g1, g2, g3, g4};
    b.P = V3{};
    for (int k = 0; k < 4; k++) {
        const V weight = (k == 1 || k == 2 ? 2.0 : 1.0) * sixth;
        moved[k] = (2.0 * weight) * (s.v[k] * conjugate(s.e[k]));
        b.P = b.P + 0.5 * one * (s.e[k] * moved[k]).v;
    }
    const Quaternion turn = inverse * E, q{part(y + 3), y[6]}, on = q * turn;
    const V3 p = turned(q.v, q.w, b.P);
    const V size = 1.0 / root(dot(on.v, on.v) + on.w * on.w);  // q stays a unit quaternion to round-off
    for (int k = 0; k < 3; k++) y[k] += p.c[k], y[3 + k] = size * on.v.c[k];
    y[6] = size * on.w;
    if (!g.tangents) return;
    b3 = half * moved[3], b2 = quarter * (moved[2] + s.u[2] * b3), b1 = quarter * (moved[1] + s.u[1] * b2);
    const Quaternion b_[4] = {b1, b2, b3, Quaternion{}};
    for (int k = 0; k < 4; k++) {
        BodyStep::Stage& at = b.at[k];
        at.row = row[k], at.u = s.u[k], at.v = s.v[k], at.share = k < 2 ? half : k == 2 ? h : sixth;
        skewed(at.share, s.u[k], V3{}, V3{}, at.NN), skewed(at.share, V3{}, s.N[k], B[k], at.NM);
        skewed(at.share, s.v[k], s.N[k], S[k], at.MN), skewed(at.share, s.u[k], s.M[k], B[k], at.MM);
        between(back * s.e[k], g_[k], B[k], at.C), between(s.e[k], b_[k], B[k], at.D);
        const V weight = (k == 1 || k == 2 ? 2.0 : 1.0) * sixth;
        between(s.e[k], conjugate(s.e[k]), weight * S[k], at.F);
    }
    between(conjugate(turn), turn, V3{one, one, one}, b.Q);
}

// And of one tangent t = [dN~, dM~, theta, pi]; Loaded: it moves the local loads as well. Forced: it is a parameter's, which adds to
// what strains the section, not to the wrench itself.
template <bool Loaded, bool Forced> __attribute__((noinline)) void body_tangent(const Group& g, const BodyStep& b, int64_t j, V* t) {
    V x[4][6], sum[6], z[6];
    for (int c = 0; c < 6; c++) z[c] = t[c], sum[c] = -t[c];
#pragma GCC unroll 4
    for (int k = 0; k < 4; k++) {
        const BodyStep::Stage& at = b.at[k];
        V* d = x[k];
        for (int c = 0; c < 6; c++) d[c] = z[c], z[c] = k < 3 ? t[c] : V{};
        if (Loaded) {
            const V* l = g.local_slope(at.row, j);
            d[0] -= l[0], d[1] -= l[1], d[2] -= l[2], d[3] -= l[4], d[4] += l[3];
            z[3] += at.share * l[1], z[4] -= at.share * l[0];
        }
        add_skewed(at.NN, d, z);
        if (Forced) {  // d x u and d x v of the matrices are of the wrench alone
            const V* f = g.forced + (k * g.parameter_tangents + j - g.first_parameter()) * FORCED;
            const V3 more = cross(part(f), at.v) + cross(part(f + 3), at.u);
            for (int c = 0; c < 3; c++) z[3 + c] -= at.share * more.c[c];
            for (int c = 0; c < 6; c++) d[c] += f[c];
        }
        add_skewed(at.NM, d + 3, z);
        add_skewed(at.MN, d, z + 3), add_skewed(at.MM, d + 3, z + 3);
        if (k < 3)
            for (int c = 0; c < 6; c++) sum[c] += (k == 1 ? 2.0 : 1.0) * z[c];
    }
    for (int c = 0; c < 6; c++) t[c] = (1.0 / 3) * sum[c] + z[c];
    const V3 theta = part(t + 6);
    V3 dE{}, dP = part(t + 9) + cross(theta, b.P);
#pragma GCC unroll 4
    for (int k = 0; k < 4; k++) {
        const BodyStep::Stage& at = b.at[k];
        const V3 dN = part(x[k]), dM = part(x[k] + 3);
        dE = dE + matvec(at.C, dM), dP = dP + matvec(at.F, dN);
        if (k < 3) dP = dP + matvec(at.D, dM);
    }
    const V3 turned = matvec(b.Q, theta) + dE, shifted = matvec(b.Q, dP);
    for (int c = 0; c < 3; c++) t[6 + c] = turned.c[c], t[9 + c] = shifted.c[c];
}

// R(q) of y.
INLINE void rotation(const V* y, V* R) {
    const Quaternion q{part(y + 3), y[6]};
    const V one = splat(1.0);
    between(q, conjugate(q), V3{one, one, one}, R);
}

// The tangent as section.h has it, [dp, dq, dN~, dM~] in the base frame, and back. R: of y.
INLINE void to_base_frame(const V* y, const V* R, const V* t, bool turning, V* dy) {
    const V3 p = matvec(R, part(t + 9));
    for (int c = 0; c < 3; c++) dy[c] = p.c[c];
    for (int c = 0; c < 6; c++) dy[7 + c] = t[c];
    if (!turning) return;
    const Quaternion dq = Quaternion{part(y + 3), y[6]} * part(t + 6);
    for (int c = 0; c < 3; c++) dy[3 + c] = 0.5 * dq.v.c[c];
    dy[6] = 0.5 * dq.w;
}
INLINE void to_own_frame(const V* y, const V* R, const V* dy, V* t) {
    const V3 half = (conjugate(Quaternion{part(y + 3), y[6]}) * Quaternion{part(dy + 3), dy[6]}).v;
    for (int c = 0; c < 6; c++) t[c] = dy[7 + c];
    for (int c = 0; c < 3; c++) t[6 + c] = 2.0 * half.c[c], t[9 + c] = R[c] * dy[0] + R[3 + c] * dy[1] + R[6 + c] * dy[2];
}
