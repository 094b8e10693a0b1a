// See registration/motion.py.
#include "fast/motion.h"

struct forward {
    Flow flow;
    Pose pose;
    f32_2 points;
    f64_2 out;
};
KERNEL(void, forward) {
    const double *center = a->pose.center_ct.at, *turn = a->pose.rotation.at;
    Block block;
    for (int64_t first = 0, count; (count = next_block(&a->flow, &a->points, first, &block));
         first += count) {
        for (int64_t p = 0; p < count; p++) {
            float at[3];
            leave(&a->flow, &block, p, at);
            const double x = at[0] - center[0], y = at[1] - center[1], z = at[2] - center[2];
            for (int axis = 0; axis < 3; axis++) {
                const double *row = turn + 3 * axis;
                a->out.at[3 * (first + p) + axis] =
                    row[0] * x + row[1] * y + row[2] * z + a->pose.centre_mm.at[axis];
            }
        }
    }
}

struct inverse {
    Flow flow;
    Pose pose;
    f32_2 points;
    f64_2 out;
};
KERNEL(void, inverse) {
    const double *center = a->pose.center_ct.at, *turn = a->pose.rotation.at;
    const double *to = a->pose.centre_mm.at;
    const float *origin = a->flow.origin_mm.at, per_cell = 1 / (float)a->flow.spacing_mm;
    Block block;
    for (int64_t first = 0; first < a->points.n[0]; first += BLOCK) {
        const int64_t count = min_i64(BLOCK, a->points.n[0] - first);
        for (int64_t p = 0; p < count; p++) {
            const float *point = a->points.at + 3 * (first + p);
            const double x = point[0] - to[0], y = point[1] - to[1], z = point[2] - to[2];
            for (int axis = 0; axis < 3; axis++) {
                const double turned = turn[axis] * x + turn[3 + axis] * y + turn[6 + axis] * z;
                block.places[axis][p] = ((float)(turned + center[axis]) - origin[axis]) * per_cell;
            }
        }
        travel(&a->flow, &block, count);
        for (int64_t p = 0; p < count; p++) {
            float at[3];
            leave(&a->flow, &block, p, at);
            for (int axis = 0; axis < 3; axis++) a->out.at[3 * (first + p) + axis] = at[axis];
        }
    }
}

// What each unknown does to the place of each point, in the organ's axes (n, 3, p).
struct effects {
    Flow flow;
    Modes modes;
    f64_1 center_ct;
    f32_2 points;
    f32_1 row;
    f64_3 out;
};
KERNEL(void, effects) {
    const double *center = a->center_ct.at;
    const int64_t m = a->row.n[0], unknowns = POSE + m;
    float *row = a->row.at;
    Block block;
    for (int64_t first = 0, count; (count = next_block(&a->flow, &a->points, first, &block));
         first += count) {
        for (int64_t p = 0; p < count; p++) {
            float at[3];
            leave(&a->flow, &block, p, at);
            for (int axis = 0; axis < 3; axis++) {
                const int after = (axis + 1) % 3, before = (axis + 2) % 3;
                const float along[3] = {axis == 0, axis == 1, axis == 2};
                double *effect = a->out.at + (3 * (first + p) + axis) * unknowns;
                memset(effect, 0, POSE * sizeof(double));
                effect[axis] = 1;
                effect[3 + after] = at[before] - center[before];
                effect[3 + before] = center[after] - at[after];
                memset(row, 0, (size_t)m * sizeof(float));
                add_modes(&a->modes, block.middles[0][p], block.middles[1][p], block.middles[2][p],
                          along, row);
                for (int64_t mode = 0; mode < m; mode++) effect[POSE + mode] = row[mode];
            }
        }
    }
}

struct residual_rows {
    Modes modes;
    DistanceField field;
    Flow flow;
    Pose pose;
    f32_2 points;
    f32_2 out;
};
KERNEL(void, residual_rows) {
    for (int64_t first = 0; first < a->points.n[0]; first += BLOCK)
        add_rows(&a->modes, &a->field, &a->flow, a->pose.center_ct.at, a->pose.rotation.at,
                 a->pose.centre_mm.at, a->points.at + 3 * first,
                 min_i64(BLOCK, a->points.n[0] - first), a->out.at + a->out.n[1] * first);
}

// Labels points inside, and lowers each point's margin to its distance from the surface.
struct mark {
    DistanceField field;
    int64_t label;
    f32_2 points;
    u8_1 labels;
    f32_1 margin_mm;
};
KERNEL(void, mark) {
    const float *restrict points = a->points.at;
    float *restrict margin_mm = a->margin_mm.at;
    uint8_t *restrict labels = a->labels.at;
    const uint8_t label = (uint8_t)a->label;
    const DistanceField field = a->field;
    const int32_t count = (int32_t)a->points.n[0];
#pragma omp simd
    for (int32_t p = 0; p < count; p++) {
        float slope[3];
        const float distance =
            distance_at(&field, points[3 * p], points[3 * p + 1], points[3 * p + 2], slope);
        const float off = fabsf(distance);
        labels[p] = distance < 0 ? label : labels[p];
        margin_mm[p] = off < margin_mm[p] ? off : margin_mm[p];
    }
}
