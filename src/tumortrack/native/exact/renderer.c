// The renderer's inner loop: which triangle a pixel sees.
#include "triangle.h"

// Widens the columns from `start` to `end` by where the edge from u, v is in row y.
static inline void widen(
    float u, float v, float to_u, float to_v, double y, double *start, double *end
) {
    if (!((to_v < v ? to_v : v) <= y && y <= (to_v > v ? to_v : v))) return;
    double at = to_v != v ? u + (y - v) * (to_u - u) / (to_v - v) : u;
    *start = at < *start ? at : *start;
    *end = at > *end ? at : *end;
}

// Greatest nearness up to the limit in each pixel, from -infinity on, and whose it is. Seen
// (t, 3, 3) are the corners' column, row and nearness, linear in the picture. In perspective a
// triangle that reaches behind the eye (nearness 0 or less) is left out.
struct nearest { f32_3 seen; double limit; int64_t perspective; f32_2 near; i32_2 winner; };
KERNEL(void, nearest) {
    const int64_t height = a->near.n[0], width = a->near.n[1];
    const double limit = a->limit, beside = (double)width;
    const float below = (float)height;
    for (int64_t t = 0; t < a->seen.n[0]; t++) {
        const float *p = a->seen.at + 9 * t, *q = p + 3, *r = p + 6;
        const float ua = p[0], va = p[1], na = p[2], ub = q[0], vb = q[1], nb = q[2];
        const float uc = r[0], vc = r[1], nc = r[2];
        if (a->perspective && least3f(na, nb, nc) <= 0) continue;
        float area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua);
        if (area == 0) continue;
        int64_t y = (int64_t)clampf(ceilf(least3f(va, vb, vc)), 0, below);
        int64_t bottom = (int64_t)clampf(floorf(most3f(va, vb, vc)), -1, below - 1);
        if (y > bottom) continue;
        // Along a row nearness is slope * x + constant.
        float slope = (na * (vb - vc) + nb * (vc - va) + nc * (va - vb)) / area;
        float rise = (na * (uc - ub) + nb * (ua - uc) + nc * (ub - ua)) / area;
        for (; y <= bottom; y++) {
            double start = INFINITY, end = -INFINITY;
            widen(ua, va, ub, vb, (double)y, &start, &end);
            widen(ub, vb, uc, vc, (double)y, &start, &end);
            widen(uc, vc, ua, va, (double)y, &start, &end);
            // No cracks between neighbours
            int64_t left = (int64_t)clampd(ceil(start - 1e-3), 0, beside);
            int64_t right = (int64_t)clampd(floor(end + 1e-3), -1, beside - 1);
            float *near = a->near.at + y * width;
            int32_t *winner = a->winner.at + y * width;
            double here = na + slope * ((double)left - ua) + rise * ((double)y - va);
            for (int64_t x = left; x <= right; x++, here += slope) {
                if (!(near[x] < here && here <= limit)) continue;
                near[x] = (float)here;
                winner[x] = (int32_t)t;
            }
        }
    }
}

// Lays each pixel's triangle (-1: none) over what is there: of its corners' red, green, blue and
// cover (t, 3, 4) as much as there is of each in the pixel. Seen as in `nearest`.
struct blend { f32_3 picture; i32_2 winner; f32_3 seen, colours; int64_t perspective; };
KERNEL(void, blend) {
    const int64_t height = a->winner.n[0], width = a->winner.n[1], count = a->seen.n[0];
    for (int64_t pixel = 0; pixel < height * width; pixel++) {
        const int64_t t = a->winner.at[pixel];
        if (t < 0 || t >= count) continue;
        const double x = (double)(pixel % width), y = (double)(pixel / width);
        const float *p = a->seen.at + 9 * t;
        const double ua = p[0] - x, va = p[1] - y, ub = p[3] - x, vb = p[4] - y;
        const double uc = p[6] - x, vc = p[7] - y;
        double of_a = ub * vc - vb * uc, of_b = uc * va - vc * ua, of_c = ua * vb - va * ub;
        if (a->perspective) of_a *= p[2], of_b *= p[5], of_c *= p[8];
        const double whole = of_a + of_b + of_c;
        const float *c = a->colours.at + 12 * t;
        double mixed[4];
        for (int n = 0; n < 4; n++)
            mixed[n] = (of_a * c[n] + of_b * c[4 + n] + of_c * c[8 + n]) / whole;
        for (int n = 0; n < 3; n++) {
            float *value = a->picture.at + 3 * pixel + n;
            *value = (float)(*value + mixed[3] * (mixed[n] - *value));
        }
    }
}
