// The renderer's inner loops: which triangle a pixel sees, and in what light.
#include "triangle.h"

static inline double dot(const double *one, const double *two) {
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2];
}

// Unit normals (f, 3, 3) of faces' corners (f, 3), numbers of places: the mean of the `weighted`
// normals (f, 3) of the faces about the same place whose unit normals (`facing`) have at least this
// cosine to its own. `first` says where the faces about each place, and those about a last one
// without any, end in the work array `sharers` (f, 3); it is changed to where they begin.
struct mean_normals {
    i64_2 corner;
    i64_1 first;
    i64_2 sharers;
    f64_2 weighted, facing;
    double cosine;
    f32_3 out;
};
KERNEL(void, mean_normals) {
    const int64_t *corner = a->corner.at, corners = 3 * a->corner.n[0];
    int64_t *first = a->first.at, *sharers = a->sharers.at;
    for (int64_t c = corners - 1; c >= 0; c--) sharers[--first[corner[c]]] = c / 3;
    for (int64_t c = 0; c < corners; c++) {
        const double *own = a->facing.at + 3 * (c / 3);
        double x = 0, y = 0, z = 0;
        for (int64_t n = first[corner[c]]; n < first[corner[c] + 1]; n++) {
            if (!(dot(a->facing.at + 3 * sharers[n], own) > a->cosine)) continue;
            const double *weighted = a->weighted.at + 3 * sharers[n];
            x += weighted[0], y += weighted[1], z += weighted[2];
        }
        double length = sqrt(x * x + y * y + z * z);
        length = length < 1e-12 ? 1e-12 : length;
        float *normal = a->out.at + 3 * c;
        normal[0] = (float)(x / length), normal[1] = (float)(y / length);
        normal[2] = (float)(z / length);
    }
}

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

// How much of each corner there is in a pixel of a triangle.
static inline void shares(const float *seen, double x, double y, bool perspective, double *share) {
    const float ua = seen[0], va = seen[1], na = seen[2], ub = seen[3], vb = seen[4], nb = seen[5];
    const float uc = seen[6], vc = seen[7], nc = seen[8];
    float area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua);
    double a = ((ub - x) * (vc - y) - (vb - y) * (uc - x)) / area;
    double b = ((uc - x) * (va - y) - (vc - y) * (ua - x)) / area;
    double c = 1 - a - b;
    if (perspective) {
        a *= na, b *= nb, c *= nc;
        double whole = a + b + c;
        a /= whole, b /= whole, c /= whole;
    }
    share[0] = a, share[1] = b, share[2] = c;
}

static inline void mix(const float *of, const double *share, double *mixed) {
    for (int axis = 0; axis < 3; axis++)
        mixed[axis] = share[0] * of[axis] + share[1] * of[3 + axis] + share[2] * of[6 + axis];
}

static inline double to_the_40th(double x) {
    double to_2 = x * x, to_4 = to_2 * to_2, to_8 = to_4 * to_4, to_16 = to_8 * to_8;
    return to_8 * (to_16 * to_16);
}

// Of many bodies, world frame, mm: each triangle's corners, their normals, and its colour.
struct triangles { f32_3 corners, normals; f32_2 colors; };
struct light { f32_1 sun, up; };  // a direction towards it, and one where the rest comes from
struct eye { f32_1 place; int64_t perspective; };

// Lays each pixel's triangle (-1: none) over what is there; a diffuse light, a little gloss. Seen
// as in `nearest`.
struct shade {
    f32_3 picture;
    i32_2 winner;
    f32_3 seen;
    struct triangles triangles;
    struct light light;
    struct eye eye;
    double opacity;
};
KERNEL(void, shade) {
    const int64_t height = a->winner.n[0], width = a->winner.n[1], count = a->seen.n[0];
    const float *place = a->eye.place.at, *lights = a->light.sun.at, *rest = a->light.up.at;
    const double sun[3] = {lights[0], lights[1], lights[2]}, up[3] = {rest[0], rest[1], rest[2]};
    for (int64_t pixel = 0; pixel < height * width; pixel++) {
        const int64_t t = a->winner.at[pixel];
        if (t < 0 || t >= count) continue;
        double share[3], spot[3], normal[3], view[3], half[3];
        shares(
            a->seen.at + 9 * t, (double)(pixel % width), (double)(pixel / width),
            a->eye.perspective, share
        );
        mix(a->triangles.corners.at + 9 * t, share, spot);
        mix(a->triangles.normals.at + 9 * t, share, normal);
        for (int axis = 0; axis < 3; axis++) view[axis] = place[axis] - spot[axis];
        double length = sqrt(dot(normal, normal)), far = 1 / sqrt(dot(view, view));
        double scale = 1 / (length < 1e-12 ? 1e-12 : length);
        double toward = dot(normal, view) * far * scale;
        scale = toward >= 0 ? scale : -scale;  // of a surface seen from behind
        double lit = dot(normal, sun) * scale, gloss = 0;
        lit = lit < 0 ? 0 : lit;
        if (lit > 0) {  // about the direction half way between the light and the viewer
            for (int axis = 0; axis < 3; axis++) half[axis] = sun[axis] + view[axis] * far;
            gloss = dot(normal, half) * scale / sqrt(dot(half, half));
            gloss = 0.16 * to_the_40th(gloss < 0 ? 0 : gloss);
        }
        double strength = 0.46 + 0.1 * dot(normal, up) * scale + 0.5 * lit;
        double slant = 1 - fabs(toward);
        double cover = a->opacity + (1 - a->opacity) * 0.75 * slant * slant;
        for (int d = 0; d < 3; d++) {
            double own = a->triangles.colors.at[3 * t + d] * strength + gloss;
            float *value = a->picture.at + 3 * pixel + d;
            *value = (float)(*value + cover * ((own > 1 ? 1 : own) - *value));
        }
    }
}
