// See ``organ.flow``.
#include "fast/flow.h"

struct count_steps {
    f32_4 velocity;
    double spacing_mm;
};
KERNEL(int64_t, count_steps) {
    return steps_of(a->velocity.at, a->velocity.n, (float)a->spacing_mm);
}

struct combine_modes {
    f32_5 modes;
    f32_1 coefficients;
    f32_4 velocity;
};
KERNEL(void, combine_modes) {
    const int64_t *n = a->velocity.n;
    combine(a->modes.at, a->coefficients.at, a->coefficients.n[0], a->velocity.at,
            n[0] * n[1] * n[2] * n[3]);
}

struct follow {
    Flow flow;
    f32_2 points;
    f32_2 out;
};
KERNEL(void, follow) {
    Block block;
    for (int64_t first = 0, count; (count = next_block(&a->flow, &a->points, first, &block));
         first += count)
        for (int64_t p = 0; p < count; p++)
            leave(&a->flow, &block, p, a->out.at + 3 * (first + p));
}

// Trilinear values (n, m) of modes at points (n, 3), mm, each along a direction (n, 3); beyond the
// lattice those of its border.
struct project {
    Modes modes;
    f32_2 points;
    f32_2 directions;
    f32_2 out;
};
KERNEL(void, project) {
    const float *origin = a->modes.origin_mm.at, per_cell = 1 / (float)a->modes.spacing_mm;
    const int64_t m = a->out.n[1];
    memset(a->out.at, 0, (size_t)(a->out.n[0] * m) * sizeof(float));
    for (int64_t p = 0; p < a->points.n[0]; p++) {
        const float *point = a->points.at + 3 * p;
        const float x = (point[0] - origin[0]) * per_cell;
        const float y = (point[1] - origin[1]) * per_cell;
        const float z = (point[2] - origin[2]) * per_cell;
        add_modes(&a->modes, x, y, z, a->directions.at + 3 * p, a->out.at + m * p);
    }
}
