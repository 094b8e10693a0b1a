// What the refinement and the search have in common; see ``registration.gauss_newton``.
#pragma once

#include "fast/motion.h"

// The robust kernel, r^2 / (1 + r^2), of a distance in widths (Geman and McClure 1987).
static inline double rho(double r) { return r * r / (1 + r * r); }

// The root of rho'(r) / (2 r), which is 1 / (1 + r^2): a residual and its derivatives are each
// multiplied by it in a Gauss-Newton step.
static inline float root_weight(float r) { return 1 / (1 + r * r); }

// Moves a pose by ``-change`` in the organ's axes: rotation times the rotation vector's matrix
// (Rodrigues), centre along the axes of before.
static inline void turn(double rotation[9], double centre[3], const double change[POSE]) {
    const double axis[3] = {-change[3], -change[4], -change[5]};
    double before[9];
    memcpy(before, rotation, sizeof before);
    for (int n = 0; n < 3; n++)
        for (int m = 0; m < 3; m++) centre[n] -= before[3 * n + m] * change[m];
    const double angle = sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
    const double sine = angle > 0 ? sin(angle) / angle : 1;
    const double flat = angle > 1e-8 ? (1 - cos(angle)) / (angle * angle) : 0.5;
    const double cross[3][3] = {
        {0, -axis[2], axis[1]}, {axis[2], 0, -axis[0]}, {-axis[1], axis[0], 0}};
    for (int n = 0; n < 3; n++)
        for (int m = 0; m < 3; m++) {
            double total = before[3 * n + m];
            for (int k = 0; k < 3; k++) {
                double twice = 0;
                for (int j = 0; j < 3; j++) twice += cross[k][j] * cross[j][m];
                total += before[3 * n + k] * (sine * cross[k][m] + flat * twice);
            }
            rotation[3 * n + m] = total;
        }
}

// Solves ``matrix x = x`` for a symmetric positive definite matrix (n, n), of which it leaves
// Cholesky's factor in the lower triangle. False: the matrix is none such.
static inline bool solve(double *restrict matrix, double *restrict x, int64_t n) {
    for (int64_t i = 0; i < n; i++) {
        double *restrict row = matrix + n * i;
        for (int64_t j = 0; j <= i; j++) {
            const double *other = matrix + n * j;
            double total = row[j];
            for (int64_t k = 0; k < j; k++) total -= row[k] * other[k];
            if (j < i) row[j] = total / other[j];
            else if (!(total > 0)) return false;
            else row[i] = sqrt(total);
        }
        double total = x[i];
        for (int64_t k = 0; k < i; k++) total -= row[k] * x[k];
        x[i] = total / row[i];
    }
    for (int64_t i = n - 1; i >= 0; i--) {
        x[i] /= matrix[n * i + i];
        for (int64_t k = 0; k < i; k++) x[k] -= matrix[n * i + k] * x[i];
    }
    return true;
}
