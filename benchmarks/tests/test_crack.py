"""The twin that cuts: meshes that are parted along a surface, walls that touch, flaps that follow
the cup, and what is seen of them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cut as script
import numpy as np
import pytest
from scipy.spatial import cKDTree

from stress_objects import ellipsoid
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import nearest_places
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy
from tumortrack.io.scene_folder import draw_targets
from tumortrack_benchmarks.physics.crack import (
    KERF_MM,
    MARGIN_MM,
    Incision,
    Lift,
    Opened,
    Walls,
    facets,
    shell,
    solve,
    way_out,
)

pytestmark = pytest.mark.slow

UP, X = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def anatomy(height_mm: float) -> Anatomy:
    """A tumor of 6 mm over or in an ellipsoid whose top is at 32 mm."""
    tumor = ellipsoid((6, 6, 6), (4.0, 0.0, height_mm))
    whole = solid_of(ellipsoid((32, 22, 16), (0, 0, 16)), "organ") + solid_of(tumor, "tumor")
    return Anatomy((mesh_of(whole), tumor))


@cache
def incision(kind: str) -> Incision:
    there = anatomy(22.0 if kind == "inside" else 29.0)
    out = way_out(there, 0)
    along = np.cross(np.cross(out, X), out)
    along /= np.linalg.norm(along)
    surface = shell(there.tumors[0], out, along, 20.0)
    if kind == "planes":
        normals = np.array(
            [[-0.8, 0.0, -0.6], [0.0, 0.8, -0.6], [0.0, -0.8, -0.6], [0.8, 0.0, -0.6]]
        )
        reach = (there.tumors[0].vertices_mm @ normals.T).max(0) + MARGIN_MM
        surface = facets(np.column_stack([normals, reach]), UP)
    with TemporaryDirectory() as folder:
        return Incision.of(there, surface, 0, Path(folder) / "tets.safetensors")


@cache
def state(kind: str, share: float, *lift: float) -> Opened:
    return solve(incision(kind), share, Lift(*lift), 2)


@pytest.mark.parametrize("kind", ["bulging", "inside", "planes"])
def test_no_tetrahedron_crosses_the_surface_and_what_is_cut_grows(kind: str) -> None:
    mesh, surface = incision(kind).organ.mesh, incision(kind).surface
    off = surface.distance(mesh.nodes_mm)[0][mesh.tets]
    across = np.minimum(off.max(1), -off.min(1))  # how far its corners reach beyond
    assert np.quantile(across, 0.99) < 0.1
    most_mm = 1.5 if kind == "planes" else 0.5  # where planes meet, it is rounded
    assert across.max() < most_mm
    assert mesh.volumes_mm3.sum() == pytest.approx(
        incision(kind).organ.anatomy.organ.volume_mm3, rel=0.02
    )
    swept, before = [], np.zeros((0, 3))
    for share in (0.3, 0.6, 0.85):
        wound, left = incision(kind).opened(share)
        inner, outer = (wound.mesh.nodes_mm[w] for w in np.split(wound.walls, 2))
        assert {tuple(p) for p in inner.mean(1).round(6)} == {
            tuple(p) for p in outer.mean(1).round(6)
        }
        assert not set(np.split(wound.walls, 2)[0].ravel()) >= set(wound.walls.ravel())
        off = np.abs(surface.distance(inner.reshape(-1, 3))[0])
        assert np.quantile(off, 0.9) < 0.1
        assert off.max() < most_mm
        assert surface.order(inner.mean(1)).max() <= surface.order(left).min()
        if len(before):
            assert cKDTree(inner.mean(1)).query(before)[0].max() < 1e-9  # it stays cut
        before = inner.mean(1)
        swept.append(
            np.linalg.norm(np.cross(*(inner[:, 1:] - inner[:, :1]).swapaxes(0, 1)), axis=1).sum()
        )
    assert swept == pytest.approx(np.array([0.3, 0.6, 0.85]) / 0.85 * swept[-1], rel=0.05)


def test_without_a_cut_the_mesh_is_the_same_and_the_organ_whole() -> None:
    wound, _ = incision("bulging").opened(0.0)
    mesh = incision("bulging").organ.mesh
    assert len(wound.walls) == 0
    assert len(wound.mesh.nodes_mm) == len(mesh.nodes_mm)
    np.testing.assert_array_equal(wound.mesh.nodes_mm[wound.mesh.tets], mesh.nodes_mm[mesh.tets])
    rest = state("bulging", 0.0)
    assert rest.organ_mm.volume_mm3 == pytest.approx(
        incision("bulging").organ.anatomy.organ.volume_mm3, rel=0.01
    )
    assert rest.about["tumor_moved_mm"] < 0.5


def test_walls_push_apart_by_their_energys_slope_and_move_nothing_as_a_whole() -> None:
    wound, _ = incision("bulging").opened(0.7)
    walls = Walls.of(incision("bulging"), wound, of_piece=True)
    nodes = wound.mesh.nodes_mm.copy()
    assert walls.energy(nodes)[0] == 0
    nodes[np.unique(wound.mesh.tets[wound.side])] -= 2.5 * incision("bulging").surface.out
    slope = walls.energy(nodes)[1]
    depth = walls.sunk(nodes)[2]
    assert 0.3 < depth.max() < 2.5 - KERF_MM / 2
    assert np.abs(slope.sum(0)).max() < 1e-6 * np.abs(slope).sum()
    assert slope[np.unique(wound.walls)].sum(0) @ UP == pytest.approx(
        0, abs=0.3 * np.abs(slope).sum()
    )
    rng, step = np.random.default_rng(0), 1e-6
    way = rng.normal(size=nodes.shape)
    up, down = (walls.energy(nodes + sign * step * way)[0] for sign in (1, -1))
    assert (up - down) / (2 * step) == pytest.approx((slope * way).sum(), rel=1e-3)
    piece = slope[np.unique(wound.mesh.tets[wound.side])].sum(0)
    assert piece @ incision("bulging").surface.out < 0  # down the slope is out


@pytest.mark.parametrize("kind", ["bulging", "inside", "planes"])
def test_a_flap_follows_the_cup_and_walls_stay_out_of_each_other(kind: str) -> None:
    half, most = state(kind, 0.5, 4.0), state(kind, 0.85, 10.0)
    out = incision(kind).surface.out
    for one, mm in ((half, 4.0), (most, 10.0)):
        cup = one.forward(one.cup_mm[None])[0] - one.cup_mm
        assert cup @ out == pytest.approx(mm, abs=0.15 * mm + 0.3)
        assert max(one.about["sunk_in_mm"]) < 0.3
        assert one.about["least_stretch"] > 0.3
    assert 4.0 < most.about["tumor_moved_mm"] < 12.0
    assert half.about["tumor_moved_mm"] < 0.6 * most.about["tumor_moved_mm"]


def test_a_flap_that_is_pressed_down_meets_its_bed() -> None:
    pressed = state("bulging", 0.85, -6.0)
    assert max(pressed.about["sunk_in_mm"]) < 0.3
    bare = pressed.forward(pressed.cup_mm[None])[0] - pressed.cup_mm
    assert bare @ incision("bulging").surface.out < -3.0
    assert pressed.about["tumor_moved_mm"] < 4.0


def test_a_flap_turns_about_what_still_holds_it() -> None:
    one, surface = state("bulging", 0.8, 0.0, 30.0), incision("bulging").surface
    assert 12.0 < one.about["flap_turned_degrees"] < 40.0
    skin = one.incision.organ.points_mm[one.wound.side[one.incision.organ.owner]]
    moved = (one.forward(skin) - skin) @ surface.out
    reach = skin @ surface.along
    first, last = moved[reach < np.quantile(reach, 0.2)], moved[reach > np.quantile(reach, 0.8)]
    assert first.mean() > last.mean() + 3.0  # it opens where it was cut first


@pytest.mark.parametrize("kind", ["bulging", "inside", "planes"])
def test_the_groove_is_seen_with_both_walls_and_nothing_spans_it(kind: str) -> None:
    one = state(kind, 0.85, 10.0)
    rest, seen = solve_rest(kind), one.organ_mm
    whole = one.incision.organ.anatomy.organ
    lost = whole.volume_mm3 - rest.organ_mm.volume_mm3
    faces = rest.wound.mesh.nodes_mm[np.split(rest.wound.walls, 2)[0]]
    area = np.linalg.norm(np.cross(*(faces[:, 1:] - faces[:, :1]).swapaxes(0, 1)), axis=1).sum() / 2
    assert lost == pytest.approx(KERF_MM * area, rel=0.25)
    edges = seen.vertices_mm[seen.faces] - np.roll(seen.vertices_mm[seen.faces], 1, axis=1)
    assert np.linalg.norm(edges, axis=2).max() < 9.0
    # Places of both walls lie on the surface, as far apart as the walls are.
    middles = faces.mean(1)[:: max(1, len(faces) // 40)]
    slope = one.incision.surface.distance(middles)[1]
    walls = [one.forward(middles + sign * KERF_MM / 2 * slope) for sign in (1, -1)]
    inside = np.linalg.norm(middles - nearest_places(whole, middles), axis=1) > 3.0
    for wall in walls:
        off = np.linalg.norm(nearest_places(seen, wall[inside]) - wall[inside], axis=1)
        assert np.quantile(off, 0.9) < 0.4
    assert np.linalg.norm(walls[0] - walls[1], axis=1).max() > 4.0
    assert solid_of(seen, "organ").volume() > 0.9 * whole.volume_mm3


@cache
def solve_rest(kind: str) -> Opened:
    """So much cut, and nothing moved."""
    one = state(kind, 0.85, 10.0)
    return Opened(
        one.incision, one.wound, one.wound.mesh.nodes_mm, one.rim_mm, one.cup_mm, one.axis, {}
    )


def test_a_scene_shows_the_truth_and_tells_where_was_cut() -> None:
    one, whole = state("bulging", 0.85, 10.0), incision("bulging").organ.anatomy
    inner, to_bench = draw_targets(whole, 0), np.eye(4)
    looks = (script.Look(), script.Look(cup=True), script.Look(smoke=0.2, blood=0.1))
    scenes = [script.seen(one, to_bench, inner, look, np.random.default_rng(4)) for look in looks]
    seen = [int(np.isfinite(scene.depth.depth_mm).sum()) for scene, _ in scenes]
    assert seen[0] > max(seen[1:])
    assert seen[2] == pytest.approx(0.78 * seen[0], rel=0.1)
    scene, held = scenes[0]
    organ = scene.reference.organ
    off = np.linalg.norm(
        nearest_places(organ, scene.cloud.points_mm.astype(float)) - scene.cloud.points_mm, axis=1
    )
    assert np.quantile(off, 0.95) < 3.0
    (told,) = scene.evidence
    off = np.abs(incision("bulging").surface.distance(np.array(told.points_ct))[0])
    assert np.sqrt(np.mean(off**2)) == pytest.approx(told.std_mm, rel=0.15)
    camera_from_bench = np.array(scene.meta["camera_from_bench"])
    cup = transform_points(camera_from_bench, one.forward(one.cup_mm[None]))[0]
    assert np.linalg.norm(cup - held.place_mm) < 5.0
    targets = scene.targets
    rest = targets.labels == 1
    pose = kabsch(targets.points_ct[rest], targets.points_mm[rest], np.ones(rest.sum()))
    moved = (transform_points(pose, targets.points_ct) - targets.points_mm)[targets.labels == 2]
    assert np.linalg.norm(moved.mean(0)) == pytest.approx(one.about["tumor_moved_mm"], abs=2.0)


def test_an_organ_that_is_not_cut_has_no_evidence_of_a_cut() -> None:
    inner = draw_targets(incision("bulging").organ.anatomy, 0)
    scene, _ = script.seen(
        state("bulging", 0.0), np.eye(4), inner, script.Look(), np.random.default_rng(4)
    )
    assert scene.evidence == ()
