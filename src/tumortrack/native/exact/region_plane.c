// See ``segmentation.plane``.
#include "native.h"

static const double STEEPEST = 0.35;  // cosine of the largest angle between normal and optical axis
static const double BEHIND = 2;       // one point behind the plane cancels this many on it
enum { AT_ONCE = 128 };

struct plane { double x, y, z, offset; };
struct mm { double tolerance, deepest; };

// How many points (n, 3) lie on a plane, to a tolerance, the nearer the more; less those behind it,
// but for what lies deeper than an organ is.
static double score(const float *points, int64_t n, struct plane plane, struct mm mm) {
    double total = 0, each[AT_ONCE];
    for (int64_t start = 0; start < n; start += AT_ONCE) {
        const int64_t count = min_i64(AT_ONCE, n - start);
        for (int64_t i = 0; i < count; i++) {  // apart from the sum, to be vectorised
            const float *const p = points + 3 * (start + i);
            const double height = plane.x * p[0] + plane.y * p[1] + plane.z * p[2] - plane.offset;
            const double share = height / mm.tolerance;
            const double behind = (-mm.deepest < height && height < 0) ? -BEHIND : 0;
            each[i] = fabs(share) < 1 ? 1 - share * share : behind;
        }
        for (int64_t i = 0; i < count; i++) total += each[i];
    }
    return total;
}

// The best plane through three of the points (n, 3), and its score. A tenth of the points suffices
// to reject hopeless planes.
struct plane_consensus {
    f32_2 points;
    i64_2 triples;
    struct mm mm;
    f32_1 normal;
    f64_1 offset;
};
KERNEL(double, plane_consensus) {
    const float *const points = a->points.at;
    const int64_t n = a->points.n[0], few = n / 10;
    double best = -INFINITY;
    for (int64_t t = 0; t < a->triples.n[0]; t++) {
        const int64_t *const triple = a->triples.at + 3 * t;
        const float *const p = points + 3 * triple[0], *const q = points + 3 * triple[1];
        const float *const r = points + 3 * triple[2];
        const float bx = q[0] - p[0], by = q[1] - p[1], bz = q[2] - p[2];
        const float cx = r[0] - p[0], cy = r[1] - p[1], cz = r[2] - p[2];
        const float nx = by * cz - bz * cy, ny = bz * cx - bx * cz, nz = bx * cy - by * cx;
        const float length = sqrtf(nx * nx + ny * ny + nz * nz);
        if (length < 100 || fabsf(nz) < STEEPEST * length) continue;  // mm^2: slivers are no planes
        const double to_camera = (nz > 0 ? -1.0 : 1.0) / length;
        struct plane plane = {nx * to_camera, ny * to_camera, nz * to_camera, 0};
        plane.offset = plane.x * p[0] + plane.y * p[1] + plane.z * p[2];
        double total = score(points, few, plane, a->mm);
        if (total < 0.05 * best) continue;
        total += score(points + 3 * few, n - few, plane, a->mm);
        if (total > best) {
            best = total;
            a->normal.at[0] = plane.x;
            a->normal.at[1] = plane.y;
            a->normal.at[2] = plane.z;
            a->offset.at[0] = plane.offset;
        }
    }
    return best;
}

// Removes, as the ``step`` that does it, what lies less than ``half`` mm above a plane. At depth z
// a pixel is z (right + down) - offset above it.
struct remove_below {
    f32_2 depth;
    u8_2 taken;
    f64_1 right;
    f64_1 down;
    double offset, half;
    int64_t step;
};
KERNEL(void, remove_below) {
    const int64_t width = a->depth.n[1];
    const double *restrict const right = a->right.at, offset = a->offset, half = a->half;
    const uint8_t step = (uint8_t)a->step;
    for (int64_t v = 0; v < a->depth.n[0]; v++) {
        const double down = a->down.at[v];
        const float *restrict const depth = a->depth.at + v * width;
        uint8_t *restrict const taken = a->taken.at + v * width;
        for (int64_t u = 0; u < width; u++) {
            const bool below = depth[u] * (right[u] + down) - offset < half;
            taken[u] = (!taken[u] & below) ? step : taken[u];
        }
    }
}
