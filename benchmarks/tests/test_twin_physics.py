"""The twin's solid: energies against differences, a block against theory, meshes against finer
ones, and the bench's experiments against what they promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.organ.tets import TetMesh, lattice, tet_volumes
from tumortrack_benchmarks.physics import twin
from tumortrack_benchmarks.physics.equilibrium import ContactPlate, Rod, Support, find_equilibrium
from tumortrack_benchmarks.physics.families import even_tissue
from tumortrack_benchmarks.physics.forces import LoadedBody, Steady, Touch, Weight, rows_of
from tumortrack_benchmarks.physics.organ import Stage
from tumortrack_benchmarks.physics.solid import NeoHookeanSolid
from tumortrack_benchmarks.physics.tets import find, tetrahedralise
from tumortrack_benchmarks.physics.twin import Bench, solve

pytestmark = pytest.mark.slow


def block(side_mm: float, cells: int) -> TetMesh:
    """A cube standing on z = 0, each cell cut into six tetrahedra round its diagonal."""
    ticks = np.linspace(0, side_mm, cells + 1)
    nodes = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape((cells + 1,) * 3)
    tets = []
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (1, 0, 2), (0, 2, 1), (2, 1, 0)):
        corner = [np.zeros(3, int)]
        for axis in order:
            corner.append(corner[-1] + np.eye(3, dtype=int)[axis])
        picks = [
            number[tuple(slice(c, c + cells) for c in step)].ravel() for step in np.array(corner)
        ]
        cell = np.stack(picks, 1)
        tets.append(cell if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else cell[:, [0, 1, 3, 2]])
    return TetMesh(nodes, np.concatenate(tets).astype(np.int32))


def ellipsoid(half_mm: tuple[float, float, float], centre_mm=(0.0, 0.0, 0.0)) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    return Mesh(sphere.vertices * half_mm + centre_mm, sphere.faces)


ANATOMY = Anatomy((ellipsoid((32.0, 18.0, 15.0)), ellipsoid((6, 6, 6), (12, 0, 4))))


def _outer(tets: np.ndarray) -> np.ndarray:
    """The faces of one tetrahedron alone; every other is shared by two."""
    corners = tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    faces, times = np.unique(np.sort(corners, axis=1), axis=0, return_counts=True)
    assert times.max() == 2
    return faces[times == 1]


def test_a_lattice_fills_a_ball_and_repeats_to_the_last_bit():
    ball = trimesh.creation.icosphere(subdivisions=3)
    surface = Mesh(ball.vertices * 30 + [5, -7, 11], ball.faces)
    mesh = lattice(surface, 8.0)
    assert mesh.volumes_mm3.sum() == pytest.approx(surface.volume_mm3, rel=0.03)
    outside = np.linalg.norm(mesh.nodes_mm - [5, -7, 11], axis=1) - 30
    assert np.median(np.abs(outside[np.unique(_outer(mesh.tets))])) < 8.0 / 8
    assert outside.max() < 8.0 / 2
    assert mesh.volumes_mm3.min() > 8.0**3 / 12 / 5 * 0.99
    edges = _outer(mesh.tets)[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2)  # of a closed surface
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    again = lattice(surface, 8.0)
    assert np.array_equal(again.nodes_mm, mesh.nodes_mm)
    assert np.array_equal(again.tets, mesh.tets)
    assert (tet_volumes(again.nodes_mm, again.tets) > 0).all()


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Bench:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(twin, "EDGE_MM", 7.0)
        return Bench.from_anatomy(
            ANATOMY, (0.0, 0.0, 1.0), tmp_path_factory.mktemp("bench") / "tets"
        )


@pytest.fixture
def small(monkeypatch) -> None:
    """Loads for a small organ."""
    for name, mm in {"_PLATE_MM": 20.0, "_SINK_MM": 2.0, "_POKE_MM": 4.0}.items():
        monkeypatch.setattr(twin, name, mm)


def test_forces_are_the_energys_slope_and_the_stiffness_is_theirs() -> None:
    mesh = block(10.0, 2)
    rng = np.random.default_rng(0)
    solid = NeoHookeanSolid(mesh, rng.uniform(3, 9, len(mesh.tets)), 0.45)
    bent = mesh.nodes_mm + rng.normal(0, 0.3, mesh.nodes_mm.shape)
    way = rng.normal(size=bent.shape)
    step = 1e-5
    slope = (solid.energy(bent + step * way)[0] - solid.energy(bent - step * way)[0]) / (2 * step)
    assert slope == pytest.approx(float((solid.energy(bent)[1] * way).sum()), rel=1e-5)
    rest = mesh.nodes_mm
    change = (solid.energy(rest + step * way)[1] - solid.energy(rest - step * way)[1]) / (2 * step)
    np.testing.assert_allclose(
        solid.rest_stiffness @ way.ravel(), change.ravel(), atol=1e-5 * np.abs(change).max()
    )


def test_moving_a_solid_costs_nothing_and_turning_it_inside_out_is_impossible() -> None:
    mesh = block(10.0, 2)
    solid = NeoHookeanSolid(mesh, np.full(len(mesh.tets), 5.0))
    turn = Rotation.from_rotvec([0.5, -1.0, 0.8]).as_matrix()
    energy, forces = solid.energy(mesh.nodes_mm @ turn.T + 7.0)
    assert energy == pytest.approx(0, abs=1e-9)
    assert np.abs(forces).max() < 1e-9
    assert solid.energy(mesh.nodes_mm * [1.0, 1.0, -1.0])[0] == np.inf
    flat = [solid.energy(mesh.nodes_mm * [1.0, 1.0, thin])[0] for thin in (0.5, 0.1, 0.01)]
    assert flat[0] < flat[1] < flat[2]


@pytest.mark.parametrize("poisson", [0.4, 0.49])
def test_a_block_between_plates_follows_theory(poisson: float) -> None:
    """Uniaxial compression to 80 %: force and bulge of the compressible neo-Hookean law."""
    side, shear = 20.0, 5.0
    mesh = block(side, 5)
    solid = NeoHookeanSolid(mesh, np.full(len(mesh.tets), shear), poisson)
    bulk = 2 * shear * (1 + poisson) / (3 * (1 - 2 * poisson))
    skin = np.flatnonzero(np.isclose(mesh.nodes_mm[:, 2] % side, 0))
    rim = np.isclose(mesh.nodes_mm[skin, :2] % side, 0)
    area = (side / 5) ** 2 * np.where(rim, 0.5, 1.0).prod(1)  # each node's part of the face
    rows = rows_of(skin[:, None], np.ones((len(skin), 1)), len(mesh.nodes_mm))
    above = ContactPlate((10.0, 10.0, 16.0 + 10), (40.0, 40.0, 10.0), 1.0)
    below, pressed = (Touch(rows, area, obstacle, 3000.0) for obstacle in (Support(), above))
    problem = LoadedBody(solid, (below, pressed, Steady.from_solid(solid)))
    start = mesh.nodes_mm * [1.05, 1.05, 0.9]
    nodes, about = find_equilibrium(problem, start)
    assert about.residual < 1e-3

    axial = float(np.ptp(nodes[:, 2])) / side

    def lateral_stress(wide: float) -> float:
        J = axial * wide**2
        iso = J ** (-2 / 3) * (wide - (axial**2 + 2 * wide**2) / (3 * wide))
        return shear * iso + bulk * (J - 1) * axial * wide

    wide = brentq(lateral_stress, 0.8, 1.5)
    J = axial * wide**2
    iso = J ** (-2 / 3) * (axial - (axial**2 + 2 * wide**2) / (3 * axial))
    stress = shear * iso + bulk * (J - 1) * wide**2
    assert axial == pytest.approx(0.8, abs=0.005)
    assert stress < -3.0  # kPa: far from small strain
    load = -pressed.energy(nodes)[1][:, 2].sum()
    assert load == pytest.approx(stress * side**2, rel=0.02)
    for layer in np.linspace(0, side, 6):
        widths = np.ptp(nodes[np.isclose(mesh.nodes_mm[:, 2], layer), :2], axis=0)
        np.testing.assert_allclose(widths, wide * side, rtol=0.005)


def test_obstacles_measure_true_distances() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-20, 20, (400, 3))
    plate = ContactPlate((1.0, -2.0, 3.0), (8.0, 12.0, 5.0), 2.0)
    rod = Rod(np.array([0.0, 0.0, -5.0]), np.array([0.0, 0.6, 0.8]), 4.0)
    packing = Support(points[:, 2] - np.linspace(-3, 3, 400))
    np.testing.assert_allclose(packing.distance(points)[0], np.linspace(-3, 3, 400), atol=1e-12)
    for obstacle in (plate, rod, Support(2.0)):
        distance, normal = obstacle.distance(points)
        assert (distance < 0).any()
        assert (distance > 0).any()
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
        # Outside, the foot of the perpendicular lies on the surface.
        out = distance > 0
        foot = points[out] - distance[out, None] * normal[out]
        assert np.abs(obstacle.distance(foot)[0]).max() < 1e-9
    # A box's face, an edge's rounding, a rod's tip and side, by hand.
    assert plate.distance(np.array([[1.0, -2.0, 11.0]]))[0][0] == pytest.approx(3)
    corner = np.array([[1 + 8 + 3.0, -2.0, 3 + 5 + 3.0]])
    assert plate.distance(corner)[0][0] == pytest.approx(np.hypot(5, 5) - 2)
    assert rod.distance(np.array([[0.0, 0.0, -5.0]]) - 2 * np.array(rod.axis))[0] == 2
    assert rod.distance(np.array([[9.0, 6.0, 3.0]]))[0][0] == pytest.approx(5)


def test_embedded_points_follow_affine_motions_exactly() -> None:
    mesh = tetrahedralise(ellipsoid((12, 9, 8)), 4.0)
    points = np.random.default_rng(2).uniform(-8.5, 8.5, (300, 3))  # some outside
    bend = np.array([[1.2, 0.1, 0.0], [0.3, 0.9, -0.1], [0.0, 0.2, 1.1]])
    owner, weights = find(mesh.nodes_mm[mesh.tets], points)
    rows = rows_of(mesh.tets[owner], weights, len(mesh.nodes_mm))
    moved = rows @ (mesh.nodes_mm @ bend.T + 5)
    np.testing.assert_allclose(moved, points @ bend.T + 5, atol=1e-9)


def test_a_tetrahedral_mesh_keeps_the_surface_and_its_volume() -> None:
    surface = ellipsoid((20, 14, 12))
    mesh = tetrahedralise(surface, 5.0)
    assert (mesh.volumes_mm3 > 0).all()
    assert mesh.volumes_mm3.sum() == pytest.approx(surface.volume_mm3, rel=0.02)
    with pytest.raises(InputError):
        TetMesh(mesh.nodes_mm, mesh.tets[:, [1, 0, 2, 3]])


def test_plates_close_by_what_the_state_says(bench: Bench, small) -> None:
    state = solve(bench, "D1")
    about, (before, after) = state.about, state.about["midsection_mm"]
    assert before - after == pytest.approx(4.0, abs=0.4)
    assert about["sunk_in_mm"] < 0.4
    assert abs(about["volume_change"]) < 0.02
    assert about["least_stretch"] > 0
    assert about["plate_load_n"] > 0.1
    assert min(about["sides_outwards_mm"]) > 0.2  # volume has to go somewhere
    # What is carried are the organ's own points: its surface stays above the support.
    surface = state.forward(state.organ.anatomy.organ.vertices_mm)
    assert surface[:, 2].min() > -0.4
    assert np.ptp(surface[np.abs(surface[:, 0]) < 4, 2]) == pytest.approx(after, abs=0.5)


def test_nothing_moves_until_something_is_added(bench: Bench) -> None:
    rest = bench.stage.organ.mesh.nodes_mm
    np.testing.assert_array_equal(bench.load(rest), rest)
    np.testing.assert_array_equal(solve(bench, "D0").forward(rest), rest)
    lowered = (rest - bench.load(rest, weight=1.0))[:, 2]
    assert 0 < lowered.mean() < 1.0  # the packing bears it


def test_a_finer_mesh_says_the_same(bench: Bench, small, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(twin, "EDGE_MM", 3.5)
    other = Bench.from_anatomy(ANATOMY, (0.0, 0.0, 1.0), tmp_path / "tets")
    assert len(other.stage.organ.mesh.tets) > 2 * len(bench.stage.organ.mesh.tets)
    points = np.random.default_rng(3).uniform(-1, 1, (400, 3))
    points = points[np.linalg.norm(points, axis=1) < 0.95] * (32, 18, 15) + [0, 0, 15.0]
    coarse, fine = (solve(one, "D1").forward(points) for one in (bench, other))
    assert np.linalg.norm(fine - points, axis=1).max() > 3
    assert np.linalg.norm(fine - coarse, axis=1).mean() < 0.25


def test_gravity_sinks_the_midsection_as_far_as_asked(bench: Bench, small) -> None:
    about = solve(bench, "G1").about
    assert about["sunk_mm"] == pytest.approx(2.0, abs=0.4)
    assert sum(about["sides_outwards_mm"]) > 0.3
    assert about["softer_by"] > 1
    assert abs(about["volume_change"]) < 0.02


def test_the_rod_presses_a_dent_off_the_tumor(bench: Bench, small) -> None:
    state = solve(bench, "P1")
    tip, rest = np.array(state.about["poke"]["tip_mm"]), state.organ.points_mm
    under = np.linalg.norm(state.forward(rest)[:, :2] - tip[:2], axis=1) < 1.5
    dent_mm = (rest - state.forward(rest))[under, 2].max()
    assert dent_mm == pytest.approx(4.0, abs=0.8)
    tumor = state.organ.anatomy.tumors[0].vertices_mm
    assert np.linalg.norm(tumor - (tip + [0, 0, 4.0]), axis=1).min() > 5
    with pytest.raises(InputError):
        solve(bench, "D9")


def test_a_stiffer_tumor_deforms_less(bench: Bench, small) -> None:
    organ, tumor = bench.stage.organ, bench.stage.organ.anatomy.tumors[0].vertices_mm
    even = replace(organ, in_tumor=np.zeros_like(organ.in_tumor))
    heights = []
    for one in (organ, even):
        solid = even_tissue(one)
        plain = replace(
            bench, stage=Stage(one, solid), always=(*bench.always[:2], Steady.from_solid(solid))
        )
        heights.append(12 - np.ptp(solve(plain, "D1").forward(tumor)[:, 2]))
    assert 0 < heights[0] < 0.9 * heights[1]


def test_a_load_that_finds_no_rest_is_an_error(bench: Bench) -> None:
    trap = ContactPlate((0.0, 0.0, 15.0), (100.0, 100.0, 14.9), 1.0)  # swallows the organ whole
    solid = bench.stage.solid
    down_mn = 1e4 * solid.node_volumes_mm3[:, None] * [0.0, 0.0, -1.0]  # a million times
    forces = bench.stage.touch(Support()), bench.stage.touch(trap), Weight(down_mn)
    with pytest.raises(TumortrackError):
        find_equilibrium(LoadedBody(solid, forces), solid.mesh.nodes_mm, 150)
