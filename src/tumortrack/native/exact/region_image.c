// See ``segmentation.working_image``.
#include "native.h"

// Removes, as the ``step`` that does it, what lies outside a box (camera frame, mm). ``across``,
// ``down``: x / z and y / z of the columns and rows.
struct keep_inside {
    f32_2 depth;
    u8_2 taken;
    f64_1 across;
    f64_1 down;
    double low[3], high[3];
    int64_t step;
};
KERNEL(void, keep_inside) {
    const int64_t width = a->depth.n[1];
    const double *const low = a->low, *const high = a->high;
    const double x0 = low[0], x1 = high[0], y0 = low[1], y1 = high[1], z0 = low[2], z1 = high[2];
    const double *restrict const across = a->across.at;
    const uint8_t step = (uint8_t)a->step;
    for (int64_t v = 0; v < a->depth.n[0]; v++) {
        const float *restrict const depth = a->depth.at + v * width;
        uint8_t *restrict const taken = a->taken.at + v * width;
        const double down = a->down.at[v];
        for (int64_t u = 0; u < width; u++) {
            const double z = depth[u], x = across[u] * z, y = down * z;
            const bool inside = (z0 < z) & (z < z1) & (y0 < y) & (y < y1) & (x0 < x) & (x < x1);
            taken[u] = (!taken[u] & !inside) ? step : taken[u];
        }
    }
}

// x / z and y / z of points, NaN for those behind the camera or too far aside; in ``ends`` the
// minima, the maxima, and the spread of the middle 96 %, from a histogram, so that the order of
// the points doesn't matter; 0 without such points.
struct cloud_tangents {
    f32_2 points;
    f32_2 tangents;
    i64_2 histogram;
    f64_2 ends;
};
KERNEL(void, cloud_tangents) {
    const float widest = 2;  // tangent of the largest angle from the optical axis
    const int64_t count = a->points.n[0], bins = a->histogram.n[1];
    float *restrict const tangents = a->tangents.at;
    double *const low = a->ends.at, *const high = low + 2, *const inner = low + 4;
    float from[2] = {INFINITY, INFINITY}, to[2] = {-INFINITY, -INFINITY};
    int64_t used = 0;
    for (int64_t i = 0; i < count; i++) {
        const float *const point = a->points.at + 3 * i, z = point[2];
        const float t[2] = {point[0] / z, point[1] / z};
        const bool seen = z > 1 && fabsf(t[0]) < widest && fabsf(t[1]) < widest;
        for (int k = 0; k < 2; k++) {
            tangents[2 * i + k] = seen ? t[k] : NAN;
            from[k] = seen && t[k] < from[k] ? t[k] : from[k];
            to[k] = seen && t[k] > to[k] ? t[k] : to[k];
        }
        used += seen;
    }
    memset(low, 0, 6 * sizeof *low);
    if (!used) return;
    memset(a->histogram.at, 0, 2 * bins * sizeof *a->histogram.at);
    for (int k = 0; k < 2; k++) {
        int64_t *const histogram = a->histogram.at + k * bins;
        low[k] = from[k];
        high[k] = to[k];
        const double width = high[k] - low[k], least = 1e-9 > width ? 1e-9 : width;
        for (int64_t i = 0; i < count; i++) {
            const float tangent = tangents[2 * i + k];
            if (isnan(tangent)) continue;
            const double share = (tangent - low[k]) / least;
            histogram[(int64_t)clampd(share * bins, 0, bins - 1)]++;
        }
        int64_t total = 0;
        for (int64_t bin = 0; bin < bins; bin++) {
            total += histogram[bin];
            if (0.02 * used < total && total < 0.98 * used) inner[k] += width / bins;
        }
    }
}

// The nearest depth in each pixel of ``depth``, which is all NaN; and each point's pixel, -1
// outside.
struct rasterise {
    f32_2 tangents;
    f32_1 z;
    Pinhole pinhole;
    f32_2 depth;
    i32_1 pixel;
};
KERNEL(void, rasterise) {
    const Pinhole at = a->pinhole;
    const int64_t height = a->depth.n[0], width = a->depth.n[1];
    const float *restrict const tangents = a->tangents.at, *restrict const depths = a->z.at;
    float *restrict const out = a->depth.at;
    int32_t *restrict const pixel = a->pixel.at;
    const int64_t count = a->z.n[0];
    for (int64_t i = 0; i < count; i++) {
        const double u = at.fx * tangents[2 * i] + at.cx + 0.5;
        const double v = at.fy * tangents[2 * i + 1] + at.cy + 0.5;
        const bool inside = (u > -1) & (u < width) & (v > -1) & (v < height);  // NaN is not
        pixel[i] = -1;
        if (!inside) continue;
        const int64_t place = (int64_t)v * width + (int64_t)u;
        pixel[i] = (int32_t)place;
        if (!(out[place] <= depths[i])) out[place] = depths[i];
    }
}
