// See ``segmentation.pieces`` and ``segmentation.choose``. ``depth`` is in mm, ``taken`` is 0 where
// no step has removed a pixel.
#include "native.h"

// Neighbouring pixels at depth z are connected if their depths differ by less than this.
struct jump { double slope, noise; };

static inline double most(struct jump jump, float z) {
    return jump.slope * z + jump.noise * z * z;
}

static inline bool within(int64_t v, int64_t u, const int64_t *n) {
    return (uint64_t)v < (uint64_t)n[0] && (uint64_t)u < (uint64_t)n[1];
}

// Pixels with fewer than 3 of 8 neighbours at their depth; at a straight edge there are 5, at a
// right angle 3. What lies outside the image is unknown and counts.
struct isolated { f32_2 depth; u8_2 taken; struct jump jump; bool_2 out; };
KERNEL(void, isolated) {
    const int64_t height = a->depth.n[0], width = a->depth.n[1];
    const uint8_t *restrict const taken = a->taken.at;
    const float *restrict const depth = a->depth.at;
    const struct jump jump = a->jump;
    bool *restrict const out = a->out.at;
    for (int64_t v = 0; v < height; v++) {
        for (int64_t u = 0; u < width; u++) {
            const int64_t place = v * width + u;
            out[place] = false;
            if (taken[place]) continue;
            const bool border = v == 0 || v == height - 1 || u == 0 || u == width - 1;
            const float z = depth[place];
            const double apart = most(jump, z);
            int near = 0;
            for (int64_t y = -1; y <= 1; y++) {
                for (int64_t x = -1; x <= 1; x++) {
                    const int64_t there = place + y * width + x;
                    near += (border && !within(v + y, u + x, a->depth.n))
                        || (!taken[there] & (fabsf(depth[there] - z) < apart));
                }
            }
            out[place] = near - 1 < 3;
        }
    }
}

// The remaining depths, NaN otherwise; short holes along a row, failed matches, are bridged where
// the hole's ends agree.
struct without_holes { f32_2 depth; u8_2 taken; struct jump jump; f32_2 out; };
KERNEL(void, without_holes) {
    const int64_t longest = 5, width = a->depth.n[1];
    for (int64_t v = 0; v < a->depth.n[0]; v++) {
        const float *restrict const depth = a->depth.at + v * width;
        const uint8_t *restrict const taken = a->taken.at + v * width;
        float *restrict const out = a->out.at + v * width;
        for (int64_t u = 0; u < width; u++) out[u] = taken[u] ? NAN : depth[u];
        int64_t last = width;  // none yet
        for (int64_t u = 0; u < width; u++) {
            if (taken[u]) continue;
            if (u - last > 1 && u - last <= longest + 1) {
                const float z = depth[u], before = depth[last];
                const bool agree = fabsf(before - z) < most(a->jump, z);
                for (int64_t x = last + 1; agree && x < u; x++) {
                    out[x] = before + (double)(z - before) * (x - last) / (u - last);
                }
            }
            last = u;
        }
    }
}

// Zeroes missing pixels and both sides of a jump; ``out`` is larger by 1 on every side.
static void mark_jumps(const f32_2 *image, float slope, float noise, float *out) {
    const int64_t height = image->n[0], width = image->n[1], stride = width + 2;
    for (int64_t v = 0; v < height; v++) {
        const float *const depth = image->at + v * width;
        float *const here = out + (v + 1) * stride + 1;
        for (int64_t u = 0; u < width; u++) {
            const float z = depth[u], apart = (slope + noise * z) * z;
            if (!(z > 0)) here[u] = 0;
            if (u + 1 < width && !(fabsf(depth[u + 1] - z) < apart)) here[u] = here[u + 1] = 0;
            if (v + 1 < height && !(fabsf(depth[u + width] - z) < apart)) {
                here[u] = here[u + stride] = 0;
            }
        }
    }
}

// Zeroes pixels where the surface lies deeper, by ``crease`` mm, than ``reach`` mm (at distance 1)
// away on both sides.
static void mark_creases(const f32_2 *image, float noise, float crease, float reach, float *out) {
    const int64_t height = image->n[0], width = image->n[1];
    const float largest = (float)(height + width);
    for (int64_t v = 0; v < height; v++) {
        float *const here = out + (v + 1) * (width + 2) + 1;
        for (int64_t u = 0; u < width; u++) {
            if (here[u] == 0) continue;
            const float *const at = image->at + v * width + u, z = *at;
            const int64_t r = (int64_t)clampf(reach / z + 0.5f, 1, largest), d = r * 7 / 10;
            if (v < r || v >= height - r || u < r || u >= width - r) continue;
            // NaN of a neighbour compares as no crease.
            const double twice = 2.0 * z - 2 * crease - 2.0 * noise * z * z;
            if (at[-r] + at[r] < twice || at[-r * width] + at[r * width] < twice
                || at[-d * width - d] + at[d * width + d] < twice
                || at[-d * width + d] + at[d * width - d] < twice) {
                here[u] = 0;
            }
        }
    }
}

