// What tumortrack_occupancy runs beside its network: refinement and filling of lattices of logits,
// and neighbours within a radius.
#include "native.h"

// Rows of a coarse lattice (.., .., .., classes) round point (i, j, ..) of the lattice of half the
// step; along an axis both may be the same.
typedef struct { const float *at[4]; } Rows;

static inline Rows rows_of(const f32_4 *coarse, int64_t i, int64_t j) {
    int64_t size = coarse->n[2] * coarse->n[3];
    const float *low = coarse->at + i / 2 * coarse->n[1] * size;
    const float *high = coarse->at + (i + 1) / 2 * coarse->n[1] * size;
    int64_t left = j / 2 * size, right = (j + 1) / 2 * size;
    return (Rows){{low + left, low + right, high + left, high + right}};
}

// The logits halfway between the eight points round the k-th.
static inline void linear(const Rows *rows, int64_t k, int64_t classes, float *restrict out) {
    int64_t low = k / 2 * classes, high = (k + 1) / 2 * classes;
    for (int64_t n = 0; n < classes; n++, low++, high++) {
        float near = rows->at[0][low] + rows->at[0][high];
        near += rows->at[1][low] + rows->at[1][high];
        float far = rows->at[2][low] + rows->at[2][high];
        far += rows->at[3][low] + rows->at[3][high];
        out[n] = 0.125f * (near + far);
    }
}

struct halved { f32_4 coarse, fine; int64_t first, last; };
// Logits at half the step, linear between the coarse ones, into planes `first` to `last`.
KERNEL(void, halved) {
    const int64_t *n = a->fine.n;
    float *out = a->fine.at + a->first * n[1] * n[2] * n[3];
    for (int64_t i = a->first; i < a->last; i++)
        for (int64_t j = 0; j < n[1]; j++) {
            Rows rows = rows_of(&a->coarse, i, j);
            for (int64_t k = 0; k < n[2]; k++, out += n[3]) linear(&rows, k, n[3], out);
        }
}

struct leading { f32_2 logits; u8_1 labels; f32_1 leads; };

static inline void lead(const struct leading *a, int64_t classes) {
    for (int64_t row = 0; row < a->logits.n[0]; row++) {
        const float *logits = a->logits.at + row * classes;
        float first = -INFINITY, second = -INFINITY;
        int label = 0;
        for (int n = 0; n < classes; n++) {
            float value = logits[n];
            bool more = value > first;
            second = more ? first : value > second ? value : second;
            label = more ? n : label;
            first = more ? value : first;
        }
        a->labels.at[row] = (uint8_t)label;
        a->leads.at[row] = first - second;
    }
}

// The label of the largest logit in every row, and its lead over the second.
KERNEL(void, leading) {
    switch (a->logits.n[1]) {  // the usual numbers: without a loop over classes
        case 2: return lead(a, 2);
        case 3: return lead(a, 3);
        case 4: return lead(a, 4);
        default: lead(a, a->logits.n[1]);
    }
}

struct mispredicted {
    f32_4 coarse; i64_1 shape, flat; f32_2 logits; double limit; bool_1 wrong; f32_1 expected;
};
// Which points of the lattice of half the step, flat indices, have another label than linear
// interpolation predicts, where the prediction of the two labels' difference is off by more than
// the limit. `logits`: those queried at the points; `expected`: room for one point's.
KERNEL(void, mispredicted) {
    int64_t n_j = a->shape.at[1], n_k = a->shape.at[2], classes = a->coarse.n[3];
    float *expected = a->expected.at, limit = (float)a->limit;
    for (int64_t m = 0; m < a->flat.n[0]; m++) {
        int64_t at = a->flat.at[m], row = at / n_k;
        Rows rows = rows_of(&a->coarse, row / n_j, row % n_j);
        linear(&rows, at % n_k, classes, expected);
        const float *logits = a->logits.at + m * classes;
        int64_t predicted = 0, label = 0;
        for (int64_t n = 0; n < classes; n++) {
            if (expected[n] > expected[predicted]) predicted = n;
            if (logits[n] > logits[label]) label = n;
        }
        float before = expected[predicted] - expected[label];
        float now = logits[label] - logits[predicted];
        a->wrong.at[m] = predicted != label && before + now > limit;
    }
}

