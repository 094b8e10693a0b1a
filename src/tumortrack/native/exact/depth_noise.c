// The per-pixel work of ``simulation.noise``. An organ fills a tenth of an image: kernels visit only the
// pixels with a return, which ``seen_pixels`` lists once, and change a list of their depths.
//
// Noise is hashed from (key, pixel) with SplitMix64 (Steele, Lea and Flood 2014,
// doi 10.1145/2660193.2660195): no state, a few ns each, and no pixel's number depends on the
// others.
#include "native.h"

// Flat indices of the pixels with a return, and where each row starts among them.
struct seen { i32_1 pixels; i32_1 starts; };
struct row { int64_t first, last; };

// A row's part of the list, within the list even if the list is another image's.
static inline struct row row_of(const struct seen *seen, int64_t v) {
    const int32_t *starts = seen->starts.at + v;
    return (struct row){max_i64(starts[0], 0), min_i64(starts[1], seen->pixels.n[0])};
}

static inline int64_t rows_of(const struct seen *seen, int64_t height) {
    return min_i64(seen->starts.n[0] - 1, height);
}

static inline bool within(int64_t u, int64_t width) { return (uint64_t)u < (uint64_t)width; }

static inline uint64_t bits_of(int64_t key, int64_t counter) {
    uint64_t z = (uint64_t)key + (uint64_t)(counter + 1) * 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

// One of the 2^14 quantiles of the normal distribution.
static inline int32_t quantile(uint64_t bits) { return (int32_t)(bits & 0x3FFF); }

static inline double unit(uint64_t bits) { return (double)(uint32_t)bits * 0x1p-32; }

// Lists the pixels that are not NaN; ``pixels`` has room for all. Returns how many they are.
struct seen_pixels { f32_2 depth; i32_1 pixels; i32_1 starts; };
KERNEL(int64_t, seen_pixels) {
    const int64_t height = a->depth.n[0], width = a->depth.n[1];
    int32_t *restrict const pixels = a->pixels.at, at = 0;
    for (int64_t v = 0; v < height; v++) {
        const float *const row = a->depth.at + v * width;
        int32_t count = 0;
        for (int64_t u = 0; u < width; u++) count += row[u] == row[u];
        a->starts.at[v] = at;
        const int32_t last = at + count, first = (int32_t)(v * width);
        for (int32_t u = 0; at < last; u++) {
            pixels[at] = first + u;
            at += row[u] == row[u];
        }
    }
    a->starts.at[height] = at;
    return at;
}

static inline float slope(float before, float here, float after) {
    if (isnan(before)) return isnan(after) ? 0 : after - here;
    return isnan(after) ? here - before : (after - before) * 0.5f;
}

// Drops pixels that see a surface at grazing angles: of those where the cosine between the normal
// and the line of sight is less than ``cosine``, this ``share``.
//
// With the depth's slopes (p, q) per pixel the surface normal is n = (fx p, fy q,
// -(z + (u - cx) p + (v - cy) q)), and its product with the line of sight r is -z.
// ``across``: squared tangents of the columns.
struct lose_grazing {
    f32_2 depth;
    f32_1 out;
    struct seen seen;
    int64_t key;
    double share, cosine;
    Pinhole pinhole;
    f64_1 across;
};
KERNEL(void, lose_grazing) {
    const int64_t height = a->depth.n[0], width = a->depth.n[1], key = a->key;
    const Pinhole at = a->pinhole;
    const double share = a->share, steep = a->cosine * a->cosine;
    for (int64_t v = 0; v < rows_of(&a->seen, height); v++) {
        const float *const row = a->depth.at + v * width;
        const double aside = v - at.cy, tangent = aside / at.fy, down = tangent * tangent;
        const struct row part = row_of(&a->seen, v);
        for (int64_t i = part.first; i < part.last; i++) {
            const int64_t u = a->seen.pixels.at[i] - v * width;
            if (!within(u, width)) continue;
            const float z = row[u];
            const float p = slope(u > 0 ? row[u - 1] : NAN, z, u + 1 < width ? row[u + 1] : NAN);
            const float q = slope(
                v > 0 ? row[u - width] : NAN, z, v + 1 < height ? row[u + width] : NAN);
            const double along = z + (u - at.cx) * p + aside * q;
            const double x = at.fx * p, y = at.fy * q;
            const double normal = x * x + y * y + along * along;
            if (z * z < steep * normal * (a->across.at[u] + down + 1)
                && unit(bits_of(key, v * width + u)) < share) {
                a->out.at[i] = NAN;
            }
        }
    }
}

static inline float farther(float far, float other) { return other > far ? other : far; }

// Sends a ``share`` of edge pixels backwards, by at most ``reach`` mm: those with depth that falls
// back by ``step`` mm or more within ``near`` px, or ends. The image's own border is no edge: what
// it cuts off continues outside.
struct flying { double share, reach; int64_t near; double step; };
struct fly {
    f32_2 depth;
    f32_1 out;
    struct seen seen;
    int64_t key;
    struct flying flying;
};
KERNEL(void, fly) {
    const int64_t height = a->depth.n[0], width = a->depth.n[1], key = a->key;
    const struct flying how = a->flying;
    // Farther than the image is wide and high there is nothing, however far.
    const int64_t near = min_i64(max_i64(how.near, 0), height + width), down = near * width;
    for (int64_t v = 0; v < rows_of(&a->seen, height); v++) {
        const float *const row = a->depth.at + v * width;
        const struct row part = row_of(&a->seen, v);
        for (int64_t i = part.first; i < part.last; i++) {
            const int64_t u = a->seen.pixels.at[i] - v * width;
            if (!within(u, width)) continue;
            const float z = row[u];
            const float above = v >= near ? row[u - down] : z;
            const float below = v + near < height ? row[u + down] : z;
            const float left = u >= near ? row[u - near] : z;
            const float right = u + near < width ? row[u + near] : z;
            double gap;
            if (isnan(above + below + left + right)) {  // one of them is none
                float far = farther(farther(z, above), below);  // NaN is not farther
                far = farther(farther(far, left), right);
                gap = far - z > how.reach ? far - z : how.reach;
            } else {
                gap = farther(farther(above, below), farther(left, right)) - z;
                gap = gap < 0 ? 0 : gap;
            }
            if (gap >= how.step) {
                const uint64_t bits = bits_of(key, v * width + u);
                const double back = how.reach < gap ? how.reach : gap;
                if (unit(bits) < how.share) a->out.at[i] = z + unit(bits >> 32) * back;
            }
        }
    }
}

// Adds noise of standard deviation ``relative * z^2``, a mix of each pixel's own and of ``smooth``.
struct jitter {
    f32_1 out;
    i32_1 pixels;
    int64_t key;
    double relative, own, common;
    f32_1 smooth;
    f32_1 quantiles;
};
// With pointers that are known to be apart the table's look-ups are vectorised.
static void add_noise(
    const struct jitter *a, const float *restrict quantiles, const float *restrict smooth,
    float *restrict out) {
    const float relative = (float)a->relative, own = (float)a->own, common = (float)a->common;
    for (int64_t i = 0; i < a->pixels.n[0]; i++) {
        const float each = quantiles[quantile(bits_of(a->key, a->pixels.at[i]))];
        out[i] += relative * out[i] * out[i] * (own * each + common * smooth[i]);
    }
}
KERNEL(void, jitter) { add_noise(a, a->quantiles.at, a->smooth.at, a->out.at); }

// A smooth random field at the seen pixels: normal numbers on a grid of every ``step``-th pixel,
// which reaches one node beyond the image, and between them linear interpolation by ``weights``.
// ``row``: room for one of the image's, and a step more.
struct smooth_at {
    struct seen seen;
    int64_t key;
    f32_2 weights;
    f32_1 quantiles;
    f32_2 grid;
    f32_1 row;
    f32_1 out;
};
KERNEL(void, smooth_at) {
    const int64_t step = a->weights.n[1], width = a->row.n[0] - step, columns = a->grid.n[1];
    const float *const first = a->weights.at, *const second = first + step;
    float *const row = a->row.at;
    for (int64_t node = 0; node < a->grid.n[0] * columns; node++) {
        a->grid.at[node] = a->quantiles.at[quantile(bits_of(a->key, node))];
    }
    for (int64_t v = 0; v < rows_of(&a->seen, (a->grid.n[0] - 1) * step); v++) {
        const struct row part = row_of(&a->seen, v);
        if (part.first >= part.last) continue;
        const int32_t *const pixels = a->seen.pixels.at;
        const int64_t left = max_i64(pixels[part.first] - v * width, 0);
        const int64_t right = min_i64(pixels[part.last - 1] - v * width, width - 1);
        const float *const top = a->grid.at + v / step * columns, *const bottom = top + columns;
        const float upper = first[v % step], lower = second[v % step];
        for (int64_t node = left / step; node <= right / step; node++) {
            const float one = upper * top[node] + lower * bottom[node];
            const float two = upper * top[node + 1] + lower * bottom[node + 1];
            float *const here = row + node * step;
            for (int64_t k = 0; k < step; k++) here[k] = first[k] * one + second[k] * two;
        }
        for (int64_t i = part.first; i < part.last; i++) {
            const int64_t u = pixels[i] - v * width;
            if (within(u, width)) a->out.at[i] = row[u];
        }
    }
}
