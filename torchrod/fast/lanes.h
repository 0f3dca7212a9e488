// Numbers of the kernel: W samples in the lanes of one SIMD register, and the vectors and rotations made of them.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#define INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__)
constexpr int W = 8;
#elif defined(__AVX__)
constexpr int W = 4;
#else
constexpr int W = 2;
#endif

typedef double V __attribute__((vector_size(W * sizeof(double))));
typedef int64_t Mask __attribute__((vector_size(W * sizeof(double))));

INLINE V splat(double x) {
    V r;
    for (int i = 0; i < W; i++) r[i] = x;
    return r;
}
template <class F> INLINE V each(V x, F function) {
    for (int i = 0; i < W; i++) x[i] = function(x[i]);
    return x;
}
INLINE V root(V x) {
    return each(x, [](double a) { return std::sqrt(a); });
}
INLINE V select(Mask m, V a, V b) { return m ? a : b; }
INLINE V larger(V a, V b) { return a > b ? a : b; }
INLINE V smaller(V a, V b) { return a < b ? a : b; }
INLINE Mask finite(V x) { return x - x == 0.0; }

struct V3 {
    V c[3];
};
INLINE V3 operator+(const V3& a, const V3& b) { return {a.c[0] + b.c[0], a.c[1] + b.c[1], a.c[2] + b.c[2]}; }
INLINE V3 operator-(const V3& a, const V3& b) { return {a.c[0] - b.c[0], a.c[1] - b.c[1], a.c[2] - b.c[2]}; }
INLINE V3 operator*(V s, const V3& a) { return {s * a.c[0], s * a.c[1], s * a.c[2]}; }
INLINE V3 cross(const V3& a, const V3& b) {
    return {a.c[1] * b.c[2] - a.c[2] * b.c[1], a.c[2] * b.c[0] - a.c[0] * b.c[2], a.c[0] * b.c[1] - a.c[1] * b.c[0]};
}
INLINE V dot(const V3& a, const V3& b) { return a.c[0] * b.c[0] + a.c[1] * b.c[1] + a.c[2] * b.c[2]; }
INLINE V3 part(const V* x) { return {x[0], x[1], x[2]}; }
INLINE V3 matvec(const V* A, const V3& x) {  // (3, 3)
    return {A[0] * x.c[0] + A[1] * x.c[1] + A[2] * x.c[2], A[3] * x.c[0] + A[4] * x.c[1] + A[5] * x.c[2],
            A[6] * x.c[0] + A[7] * x.c[1] + A[8] * x.c[2]};
}
INLINE V3 matvec(const double* A, const V3& x) {
    return {A[0] * x.c[0] + A[1] * x.c[1] + A[2] * x.c[2], A[3] * x.c[0] + A[4] * x.c[1] + A[5] * x.c[2],
            A[6] * x.c[0] + A[7] * x.c[1] + A[8] * x.c[2]};
}
INLINE V3 matvec4(const V* A, const V* x) {  // (3, 4)
    V3 r;
    for (int i = 0; i < 3; i++) r.c[i] = A[4 * i] * x[0] + A[4 * i + 1] * x[1] + A[4 * i + 2] * x[2] + A[4 * i + 3] * x[3];
    return r;
}

// R(q) a with q = (vector, w): lie.py, rotate; with the vector reversed, unrotate.
INLINE V3 turned(const V3& q, V w, const V3& a) {
    const V3 t = splat(2.0) * cross(q, a);
    return a + w * t + cross(q, t);
}
// How it moves with q, (3, 4): 2 [w e_k x a + q a_k + e_k (q . a) - 2 a q_k], and 2 q x a by w. sign = -1: of unrotate.
INLINE void turning(const V3& q, V w, double sign, const V3& a, V* J) {
    const V3 by_w = cross(q, a);
    const V along = dot(q, a), s = sign * w;
    const V hat[9] = {V{}, -a.c[2], a.c[1], a.c[2], V{}, -a.c[0], -a.c[1], a.c[0], V{}};
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < 3; k++)
            J[4 * i + k] = 2.0 * (q.c[i] * a.c[k] - s * hat[3 * i + k] - 2.0 * a.c[i] * q.c[k] + (i == k ? along : V{}));
        J[4 * i + 3] = (2.0 * sign) * by_w.c[i];
    }
}
