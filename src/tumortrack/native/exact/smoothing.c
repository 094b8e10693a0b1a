// See ``segmentation.smoothing``.
#include "native.h"

struct plane { double here, by_row, by_column; };

// Replaces ``plane`` with the least-squares plane through the neighbours within ``reach`` pixels
// that lie ``within`` so many mm of it, and ``slope`` more for each pixel away. Returns how many
// they are; 0: they show none, and it stays.
static int64_t fit(
    const f32_2 *depth, int64_t row, int64_t column, int64_t reach, double within, double slope,
    struct plane *plane) {
    const int64_t top = max_i64(row - reach, 0), bottom = min_i64(row + reach + 1, depth->n[0]);
    const int64_t left = max_i64(column - reach, 0);
    const int64_t right = min_i64(column + reach + 1, depth->n[1]);
    const struct plane near = *plane;
    int64_t number = 0;
    double su = 0, sv = 0, suu = 0, suv = 0, svv = 0, sz = 0, suz = 0, svz = 0;
    for (int64_t v = top; v < bottom; v++) {
        const float *const depths = depth->at + v * depth->n[1];
        const double y = v - row;
        for (int64_t u = left; u < right; u++) {
            const double x = u - column;
            const double off = depths[u] - (near.here + near.by_row * y + near.by_column * x);
            const double away = fabs(x) > fabs(y) ? fabs(x) : fabs(y);
            if (fabs(off) < within + slope * away) {  // NaN is not
                number++;
                sv += y;
                su += x;
                svv += y * y;
                suv += y * x;
                suu += x * x;
                sz += off;
                svz += y * off;
                suz += x * off;
            }
        }
    }
    // Of the normal equations, by Cramer's rule.
    const double count = number;
    const double a = svv * suu - suv * suv, b = suv * su - sv * suu, c = sv * suv - svv * su;
    const double d = sv * su - count * suv, determinant = count * a + sv * b + su * c;
    if (number < 3 || determinant < 1e-6 * count) return 0;
    plane->here += (sz * a + svz * b + suz * c) / determinant;
    plane->by_row += (sz * b + svz * (count * suu - su * su) + suz * d) / determinant;
    plane->by_column += (sz * c + svz * d + suz * (count * svv - sv * sv)) / determinant;
    return number;
}

// The depth at each of some rows and columns, by the plane through its neighbours within ``reach``
// pixels. The noise is ``relative`` to the squared depth, a steep surface rises by ``slope`` of the
// depth a pixel.
struct smooth_depth {
    f32_2 depth;
    i64_1 rows;
    i64_1 columns;
    int64_t reach;
    double relative, slope;
    f32_2 out;
};
KERNEL(void, smooth_depth) {
    const int64_t side = 2 * a->reach + 1;
    const double fewest = 0.3 * (side * side);  // else there is no surface round the pixel
    float *out = a->out.at;
    for (int64_t n = 0; n < a->rows.n[0]; n++) {
        const int64_t v = a->rows.at[n];
        for (int64_t m = 0; m < a->columns.n[0]; m++, out++) {
            const int64_t u = a->columns.at[m];
            const float z = *out = a->depth.at[v * a->depth.n[1] + u];
            if (!(z > 0)) continue;
            const double sigma = a->relative * z * z;
            struct plane plane = {z, 0, 0};
            // Of two noisy pixels, and of a slope; then about the plane that they show.
            const double slope = a->slope * z;
            if (fit(&a->depth, v, u, a->reach, 4.2 * sigma, slope, &plane) < fewest) continue;
            if (fit(&a->depth, v, u, a->reach, 3.0 * sigma, 0, &plane) < fewest) continue;
            *out = plane.here;
        }
    }
}
