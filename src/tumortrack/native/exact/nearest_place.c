// The nearest places on triangles, by a tree of boxes about boxes about leaves of triangles.
#include "triangle.h"

enum { WIDE = 8, MOST_LEVELS = 12 };  // boxes in a box, triangles in a leaf; for 2^31 triangles

// Triangles in the order of the curve. Leaves (n, 7, 8) have each one's middle, unit normal (0 if
// it is a line) and radius; boxes (m, 6, 8) the lower and upper corners of those in them. Leaves
// are level 0, one box is the last; each level's boxes begin at `firsts`. What fills the last of a
// level is infinitely far away, as all are before `build_tree`.
struct tree { f64_3 triangles, leaves, boxes; i64_1 firsts; };

// Lane k of a leaf.
static void put_triangle(double *leaf, int64_t k, const double *a) {
    const double *b = a + 3, *c = a + 6;
    double u0 = b[0] - a[0], u1 = b[1] - a[1], u2 = b[2] - a[2];
    double v0 = c[0] - a[0], v1 = c[1] - a[1], v2 = c[2] - a[2];
    double x = u1 * v2 - u2 * v1, y = u2 * v0 - u0 * v2, z = u0 * v1 - u1 * v0;
    double square = x * x + y * y + z * z;
    double edges = (u0 * u0 + u1 * u1 + u2 * u2) * (v0 * v0 + v1 * v1 + v2 * v2);
    double scale = square > 1e-10 * edges ? 1 / sqrt(square) : 0;
    double values[7] = {0, 0, 0, scale * x, scale * y, scale * z, 0};
    for (int axis = 0; axis < 3; axis++) values[axis] = (a[axis] + b[axis] + c[axis]) / 3;
    for (const double *corner = a; corner < a + 9; corner += 3) {
        double dx = corner[0] - values[0], dy = corner[1] - values[1], dz = corner[2] - values[2];
        double off = sqrt(dx * dx + dy * dy + dz * dz);
        values[6] = off > values[6] ? off : values[6];
    }
    for (int n = 0; n < 7; n++) leaf[WIDE * n + k] = values[n];
}

// Lane n of the boxes of a level: about `count` places (or about boxes, from their lower and upper
// corners), whose coordinates are `lane` apart, one after the other `next` apart.
static void put_box(
    const struct tree *tree, int64_t level, int64_t n, const double *low, const double *high,
    int64_t count, int64_t next, int64_t lane
) {
    double *box = tree->boxes.at + 6 * WIDE * (tree->firsts.at[level] + n / WIDE) + n % WIDE;
    for (int axis = 0; axis < 3; axis++) {
        double lowest = INFINITY, highest = -INFINITY;
        for (int64_t k = 0; k < count; k++) {
            double lower = low[lane * axis + next * k], higher = high[lane * axis + next * k];
            lowest = lower < lowest ? lower : lowest;
            highest = higher > highest ? higher : highest;
        }
        box[WIDE * axis] = lowest;
        box[WIDE * (3 + axis)] = highest;
    }
}

struct build_tree { struct tree tree; };
KERNEL(void, build_tree) {
    const struct tree *tree = &a->tree;
    const int64_t levels = tree->firsts.n[0];
    int64_t below = tree->triangles.n[0], count = tree->leaves.n[0];
    for (int64_t n = 0; n < count; n++) {
        const double *triangles = tree->triangles.at + 9 * WIDE * n;
        int64_t some = min_i64(WIDE, below - WIDE * n);
        for (int64_t k = 0; k < some; k++)
            put_triangle(tree->leaves.at + 7 * WIDE * n, k, triangles + 9 * k);
        if (levels > 1) put_box(tree, 1, n, triangles, triangles, 3 * some, 3, 1);
    }
    for (int64_t level = 1; level + 1 < levels; level++) {
        below = count;
        count = (count + WIDE - 1) / WIDE;
        for (int64_t n = 0; n < count; n++) {
            const double *box = tree->boxes.at + 6 * WIDE * (tree->firsts.at[level] + n);
            int64_t some = min_i64(WIDE, below - WIDE * n);
            put_box(tree, level + 1, n, box, box + 3 * WIDE, some, 1, WIDE);
        }
    }
}

// The squares of a point's distances to boxes (6, 8).
static inline void to_boxes(const double *p, const double *box, double *restrict out) {
    const double px = p[0], py = p[1], pz = p[2];
    for (int k = 0; k < WIDE; k++) {
        double x = most3(box[k] - px, px - box[3 * WIDE + k], 0);
        double y = most3(box[WIDE + k] - py, py - box[4 * WIDE + k], 0);
        double z = most3(box[2 * WIDE + k] - pz, pz - box[5 * WIDE + k], 0);
        out[k] = x * x + y * y + z * z;
    }
}

// Not above the squares of a point's distances to a leaf's triangles: those to discs about them
// (balls, if they are lines).
static inline void to_triangles(const double *p, const double *leaf, double *restrict out) {
    const double px = p[0], py = p[1], pz = p[2];
    for (int k = 0; k < WIDE; k++) {
        double x = px - leaf[k], y = py - leaf[WIDE + k], z = pz - leaf[2 * WIDE + k];
        double height = x * leaf[3 * WIDE + k] + y * leaf[4 * WIDE + k] + z * leaf[5 * WIDE + k];
        double flat = x * x + y * y + z * z - height * height;
        double aside = sqrt(flat < 0 ? 0 : flat) - leaf[6 * WIDE + k];
        aside = aside < 0 ? 0 : aside;
        out[k] = height * height + aside * aside;
    }
}

