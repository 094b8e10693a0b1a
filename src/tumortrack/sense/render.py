"""Depth images of a mesh (z-buffer), and which points of it are visible."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.compiled import njit
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh
from tumortrack.sense.camera import pinhole_of

_TOLERANCE_MM = 0.05  # a ray to a vertex hits that vertex's triangles at about its own length


def render_depth(
    vertices_camera_mm: Float[np.ndarray, "v 3"],
    faces: np.ndarray,
    intrinsics: Intrinsics,
    stamp_ns: int = 0,
) -> DepthFrame:
    """Depth image (mm along z, NaN where nothing is hit) of a closed mesh seen from outside, with
    faces (f, 3) turned outward. Only triangles that face the camera and lie wholly in front of it
    are drawn."""
    vertices = np.ascontiguousarray(vertices_camera_mm, np.float32)
    shape = (intrinsics.height, intrinsics.width)
    faces = np.ascontiguousarray(faces, np.int32)
    nearest = _z_buffer(vertices, faces, shape, pinhole_of(intrinsics))
    depth_mm = np.full(shape, np.nan, np.float32)
    return DepthFrame(np.divide(1, nearest, depth_mm, where=nearest > 0), intrinsics, stamp_ns)


@njit(nogil=True)
def _z_buffer(vertices, faces, shape, pinhole):  # type: ignore[no-untyped-def]
    """The greatest 1/z in each pixel (h, w), 0 where nothing is hit."""
    fx, fy, cx, cy = pinhole
    height, width = shape
    n = len(vertices)
    u, v = np.zeros(n, np.float32), np.zeros(n, np.float32)
    w = np.empty(n, np.float32)  # 1/z: linear in the image, unlike z
    for i in range(n):
        z = vertices[i, 2]
        if z > 1.0:
            w[i] = 1.0 / z
            u[i] = fx * vertices[i, 0] * w[i] + cx
            v[i] = fy * vertices[i, 1] * w[i] + cy
        else:
            w[i] = -1.0
    nearest = np.zeros((height, width), np.float32)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ua, ub, uc, va, vb, vc = u[a], u[b], u[c], v[a], v[b], v[c]
        # Outward faces run clockwise in a y-down image when they face the camera.
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area >= 0:
            continue
        wa, wb, wc = w[a], w[b], w[c]
        if min(wa, wb, wc) < 0:
            continue
        left = max(int(np.ceil(min(ua, ub, uc))), 0)
        right = min(int(np.floor(max(ua, ub, uc))), width - 1)
        top = max(int(np.ceil(min(va, vb, vc))), 0)
        bottom = min(int(np.floor(max(va, vb, vc))), height - 1)
        inverse = 1.0 / area
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                pa = ((ub - x) * (vc - y) - (vb - y) * (uc - x)) * inverse
                pb = ((uc - x) * (va - y) - (vc - y) * (ua - x)) * inverse
                pc = 1.0 - pa - pb
                here = np.float32(pa * wa + pb * wb + pc * wc)
                # No branch: half of these pixels lie outside, unpredictably.
                here = here if min(pa, pb, pc) >= -1e-5 else np.float32(0.0)
                nearest[y, x] = max(nearest[y, x], here)
    return nearest


class Visibility:
    """Which points on a fixed mesh are visible from an eye, by exact ray casting.

    All rays leave one eye, so a triangle can hide only points within its bounds in the eye's image:
    these are found by bisection, and no tree is needed.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._centre = mesh.vertices_mm.mean(0)
        self._vertices = np.ascontiguousarray(mesh.vertices_mm - self._centre, np.float64)
        self._faces = np.ascontiguousarray(mesh.faces, np.int32)

    def __call__(
        self, points_mm: Float[np.ndarray, "n 3"], eye_mm: Float[np.ndarray, " 3"]
    ) -> Bool[np.ndarray, " n"]:
        """True where no part of the mesh lies between eye and point (mesh's frame)."""
        eye = np.asarray(eye_mm, np.float64) - self._centre
        axes = np.linalg.svd(eye[None])[2]  # rows: along the line of sight, and two across it
        axes = np.stack([axes[1], axes[2], -axes[0] * np.sign(axes[0] @ eye)])
        rays = (np.asarray(points_mm, np.float64) - self._centre - eye) @ axes.T
        vertices = (self._vertices - eye) @ axes.T
        order = np.argsort(_across(rays)[:, 0], kind="stable")
        uv = _across(rays)[order]
        ahead = uv[np.isfinite(uv[:, 0]), 0]  # other rays point away from the mesh
        lowest, width = (ahead[0], np.ptp(ahead) / 256 + 1e-12) if len(ahead) else (0.0, 1.0)
        starts = np.searchsorted(ahead, lowest + width * np.arange(258))  # of columns of rays
        hidden = np.empty(len(rays), np.bool_)
        columns = (starts, lowest, width)
        sorted_rays, mesh = (rays[order], uv), (vertices, _across(vertices), self._faces)
        hidden[order] = _hidden(*sorted_rays, *mesh, columns, _TOLERANCE_MM)
        return ~hidden


