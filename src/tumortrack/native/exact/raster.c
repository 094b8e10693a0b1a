// Scan conversion of closed surfaces into grids, by rays along the grids' last axis. Rounded as in
// the reference, `cover` in tests/support: which pixel an edge owns depends on the last bit.
#include "triangle.h"

ARRAYS(i16, int16_t)

// Where a triangle begins and ends on the line i of its first axis.
static inline void span(const double *corners, double i, double *low, double *high) {
    *low = INFINITY, *high = -INFINITY;
    for (int edge = 0; edge < 3; edge++) {
        const double *a = corners + 3 * edge, *b = corners + 3 * ((edge + 1) % 3);
        if (a[0] > b[0]) {  // one direction, so that both triangles round alike
            const double *swapped = a;
            a = b, b = swapped;
        }
        if (!(a[0] <= i && b[0] > i)) continue;
        double at = a[1] + (i - a[0]) * (b[1] - a[1]) / (b[0] - a[0]);
        *low = at < *low ? at : *low;
        *high = at > *high ? at : *high;
    }
}

// Where rays cross triangles (t, 3, 3), in cells: 2 x the first voxel behind each crossing, + 1
// where the ray enters. Called twice. Without room for `crossings` it counts those of ray (i, j) in
// first[i * size[1] + j + 1]. With their cumulative sum in `first` it writes the crossings of the
// same triangles, and advances `first`.
struct find_crossings {
    f64_3 triangles;
    int64_t size[3];
    i64_1 first;
    i32_1 crossings;
};
KERNEL(void, find_crossings) {
    const int64_t *size = a->size;
    const double most_i = (double)size[0], most_j = (double)size[1], most_k = (double)size[2];
    for (int64_t t = 0; t < a->triangles.n[0]; t++) {
        const double *p = a->triangles.at + 9 * t, *q = p + 3, *r = p + 6;
        double ax = q[0] - p[0], ay = q[1] - p[1], bx = r[0] - p[0], by = r[1] - p[1];
        double area = ax * by - ay * bx;
        if (area == 0) continue;
        // As NumPy's cross product: the same products in the same order
        double az = q[2] - p[2], bz = r[2] - p[2];
        double slope_i = (ay * bz - az * by) / area, slope_j = (az * bx - ax * bz) / area;
        double lowest = least3(p[2], q[2], r[2]), highest = most3(p[2], q[2], r[2]);
        int64_t stop = (int64_t)clampd(ceil(most3(p[0], q[0], r[0])), 0, most_i);
        int64_t start = (int64_t)clampd(ceil(least3(p[0], q[0], r[0])), 0, most_i);
        for (int64_t i = start; i < stop; i++) {
            double low, high;
            span(p, (double)i, &low, &high);
            int64_t right = (int64_t)clampd(ceil(high), 0, most_j);
            for (int64_t j = (int64_t)clampd(ceil(low), 0, most_j); j < right; j++) {
                double depth = p[2] - slope_i * ((double)i - p[0]);
                depth -= slope_j * ((double)j - p[1]);
                depth = clampd(ceil(clampd(depth, lowest, highest)), 0, most_k);
                int32_t behind = (int32_t)depth;
                if (behind >= size[2]) continue;
                int64_t ray = i * size[1] + j;
                if (a->crossings.n[0])
                    a->crossings.at[a->first.at[ray]++] = 2 * behind + (area < 0);
                else
                    a->first.at[ray + 1]++;
            }
        }
    }
}

// Insertion sort of one ray's few crossings.
static void sort(int32_t *crossings, int64_t count) {
    for (int64_t n = 1; n < count; n++) {
        int32_t moved = crossings[n];
        int64_t at = n;
        for (; at > 0 && crossings[at - 1] > moved; at--) crossings[at] = crossings[at - 1];
        crossings[at] = moved;
    }
}

// A box within a grid, and the crossings of each ray through it, which begin at `first`. `entering`
// is 1, or -1 where the grid's axes are left-handed: there triangles look inside out.
struct rays {
    int64_t low[3], size[3], entering;
    i64_1 first;
    i32_1 crossings;
};

// Where the winding number along the rays is not 0: it, or into labels the value.
static inline void fill(
    const struct rays *rays, const int64_t *shape, int16_t *windings, uint8_t *labels, int value
) {
    for (int64_t i = 0; i < rays->size[0]; i++)
        for (int64_t j = 0; j < rays->size[1]; j++) {
            const int64_t *first = rays->first.at + i * rays->size[1] + j;
            const int64_t count = first[1] - first[0];
            const int64_t line = (rays->low[0] + i) * shape[1] + rays->low[1] + j;
            const int64_t start = line * shape[2] + rays->low[2];
            int32_t *crossings = rays->crossings.at + first[0];
            sort(crossings, count);
            int64_t winding = 0;
            for (int64_t n = 0; n < count; n++) {
                int64_t k = crossings[n] >> 1;
                int64_t stop = n + 1 < count ? crossings[n + 1] >> 1 : rays->size[2];
                winding += crossings[n] & 1 ? rays->entering : -rays->entering;
                if (winding == 0) continue;
                if (labels) memset(labels + start + k, value, (size_t)(stop - k));
                else for (; k < stop; k++) windings[start + k] = (int16_t)winding;
            }
        }
}

struct fill_labels { struct rays rays; int64_t label; u8_3 out; };
KERNEL(void, fill_labels) { fill(&a->rays, a->out.n, NULL, a->out.at, (int)a->label); }

struct fill_windings { struct rays rays; i16_3 out; };
KERNEL(void, fill_windings) { fill(&a->rays, a->out.n, a->out.at, NULL, 0); }
