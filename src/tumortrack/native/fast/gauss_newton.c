// The refinement: all Gauss-Newton iterations in one call. See ``registration.gauss_newton`` for
// what is minimised.
#include "fast/gauss_newton.h"

#define AT_ONCE 256  // points whose rows stay in the cache; also so many are summed in float
#define APART 16     // numbers between rows of sums: rows a power of two apart share a cache's lines
#define STRIDE (AT_ONCE + APART)

// The organ at rest and the prior of its motion (CT frame, mm), the observed points (camera frame,
// mm), and settings; ``weight`` of one point's squared distance.
typedef struct {
    Modes modes;
    f64_1 center_ct;
    DistanceField distances;
    f64_2 precision;
    f64_1 mean;
    f32_2 points;
    double weight, first_mm, last_mm, narrowing, enough_mm;
} Problem;

// What is refined, and what its last step has left.
typedef struct {
    f64_2 rotation;
    f64_1 centre_mm;
    f64_1 coefficients;
    f64_1 moved;
    f32_1 distances_mm;
    f64_2 curvature;
    f64_1 gradient;
} State;

// Room to work in. ``columns``: the rows of AT_ONCE points, transposed, padded to fours of columns.
typedef struct {
    f32_4 velocity;
    f32_1 coefficients;
    f32_2 rows;
    f32_2 columns;
    f64_2 sums;
    f64_2 factor;
    f64_1 change;
} Room;

struct descend {
    Problem problem;
    State state;
    Room room;
    int64_t first, last;
    f64_1 ended;  // whether it has converged, and the last cost
};

// The robust kernel's width (mm) after so many steps; a point pulls most at 0.58 of it.
static double width_mm(const Problem *problem, int64_t step) {
    const double width = problem->first_mm * pow(problem->narrowing, (double)step);
    return width > problem->last_mm ? width : problem->last_mm;
}

// Adds the products of all pairs of columns, over ``count`` points, to the lower triangle of
// ``sums``: eight at a time, so that a number read is used more than once.
static void add_products(
    const float *restrict columns, int64_t n_columns, int64_t count, double *restrict sums) {
    for (int64_t n = 0; n < n_columns; n += 2) {
        const float *a = columns + STRIDE * n, *b = a + STRIDE;
        for (int64_t m = 0; m < n + 2; m += 4) {
            const float *c = columns + STRIDE * m, *d = c + STRIDE, *e = d + STRIDE, *f = e + STRIDE;
            float ac = 0, ad = 0, ae = 0, af = 0, bc = 0, bd = 0, be = 0, bf = 0;
            for (int64_t p = 0; p < count; p++) {
                ac += a[p] * c[p];
                ad += a[p] * d[p];
                ae += a[p] * e[p];
                af += a[p] * f[p];
                bc += b[p] * c[p];
                bd += b[p] * d[p];
                be += b[p] * e[p];
                bf += b[p] * f[p];
            }
            double *upper = sums + (n_columns + 4) * n + m, *lower = upper + n_columns + 4;
            upper[0] += ac;
            upper[1] += ad;
            upper[2] += ae;
            upper[3] += af;
            lower[0] += bc;
            lower[1] += bd;
            lower[2] += be;
            lower[3] += bf;
        }
    }
}

// Distances as ``add_rows`` gives them, and the sums over points of ``weight * row * row'`` and
// ``weight * row * distance``, into the state; ``weight`` is ``root_weight`` squared. ``flow`` has
// the opposite velocity.
static void normal_equations(
    const Problem *problem, const Flow *flow, float width, const Room *room, const State *state) {
    const int64_t unknowns = state->gradient.n[0], n_columns = room->columns.n[0];
    const int64_t n_points = problem->points.n[0], stride = n_columns + 4;
    const float per_width = 1 / width;
    float *rows = room->rows.at, *columns = room->columns.at;
    double *sums = room->sums.at, *curvature = state->curvature.at;
    memset(sums, 0, (size_t)(n_columns * stride) * sizeof(double));
    for (int64_t start = 0; start < n_points; start += AT_ONCE) {
        const int64_t end = min_i64(start + AT_ONCE, n_points);
        for (int64_t first = start; first < end; first += BLOCK) {
            const int64_t count = min_i64(BLOCK, end - first);
            add_rows(&problem->modes, &problem->distances, flow, problem->center_ct.at,
                     state->rotation.at, state->centre_mm.at, problem->points.at + 3 * first, count,
                     rows);
            for (int64_t p = 0; p < count; p++) {
                const float *row = rows + (unknowns + 1) * p;
                const float weight = root_weight(row[unknowns] * per_width);
                state->distances_mm.at[first + p] = row[unknowns];
                for (int64_t n = 0; n <= unknowns; n++)
                    columns[STRIDE * n + first - start + p] = row[n] * weight;
            }
        }
        add_products(columns, n_columns, end - start, sums);
    }
    for (int64_t n = 0; n < unknowns; n++) {
        for (int64_t m = 0; m <= n; m++)
            curvature[unknowns * n + m] = curvature[unknowns * m + n] = sums[stride * n + m];
        state->gradient.at[n] = sums[stride * unknowns + n];
    }
}

