// Points that follow a velocity field on a lattice, in blocks; see ``organ.flow``.
#pragma once

#include "native.h"

#define BLOCK 64  // points that take each step together; a single one stalls on its previous step

// A velocity at the nodes ``origin_mm + spacing_mm * (i, j, k)``, mm per unit of time: points follow
// it for one unit, in ``steps``.
typedef struct {
    f32_4 velocity;
    f32_1 origin_mm;
    double spacing_mm;
    int64_t steps;
} Flow;

// Modes (i, j, k, 3, m) at the same nodes.
typedef struct {
    f32_5 values;
    f32_1 origin_mm;
    double spacing_mm;
} Modes;

// Places in cells, speeds in mm per unit of time, and places at half time.
typedef struct {
    float places[3][BLOCK];
    float speeds[3][BLOCK];
    float middles[3][BLOCK];
} Block;

// One step of ``count`` points: a place moves by ``move`` times the speed at ``places + half *
// speeds``. Trilinear; places beyond the lattice are clamped to its border.
static inline void advance(const Flow *flow, Block *block, int64_t count, float half, float move) {
    const float *restrict field = flow->velocity.at;
    const int64_t *n = flow->velocity.n;
    const float most_x = (float)n[0] - 1.001f, most_y = (float)n[1] - 1.001f;
    const float most_z = (float)n[2] - 1.001f;
    const int32_t row = (int32_t)(3 * n[2]), plane = (int32_t)n[1] * row;
    float *restrict x_at = block->places[0], *restrict y_at = block->places[1];
    float *restrict z_at = block->places[2], *restrict x_speed = block->speeds[0];
    float *restrict y_speed = block->speeds[1], *restrict z_speed = block->speeds[2];
#pragma omp simd
    for (int32_t p = 0; p < (int32_t)count; p++) {
        const float x = clampf(x_at[p] + half * x_speed[p], 0, most_x);
        const float y = clampf(y_at[p] + half * y_speed[p], 0, most_y);
        const float z = clampf(z_at[p] + half * z_speed[p], 0, most_z);
        const int32_t i = (int32_t)x, j = (int32_t)y, k = (int32_t)z;
        const float a = x - (float)i, b = y - (float)j, c = z - (float)k;
        const float a0 = 1 - a, b0 = 1 - b, c0 = 1 - c;
        const float w00 = a0 * b0, w01 = a0 * b, w10 = a * b0, w11 = a * b;
        const int32_t n00 = i * plane + j * row + 3 * k, n01 = n00 + row;
        const int32_t n10 = n00 + plane, n11 = n10 + row;
#define NODES(d) (w00 * field[n00 + d] + w01 * field[n01 + d] + w10 * field[n10 + d] + w11 * field[n11 + d])
        x_speed[p] = c0 * NODES(0) + c * NODES(3);
        y_speed[p] = c0 * NODES(1) + c * NODES(4);
        z_speed[p] = c0 * NODES(2) + c * NODES(5);
#undef NODES
        x_at[p] += move * x_speed[p];
        y_at[p] += move * y_speed[p];
        z_at[p] += move * z_speed[p];
    }
}

// Up to BLOCK points (n, 3), mm, as places in cells.
static inline void enter(const float *points, int64_t count, const Flow *flow, Block *block) {
    const float per_cell = 1 / (float)flow->spacing_mm;
    for (int64_t p = 0; p < count; p++)
        for (int axis = 0; axis < 3; axis++)
            block->places[axis][p] = (points[3 * p + axis] - flow->origin_mm.at[axis]) * per_cell;
}

// Moves ``count`` places of a block for one unit of time.
//
// Midpoint rule, with the middle of a step predicted from the last step's velocity: second order
// with one sample a step, and nearly symmetric, so that the opposite field leads back to within a
// few micrometres.
static inline void travel(const Flow *flow, Block *block, int64_t count) {
    const float dt = 1 / ((float)flow->spacing_mm * (float)flow->steps), half = 0.5f * dt;
    memset(block->speeds, 0, sizeof block->speeds);
    advance(flow, block, count, half, 0);
    for (int64_t step = 0; step < flow->steps; step++) {
        if (step == flow->steps / 2) {  // half of the time has passed, or will within this step
            const float past = flow->steps % 2 ? half : 0;
            for (int axis = 0; axis < 3; axis++)
                for (int64_t p = 0; p < count; p++)
                    block->middles[axis][p] =
                        block->places[axis][p] + past * block->speeds[axis][p];
        }
        advance(flow, block, count, half, dt);
    }
}