static const double FLAT = 1e-14;  // square of the sine of a corner, below which it is a line

// The nearest place on a triangle, by the region (corner, edge, inside) that the point is over:
// Ericson 2005, Real-Time Collision Detection, 5.1.5.
static inline void on_triangle(const double *p, const double *a, double *place) {
    const double *b = a + 3, *c = a + 6;
    double ab0 = b[0] - a[0], ab1 = b[1] - a[1], ab2 = b[2] - a[2];
    double ac0 = c[0] - a[0], ac1 = c[1] - a[1], ac2 = c[2] - a[2];
    double x = p[0] - a[0], y = p[1] - a[1], z = p[2] - a[2];
    double d1 = ab0 * x + ab1 * y + ab2 * z, d2 = ac0 * x + ac1 * y + ac2 * z;
    double bb = ab0 * ab0 + ab1 * ab1 + ab2 * ab2;
    double bc = ab0 * ac0 + ab1 * ac1 + ab2 * ac2;
    double cc = ac0 * ac0 + ac1 * ac1 + ac2 * ac2;
    double d3 = d1 - bb, d4 = d2 - bc;  // of p - b
    double d5 = d1 - bc, d6 = d2 - cc;  // of p - c
    double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    double ee = bb + cc - 2 * bc;  // squares of the edges' lengths
    double s, t;
    if (bb * cc - bc * bc <= FLAT * bb * cc || ee <= 0) {  // a line: its longest edge
        if (bb >= cc && bb >= ee) {
            s = bb > 0 ? clampd(d1 / bb, 0, 1) : 0, t = 0;
        } else if (cc >= ee) {
            s = 0, t = clampd(d2 / cc, 0, 1);
        } else {
            t = clampd((d4 - d3) / ee, 0, 1), s = 1 - t;
        }
    } else if (d1 <= 0 && d2 <= 0) {
        s = 0, t = 0;
    } else if (d3 >= 0 && d4 <= d3) {
        s = 1, t = 0;
    } else if (d6 >= 0 && d5 <= d6) {
        s = 0, t = 1;
    } else if (vc <= 0 && d1 >= 0 && d3 <= 0) {
        s = d1 / (d1 - d3), t = 0;
    } else if (vb <= 0 && d2 >= 0 && d6 <= 0) {
        s = 0, t = d2 / (d2 - d6);
    } else if (va <= 0 && d4 >= d3 && d5 >= d6) {
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6)), s = 1 - t;
    } else {
        s = vb / (va + vb + vc), t = vc / (va + vb + vc);
    }
    place[0] = a[0] + s * ab0 + t * ac0;
    place[1] = a[1] + s * ab1 + t * ac1;
    place[2] = a[2] + s * ab2 + t * ac2;
}

// A box that is still open: its level, its number there, and the square of its distance.
struct open { int64_t level, number; double away; };

// Opens a box: those in it that are nearer than `least` are sorted in, the nearest last.
static inline int64_t open_box(
    struct open *open, int64_t count, struct open box, const double *away, double least
) {
    int64_t first = count;
    for (int k = 0; k < WIDE; k++) {
        if (!(away[k] < least)) continue;
        int64_t at = count++;
        for (; at > first && open[at - 1].away < away[k]; at--) open[at] = open[at - 1];
        open[at] = (struct open){box.level - 1, WIDE * box.number + k, away[k]};
    }
    return count;
}

// The nearest place on a tree's triangles of each point. Neighbouring points are often nearest to
// neighbouring triangles: first where the last was.
struct nearest_places { f64_2 points; struct tree tree; f64_2 places; };
KERNEL(void, nearest_places) {
    const struct tree *tree = &a->tree;
    const int64_t levels = tree->firsts.n[0], triangles = tree->triangles.n[0];
    struct open open[WIDE * MOST_LEVELS + 1];
    double bounds[WIDE], place[3];
    int64_t last = 0;
    for (int64_t n = 0; levels <= MOST_LEVELS && n < a->points.n[0]; n++) {
        const double p[3] = {a->points.at[3 * n], a->points.at[3 * n + 1], a->points.at[3 * n + 2]};
        double least = INFINITY;
        int64_t count = 2;
        open[0] = (struct open){levels - 1, 0, 0};
        open[1] = (struct open){0, last / WIDE, 0};
        while (count) {
            struct open box = open[--count];
            if (box.away >= least) continue;
            if (box.level) {
                int64_t at = tree->firsts.at[box.level] + box.number;
                to_boxes(p, tree->boxes.at + 6 * WIDE * at, bounds);
                count = open_box(open, count, box, bounds, least);
                continue;
            }
            to_triangles(p, tree->leaves.at + 7 * WIDE * box.number, bounds);
            int64_t some = min_i64(WIDE, triangles - WIDE * box.number);
            for (int64_t k = 0; k < some; k++) {
                if (!(bounds[k] < least)) continue;
                int64_t t = WIDE * box.number + k;
                on_triangle(p, tree->triangles.at + 9 * t, place);
                double x = p[0] - place[0], y = p[1] - place[1], z = p[2] - place[2];
                double off = x * x + y * y + z * z;
                if (!(off < least)) continue;
                least = off, last = t;
                memcpy(a->places.at + 3 * n, place, sizeof place);
            }
        }
    }
}
