"""Peers: each recovers what it must, on a small organ seen from one side."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from render_objects import ellipsoid
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.rigid_fit import fit_over_volume, matched_vertices
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.report.protocol import compare
from tumortrack.sense.render import Visibility
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import (
    Fit,
    Rigid,
    RigidBound,
    RigidFit,
    estimate_of,
    rigid_carry,
)  # fmt: skip
from tumortrack_lab.peers.elastic import (
    ElasticPeer,
    ElasticPeerConfig,
    elastic_body,
    stiffness_matrix,
)
from tumortrack_lab.peers.kinds import peer_kinds
from tumortrack_lab.peers.pose_search import RigidConfig, seen_from, surface_points
from tumortrack_lab.study.methods import StudyCase, peer
from tumortrack_lab.tets import tetrahedralise

UP = (0.0, -1.0, 0.0)
FEW = RigidConfig(turns=8, refined=3)


def lumpy(half_axes_mm, center_mm, subdivisions):
    """An ellipsoid that no rotation maps onto itself."""
    mesh = ellipsoid(half_axes_mm, (0, 0, 0), subdivisions)
    x, y, z = (mesh.vertices_mm / 30).T
    swell = 1 + 0.22 * np.sin(2 * x + 1) * np.cos(1.5 * z) - 0.15 * np.cos(2.5 * z + x) * (y < 9)
    return mesh.moved(mesh.vertices_mm * swell[:, None] + np.array(center_mm, float))


@pytest.fixture(scope="module")
def anatomy():
    center = (40.0, -120.0, 300.0)  # far from the origin, as patients are
    tumor = ellipsoid((8, 8, 8), (52.0, -124.0, 305.0), 3)
    return Anatomy((lumpy((48, 24, 30), center, 5), tumor))


@pytest.fixture(scope="module")
def elastic(anatomy):
    return ElasticPeer(anatomy, UP, ElasticPeerConfig(rigid=FEW, modes=40, starts=1, edge_mm=16.0))


def pose(anatomy, spin_deg=77.0):
    """Seen from the known side, turned and a little tilted, 120 mm away."""
    turn = Rotation.from_euler("zyx", [spin_deg, 7, -5], degrees=True).as_matrix()
    rotation = turn @ rotation_onto(np.array(UP), np.array([0.0, 0.0, -1.0]))
    middle = rotation @ anatomy.organ.box_mm.mean(0)
    return rigid(rotation, np.array([6.0, -4.0, 140.0]) - middle)


def scene_of(anatomy, bend, camera_from_ct, outliers=0):
    """What a camera sees of the anatomy after ``bend`` (CT frame) and the pose."""
    moved = Anatomy(
        tuple(
            part.moved(transform_points(camera_from_ct, bend(part.vertices_mm)))
            for part in anatomy.parts
        )
    )
    surface = surface_points(moved.organ, 1.0)
    seen = seen_from(Visibility(moved.organ), surface, np.eye(4))
    rng = np.random.default_rng(3)
    cloud = rng.permutation(surface.points_mm[seen])[:900]
    stray = rng.uniform([-80, -60, 110], [80, 60, 170], (outliers, 3))
    cloud = np.concatenate([cloud + rng.normal(0, 0.1, cloud.shape), stray])
    return Scene(SensorCloud(cloud), moved)


def still(points):
    return points


def squeeze(points):
    """Narrower by a tenth across, rounder elsewhere, and bent: smooth, nearly volume-keeping."""
    x, y, z = (points - [40.0, -120.0, 300.0]).T
    z = z * 0.88
    y = y * 1.08 + 5 * (x / 45) ** 2
    return np.stack([x * 1.05, y, z], 1) + [40.0, -120.0, 300.0]


def errors(anatomy, scene, fit):
    """Mean distance of every vertex to its true place, by part, mm."""
    return [
        float(np.linalg.norm(fit.carry(part.vertices_mm) - true.vertices_mm, axis=1).mean())
        for part, true in zip(anatomy.parts, scene.reference.parts, strict=True)
    ]


# The bound ---------------------------------------------------------------------------------


def test_bound_is_exact_for_rigid_motion(anatomy):
    scene = scene_of(anatomy, still, pose(anatomy))
    fit = RigidBound(anatomy, UP).fit(scene)
    assert max(errors(anatomy, scene, fit)) < 1e-9
    assert fit.report == {"by": "triangles"}


def test_the_rigid_fit_follows_the_points_and_the_bound_the_truth(anatomy):
    scene = scene_of(anatomy, still, pose(anatomy))
    beside = Scene(SensorCloud(scene.cloud.points_mm + [0, 0, 3.0]), scene.reference)
    organ, tumor = errors(anatomy, beside, RigidFit(anatomy, UP).fit(beside))
    assert (organ, tumor) == (pytest.approx(3.0, abs=0.3), pytest.approx(3.0, abs=0.3))
    assert max(errors(anatomy, beside, RigidBound(anatomy, UP).fit(beside))) < 1e-9


def test_rigid_peers_take_another_programs_surface(anatomy):
    scene = scene_of(anatomy, still, pose(anatomy))
    others = (Mesh(part.vertices_mm, part.faces[::-1]) for part in scene.reference.parts)
    scene = Scene(scene.cloud, Anatomy(tuple(others)))
    for kind in (RigidBound, RigidFit):
        fit = kind(anatomy, UP).fit(scene)
        assert fit.report == {"by": "surfaces"}
        assert max(errors(anatomy, scene, fit)) < 0.3


def test_bound_knows_triangles_whose_vertices_were_reordered(anatomy):
    scene = scene_of(anatomy, squeeze, pose(anatomy))
    organ = scene.reference.organ
    order = np.random.default_rng(0).permutation(len(organ.vertices_mm))
    place = np.argsort(order)
    shuffled = Mesh(organ.vertices_mm[order], place[organ.faces])
    np.testing.assert_array_equal(matched_vertices(anatomy.organ, shuffled), organ.vertices_mm)
    with pytest.raises(InputError, match="were made from this case"):
        matched_vertices(anatomy.organ, Mesh(organ.vertices_mm, organ.faces[::-1]))


def test_bound_knows_vertices_that_rounding_made_one():
    """Two vertices 2e-5 mm apart, which a file in single precision does not tell apart."""
    square = np.array([[0.0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0], [100, 100, 2e-5]])
    rest = Mesh(square, np.array([[0, 1, 2], [2, 1, 4], [0, 4, 3]]))
    read = Mesh(square[:4] + 7, np.array([[0, 1, 2], [0, 2, 3]]))
    found = matched_vertices(rest, read)
    np.testing.assert_allclose(found, square + 7, atol=1e-4)


def test_bound_knows_an_edge_that_bending_made_shorter_than_rounding():
    square = np.array([[0.0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0], [100, 100, 1.01e-3]])
    rest = Mesh(square, np.array([[0, 1, 2], [2, 1, 4], [0, 4, 3]]))
    np.testing.assert_array_equal(matched_vertices(rest, rest.moved(0.98 * square)), 0.98 * square)


def test_bound_minimises_over_the_volume():
    """A ball stretched along x by a: the mean square over its volume is a^2 R^2 / 5."""
    ball = ellipsoid((30, 30, 30), (5, 6, 7), 4)
    centre = ball.vertices_mm.mean(0)
    stretched = ball.moved(centre + (ball.vertices_mm - centre) * [1.1, 1, 1])
    transform, rms = fit_over_volume(ball, stretched)
    np.testing.assert_allclose(transform, np.eye(4), atol=1e-6)
    assert rms == pytest.approx(0.1 * 30 / np.sqrt(5), rel=0.01)


# Recovering rigid motion -------------------------------------------------------------------


@pytest.mark.parametrize("spin_deg", [10.0, 200.0])
def test_rigid_motion_is_recovered(anatomy, elastic, spin_deg):
    scene = scene_of(anatomy, still, pose(anatomy, spin_deg))
    assert max(errors(anatomy, scene, Rigid(anatomy, UP, FEW).fit(scene))) < 0.3
    assert max(errors(anatomy, scene, elastic.fit(scene))) < 0.3


def test_outliers_do_not_break_registration(anatomy, elastic):
    scene = scene_of(anatomy, still, pose(anatomy), outliers=45)
    assert max(errors(anatomy, scene, Rigid(anatomy, UP, FEW).fit(scene))) < 1.0
    assert max(errors(anatomy, scene, elastic.fit(scene))) < 1.0


def test_too_few_points_are_refused(anatomy):
    scene = scene_of(anatomy, still, pose(anatomy))
    few = Scene(SensorCloud(scene.cloud.points_mm[:10]), scene.reference)
    with pytest.raises(NoEstimate, match="10 points"):
        Rigid(anatomy, UP, FEW).fit(few)


# Deformation -------------------------------------------------------------------------------


def test_the_elastic_peer_beats_rigid_registration(anatomy, elastic):
    scene = scene_of(anatomy, squeeze, pose(anatomy), outliers=20)
    rigid_mm = errors(anatomy, scene, Rigid(anatomy, UP, FEW).fit(scene))
    elastic_mm = errors(anatomy, scene, elastic.fit(scene))
    assert rigid_mm[0] > 2.0  # the deformation matters
    assert elastic_mm[0] < 0.7 * rigid_mm[0]
    assert elastic_mm[1] < rigid_mm[1]


# The elastic body --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball_mesh():
    return tetrahedralise(ellipsoid((30, 30, 30), (0, 0, 0), 3), 12.0, 7e-3)


def test_stiffness_passes_the_patch_test(ball_mesh):
    """Uniform strain costs exactly the textbook energy; rigid motion costs none."""
    poisson = 0.47
    K, basis = stiffness_matrix(ball_mesh, poisson)
    volume = ball_mesh.volumes_mm3.sum()
    shear = 1 / (2 * (1 + poisson))
    lame = poisson / ((1 + poisson) * (1 - 2 * poisson))
    for gradient in (np.diag([0.1, -0.03, 0.02]), np.array([[0, 0.2, 0], [0, 0, 0], [0.1, 0, 0]])):
        u = linear_field(basis, gradient)
        strain = (gradient + gradient.T) / 2
        density = 2 * shear * (strain**2).sum() + lame * np.trace(strain) ** 2
        assert u @ (K @ u) == pytest.approx(density * volume, rel=1e-9)
    turn = linear_field(basis, np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 0]]))
    assert abs(turn @ (K @ turn)) < 1e-8
    assert np.abs(K @ np.ones(len(turn))).max() < 1e-10


def linear_field(basis, gradient):
    out = np.zeros(basis.N)
    at = gradient @ basis.doflocs
    for axis in range(3):
        dofs = basis.element_dofs[axis::3].ravel()
        out[dofs] = at[axis, dofs]
    return out


def test_modes_solve_their_problem_and_interpolate(ball_mesh):
    body = elastic_body(ball_mesh, 0.47, 30)
    assert (np.diff(body.stiffness) > -1e-9).all()
    assert body.stiffness[0] > 1e-3 / 30
    assert body.area_mm2 == pytest.approx(4 * np.pi * 900, rel=0.04)
    # Orthogonal to rigid shifts over the surface: the pose is not counted twice.
    shell = ellipsoid((30, 30, 30), (0, 0, 0), 4)
    moved = body.modes_at(shell.vertices_mm)
    assert np.abs(moved.mean(0)).max() < 0.05 * np.abs(moved).max()
    amplitudes = np.random.default_rng(0).normal(size=30)
    np.testing.assert_allclose(
        body.displacement(shell.vertices_mm, amplitudes), moved @ amplitudes, atol=1e-9
    )
    nodes = np.unique(body.corners_mm.reshape(-1, 3), axis=0)
    corner = body.modes[body.nodes[:, :4]].reshape(-1, 3, 30)
    at = body.modes_at(body.corners_mm.reshape(-1, 3))
    np.testing.assert_allclose(at, corner, atol=1e-8)
    assert len(nodes) > 50


# As estimates ------------------------------------------------------------------------------


def test_a_fit_becomes_an_estimate_that_the_protocol_measures(anatomy):
    camera_from_ct = pose(anatomy)
    scene = scene_of(anatomy, still, camera_from_ct)
    estimate = estimate_of(Fit(rigid_carry(camera_from_ct)), anatomy, 7, grid=60)
    assert set(estimate.meshes) == {"kidney", "tumor_1"}
    assert estimate.cloud.stamp_ns == 7
    metrics = compare(estimate, scene)
    assert metrics["tumor_1"]["hausdorff_mm"] < 1e-5
    assert metrics["kidney"]["iou"] == 1.0
    shift = camera_from_ct + np.array([[0, 0, 0, 3.0]] + 3 * [[0.0] * 4])
    off = compare(estimate_of(Fit(rigid_carry(shift)), anatomy, grid=60), scene)
    assert off["tumor_1"]["hausdorff_mm"] == pytest.approx(3.0, abs=0.05)
    assert off["tumor_1"]["center_mm"] == pytest.approx(3.0, abs=1e-6)
    with pytest.raises(InputError, match="diverged"):
        estimate_of(Fit(lambda points: points * np.nan), anatomy)


# Peers of other packages -------------------------------------------------------------------

ACME = """
from tumortrack_lab.peers.kinds import PeerKind
from tumortrack_lab.peers.base import Fit


