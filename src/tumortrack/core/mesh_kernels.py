"""Kernels on meshes that are moved in every frame."""

from __future__ import annotations

from tumortrack.core.compiled import numba


@numba.njit(cache=True, fastmath=True, nogil=True)
def signed_volume(vertices, faces):  # type: ignore[no-untyped-def]
    """Sum over faces (f, 3) of their area seen along z times their height over the first vertex. A
    closed surface's volume, positive where faces turn outward."""
    triple = 0.0
    for n in range(len(faces)):
        a, b, c = vertices[faces[n, 0]], vertices[faces[n, 1]], vertices[faces[n, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        triple += area * (a[2] + b[2] + c[2] - 3 * vertices[0, 2])
    return triple / 6
