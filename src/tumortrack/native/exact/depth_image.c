// Depth images of a mesh (z-buffer), and which points of it are visible.
#include "triangle.h"

// The larger one of `here`, if so, and `there`, which is 0 or more: as integers, which have the
// same order. No branch, as half of the pixels about a triangle lie outside, unpredictably.
static inline float larger_if(bool so, float here, float there) {
    int32_t one, two;
    memcpy(&one, &here, sizeof one);
    memcpy(&two, &there, sizeof two);
    one &= -(int32_t)so;
    one = one > two ? one : two;
    memcpy(&there, &one, sizeof one);
    return there;
}

// The greatest 1/z in each pixel (h, w), from 0 (nothing is hit) on. Faces (f, 3) name vertices
// that exist. `seen` is a work array: vertices' column, row and 1/z, linear in the image, unlike z.
struct z_buffer {
    f32_2 vertices;
    i32_2 faces;
    Pinhole pinhole;
    f32_2 seen, nearest;
};
KERNEL(void, z_buffer) {
    const double fx = a->pinhole.fx, fy = a->pinhole.fy, cx = a->pinhole.cx, cy = a->pinhole.cy;
    const int64_t height = a->nearest.n[0], width = a->nearest.n[1];
    const float below = (float)height, beside = (float)width;
    for (int64_t n = 0; n < a->vertices.n[0]; n++) {
        const float *p = a->vertices.at + 3 * n;
        float *seen = a->seen.at + 3 * n, inverse = p[2] > 1 ? 1 / p[2] : -1;
        seen[0] = (float)(fx * p[0] * inverse + cx);
        seen[1] = (float)(fy * p[1] * inverse + cy);
        seen[2] = inverse;
    }
    for (int64_t f = 0; f < a->faces.n[0]; f++) {
        const int32_t *face = a->faces.at + 3 * f;
        const float *p = a->seen.at + 3 * (int64_t)face[0];
        const float *q = a->seen.at + 3 * (int64_t)face[1];
        const float *r = a->seen.at + 3 * (int64_t)face[2];
        // Outward faces run clockwise in a y-down image when they face the camera.
        float area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
        if (!(area < 0) || least3f(p[2], q[2], r[2]) < 0) continue;
        int32_t left = (int32_t)clampf(ceilf(least3f(p[0], q[0], r[0])), 0, beside);
        int32_t right = (int32_t)clampf(floorf(most3f(p[0], q[0], r[0])), -1, beside - 1);
        int32_t top = (int32_t)clampf(ceilf(least3f(p[1], q[1], r[1])), 0, below);
        int32_t bottom = (int32_t)clampf(floorf(most3f(p[1], q[1], r[1])), -1, below - 1);
        if (left > right) continue;
        const double ua = p[0], ub = q[0], uc = r[0], wa = p[2], wb = q[2], wc = r[2];
        const double inverse = 1 / (double)area;
        for (int32_t y = top; y <= bottom; y++) {
            const double va = p[1] - (double)y, vb = q[1] - (double)y, vc = r[1] - (double)y;
            float *restrict line = a->nearest.at + y * width;
            for (int32_t x = left; x <= right; x++) {
                double pa = ((ub - x) * vc - vb * (uc - x)) * inverse;
                double pb = ((uc - x) * va - vc * (ua - x)) * inverse;
                double pc = 1 - pa - pb;
                float here = (float)(pa * wa + pb * wb + pc * wc);
                __asm__("");  // not in lanes: a row has a few pixels
                line[x] = larger_if(least3(pa, pb, pc) >= -1e-5, here, line[x]);
            }
        }
    }
}

// Whether a triangle crosses each ray (n, 3) nearer to the eye than the ray's end by more than the
// tolerance (Moeller and Trumbore 1997, doi 10.1080/10867651.1997.10487468). Places are relative to
// the eye. Rays are sorted by their first image coordinate (uv), in columns, whose first rays are
// `starts`, 258 numbers from 0 to n. Faces name vertices that exist.
struct hidden {
    f64_2 rays, rays_uv, vertices, vertices_uv;
    i32_2 faces;
    struct { i64_1 starts; double lowest, width; } columns;
    double tolerance_mm;
    bool_1 hidden;
};
KERNEL(void, hidden) {
    const double *uv = a->vertices_uv.at, slack = 1e-9;  // a ray along an edge belongs to both
    const double lowest = a->columns.lowest, width = a->columns.width;
    const double *restrict rays = a->rays.at, *restrict rays_uv = a->rays_uv.at;
    const double tolerance = a->tolerance_mm;
    bool *restrict hidden = a->hidden.at;
    for (int64_t f = 0; f < a->faces.n[0]; f++) {
        const int32_t *face = a->faces.at + 3 * f;
        const int64_t p = face[0], q = face[1], r = face[2];
        double left = least3(uv[2 * p], uv[2 * q], uv[2 * r]);
        double right = most3(uv[2 * p], uv[2 * q], uv[2 * r]);
        double top = -INFINITY, bottom = INFINITY;
        int64_t first = 0, last = a->rays.n[0];
        if (right < INFINITY) {
            top = least3(uv[2 * p + 1], uv[2 * q + 1], uv[2 * r + 1]) - slack;
            bottom = most3(uv[2 * p + 1], uv[2 * q + 1], uv[2 * r + 1]) + slack;
            const int64_t *starts = a->columns.starts.at;
            first = starts[(int)clampd((left - slack - lowest) / width, 0, 257)];
            last = starts[(int)clampd((right + slack - lowest) / width + 1, 0, 257)];
        }
        const double *corner = a->vertices.at + 3 * p;
        const double *second = a->vertices.at + 3 * q, *third = a->vertices.at + 3 * r;
        const double ax = corner[0], ay = corner[1], az = corner[2];
        const double e1x = second[0] - ax, e1y = second[1] - ay, e1z = second[2] - az;
        const double e2x = third[0] - ax, e2y = third[1] - ay, e2z = third[2] - az;
        // The eye is the origin; q is the normal's moment, the same for every ray.
        const double qx = ay * e1z - az * e1y, qy = az * e1x - ax * e1z, qz = ax * e1y - ay * e1x;
        const double reach = -(e2x * qx + e2y * qy + e2z * qz);
        for (int64_t i = first; i < last; i++) {
            double v = rays_uv[2 * i + 1];
            if ((v < top) | (v > bottom) | hidden[i]) continue;  // one jump, mostly taken
            double x = rays[3 * i], y = rays[3 * i + 1], z = rays[3 * i + 2];
            double px = y * e2z - z * e2y, py = z * e2x - x * e2z, pz = x * e2y - y * e2x;
            double area = e1x * px + e1y * py + e1z * pz;
            if (area == 0) continue;
            double s = -(ax * px + ay * py + az * pz) / area;
            double t = -(x * qx + y * qy + z * qz) / area;
            if (s < -slack || t < -slack || s + t > 1 + slack) continue;
            double share = reach / area;  // of the ray, from the eye to the triangle
            double length = sqrt(x * x + y * y + z * z);
            hidden[i] = 0 < share * length && share * length < length - tolerance;
        }
    }
}