// Distances, curvature and gradient of the cost at a state into it; the cost.
static double equations(
    const Problem *problem, const State *state, double width, const Room *room) {
    const double weight = problem->weight, last_mm = problem->last_mm;
    const int64_t m = problem->modes.values.n[4], unknowns = POSE + m, *n = room->velocity.n;
    double *change = room->change.at, *gradient = state->gradient.at, cost = 0;
    for (int64_t mode = 0; mode < m; mode++)
        room->coefficients.at[mode] = (float)-state->coefficients.at[mode];
    combine(problem->modes.values.at, room->coefficients.at, m, room->velocity.at,
            n[0] * n[1] * n[2] * n[3]);
    const float spacing_mm = (float)problem->modes.spacing_mm;
    const Flow flow = {room->velocity, problem->modes.origin_mm, problem->modes.spacing_mm,
                       steps_of(room->velocity.at, n, spacing_mm)};
    normal_equations(problem, &flow, (float)width, room, state);
    for (int64_t p = 0; p < problem->points.n[0]; p++)
        cost += rho(state->distances_mm.at[p] / last_mm);
    cost *= weight * last_mm * last_mm;
    for (int64_t i = 0; i < POSE; i++) change[i] = state->moved.at[i];
    for (int64_t i = 0; i < m; i++)  // from the prior's mean
        change[POSE + i] = state->coefficients.at[i] - problem->mean.at[i];
    for (int64_t i = 0; i < unknowns; i++) {
        const double *precision = problem->precision.at + unknowns * i;
        double *curvature = state->curvature.at + unknowns * i, slope = 0;  // of the prior, halved
        for (int64_t j = 0; j < unknowns; j++) {
            slope += precision[j] * change[j];
            curvature[j] = weight * curvature[j] + precision[j];
        }
        gradient[i] = weight * gradient[i] + slope;
        cost += change[i] * slope;
    }
    return cost;
}

// Steps ``first`` to ``last`` of a refinement, fewer if it converges: their number, or -1 if the
// curvature is not positive definite. Where ``first`` is not 0, the state is what is left by the
// steps before.
KERNEL(int64_t, descend) {
    const Problem *problem = &a->problem;
    const State *state = &a->state;
    const int64_t unknowns = state->gradient.n[0];
    double *change = a->room.change.at, *converged = a->ended.at, *cost = a->ended.at + 1;
    *converged = *cost = 0;
    memset(a->room.columns.at, 0, (size_t)(a->room.columns.n[0] * STRIDE) * sizeof(float));
    // Before step 0 there are equations, no step.
    for (int64_t step = a->first > 0 ? a->first : -1; step < a->last; step++) {
        double largest = 0;
        if (step >= 0) {
            memcpy(a->room.factor.at, state->curvature.at,
                   (size_t)(unknowns * unknowns) * sizeof(double));
            memcpy(change, state->gradient.at, (size_t)unknowns * sizeof(double));
            if (!solve(a->room.factor.at, change, unknowns)) return -1;
            turn(state->rotation.at, state->centre_mm.at, change);
            for (int64_t i = 0; i < POSE; i++) state->moved.at[i] -= change[i];
            for (int64_t i = POSE; i < unknowns; i++)
                state->coefficients.at[i - POSE] -= change[i];
            for (int64_t i = 0; i < unknowns; i++) largest = fmax(largest, fabs(change[i]));
        }
        *cost = equations(problem, state, width_mm(problem, step + 1), &a->room);
        if (step >= 0 && largest < problem->enough_mm && width_mm(problem, step) == problem->last_mm) {
            *converged = 1;
            return step + 1;
        }
    }
    return a->last;
}
