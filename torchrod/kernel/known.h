// What is known beforehand: tables in memory that are shared by the batch or have one row per sample, and which samples are at work.
// These structures are mirrored in structures.py.
#pragma once

#include "lanes.h"

struct Table {  // null where there is none; stride 0: shared, else numbers per sample
    const double* data;
    int64_t stride;
};

struct Places {  // integers, likewise
    const int64_t* data;
    int64_t stride;
};

struct Known {
    int64_t steps, tendons, newton, diagonal;
    const double *K_se, *K_bt, *K_se_inverse, *K_bt_inverse;  // 9 each
    Table h;                                                  // (S)
    Table Gm, Wn, Wm, u_star;                                 // (S, 3, 3)
    Table L, dr, tau;                                         // (S, 3, T, 18), (S, 3, T, 3), (S, 3, T)
    Places at;                                                // (P) nodes of the outputs
    int64_t outputs;
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
