// See ``registration.compliance``.
#include "fast/gauss_newton.h"

// -2 log of the evidence of the prior that ``explained`` (n, n; J C J', mm^2) follows from, for the
// distances d + J x with robust weights W, up to a constant; NaN where the system has no solution.
// The most likely x is -C J' z, where z = (J C J' + 1 / W)^-1 d: a small system, since the means are
// fewer than the unknowns. Its determinant, times W's, is that of the posterior's precision over the
// prior's.
struct linear_cost {
    f64_2 explained;
    f64_1 weights;
    f64_1 at_mean_mm;    // d where the prior has its mean
    f64_1 distances_mm;  // d at first
    f64_1 width_mm;      // of the robust kernel
    double judged_width; // in these, of the misfit
    int64_t steps;
    f64_2 system;        // room for a system, and for roots, pulls and residuals
    f64_2 room;
};
KERNEL(double, linear_cost) {
    const int64_t n = a->weights.n[0];
    const double *restrict explained = a->explained.at, *restrict width = a->width_mm.at;
    const double *restrict weights = a->weights.at, *restrict at_mean = a->at_mean_mm.at;
    double *restrict system = a->system.at, *restrict roots = a->room.at;
    double *restrict pulls = roots + n, *restrict residuals = pulls + n, cost = 0;
    memcpy(residuals, a->distances_mm.at, (size_t)n * sizeof(double));
    for (int64_t step = 0; step < a->steps; step++) {
        for (int64_t i = 0; i < n; i++) {
            const double r = residuals[i] / width[i];
            roots[i] = sqrt(weights[i]) / (1 + r * r);
            pulls[i] = roots[i] * at_mean[i];
        }
        for (int64_t i = 0; i < n; i++) {
            for (int64_t j = 0; j <= i; j++)
                system[n * i + j] = roots[i] * explained[n * i + j] * roots[j];
            system[n * i + i] += 1;
        }
        if (!solve(system, pulls, n)) return NAN;
        for (int64_t i = 0; i < n; i++) pulls[i] *= roots[i];
        for (int64_t i = 0; i < n; i++) {
            double explains = 0;
            for (int64_t j = 0; j < n; j++) explains += explained[n * i + j] * pulls[j];
            residuals[i] = at_mean[i] - explains;
        }
    }
    for (int64_t i = 0; i < n; i++) {
        const double judged = a->judged_width * width[i], r = residuals[i] / judged;
        cost += judged * judged * weights[i] * (r * r / (1 + r * r));
        cost += pulls[i] * (at_mean[i] - residuals[i]);
        cost += 2 * log(system[n * i + i]);  // of Cholesky's factor
    }
    return cost;
}
