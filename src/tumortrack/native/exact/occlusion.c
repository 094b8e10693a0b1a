// See ``sense.occlusion``: in what order pixels are hidden.
#include "native.h"

enum { BINS = 1024, LANES = 64 };  // of the histogram in ``take_first``; at once there

// A straight band that comes in against ``towards`` (unit vector, px) and ends round at ``tip``
// (px), ``half`` wide there to either side and wider by ``taper`` a pixel outwards. What lies
// farthest out comes first, as when it is pushed in; what lies outside is infinite.
struct order_shaft {
    i32_1 columns;
    i32_1 rows;
    double tip[2], towards[2], half, taper;
    f32_1 out;
};
KERNEL(void, order_shaft) {
    const double x = a->tip[0], y = a->tip[1], half = a->half, taper = a->taper;
    const double dx = a->towards[0], dy = a->towards[1];
    const int32_t *restrict const columns = a->columns.at, *restrict const rows = a->rows.at;
    float *restrict const out = a->out.at;
    for (int64_t i = 0; i < a->columns.n[0]; i++) {
        const double du = columns[i] - x, dv = rows[i] - y;
        const double along = du * dx + dv * dy, across = fabs(dv * dx - du * dy);
        const bool shaft = across < half + taper * along, tip = du * du + dv * dv < half * half;
        out[i] = (along >= 0 ? shaft : tip) ? (float)-along : INFINITY;
    }
}

// Sums of the waves (k, 3): frequency (rad/px), phase, height.
static void add_waves(const double *waves, int64_t count, float *out, int64_t length) {
    for (int64_t place = 0; place < length; place++) out[place] = 0;
    for (const double *wave = waves; wave < waves + 3 * count; wave += 3) {
        for (int64_t place = 0; place < length; place++) {
            out[place] += wave[2] * cos(wave[0] * place + wave[1]);
        }
    }
}

// A patch with a wavy edge that grows from ``start`` (px): a blob or a half plane.
//
// ``axes``, 1/px: a blob's two lengths and directions; a half plane grows along the first.
// ``waves``: of the edge, along the columns and along the rows. ``along_u``, ``along_v``: room for
// a row and a column of the image.
struct order_patch {
    i32_1 columns;
    i32_1 rows;
    double start[2], axes[4];
    int64_t blob;
    f64_3 waves;
    f32_1 along_u;
    f32_1 along_v;
    f32_1 out;
};
// With pointers that are known to be apart it is vectorised. Pixels outside wave as the border's.
static void patch(
    const struct order_patch *a, const float *restrict along_u, const float *restrict along_v,
    float *restrict out) {
    const uint32_t width = (uint32_t)a->along_u.n[0], height = (uint32_t)a->along_v.n[0];
    const double x = a->start[0], y = a->start[1], *const axes = a->axes;
    const bool blob = a->blob;
    for (int64_t i = 0; i < a->columns.n[0]; i++) {
        const int32_t u = a->columns.at[i], v = a->rows.at[i];
        const double du = u - x, dv = v - y;
        const double one = du * axes[0] + dv * axes[1], two = du * axes[2] + dv * axes[3];
        const double distance = blob ? sqrt(one * one + two * two) : one;
        const uint32_t here = (uint32_t)u < width ? (uint32_t)u : width - 1;
        const uint32_t there = (uint32_t)v < height ? (uint32_t)v : height - 1;
        out[i] = distance + along_u[here] + along_v[there];
    }
}
KERNEL(void, order_patch) {
    const int64_t count = a->waves.n[1];
    add_waves(a->waves.at, count, a->along_u.at, a->along_u.n[0]);
    add_waves(a->waves.at + 3 * count, count, a->along_v.at, a->along_v.n[0]);
    patch(a, a->along_u.at, a->along_v.at, a->out.at);
}

// Marks in ``taken`` the ``count`` pixels of lowest ``order`` that are not taken yet, or a few less
// (whole bins of a histogram only); infinite ones never. Returns how many. The extremes are sought
// in lanes: only so are they vectorised.
#define TAKE_FIRST(name, array, real)                                                              \
    struct name { array order; u8_1 taken; int64_t count; i64_1 histogram; };                      \
    KERNEL(int64_t, name) {                                                                        \
        const real *restrict const order = a->order.at, none = INFINITY;                           \
        uint8_t *restrict const taken = a->taken.at;                                               \
        const int64_t n = a->taken.n[0];                                                           \
        real low = none, high = -none, lows[LANES], highs[LANES], up[LANES], down[LANES];          \
        for (int k = 0; k < LANES; k++) lows[k] = none, highs[k] = -none;                          \
        for (int64_t start = 0; start < n; start += LANES) {                                       \
            const int64_t count = min_i64(LANES, n - start);                                       \
            for (int k = 0; k < LANES; k++) up[k] = none;                                          \
            for (int k = 0; k < count; k++) up[k] = taken[start + k] ? none : order[start + k];    \
            for (int k = 0; k < LANES; k++) down[k] = up[k] < none ? up[k] : -none;                \
            for (int k = 0; k < LANES; k++) lows[k] = up[k] < lows[k] ? up[k] : lows[k];           \
            for (int k = 0; k < LANES; k++) highs[k] = down[k] > highs[k] ? down[k] : highs[k];    \
        }                                                                                          \
        for (int k = 0; k < LANES; k++) {                                                          \
            low = lows[k] < low ? lows[k] : low;                                                   \
            high = highs[k] > high ? highs[k] : high;                                              \
        }                                                                                          \
        const double scale = (BINS - 1) / (double)(high - low > 1e-6f ? high - low : 1e-6f);       \
        int64_t room = 0, marked = 0, last = BINS - 1, total = 0;                                  \
        for (int64_t i = 0; i < n; i++) room += (taken[i] == 0) & (order[i] < none);               \
        if (room > a->count) {                                                                     \
            int64_t *const histogram = a->histogram.at;                                            \
            memset(histogram, 0, BINS * sizeof *histogram);                                        \
            for (int64_t i = 0; i < n; i++) {                                                      \
                if (taken[i] || !(order[i] < none)) continue;                                      \
                histogram[(int)clampd((order[i] - low) * scale, 0, BINS - 1)]++;                   \
            }                                                                                      \
            for (last = -1; total + histogram[last + 1] <= a->count;) total += histogram[++last];  \
        }                                                                                          \
        const double end = last + 1;                                                               \
        for (int64_t i = 0; i < n; i++) {                                                          \
            const uint8_t later = (order[i] - low) * scale >= end;                                 \
            const uint8_t first = (taken[i] == 0) & (order[i] < none) & !later;                    \
            taken[i] |= first;                                                                     \
            marked += first;                                                                       \
        }                                                                                          \
        return marked;                                                                             \
    }
TAKE_FIRST(take_first, f32_1, float)
TAKE_FIRST(take_first_wide, f64_1, double)
