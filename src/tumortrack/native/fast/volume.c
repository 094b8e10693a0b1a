// The volume of a closed surface.
#include "native.h"

// Positive where faces (f, 3) turn outward: the sum of each face's area projected along z times its
// height over the first vertex. Faces name vertices that exist.
struct signed_volume { f64_2 vertices; i32_2 faces; };
KERNEL(double, signed_volume) {
    const double *vertices = a->vertices.at;
    double triple = 0;
    for (int64_t f = 0; f < a->faces.n[0]; f++) {
        const int32_t *face = a->faces.at + 3 * f;
        const double *p = vertices + 3 * (int64_t)face[0];
        const double *q = vertices + 3 * (int64_t)face[1];
        const double *r = vertices + 3 * (int64_t)face[2];
        double area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
        triple += area * (p[2] + q[2] + r[2] - 3 * vertices[2]);
    }
    return triple / 6;
}
