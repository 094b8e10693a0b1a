// The search: a rigid body fitted to a few points from many starts, in one call. See
// ``registration.gauss_newton`` for what is minimised; here without an elastic state and a prior.
#include "fast/gauss_newton.h"

#define MOST_RAD 0.5  // a step: linear beyond these it is not
#define MOST_MM 25.0

// The organ at rest (CT frame, mm), points (camera frame, mm), the robust kernel's width (mm) in
// each step, and the width by which starts are compared; ``damping`` of shift and turn.
typedef struct {
    DistanceField distances;
    f64_1 center_ct;
    f32_2 points;
    f64_1 widths_mm;
    double last_mm;
    f64_1 damping;
} RigidProblem;

// What shift and turn do to each point's distance, and the distance last, times ``root_weight``
// (p + 1, n); the mean of ``rho``.
static double weighed_rows(
    const RigidProblem *problem, const double rotation[9], const double centre[3], float width,
    float *restrict columns) {
    const int64_t n = problem->points.n[0];
    const float per_width = 1 / width;
    float turned[9], at[3], center[3], cost = 0;
    for (int k = 0; k < 9; k++) turned[k] = (float)rotation[k];
    for (int k = 0; k < 3; k++) at[k] = (float)centre[k];
    for (int k = 0; k < 3; k++) center[k] = (float)problem->center_ct.at[k];
    const float *restrict points = problem->points.at;
    const DistanceField field = problem->distances;
#pragma omp simd reduction(+ : cost)
    for (int64_t p = 0; p < n; p++) {
        const float x = points[3 * p] - at[0], y = points[3 * p + 1] - at[1];
        const float z = points[3 * p + 2] - at[2];
        const float ox = turned[0] * x + turned[3] * y + turned[6] * z;
        const float oy = turned[1] * x + turned[4] * y + turned[7] * z;
        const float oz = turned[2] * x + turned[5] * y + turned[8] * z;
        float slope[3];
        const float off =
            distance_at(&field, ox + center[0], oy + center[1], oz + center[2], slope);
        const float r = off * per_width, weight = root_weight(r);
        cost += r * r / (1 + r * r);
        const float sx = -slope[0] * weight, sy = -slope[1] * weight, sz = -slope[2] * weight;
        columns[p] = sx;
        columns[n + p] = sy;
        columns[2 * n + p] = sz;
        columns[3 * n + p] = sz * oy - sy * oz;
        columns[4 * n + p] = sx * oz - sz * ox;
        columns[5 * n + p] = sy * ox - sx * oy;
        columns[6 * n + p] = off * weight;
    }
    return (double)cost / (double)n;
}

// Curvature and gradient of the mean cost.
static void mean_equations(
    const RigidProblem *problem, const float *restrict columns, double *curvature,
    double *gradient) {
    const int64_t count = problem->points.n[0];
    for (int n = 0; n < POSE; n++) {
        for (int m = n; m < POSE + 1; m++) {
            const float *one = columns + count * n, *other = columns + count * m;
            float total = 0;
            for (int64_t p = 0; p < count; p++) total += one[p] * other[p];
            const double mean = (double)total / (double)count;
            if (m == POSE) gradient[n] = mean;
            else curvature[POSE * n + m] = curvature[POSE * m + n] = mean;
        }
        curvature[POSE * n + n] += problem->damping.at[n];
    }
}

// Refines each start's rotation (s, 3, 3) and centre (s, 3) in place; the mean ``rho`` of the
// points' distances, by ``last_mm``, into ``costs``. The number of starts, fewer if the equations of
// the next have no solution.
struct descend_rigidly {
    RigidProblem problem;
    f32_2 columns;
    f64_3 rotations;
    f64_2 centres;
    f64_1 costs;
};
KERNEL(int64_t, descend_rigidly) {
    const RigidProblem *problem = &a->problem;
    for (int64_t start = 0; start < a->costs.n[0]; start++) {
        double *rotation = a->rotations.at + 9 * start, *centre = a->centres.at + 3 * start;
        for (int64_t step = 0;; step++) {
            const bool whole = step == problem->widths_mm.n[0];  // the last one tells the cost alone
            const double width = whole ? problem->last_mm : problem->widths_mm.at[step];
            double curvature[POSE * POSE], change[POSE];
            a->costs.at[start] =
                weighed_rows(problem, rotation, centre, (float)width, a->columns.at);
            if (whole) break;
            mean_equations(problem, a->columns.at, curvature, change);
            if (!solve(curvature, change, POSE)) return start;
            for (int part = 0; part < POSE; part += 3) {
                double *step_part = change + part;
                const double most = part ? MOST_RAD : MOST_MM;
                const double size = sqrt(step_part[0] * step_part[0] + step_part[1] * step_part[1] +
                                         step_part[2] * step_part[2]);
                for (int k = 0; size > most && k < 3; k++) step_part[k] *= most / size;
            }
            turn(rotation, centre, change);
        }
    }
    return a->costs.n[0];
}
