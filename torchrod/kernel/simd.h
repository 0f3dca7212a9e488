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

// e^x for |x| <= 700, to 2 units in the last place: x = n log 2 + r, e^r by its series to r^13, then 2^n into the exponent.
INLINE V exponential(V x) {
    const V shifted = x * 1.4426950408889634 + 0x1.8p52, n = shifted - 0x1.8p52;  // the sum's last bits hold n, rounded to nearest
    const V r = (x - n * 0x1.62e42fefa3800p-1) - n * 0x1.ef35793c76730p-45;
    V series = splat(1.0 / 6227020800.0);
    for (double factorial : {479001600.0, 39916800.0, 3628800.0, 362880.0, 40320.0, 5040.0, 720.0, 120.0, 24.0, 6.0, 2.0, 1.0, 1.0})
        series = series * r + 1.0 / factorial;
    return (V)((Mask)series + ((Mask)shifted << 52));
}

// erf(x), bell = exp(-x^2), to 6e-16: 1 - bell f(t) / (1 + 2 |x|), where f = erfcx(x) (1 + 2 x) is smooth in t = (x - a) / (x + a)
// on all of [0, inf) (Shepherd & Laframboise 1981); a = 3.75, the Chebyshev series of f cut at t^23 and written in powers of t.
INLINE V error_function(V x, V bell) {
    constexpr double f[24] = {
        1.2375126308378275,    -0.14024059858554697,   0.0035854154854790257,  0.0822767384901452,    -0.10880393014244462,
        0.09230432116037748,   -0.05869339857664934,   0.028362277418956406,   -0.009746579683265262, 0.0017556258528952954,
        0.000293714378044958,  -0.0002901540805408417, 5.164652974177416e-05,  2.238423915508223e-05, -1.1438048033346894e-05,
        -9.73559896736775e-07, 1.7419821586224816e-06, -5.7218230603224086e-08, -2.4857126248016745e-07, 2.3263508708859124e-08,
        3.197926671666804e-08, -3.744210080962018e-09, -2.623107347133476e-09, 3.1114333809799254e-10};
    const V away = x < 0 ? -x : x, size = away > 30 ? splat(30.0) : away, twice = 1.0 + 2.0 * size, far = size + 3.75;
    const V both = 1.0 / (twice * far), t = (size - 3.75) * twice * both, square = t * t;  // a division less
    V even = splat(f[22]), odd = splat(f[23]);  // two chains of half the length
    for (int k = 20; k >= 0; k -= 2) even = even * square + f[k], odd = odd * square + f[k + 1];
    const V result = 1.0 - bell * (even + t * odd) * (far * both);
    return x < 0 ? -result : result;
}

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

// R(q) a = q a q* with q = (vector, w): lie.py, rotate; with the vector reversed, unrotate.
INLINE V3 turned(const V3& q, V w, const V3& a) {
    const V3 t = splat(2.0) * cross(q, a);
    return (w * w + dot(q, q)) * a + w * t + cross(q, t);
}
// How it moves with q, (3, 4): 2 [w e_k x a + q a_k + e_k (q . a) - a q_k], and 2 (q x a + w a) by w. sign = -1: of unrotate.
INLINE void turning(const V3& q, V w, double sign, const V3& a, V* J) {
    const V3 by_w = cross(q, a);
    const V along = dot(q, a), s = sign * w;
    const V hat[9] = {V{}, -a.c[2], a.c[1], a.c[2], V{}, -a.c[0], -a.c[1], a.c[0], V{}};
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < 3; k++)
            J[4 * i + k] = 2.0 * (q.c[i] * a.c[k] - s * hat[3 * i + k] - a.c[i] * q.c[k] + (i == k ? along : V{}));
        J[4 * i + 3] = 2.0 * (sign * by_w.c[i] + w * a.c[i]);
    }
}