static inline float less(float a, float b) { return b < a ? b : a; }

// Chamfer distance (Borgefors 1986, doi 10.1016/S0734-189X(86)80047-0) in px to the nearest edge; 0
// on edges and removed pixels. The image's border is no edge: ``out`` has a frame of pixels around
// it that is far from everything. ``crease`` 0: folds are no edges.
struct edge_distance { f32_2 depth; struct jump jump; double crease, reach; f32_2 out; };
KERNEL(void, edge_distance) {
    const float axial = 0.955f, oblique = 1.369f;
    const int64_t height = a->depth.n[0], width = a->depth.n[1], stride = width + 2;
    float *const out = a->out.at, noise = (float)a->jump.noise;
    for (int64_t n = 0; n < (height + 2) * stride; n++) out[n] = (float)(height + width);
    mark_jumps(&a->depth, (float)a->jump.slope, noise, out);
    if (a->crease > 0) mark_creases(&a->depth, noise, (float)a->crease, (float)a->reach, out);
    for (int64_t v = 1; v <= height; v++) {
        float *const here = out + v * stride;
        const float *const above = here - stride;
        for (int64_t u = 1; u <= width; u++) {  // apart from what depends on u - 1: vectorised
            const float across = less(above[u - 1], above[u + 1]) + oblique;
            here[u] = less(here[u], less(above[u] + axial, across));
        }
        for (int64_t u = 1; u <= width; u++) here[u] = less(here[u], here[u - 1] + axial);
    }
    for (int64_t v = height; v > 0; v--) {
        float *const here = out + v * stride;
        const float *const below = here + stride;
        for (int64_t u = 1; u <= width; u++) {
            const float across = less(below[u - 1], below[u + 1]) + oblique;
            here[u] = less(here[u], less(below[u] + axial, across));
        }
        for (int64_t u = width; u > 0; u--) here[u] = less(here[u], here[u + 1] + axial);
    }
}

// Grows all pieces (0: none) at the same pace, a pixel a round, never across a jump, by little
// more than ``radius``, px at distance 1. ``queue`` has room for every pixel.
struct grow { f32_2 depth; i32_2 pieces; struct jump jump; double radius; i32_1 queue; };
KERNEL(void, grow) {
    const int64_t height = a->depth.n[0], width = a->depth.n[1];
    int32_t *const pieces = a->pieces.at, *const queue = a->queue.at;
    int64_t end = 0;
    for (int64_t v = 0, place = 0; v < height; v++) {
        for (int64_t u = 0; u < width; u++, place++) {
            if (pieces[place]
                && ((u > 0 && !pieces[place - 1]) || (u + 1 < width && !pieces[place + 1])
                    || (v > 0 && !pieces[place - width])
                    || (v + 1 < height && !pieces[place + width]))) {
                queue[end++] = (int32_t)place;
            }
        }
    }
    int64_t rounds = 0, last = end;  // of this round
    for (int64_t start = 0; start < end; start++) {
        if (start == last) {
            rounds++;
            last = end;
        }
        const int32_t place = queue[start], v = place / (int32_t)width, u = place % (int32_t)width;
        const float z = a->depth.at[place];
        if (rounds >= 1.4 * a->radius / z + 2) continue;
        const double apart = most(a->jump, z);
        for (int64_t y = v - 1; y <= v + 1; y++) {
            for (int64_t x = u - 1; x <= u + 1; x++) {
                const int64_t there = y * width + x;
                if (!within(y, x, a->depth.n) || pieces[there]) continue;
                if (!(fabsf(a->depth.at[there] - z) < apart)) continue;
                pieces[there] = pieces[place];
                queue[end++] = (int32_t)there;  // once for each pixel
            }
        }
    }
}

