// What tumortrack_benchmarks runs in its inner loops: the bed round an organ, and an electrode's kerf.
#include "native.h"

struct bed_spline { f64_3 values; f64_2 places; f64_1 out; f64_2 slope; };
// Uniform cubic B-spline with the grid's values as its coefficients, four at least along each axis,
// and its gradient; beyond the grid as at its border.
KERNEL(void, bed_spline) {
    const int64_t *size = a->values.n;
    for (int64_t n = 0; n < a->places.n[0]; n++) {
        double w[3][4], d[3][4];
        int64_t base[3];
        for (int axis = 0; axis < 3; axis++) {
            double x = clampd(a->places.at[3 * n + axis], 1.0, (double)size[axis] - 2.000001);
            base[axis] = (int64_t)x - 1;
            double t = x - (double)(int64_t)x, u = 1 - t;
            double *by = w[axis], *slope = d[axis];
            by[0] = u * (u * u) / 6;
            by[3] = t * (t * t) / 6;
            by[1] = (3 * (t * (t * t)) - 6 * (t * t) + 4) / 6;
            by[2] = 1 - by[0] - by[1] - by[3];
            slope[0] = -(u * u) / 2;
            slope[3] = t * t / 2;
            slope[1] = (3 * (t * t) - 4 * t) / 2;
            slope[2] = -slope[0] - slope[1] - slope[3];
        }
        double total = 0.0, sx = 0.0, sy = 0.0, sz = 0.0;
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < 4; j++) {
                int64_t row = (base[0] + i) * size[1] + base[1] + j;
                const double *values = a->values.at + row * size[2] + base[2];
                for (int k = 0; k < 4; k++) {
                    total += values[k] * w[0][i] * w[1][j] * w[2][k];
                    sx += values[k] * d[0][i] * w[1][j] * w[2][k];
                    sy += values[k] * w[0][i] * d[1][j] * w[2][k];
                    sz += values[k] * w[0][i] * w[1][j] * d[2][k];
                }
            }
        a->out.at[n] = total;
        a->slope.at[3 * n] = sx;
        a->slope.at[3 * n + 1] = sy;
        a->slope.at[3 * n + 2] = sz;
    }
}

#define PART 4.0        // voxels: a box of voxels is looked through for so much of a line
#define MOST_PARTS 1e6  // so that no line is endless

// Lower the squared distances of voxels from `low` to `stop` to those from a line.
static void approach_line(
    const f32_3 *near, const int64_t low[3], const int64_t stop[3], const double start[3],
    const double way[3], double squared
) {
    double wx = way[0], wy = way[1], wz = way[2];
    for (int64_t i = low[0]; i < stop[0]; i++)
        for (int64_t j = low[1]; j < stop[1]; j++) {
            float *row = near->at + (i * near->n[1] + j) * near->n[2];
            double x0 = (double)i - start[0], y0 = (double)j - start[1];
            for (int k = (int)low[2]; k < (int)stop[2]; k++) {
                double x = x0, y = y0, z = k - start[2];
                double t = clampd((x * wx + y * wy + z * wz) / squared, 0.0, 1.0);
                x -= t * wx;
                y -= t * wy;
                z -= t * wz;
                double off = x * x + y * y + z * z;
                row[k] = off < row[k] ? (float)off : row[k];
            }
        }
}

struct approach { f64_3 ends; double reach; f32_3 near; };
// Lower `near`, squared distances of voxels, to those from the lines between `ends`, at least where
// that is less than `reach`; all in voxels.
KERNEL(void, approach) {
    for (int64_t n = 0; n < a->ends.n[0]; n++) {
        const double *start = a->ends.at + 6 * n, *end = start + 3;
        double way[3] = {end[0] - start[0], end[1] - start[1], end[2] - start[2]};
        double squared = way[0] * way[0] + way[1] * way[1] + way[2] * way[2];
        squared = squared > 1e-12 ? squared : 1e-12;
        int64_t parts = (int64_t)clampd(sqrt(squared) / PART, 0, MOST_PARTS) + 1;
        for (int64_t part = 0; part < parts; part++) {
            int64_t low[3], stop[3];
            for (int axis = 0; axis < 3; axis++) {
                double from = start[axis] + way[axis] * (double)part / (double)parts;
                double to = start[axis] + way[axis] * (double)(part + 1) / (double)parts;
                double least = from < to ? from : to, most = from < to ? to : from;
                double size = (double)a->near.n[axis];
                low[axis] = (int64_t)clampd(ceil(least - a->reach), 0, size);
                stop[axis] = (int64_t)clampd(floor(most + a->reach) + 1, 0, size);
            }
            approach_line(&a->near, low, stop, start, way, squared);
        }
    }
}
