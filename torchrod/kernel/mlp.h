// The hidden layers of a multilayer perceptron with GELU: the compiled copy of Network.hidden in torchrod/learned/network.py, in single
// precision, which is what the weights were learned in and more than a guess needs. A block of samples goes through each layer
// together, so that the weights, which do not fit beside them in the cache, are read once for the block.
#pragma once

#include <vector>

#include "simd.h"

typedef float F __attribute__((vector_size(W * sizeof(double))));  // 2 W samples
typedef int32_t Bits __attribute__((vector_size(W * sizeof(double))));
constexpr int FLOATS = 2 * W, BLOCK = 2, OUT = 4;  // registers of samples that go through together; sums at a time

struct Perceptron {
    int64_t depth;          // layers, GELU after each
    const int64_t* sizes;   // (depth + 1); all but the first multiples of OUT
    const float* weights;   // of every layer in turn: for OUT outputs at a time their bias (OUT) and then (in, OUT)
};

INLINE F splat_single(float x) {
    F r;
    for (int i = 0; i < FLOATS; i++) r[i] = x;
    return r;
}

// exp(-z^2) to 2e-7: as `exponential` in simd.h.
INLINE F bell_single(F z) {
    const F square = z * z, x = -(square < 80.0f ? square : splat_single(80.0f));
    const F shifted = x * 1.44269504f + 0x1.8p23f, n = shifted - 0x1.8p23f;
    const F r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    F series = splat_single(1.0f / 5040);
    for (float factorial : {720.0f, 120.0f, 24.0f, 6.0f, 2.0f, 1.0f, 1.0f}) series = series * r + 1.0f / factorial;
    return (F)((Bits)series + ((Bits)shifted << 23));
}

// x (1 + erf(x / sqrt 2)) / 2, erf to 2e-7 (Abramowitz & Stegun 7.1.26).
INLINE F gelu(F x) {
    const F z = 0.70710678f * x, size = z < 0 ? -z : z, t = 1.0f / (1.0f + 0.3275911f * size);
    const F tail = t * (0.254829592f + t * (-0.284496736f + t * (1.421413741f + t * (-1.453152027f + t * 1.061405429f)))) * bell_single(z);
    return 0.5f * x * (z < 0 ? tail : 2.0f - tail);
}

// OUT outputs for every sample of the block, so that their chains of additions overlap. x, y: (., BLOCK).
INLINE void outputs(const float* w, int64_t in, const F* x, F* y) {
    F sum[OUT][BLOCK];
    for (int o = 0; o < OUT; o++)
        for (int k = 0; k < BLOCK; k++) sum[o][k] = splat_single(w[o]);
    for (int64_t i = 0; i < in; i++)
        for (int o = 0; o < OUT; o++)
            for (int k = 0; k < BLOCK; k++) sum[o][k] += w[(i + 1) * OUT + o] * x[i * BLOCK + k];
    for (int o = 0; o < OUT; o++)
        for (int k = 0; k < BLOCK; k++) y[o * BLOCK + k] = gelu(sum[o][k]);
}

// x: room for two layers of the widest size; its first sizes[0] entries are the input. Returns where the last layer's output is.
inline const F* perceptron(const Perceptron& p, F* x, int64_t widest) {
    const float* w = p.weights;
    F *from = x, *to = x + widest * BLOCK;
    for (int64_t layer = 0; layer < p.depth; layer++) {
        const int64_t in = p.sizes[layer], out = p.sizes[layer + 1];
        for (int64_t o = 0; o < out; o += OUT, w += (in + 1) * OUT) outputs(w, in, from, to + o * BLOCK);
        F* was = from;
        from = to, to = was;
    }
    return from;
}