class Shifted:
    def __init__(self, anatomy_ct, up_lps):
        self.middle = anatomy_ct.organ.box_mm.mean(0)

    def fit(self, scene):
        to = scene.cloud.points_mm.mean(0)
        return Fit(lambda points: points - self.middle + to)


PEER = PeerKind(Shifted)
"""


@pytest.fixture
def acme(tmp_path, monkeypatch):
    """A distribution that is installed as far as anyone can tell."""
    info = tmp_path / "acme_peers-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-peers\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text("[tumortrack.peers]\nshifted = acme_peers:PEER\n")
    (tmp_path / "acme_peers.py").write_text(ACME)
    monkeypatch.syspath_prepend(tmp_path)
    yield info
    sys.modules.pop("acme_peers", None)


def test_another_package_adds_a_peer_by_an_entry_point(anatomy, acme, tmp_path):
    assert list(peer_kinds())[:3] == ["rigid_bound", "rigid_fit", "rigid"]
    method = peer("shifted", StudyCase("x", tmp_path, tmp_path, anatomy, UP))
    assert method.identity["versions"] == {"acme-peers": "1.2"}
    scene = scene_of(anatomy, still, pose(anatomy))
    kidney = method.locate(scene, 40).meshes["kidney"].vertices_mm
    shift = scene.cloud.points_mm.mean(0) - anatomy.organ.box_mm.mean(0)
    np.testing.assert_allclose(kidney, anatomy.organ.vertices_mm + shift)
    (acme / "entry_points.txt").write_text("[tumortrack.peers]\nrigid = acme_peers:PEER\n")
    with pytest.raises(InputError, match="'rigid' of acme-peers has the name of one of ours"):
        peer_kinds()
    (acme / "entry_points.txt").write_text("[tumortrack.peers]\nbare = acme_peers:Shifted\n")
    with pytest.raises(InputError, match=r"acme_peers:Shifted of acme-peers is no PeerKind"):
        peer_kinds()
