// See registration/estimate.py.
#include "native.h"

// Of normal errors below margins (n,), 0 or more. ``per_std[which]`` is one over a point's standard
// deviation. 0, or 1 if ``which`` names one that is not there: the call ends at it.
struct probabilities {
    f32_1 margins;
    f64_1 per_std;
    i32_1 which;
    f32_1 out;
};
KERNEL(int64_t, probabilities) {
    const int64_t most = a->per_std.n[0];
    for (int64_t p = 0; p < a->margins.n[0]; p++) {
        const int32_t n = a->which.at[p];
        if (n < 0 || n >= most) return 1;
        const double off = a->margins.at[p] * a->per_std.at[n];
        a->out.at[p] = off < 6 ? (float)(0.5 * erfc(-M_SQRT1_2 * off)) : 1;  // there 1 in float32
    }
    return 0;
}

// The number of the place nearest to each point: that of the nearest node of a lattice.
struct look_up {
    f32_1 origin;
    i32_3 nearest;
    f32_2 points;
    double spacing;
    i32_1 out;
};
KERNEL(void, look_up) {
    const int64_t *n = a->nearest.n;
    const float step = (float)a->spacing, *origin = a->origin.at;
    for (int64_t p = 0; p < a->points.n[0]; p++) {
        int64_t node[3];
        for (int axis = 0; axis < 3; axis++) {
            const float place = (a->points.at[3 * p + axis] - origin[axis]) / step + 0.5f;
            node[axis] = (int64_t)clampf(place, 0, (float)(n[axis] - 1));
        }
        a->out.at[p] = a->nearest.at[(node[0] * n[1] + node[1]) * n[2] + node[2]];
    }
}
