// Numbers of the kernel: W samples in the lanes of one SIMD register, and dual numbers that carry K tangents of each.
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

template <int K> struct Dual {
    V v, d[K ? K : 1];
};
template <int K> INLINE Dual<K> constant(V v) {
    Dual<K> r;
    r.v = v;
    for (int j = 0; j < K; j++) r.d[j] = V{};
    return r;
}
template <int K> INLINE Dual<K> operator+(const Dual<K>& a, const Dual<K>& b) {
    Dual<K> r;
    r.v = a.v + b.v;
    for (int j = 0; j < K; j++) r.d[j] = a.d[j] + b.d[j];
    return r;
}
template <int K> INLINE Dual<K> operator-(const Dual<K>& a, const Dual<K>& b) {
    Dual<K> r;
    r.v = a.v - b.v;
    for (int j = 0; j < K; j++) r.d[j] = a.d[j] - b.d[j];
    return r;
}
template <int K> INLINE Dual<K> operator-(const Dual<K>& a) {
    Dual<K> r;
    r.v = -a.v;
    for (int j = 0; j < K; j++) r.d[j] = -a.d[j];
    return r;
}
template <int K> INLINE Dual<K> operator+(const Dual<K>& a, V b) {
    Dual<K> r = a;
    r.v = a.v + b;
    return r;
}
template <int K> INLINE Dual<K> operator-(const Dual<K>& a, V b) {
    Dual<K> r = a;
    r.v = a.v - b;
    return r;
}
template <int K> INLINE Dual<K> operator*(const Dual<K>& a, const Dual<K>& b) {
    Dual<K> r;
    r.v = a.v * b.v;
    for (int j = 0; j < K; j++) r.d[j] = a.v * b.d[j] + b.v * a.d[j];
    return r;
}
template <int K> INLINE Dual<K> operator*(V a, const Dual<K>& b) {
    Dual<K> r;
    r.v = a * b.v;
    for (int j = 0; j < K; j++) r.d[j] = a * b.d[j];
    return r;
}
template <int K> INLINE Dual<K> operator*(double a, const Dual<K>& b) { return splat(a) * b; }

template <int K> struct Vec {
    Dual<K> c[3];
};
template <int K> INLINE Vec<K> operator+(const Vec<K>& a, const Vec<K>& b) { return {a.c[0] + b.c[0], a.c[1] + b.c[1], a.c[2] + b.c[2]}; }
template <int K> INLINE Vec<K> operator-(const Vec<K>& a, const Vec<K>& b) { return {a.c[0] - b.c[0], a.c[1] - b.c[1], a.c[2] - b.c[2]}; }
template <int K> INLINE Vec<K> operator-(const Vec<K>& a) { return {-a.c[0], -a.c[1], -a.c[2]}; }
template <int K> INLINE Vec<K> operator*(const Dual<K>& s, const Vec<K>& a) { return {s * a.c[0], s * a.c[1], s * a.c[2]}; }
template <int K> INLINE Vec<K> cross(const Vec<K>& a, const Vec<K>& b) {
    return {a.c[1] * b.c[2] - a.c[2] * b.c[1], a.c[2] * b.c[0] - a.c[0] * b.c[2], a.c[0] * b.c[1] - a.c[1] * b.c[0]};
}
// R(q) a with q = (vector, w): lie.py, rotate; with the vector reversed, unrotate.
template <int K> INLINE Vec<K> turned(const Vec<K>& q, const Dual<K>& w, const Vec<K>& a) {
    Vec<K> t = cross(q, a);
    for (auto& x : t.c) x = 2.0 * x;
    return a + w * t + cross(q, t);
}