// Enters the block of points (n, 3) from ``first`` on, and moves it. How many they are: 0 at the end.
static inline int64_t next_block(
    const Flow *flow, const f32_2 *points, int64_t first, Block *block) {
    const int64_t count = min_i64(BLOCK, points->n[0] - first);
    enter(points->at + 3 * first, count, flow, block);
    if (count) travel(flow, block, count);
    return count;
}

// A place of a block in mm.
static inline void leave(const Flow *flow, const Block *block, int64_t p, float mm[3]) {
    for (int axis = 0; axis < 3; axis++)
        mm[axis] = flow->origin_mm.at[axis] + (float)flow->spacing_mm * block->places[axis][p];
}

// Adds the modes at a place in cells, along a direction, to ``out`` (m,).
static inline void add_modes(
    const Modes *modes, float x, float y, float z, const float direction[3], float *restrict out) {
    const int64_t *n = modes->values.n, m = n[4];
    x = clampf(x, 0, (float)n[0] - 1.001f);
    y = clampf(y, 0, (float)n[1] - 1.001f);
    z = clampf(z, 0, (float)n[2] - 1.001f);
    const int64_t i = (int64_t)x, j = (int64_t)y, k = (int64_t)z;
    const float a = x - (float)i, b = y - (float)j, c = z - (float)k;
    for (int column = 0; column < 4; column++) {
        const int u = column >> 1, v = column & 1;
        const float share = (u ? a : 1 - a) * (v ? b : 1 - b);
        const float *restrict near =
            modes->values.at + (((i + u) * n[1] + j + v) * n[2] + k) * 3 * m;
        const float *restrict far = near + 3 * m;
        const float s0 = share * direction[0], s1 = share * direction[1], s2 = share * direction[2];
        const float n0 = (1 - c) * s0, n1 = (1 - c) * s1, n2 = (1 - c) * s2;
        const float f0 = c * s0, f1 = c * s1, f2 = c * s2;
        for (int64_t mode = 0; mode < m; mode++)
            out[mode] += n0 * near[mode] + n1 * near[m + mode] + n2 * near[2 * m + mode] +
                         f0 * far[mode] + f1 * far[m + mode] + f2 * far[2 * m + mode];
    }
}

// ``modes @ coefficients``, (..., m) by (m,). BLAS would wake threads that then busy-wait and slow
// down those that move points.
static inline void combine(
    const float *restrict modes, const float *restrict coefficients, int64_t m, float *restrict out,
    int64_t count) {
    for (int64_t n = 0; n < count; n++, modes += m) {
        float total = 0;
        for (int64_t mode = 0; mode < m; mode++) total += modes[mode] * coefficients[mode];
        out[n] = total;
    }
}

// Integration steps that a field needs: the more, the steeper it is, as its inverse has to lead back
// within 0.01 mm.
static inline int64_t steps_of(const float *restrict field, const int64_t n[4], float spacing_mm) {
    const int64_t row = 3 * n[2], plane = n[1] * row;
    float most = 0;
    for (int64_t i = 0; i < n[0]; i++)
        for (int64_t j = 0; j < n[1]; j++) {
            const float *restrict here = field + i * plane + j * row;
            for (int64_t k = 3; k < row; k++) {
                const float off = fabsf(here[k] - here[k - 3]);
                most = off > most ? off : most;
            }
            for (int64_t k = 0; i > 0 && k < row; k++) {
                const float off = fabsf(here[k] - here[k - plane]);
                most = off > most ? off : most;
            }
            for (int64_t k = 0; j > 0 && k < row; k++) {
                const float off = fabsf(here[k] - here[k - row]);
                most = off > most ? off : most;
            }
        }
    return (int64_t)clampd(ceil(10 * ((double)most / (double)spacing_mm)), 3, 24);
}