// The label on which the eight corners of each cell of a row agree, 255 if they do not.
static void certain_row(const u8_3 *certain, int64_t i, int64_t j, uint8_t *restrict labels) {
    const int64_t *n = certain->n;
    int64_t i1 = min_i64(i + 1, n[0] - 1), j1 = min_i64(j + 1, n[1] - 1);
    const uint8_t *one = certain->at + (i * n[1] + j) * n[2];
    const uint8_t *two = certain->at + (i * n[1] + j1) * n[2];
    const uint8_t *three = certain->at + (i1 * n[1] + j) * n[2];
    const uint8_t *four = certain->at + (i1 * n[1] + j1) * n[2];
    for (int64_t k = 0; k < n[2]; k++) {
        bool same = (one[k] == two[k]) & (two[k] == three[k]) & (three[k] == four[k]);
        labels[k] = same ? one[k] : 255;
    }
    for (int64_t k = 0; k + 1 < n[2]; k++)
        if (labels[k] != labels[k + 1]) labels[k] = 255;
}

struct open_cells { u8_3 certain; int64_t first, last; u8_1 agreed; };
// How many cells of coarse planes `first` to `last` have corners that do not agree; `agreed`: room
// for a row.
KERNEL(int64_t, open_cells) {
    int64_t cells = 0;
    for (int64_t i = a->first; i < a->last; i++)
        for (int64_t j = 0; j < a->certain.n[1]; j++) {
            certain_row(&a->certain, i, j, a->agreed.at);
            for (int64_t k = 0; k < a->agreed.n[0]; k++) cells += a->agreed.at[k] == 255;
        }
    return cells;
}

struct fill_cells {
    f32_4 coarse; u8_3 labels, certain, fine; int64_t first, last; u8_1 agreed;
    i64_1 flat; f32_2 expected; bool_1 between;
};
// Fill the voxels `fine`, of half the step, from the lattice `coarse`, its `labels` and the
// `certain` ones, 255 elsewhere; cell by cell, coarse planes `first` to `last`. A cell whose
// corners have the same certain label is filled with it: by linear interpolation none of its voxels
// is less certain. Of the voxels of all other cells, up to eight each, these are noted: flat
// indices, linear logits, and whether they lie between coarse points. Returns how many.
KERNEL(int64_t, fill_cells) {
    const int64_t *n = a->fine.n, *cells = a->coarse.n;
    int64_t count = 0;
    for (int64_t i = a->first; i < a->last; i++)
        for (int64_t j = 0; j < cells[1]; j++) {
            certain_row(&a->certain, i, j, a->agreed.at);
            const uint8_t *labels = a->labels.at + (i * cells[1] + j) * cells[2];
            int64_t x_stop = min_i64(2 * i + 2, n[0]), y_stop = min_i64(2 * j + 2, n[1]);
            Rows rows[2][2];
            for (int64_t x = 2 * i; x < x_stop; x++)
                for (int64_t y = 2 * j; y < y_stop; y++)
                    rows[x % 2][y % 2] = rows_of(&a->coarse, x, y);
            for (int64_t k = 0; k < cells[2]; k++) {
                bool open = a->agreed.at[k] == 255;
                int64_t z_stop = min_i64(2 * k + 2, n[2]);
                for (int64_t x = 2 * i; x < x_stop; x++)
                    for (int64_t y = 2 * j; y < y_stop; y++)
                        for (int64_t z = 2 * k; z < z_stop; z++) {
                            int64_t at = (x * n[1] + y) * n[2] + z;
                            a->fine.at[at] = labels[k];
                            if (!open) continue;
                            float *expected = a->expected.at + count * cells[3];
                            linear(&rows[x % 2][y % 2], z, cells[3], expected);
                            a->flat.at[count] = at;
                            a->between.at[count++] = (x | y | z) & 1;
                        }
            }
        }
    return count;
}

struct neighbours { i64_1 shape, frontier; bool_1 known; i64_1 flat; };
// The voxels that touch those of the frontier (or are of it) and are not known yet, as flat
// indices: at most 27 each. They are marked as known. Returns how many.
KERNEL(int64_t, neighbours) {
    int64_t n_i = a->shape.at[0], n_j = a->shape.at[1], n_k = a->shape.at[2], count = 0;
    for (int64_t n = 0; n < a->frontier.n[0]; n++) {
        int64_t row = a->frontier.at[n] / n_k, k = a->frontier.at[n] % n_k;
        int64_t i = row / n_j, j = row % n_j;
        for (int64_t x = max_i64(i - 1, 0); x < min_i64(i + 2, n_i); x++)
            for (int64_t y = max_i64(j - 1, 0); y < min_i64(j + 2, n_j); y++)
                for (int64_t z = max_i64(k - 1, 0); z < min_i64(k + 2, n_k); z++) {
                    int64_t at = (x * n_j + y) * n_k + z;
                    if (a->known.at[at]) continue;
                    a->known.at[at] = true;
                    a->flat.at[count++] = at;
                }
    }
    return count;
}

