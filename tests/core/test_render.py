"""The z-buffer and the visibility of vertices against independent ray casters."""

import numpy as np
import pytest

from refused import refused
from render_objects import bumpy, ray_hits, sphere
from tumortrack.core.camera import d405, deproject
from tumortrack.core.render import Visibility, render_depth
from tumortrack.core.types import Intrinsics, Mesh

CAMERA = Intrinsics(211, 121, 110.0, 113.0, 105.0, 60.0)


def depth_of(mesh, camera=CAMERA):
    return render_depth(mesh.vertices_mm, mesh.faces, camera).depth_mm


def embree_depth(mesh, camera):
    """Depth by one Embree ray per pixel, NaN where it misses."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices_mm[mesh.faces].astype(np.float32))
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], 2)
    length = np.linalg.norm(rays, axis=2)
    unit = (rays / length[..., None]).reshape(-1, 3).astype(np.float32)
    hit = scene.run(np.zeros_like(unit), unit, query="DISTANCE").reshape(u.shape)
    return np.where(hit < 1e5, hit / length, np.nan)


@pytest.mark.parametrize("center", [(3, -2, 160), (-60, 30, 150), (10, 5, 110)])
def test_depth_agrees_with_a_ray_caster(center):
    mesh, camera = bumpy(38, center, 5), d405(424, 240)
    depth, oracle = depth_of(mesh, camera), embree_depth(mesh, camera)
    both = np.isfinite(depth) & np.isfinite(oracle)
    assert both.sum() > 8000
    assert np.mean(np.abs(depth - oracle)[both] < 1e-2) >= 0.999
    assert np.mean(np.isfinite(depth) != np.isfinite(oracle)) < 5e-4
    assert (np.isfinite(depth) != np.isfinite(oracle)).sum() < 0.005 * both.sum()


def test_depth_of_a_sphere_is_known():
    frame = render_depth(*_arrays(sphere(30, (0, 0, 150), 5)), CAMERA, stamp_ns=5)
    assert frame.stamp_ns == 5
    assert frame.depth_mm[60, 105] == pytest.approx(120, abs=1e-3)  # on the axis: 150 - 30
    assert np.isnan(frame.depth_mm[0]).all()
    radius = np.linalg.norm(deproject(frame) - [0, 0, 150], axis=1)
    assert radius.max() < 30 + 1e-3  # facets lie inside the sphere ...
    assert radius.min() > 30 - 0.02  # ... by their sagitta
    # The outline is the cone of half angle asin(30 / 150), an ellipse on the image.
    area = np.pi * CAMERA.fx * CAMERA.fy * np.tan(np.arcsin(30 / 150)) ** 2
    assert np.isfinite(frame.depth_mm).sum() == pytest.approx(area, rel=0.01)


def test_depth_across_a_large_tilted_triangle_is_perspective():
    """One triangle on the plane z = 200 + x / 2: depth is not linear in the image."""
    corners = np.array([[-90.0, -60, 155], [100, -70, 250], [0, 80, 200]])
    depth = depth_of(Mesh(corners, [[0, 2, 1]]))
    v, u = np.nonzero(np.isfinite(depth))
    assert len(u) > 2000
    expected = 200 / (1 - (u - CAMERA.cx) / CAMERA.fx / 2)
    np.testing.assert_allclose(depth[v, u], expected, rtol=1e-5)
    assert np.isnan(depth_of(Mesh(corners, [[0, 1, 2]]))).all()  # seen from its back


def test_nearer_surfaces_hide_farther_ones_whatever_the_order():
    near, far = sphere(10, (0, 0, 100)), sphere(40, (5, 0, 190))
    parts = [near, far]
    images = []
    for first, second in (parts, parts[::-1]):
        vertices = np.concatenate([first.vertices_mm, second.vertices_mm])
        faces = np.concatenate([first.faces, second.faces + len(first.vertices_mm)])
        images.append(render_depth(vertices, faces, CAMERA).depth_mm)
    np.testing.assert_array_equal(*images)
    expected = np.fmin(depth_of(near), depth_of(far))
    np.testing.assert_array_equal(images[0], expected)
    assert np.isfinite(depth_of(near)).sum() > 300


def test_the_image_border_cuts_the_organ_and_keeps_the_rest():
    mesh = bumpy(45, (40, -25, 120))
    wide = Intrinsics(411, 321, 110.0, 113.0, 205.0, 160.0)  # 100 pixels more on every side
    cut, whole = depth_of(mesh), depth_of(mesh, wide)
    np.testing.assert_allclose(cut, whole[100:221, 100:311], atol=1e-3)
    inside = np.isfinite(cut).sum()
    assert 3000 < inside < 0.9 * np.isfinite(whole).sum()


def test_what_lies_behind_the_camera_is_not_drawn():
    assert np.isnan(depth_of(sphere(30, (0, 0, -100)))).all()
    assert np.isnan(depth_of(sphere(30, (500, 0, 100)))).all()  # beside the picture


# visibility


def test_visibility_agrees_with_every_triangle_tested():
    mesh = bumpy(30, (10, 20, 30), 4)
    eye = np.array([25.0, -40, -70])
    vertices = np.random.default_rng(0).permutation(mesh.vertices_mm)[:700]
    seen = Visibility(mesh)(vertices, eye)
    rays = vertices - eye
    length = np.linalg.norm(rays, axis=1)

    def blocked(slack, nearer_mm):
        first = ray_hits(eye, rays, mesh, slack).min(1)
        return first * length < length - nearer_mm

    sure = blocked(1e-3, 0.03) == blocked(-1e-3, 0.07)  # not on an edge, not at the tolerance
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(seen[sure], ~blocked(0.0, 0.05)[sure])
    assert 0.15 < seen.mean() < 0.5
    # Some are hidden although their surface turns to the eye: a hill stands before them.
    normals = vertices - mesh.vertices_mm.mean(0)
    assert (~seen & (np.einsum("vk,vk->v", normals, -rays) > 0)).any()


def _arrays(mesh):
    return mesh.vertices_mm, mesh.faces


def test_faces_of_other_vertices_are_refused_and_vertices_that_are_no_number_not_drawn():
    corners = np.array([[-90.0, -60, 155], [100, -70, 250], [0, 80, 200], [0, np.nan, np.inf]])
    for faces in ([[0, 2, 4]], [[0, 2, -1]]):
        with refused(ValueError):
            render_depth(corners, np.array(faces), CAMERA)
    drawn = render_depth(corners, np.array([[0, 2, 1], [0, 2, 3]]), CAMERA).depth_mm
    np.testing.assert_array_equal(drawn, depth_of(Mesh(corners[:3], [[0, 2, 1]])))
    assert np.isnan(render_depth(corners, np.zeros((0, 3), int), CAMERA).depth_mm).all()
