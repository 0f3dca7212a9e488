// The hidden layers of a multilayer perceptron with GELU, for the samples in the lanes: the compiled copy of network.py, Network.hidden.
#pragma once

#include <vector>

#include "known.h"

struct Perceptron {
    int64_t depth;            // layers, GELU after each
    const int64_t* sizes;     // (depth + 1)
    const double *mean, *std;  // of the inputs
    double largest;           // inputs beyond so many standard deviations are clipped
    const double* weights;    // of every layer in turn: (in, out) and then the bias (out)
};

INLINE V gelu(V x) {
    const V z = M_SQRT1_2 * x;
    return 0.5 * x * (1.0 + error_function(z, exponential(-smaller(z * z, splat(700.0)))));
}

// `out` sums at a time, so that their chains of additions overlap.
template <int Out> INLINE void sums(const double* w, int64_t in, int64_t stride, const V* x, const double* bias, V* y) {
    V sum[Out];
    for (int o = 0; o < Out; o++) sum[o] = splat(bias[o]);
    for (int64_t i = 0; i < in; i++)
        for (int o = 0; o < Out; o++) sum[o] += w[i * stride + o] * x[i];
    for (int o = 0; o < Out; o++) y[o] = sum[o];
}

// x: room for two layers of the widest size; its first sizes[0] entries are the input. Returns where the last layer's output is.
inline const V* perceptron(const Perceptron& p, V* x, int64_t widest) {
    for (int64_t i = 0; i < p.sizes[0]; i++) {
        const V z = (x[i] - p.mean[i]) / p.std[i], low = z < -p.largest ? splat(-p.largest) : z;
        x[i] = low > p.largest ? splat(p.largest) : low;
    }
    const double* w = p.weights;
    V *from = x, *to = x + widest;
    for (int64_t layer = 0; layer < p.depth; layer++) {
        const int64_t in = p.sizes[layer], out = p.sizes[layer + 1];
        const double* bias = w + in * out;
        int64_t o = 0;
        for (; o + 8 <= out; o += 8) sums<8>(w + o, in, out, from, bias + o, to + o);
        for (; o < out; o++) sums<1>(w + o, in, out, from, bias + o, to + o);
        for (o = 0; o < out; o++) to[o] = gelu(to[o]);
        w = bias + out;
        V* was = from;
        from = to, to = was;
    }
    return from;
}