// The two lattice points next to a coordinate along one axis, and how far it is from the lower.
typedef struct { int64_t low, high; float part; } Cell;

static inline Cell cell_of(float at, int64_t size) {
    at = clampf(at, 0.0f, (float)(size - 1));
    int64_t low = max_i64(min_i64((int64_t)at, size - 2), 0);
    return (Cell){low, min_i64(low + 1, size - 1), at - (float)low};
}

// Between two values. In double precision but for one product of floats: as these numbers were
// first computed, and recorded answers depend on them.
static inline double mix_f(float low, float high, float part) {
    return (1 - (double)part) * low + part * high;
}
static inline double mix(double low, double high, float part) {
    return (1 - (double)part) * low + part * high;
}

struct trilinear { f32_4 values; f32_2 places, out; };
// Trilinear interpolation of a lattice at places in its steps; outside the value at the nearest
// border. Every axis has a point at least.
KERNEL(void, trilinear) {
    const int64_t *n = a->values.n;
    for (int64_t m = 0; m < a->places.n[0]; m++) {
        const float *place = a->places.at + 3 * m;
        Cell i = cell_of(place[0], n[0]), j = cell_of(place[1], n[1]), k = cell_of(place[2], n[2]);
        const int64_t rows[4] = {
            i.low * n[1] + j.low, i.low * n[1] + j.high,
            i.high * n[1] + j.low, i.high * n[1] + j.high,
        };
        for (int64_t c = 0; c < n[3]; c++) {
            double along[4];
            for (int row = 0; row < 4; row++) {
                const float *values = a->values.at + rows[row] * n[2] * n[3] + c;
                along[row] = mix_f(values[k.low * n[3]], values[k.high * n[3]], k.part);
            }
            double near = mix(along[0], along[1], j.part), far = mix(along[2], along[3], j.part);
            a->out.at[m * n[3] + c] = (float)mix(near, far, i.part);
        }
    }
}

#define CHUNK 32  // points at once: a bit each

typedef struct { const float *x, *y, *z; } Points;

// Which of some points lie in a ball: bit i for point i.
static inline uint32_t within(Points p, Points centre, float radius_2, int size) {
    uint32_t inside = 0;
    float cx = *centre.x, cy = *centre.y, cz = *centre.z;
    for (int i = 0; i < size; i++) {
        float dx = p.x[i] - cx, dy = p.y[i] - cy, dz = p.z[i] - cz;
        inside |= (uint32_t)(dx * dx + dy * dy + dz * dz <= radius_2) << i;
    }
    return inside;
}

static inline Points points_of(const f32_3 *clouds, int64_t cloud, int64_t first) {
    int64_t n = clouds->n[2];
    const float *x = clouds->at + cloud * 3 * n + first;
    return (Points){x, x + n, x + 2 * n};
}

struct ball_query { f32_3 points, centres; double radius_2; i64_3 indices; };
// The first points (clouds, 3, n), by index, within a radius of each centre (clouds, 3, m): indices
// (clouds, m, k). A ball that holds fewer repeats its first; an empty one gives 0.
KERNEL(void, ball_query) {
    int64_t n = a->points.n[2], k = a->indices.n[2], *found = a->indices.at;
    float radius_2 = (float)a->radius_2;
    for (int64_t cloud = 0; cloud < a->points.n[0]; cloud++)
        for (int64_t m = 0; m < a->centres.n[2]; m++, found += k) {
            Points centre = points_of(&a->centres, cloud, m);
            int64_t count = 0;
            for (int64_t start = 0; start < n && count < k; start += CHUNK) {
                Points points = points_of(&a->points, cloud, start);
                int size = (int)min_i64(CHUNK, n - start);
                uint32_t inside = size == CHUNK ? within(points, centre, radius_2, CHUNK)
                                                : within(points, centre, radius_2, size);
                for (; inside && count < k; inside &= inside - 1)
                    found[count++] = start + __builtin_ctz(inside);
            }
            int64_t first = count ? found[0] : 0;
            while (count < k) found[count++] = first;
        }
}
