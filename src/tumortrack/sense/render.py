"""What the camera sees of a mesh: a z-buffer depth image, and which vertices are visible."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.compiled import numba
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh
from tumortrack.sense.camera import pinhole_of


def render_depth(
    vertices_camera_mm: Float[np.ndarray, "v 3"],
    faces: np.ndarray,
    intrinsics: Intrinsics,
    stamp_ns: int = 0,
) -> DepthFrame:
    """Depth image (mm along z, NaN where nothing is hit) of a closed mesh seen from outside.

    Vertices (v, 3) in the camera frame, faces (f, 3) turned outward. Only triangles that face
    the camera are drawn; a triangle that reaches behind the camera is left out.
    """
    vertices = np.ascontiguousarray(vertices_camera_mm, np.float32)
    shape = (intrinsics.height, intrinsics.width)
    faces = np.ascontiguousarray(faces, np.int32)
    nearest = _z_buffer(vertices, faces, shape, pinhole_of(intrinsics))
    depth_mm = np.full(shape, np.nan, np.float32)
    return DepthFrame(np.divide(1, nearest, depth_mm, where=nearest > 0), intrinsics, stamp_ns)


@numba.njit(cache=True, nogil=True)
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
                # No branch: half of these pixels lie outside, at random.
                here = here if min(pa, pb, pc) >= -1e-5 else np.float32(0.0)
                nearest[y, x] = max(nearest[y, x], here)
    return nearest


class Visibility:
    """Which vertices of one fixed mesh a camera sees: exact, by ray, on a tree built once."""

    _TOLERANCE_MM = 0.05  # a ray to a vertex hits the vertex's own triangles at about its length

    def __init__(self, mesh: Mesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        self._origin = mesh.vertices_mm.mean(0)  # keep numbers small: Embree works in float32
        corners = (mesh.vertices_mm - self._origin)[mesh.faces]
        self._triangles = TriangleMesh(self._scene, corners.astype(np.float32))

    def __call__(
        self, points_mm: Float[np.ndarray, "n 3"], eye_mm: Float[np.ndarray, " 3"]
    ) -> Bool[np.ndarray, " n"]:
        """True where nothing of the mesh lies between the eye and the point (mesh's frame)."""
        eye = (eye_mm - self._origin).astype(np.float32)
        rays = (points_mm - self._origin).astype(np.float32) - eye
        length = np.linalg.norm(rays, axis=1)
        origins = np.broadcast_to(eye, rays.shape).copy()
        hit_mm = self._scene.run(origins, rays / length[:, None], query="DISTANCE")
        return hit_mm >= length - self._TOLERANCE_MM
