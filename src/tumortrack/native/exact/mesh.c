// Points inside a surface, and points that lie far apart.
#include "triangle.h"

// Whether, projected on x and y, the edge passes to the right of the point.
static inline bool left_of(const double *a, const double *b, double x, double y) {
    if ((a[1] > y) == (b[1] > y)) return false;
    const double *low = a[1] > b[1] ? b : a, *high = a[1] > b[1] ? a : b;
    return (high[0] - low[0]) * (y - low[1]) - (x - low[0]) * (high[1] - low[1]) > 0;
}

// Turns `inside` over for each face that lies above a point. Points are sorted by cell of a grid
// over x and y (side x side); `starts` are the cells' first points and the number of points. Each
// face, which names vertices that exist, is tested only against those in cells below it.
//
// Of two triangles that share an edge exactly one owns a point on it, as both compute that edge's
// sign from its lower end (crossing rule of Shimrat 1962, doi 10.1145/368637.368653).
struct faces_above {
    f64_2 points, vertices;
    i32_2 faces;
    int64_t side;
    i64_1 starts;
    struct { double x0, y0, per_x, per_y; } grid;
    bool_1 inside;
};
KERNEL(void, faces_above) {
    const double *points = a->points.at;
    const double x0 = a->grid.x0, y0 = a->grid.y0, side = (double)a->side, most = side - 1;
    bool *inside = a->inside.at;
    for (int64_t f = 0; f < a->faces.n[0]; f++) {
        const int32_t *face = a->faces.at + 3 * f;
        const double *p = a->vertices.at + 3 * (int64_t)face[0];
        const double *q = a->vertices.at + 3 * (int64_t)face[1];
        const double *r = a->vertices.at + 3 * (int64_t)face[2];
        double left = (least3(p[0], q[0], r[0]) - x0) * a->grid.per_x;
        double right = (most3(p[0], q[0], r[0]) - x0) * a->grid.per_x;
        double bottom = (least3(p[1], q[1], r[1]) - y0) * a->grid.per_y;
        double top = (most3(p[1], q[1], r[1]) - y0) * a->grid.per_y;
        if (right < 0 || top < 0 || left > side || bottom > side) continue;
        double area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
        if (area == 0) continue;
        int64_t first = (int64_t)clampd(left, 0, most), last = (int64_t)clampd(right, 0, most);
        int64_t last_row = (int64_t)clampd(top, 0, most);
        for (int64_t row = (int64_t)clampd(bottom, 0, side); row <= last_row; row++) {
            const int64_t *starts = a->starts.at + row * a->side;
            for (int64_t i = starts[first]; i < starts[last + 1]; i++) {
                double x = points[3 * i], y = points[3 * i + 1];
                bool crossed = left_of(p, q, x, y) != left_of(q, r, x, y);
                if (crossed == left_of(r, p, x, y)) continue;
                double s = ((x - p[0]) * (r[1] - p[1]) - (y - p[1]) * (r[0] - p[0])) / area;
                double t = ((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])) / area;
                inside[i] ^= p[2] + s * (q[2] - p[2]) + t * (r[2] - p[2]) > points[3 * i + 2];
            }
        }
    }
}

// Squares of distances to the newest choice, kept in `nearest` where they are less; the largest of
// those, found as an integer: the order is the same, and compilers take it in lanes.
static float update(const float *restrict x, int64_t n, int64_t newest, float *restrict nearest) {
    const float *restrict y = x + n, *restrict z = y + n;
    const float cx = x[newest], cy = y[newest], cz = z[newest];
    int32_t most = 0;
    for (int64_t i = 0; i < n; i++) {
        float dx = x[i] - cx, dy = y[i] - cy, dz = z[i] - cz;
        float square = dx * dx + dy * dy + dz * dz;
        nearest[i] = square < nearest[i] ? square : nearest[i];
        int32_t bits;
        memcpy(&bits, nearest + i, sizeof bits);
        most = bits > most ? bits : most;
    }
    float largest;
    memcpy(&largest, &most, sizeof largest);
    return largest;
}

// Farthest points of clouds (B, 3, N), into `chosen` (B, k), from the first choices (B,), which are
// below N, on: each next one is the first of those that are farthest from all before.
struct farthest { f32_3 points; i64_1 first; f32_1 nearest; i64_2 chosen; };
KERNEL(void, farthest) {
    const int64_t n = a->points.n[2];
    float *nearest = a->nearest.at;
    for (int64_t cloud = 0; n && cloud < a->points.n[0]; cloud++) {
        const float *x = a->points.at + 3 * n * cloud;
        int64_t newest = a->first.at[cloud];
        for (int64_t i = 0; i < n; i++) nearest[i] = INFINITY;
        for (int64_t step = 0; step < a->chosen.n[1]; step++) {
            a->chosen.at[cloud * a->chosen.n[1] + step] = newest;
            float most = update(x, n, newest, nearest);
            newest = 0;
            while (newest < n - 1 && nearest[newest] != most) newest++;
        }
    }
}
