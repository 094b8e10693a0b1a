// Equilibrium of an organ with unilateral contacts in the space of its modes: a dense problem of
// some dozens of unknowns. Loops instead of BLAS, which would wake every thread for each product:
// on a busy machine that takes many times longer than the product. And most springs are open.
#include "native.h"

#define MOST_STEPS 20
#define UNDAMPED_STEPS 6
#define CONVERGED_MM 1e-2

// matrix (n, n) += rows' diag(springs) rows, its lower triangle only, as `solve` needs no more;
// right += rows' loads.
static void add_rows(
    double *restrict matrix, double *restrict right, int64_t n, const double *restrict rows,
    const double *restrict loads, const double *restrict springs, int64_t n_rows
) {
    for (int64_t p = 0; p < n_rows; p++) {
        if (springs[p] == 0.0) continue;
        const double *row = rows + p * n;
        for (int64_t a = 0; a < n; a++) {
            double force = springs[p] * row[a];
            right[a] += row[a] * loads[p];
            for (int64_t b = 0; b <= a; b++) matrix[a * n + b] += force * row[b];
        }
    }
}

// right = inverse(matrix) right, by Cholesky; both are overwritten. The factor takes the place of
// the upper triangle, so that what is subtracted from all rows below lies side by side.
static void solve(double *restrict matrix, double *restrict right, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < i; j++) matrix[j * n + i] = matrix[i * n + j];
    for (int64_t k = 0; k < n; k++) {
        double *restrict row = matrix + k * n;
        double pivot = row[k] = sqrt(row[k]), solved = right[k] /= pivot;
        for (int64_t i = k + 1; i < n; i++) right[i] -= (row[i] /= pivot) * solved;
        for (int64_t j = k + 1; j < n; j++) {
            double *restrict below = matrix + j * n, factor = row[j];
            for (int64_t i = j; i < n; i++) below[i] -= row[i] * factor;
        }
    }
    for (int64_t i = n - 1; i >= 0; i--) {
        right[i] /= matrix[i * n + i];
        for (int64_t k = 0; k < i; k++) right[k] -= matrix[k * n + i] * right[i];
    }
}

struct add_springs { f64_2 matrix; f64_1 right; f64_2 rows; f64_1 loads, springs; };
KERNEL(void, add_springs) {
    add_rows(
        a->matrix.at, a->right.at, a->right.n[0], a->rows.at, a->loads.at, a->springs.at,
        a->rows.n[0]
    );
}

struct equilibrium {
    f64_2 stiffness; f64_1 forces;
    f64_2 rows; f64_1 depth, springs;   // of the contacts
    f64_2 matrix; f64_1 closed, loads;  // room for work
    f64_1 z, solution;
};
// 1 with the `solution` if the contacts come to rest, else 0. Each step solves with the contacts
// that the last one closed.
KERNEL(int64_t, equilibrium) {
    int64_t n = a->forces.n[0], n_rows = a->rows.n[0];
    double *z = a->z.at, *solution = a->solution.at, *closed = a->closed.at, *loads = a->loads.at;
    const double *depth = a->depth.at, *springs = a->springs.at;
    memset(z, 0, n * sizeof *z);
    for (int step = 0; step < MOST_STEPS; step++) {
        for (int64_t p = 0; p < n_rows; p++) {
            double penetration = depth[p];
            for (int64_t i = 0; i < n; i++) penetration += a->rows.at[p * n + i] * z[i];
            closed[p] = penetration > 0 ? springs[p] : 0.0;
            loads[p] = penetration > 0 ? -springs[p] * depth[p] : 0.0;
        }
        memcpy(a->matrix.at, a->stiffness.at, n * n * sizeof *z);
        memcpy(solution, a->forces.at, n * sizeof *z);
        add_rows(a->matrix.at, solution, n, a->rows.at, loads, closed, n_rows);
        solve(a->matrix.at, solution, n);
        double farthest = 0.0;
        for (int64_t i = 0; i < n; i++) {
            double move = solution[i] - z[i];
            farthest = fabs(move) > farthest ? fabs(move) : farthest;
            // Damped, for contacts that open and close in turns
            z[i] += step < UNDAMPED_STEPS ? move : 0.6 * move;
        }
        if (farthest < CONVERGED_MM) return 1;
    }
    return 0;
}