// Area (mm^2) of each piece in a box (camera frame, mm). ``across``, ``down``: x / z and y / z of
// the columns and rows; ``focal``: product of both focal lengths. Returns in ``area``, of zeros.
struct area_inside {
    f32_2 depth;
    i32_2 pieces;
    f64_1 across;
    f64_1 down;
    double focal, low[3], high[3];
    f64_1 area;
};
KERNEL(void, area_inside) {
    const double *const low = a->low, *const high = a->high;
    const double x0 = low[0], x1 = high[0], y0 = low[1], y1 = high[1], z0 = low[2], z1 = high[2];
    const double *restrict const across = a->across.at, focal = a->focal;
    double *restrict const area = a->area.at;
    const int64_t width = a->depth.n[1], count = a->area.n[0];
    for (int64_t v = 0; v < a->depth.n[0]; v++) {
        const int32_t *restrict const pieces = a->pieces.at + v * width;
        const float *restrict const depth = a->depth.at + v * width;
        const double down = a->down.at[v];
        for (int64_t u = 0; u < width; u++) {
            if (pieces[u] <= 0 || pieces[u] >= count) continue;
            const float z = depth[u];
            const double x = across[u] * z, y = down * z;
            const bool inside = z0 < z && z < z1 && y0 < y && y < y1 && x0 < x && x < x1;
            if (inside) area[pieces[u]] += z * z / focal;
        }
    }
}

// Whether a piece, here at depth z, continues at a pixel beyond the image's border or removed as
// ``last_box``, outside the last estimate's surroundings. Range, box and mask don't count: they are
// meant to cut around the organ.
static inline bool goes_on(
    const f32_2 *depth, const u8_2 *taken, int64_t last_box, float z, int64_t v, int64_t u) {
    if (!within(v, u, depth->n)) return true;
    const int64_t place = v * depth->n[1] + u;
    return taken->at[place] == last_box && fabsf(depth->at[place] - z) < 5;  // mm: one surface
}

// Of each piece, as ``segmentation.choose._Sizes``; ``across``, ``down``, ``low`` and ``high`` are
// sums of tangents and, along four directions of the image, ends (mm).
struct piece {
    double area, pixels, across, down, border, disc, wide, cut, aside, low[4], high[4];
};
_Static_assert(sizeof(struct piece) == 17 * sizeof(double), "a row of what it returns");
struct measure_pieces {
    f32_2 depth;
    f32_2 distance;
    u8_2 taken;
    i32_2 pieces;
    f64_1 across;
    f64_1 down;
    double fx, fy;
    int64_t last_box;
    f64_2 out;
};
KERNEL(void, measure_pieces) {
    const int64_t height = a->depth.n[0], width = a->depth.n[1], count = a->out.n[0];
    const double *restrict const across = a->across.at, *restrict const down = a->down.at;
    const double fx = a->fx, area = fx * a->fy;
    struct piece *restrict const out = (struct piece *)a->out.at;
    memset(out, 0, count * sizeof *out);
    for (int64_t n = 0; n < count; n++) {
        for (int k = 0; k < 4; k++) out[n].low[k] = INFINITY, out[n].high[k] = -INFINITY;
    }
    for (int64_t v = 0; v < height; v++) {
        for (int64_t u = 0; u < width; u++) {
            const int64_t place = v * width + u;
            const int32_t *const at = a->pieces.at + place, number = *at;
            if (number <= 0 || number >= count) continue;
            struct piece *const piece = out + number;
            const float z = a->depth.at[place];
            const double disc = a->distance.at[place] * z / fx;
            piece->area += z * z / area;
            piece->pixels++;
            piece->across += across[u];
            piece->down += down[v];
            piece->disc = disc > piece->disc ? disc : piece->disc;
            if (v > 0 && v < height - 1 && u > 0 && u < width - 1 && at[-width] == number
                && at[width] == number && at[-1] == number && at[1] == number) {
                continue;  // the extent is reached at the outline
            }
            if (goes_on(&a->depth, &a->taken, a->last_box, z, v - 1, u)
                || goes_on(&a->depth, &a->taken, a->last_box, z, v + 1, u)
                || goes_on(&a->depth, &a->taken, a->last_box, z, v, u - 1)
                || goes_on(&a->depth, &a->taken, a->last_box, z, v, u + 1)) {
                piece->border += z / fx;
            }
            const double x = across[u] * z, y = down[v] * z;
            const double along[4] = {x, y, (x + y) * 0.7071, (x - y) * 0.7071};
            for (int k = 0; k < 4; k++) {
                piece->low[k] = along[k] < piece->low[k] ? along[k] : piece->low[k];
                piece->high[k] = along[k] > piece->high[k] ? along[k] : piece->high[k];
            }
        }
    }
    for (struct piece *piece = out; piece < out + count; piece++) {
        if (!(piece->area > 0)) continue;
        for (int k = 0; k < 4; k++) {
            const double extent = piece->high[k] - piece->low[k];
            piece->wide = extent > piece->wide ? extent : piece->wide;
        }
        const double cut = piece->border / sqrt(piece->area);
        piece->cut = cut > 1 ? 1 : cut;
        piece->disc *= 2;
        piece->aside = sqrt(piece->across * piece->across + piece->down * piece->down);
        piece->aside /= piece->pixels;
    }
}