def _across(points: np.ndarray) -> np.ndarray:
    """x / z and y / z of points (n, 3); infinite where they are not in front of the eye."""
    ahead = points[:, 2:] > 1e-6
    return np.divide(points[:, :2], points[:, 2:], np.full((len(points), 2), np.inf), where=ahead)


@njit(nogil=True)
def _hidden(rays, rays_uv, vertices, vertices_uv, faces, columns, tolerance_mm):  # type: ignore[no-untyped-def]
    """Whether a triangle crosses each ray (n, 3) nearer to the eye than the ray's end by more than
    the tolerance (Moeller and Trumbore 1997, doi 10.1080/10867651.1997.10487468). Rays are sorted
    by their first image coordinate; columns: their first rays, lowest coordinate, width."""
    starts, lowest, width = columns
    hidden = np.zeros(len(rays), np.bool_)
    slack = 1e-9  # rounding: a ray along an edge belongs to both triangles
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        left = min(vertices_uv[a, 0], vertices_uv[b, 0], vertices_uv[c, 0])
        right = max(vertices_uv[a, 0], vertices_uv[b, 0], vertices_uv[c, 0])
        top = min(vertices_uv[a, 1], vertices_uv[b, 1], vertices_uv[c, 1])
        bottom = max(vertices_uv[a, 1], vertices_uv[b, 1], vertices_uv[c, 1])
        bounded = right < np.inf
        first, last = 0, len(rays)
        if bounded:
            first = starts[int(min(max((left - slack - lowest) / width, 0.0), 257.0))]
            last = starts[int(min(max((right + slack - lowest) / width + 1, 0.0), 257.0))]
        ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        e1x, e1y, e1z = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        e2x, e2y, e2z = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        # The eye is the origin; q is the normal's moment, the same for every ray.
        qx, qy, qz = ay * e1z - az * e1y, az * e1x - ax * e1z, ax * e1y - ay * e1x
        reach = -(e2x * qx + e2y * qy + e2z * qz)
        for i in range(first, last):
            outside = rays_uv[i, 1] < top - slack or rays_uv[i, 1] > bottom + slack
            if hidden[i] or (bounded and outside):
                continue
            x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
            px, py, pz = y * e2z - z * e2y, z * e2x - x * e2z, x * e2y - y * e2x
            area = e1x * px + e1y * py + e1z * pz
            if area == 0.0:
                continue
            s = -(ax * px + ay * py + az * pz) / area
            t = -(x * qx + y * qy + z * qz) / area
            if s < -slack or t < -slack or s + t > 1 + slack:
                continue
            share = reach / area  # of the ray, from the eye to the triangle
            length = math.sqrt(x * x + y * y + z * z)
            hidden[i] = 0 < share * length < length - tolerance_mm
    return hidden
