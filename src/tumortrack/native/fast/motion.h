// A motion and an organ at rest; see registration/motion.py and rest_shape.py.
#pragma once

#include "fast/flow.h"

#define POSE 6  // unknowns before the coefficients: shift and turn

// x -> rotation (x - center_ct) + centre_mm
typedef struct {
    f64_1 center_ct;
    f64_2 rotation;
    f64_1 centre_mm;
} Pose;

// Signed distances (mm, negative inside) to one closed surface on a lattice of the CT frame.
typedef struct {
    f32_3 values_mm;
    f32_1 origin_mm;
    double spacing_mm;
} DistanceField;

// The distance at one place (mm), and its slope along x, y and z, by trilinear interpolation.
static inline float distance_at(
    const DistanceField *field, float x, float y, float z, float slope[3]) {
    const int64_t *n = field->values_mm.n;
    const int32_t row = (int32_t)n[2], plane = (int32_t)n[1] * row;
    const float *origin = field->origin_mm.at, per_cell = 1 / (float)field->spacing_mm;
    x = clampf((x - origin[0]) * per_cell, 0, (float)n[0] - 1.001f);
    y = clampf((y - origin[1]) * per_cell, 0, (float)n[1] - 1.001f);
    z = clampf((z - origin[2]) * per_cell, 0, (float)n[2] - 1.001f);
    const int32_t i = (int32_t)x, j = (int32_t)y, k = (int32_t)z;
    const float a = x - (float)i, b = y - (float)j, c = z - (float)k;
    const float *restrict v = field->values_mm.at;
    const int32_t n00 = i * plane + j * row + k, n01 = n00 + row, n10 = n00 + plane;
    const int32_t n11 = n10 + row;
    const float s00 = v[n00 + 1] - v[n00], s01 = v[n01 + 1] - v[n01];
    const float s10 = v[n10 + 1] - v[n10], s11 = v[n11 + 1] - v[n11];
    const float l00 = v[n00] + s00 * c, l01 = v[n01] + s01 * c;
    const float l10 = v[n10] + s10 * c, l11 = v[n11] + s11 * c;
    const float f0 = l00 + (l01 - l00) * b, f1 = l10 + (l11 - l10) * b;
    const float d0 = s00 * (1 - b) + s01 * b, d1 = s10 * (1 - b) + s11 * b;
    slope[0] = (f1 - f0) * per_cell;
    slope[1] = ((l01 - l00) * (1 - a) + (l11 - l10) * a) * per_cell;
    slope[2] = (d0 * (1 - a) + d1 * a) * per_cell;
    return f0 + (f1 - f0) * a;
}

// What each unknown does to the signed distance of up to BLOCK points (n, 3; camera frame, mm),
// carried back, to a surface at rest; the distance itself stands in the last column of ``rows``
// (n, p + 1). ``flow`` has the opposite velocity.
static inline void add_rows(
    const Modes *modes, const DistanceField *field, const Flow *flow, const double center[3],
    const double rotation[9], const double centre[3], const float *points, int64_t count,
    float *rows) {
    const float per_cell = 1 / (float)flow->spacing_mm, *origin = flow->origin_mm.at;
    const int64_t m = modes->values.n[4], columns = POSE + m + 1;
    float offsets[BLOCK][3];
    Block block;
    for (int64_t p = 0; p < count; p++) {
        const double x = points[3 * p] - centre[0], y = points[3 * p + 1] - centre[1];
        const double z = points[3 * p + 2] - centre[2];
        for (int axis = 0; axis < 3; axis++) {
            const double turned =
                rotation[axis] * x + rotation[3 + axis] * y + rotation[6 + axis] * z;
            offsets[p][axis] = (float)turned;
            block.places[axis][p] = ((float)(turned + center[axis]) - origin[axis]) * per_cell;
        }
    }
    travel(flow, &block, count);
    for (int64_t p = 0; p < count; p++) {
        float at[3], slope[3], *row = rows + columns * p;
        leave(flow, &block, p, at);
        row[columns - 1] = distance_at(field, at[0], at[1], at[2], slope);
        const float sx = slope[0], sy = slope[1], sz = slope[2];
        const float ox = offsets[p][0], oy = offsets[p][1], oz = offsets[p][2];
        const float inwards[3] = {-sx, -sy, -sz};
        memcpy(row, inwards, sizeof inwards);
        row[3] = sy * oz - sz * oy;
        row[4] = sz * ox - sx * oz;
        row[5] = sx * oy - sy * ox;
        memset(row + POSE, 0, (size_t)m * sizeof(float));
        add_modes(modes, block.middles[0][p], block.middles[1][p], block.middles[2][p], inwards,
                  row + POSE);
    }
}
