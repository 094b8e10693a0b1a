"""The check of finished motions, against kinematics and distances that are not its own."""

import math

import numpy as np
import pytest
import trimesh
from pytransform3d.urdf import UrdfTransformManager

from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import Mesh
from tumortrack_resection import check
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.config import ELECTRODE_RADIUS_MM, CellConfig
from tumortrack_resection.check import STEP_MM, TOLERANCE_MM, clearances, electrode_poses, faults
from tumortrack_resection.motions import JOINTS, Motions, MotionStage
from tumortrack_resection.urdf import UrdfCell
from tumortrack_resection.values import Clearance

CONFIG = CellConfig()
HOME = np.array(CONFIG.home_rad)
URDF = cell_urdf(CONFIG)
SOLIDS = ("bracket", "pencil", "electrode", "rod", "cup")


def ellipsoid(middle_mm, half_mm, finer=2):
    ball = trimesh.creation.icosphere(finer, 1.0)
    return Mesh(ball.vertices * half_mm + middle_mm, ball.faces)


def sheet(middle_mm, u, v, half_mm=20.0):
    """An open square."""
    corners = [
        middle_mm + half_mm * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def stage(name, *samples, seconds=1.0, cutting=()):
    """Evenly timed samples; ``cutting``: at which of them."""
    cuts = np.isin(np.arange(len(samples)), cutting)
    times_s = np.linspace(0, seconds, len(samples)) if len(samples) > 1 else np.zeros(1)
    return MotionStage(name, times_s, np.array(samples), cuts)


def turned(joint, angle_rad, start=HOME):
    """Both arms, one joint of them turned."""
    joints = start.copy()
    joints[JOINTS.index(joint)] += angle_rad
    return joints


def electrode(joints_rad):
    """Tip and rear end of its axis, mm."""
    return electrode_poses(URDF, Motions((stage("hold", joints_rad),)))[0][0]


def across(ends_mm):
    """Two unit vectors across an axis."""
    along = (ends_mm[0] - ends_mm[1]) / np.linalg.norm(ends_mm[0] - ends_mm[1])
    u = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return u / np.linalg.norm(u), np.cross(along, u / np.linalg.norm(u))


def wandering(rng, stages=3, points=3, spread_rad=0.04):
    """Stages through random joint angles near home, some of them cutting."""
    found, at = [], HOME
    for n in range(stages):
        ways = [at, *(HOME + rng.uniform(-spread_rad, spread_rad, (points, 12)))]
        at = ways[-1]
        cutting = [k for k in range(points + 1) if n == 1 and 0 < k < points]
        found.append(stage(f"sweep {n + 1}", *ways, seconds=2.0, cutting=cutting))
    return Motions(tuple(found))


def of(found, solid="electrode", part="tumor_1"):
    return next(one for one in found if (one.solid, one.part) == (solid, part))


# Kinematics ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", ["0.0 0.0 0.0", "0.3 -0.5 0.7"])
def test_kinematics_are_those_of_another_library(tilt):
    text = URDF.replace('rpy="0.0 0.0 0.0"', f'rpy="{tilt}"')
    reader, cell = UrdfTransformManager(), UrdfCell(text)
    reader.load_urdf(text)
    many = np.random.default_rng(0).uniform(-3, 3, (20, 12))
    for link in ("cutter_tip", "holder_tip", "cutter_tool", "holder_tool"):
        turns, at_mm = cell.frames(link, many)
        for joints, turn, at in zip(many, turns, at_mm, strict=True):
            for name, angle in zip(JOINTS, joints, strict=True):
                reader.set_joint(name, angle)
            table_from_link = reader.get_transform(link, "table")
            np.testing.assert_allclose(at, 1000 * table_from_link[:3, 3], atol=1e-6)
            np.testing.assert_allclose(turn, table_from_link[:3, :3], atol=1e-9)


def test_poses_follow_on_each_other_closely_and_pass_through_all_samples():
    motions = wandering(np.random.default_rng(3))
    ends_mm, _ = electrode_poses(URDF, motions)
    assert np.linalg.norm(np.diff(ends_mm, axis=0), axis=2).max() <= STEP_MM
    for joints in np.concatenate([one.joints_rad for one in motions.stages]):
        assert np.abs(ends_mm - electrode(joints)).max((1, 2)).min() < 1e-6
    coarse_mm, _ = electrode_poses(URDF, motions, 5.0)
    assert STEP_MM < np.linalg.norm(np.diff(coarse_mm, axis=0), axis=2).max() <= 5.0


def test_what_borders_on_a_cut_counts_as_cut():
    ways = [turned(JOINTS[0], 0.02 * n) for n in range(6)]
    _, cuts = electrode_poses(URDF, Motions((stage("sweep 1", *ways, cutting=(2, 3)),)))
    first, last = np.flatnonzero(cuts)[[0, -1]]
    assert cuts[first : last + 1].all()
    ends_mm, _ = electrode_poses(URDF, Motions((stage("sweep 1", *ways),)))
    np.testing.assert_allclose(ends_mm[first], electrode(ways[1]), atol=1e-6)
    np.testing.assert_allclose(ends_mm[last], electrode(ways[4]), atol=1e-6)


# A slow check of its own --------------------------------------------------------------------------


def signed_mm(mesh, cloud_mm, ends_mm, radius_mm):
    """Of a cylinder and a convex surface with dense points on it, by closed formulas."""
    middle, along = ends_mm.mean(0), ends_mm[0] - ends_mm[1]
    length = np.linalg.norm(along)
    axis_mm = ends_mm[1] + np.linspace(0, 1, int(length / 0.3) + 2)[:, None] * along
    corners = mesh.vertices_mm[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    depth = ((corners[:, 0] * normals).sum(1) - axis_mm @ normals.T).min(1).max()
    if depth > 0:
        return -depth
    off = cloud_mm - middle
    ahead = np.abs(off @ along) / length
    aside = np.sqrt(np.maximum((off**2).sum(1) - ahead**2, 0))
    beyond = np.hypot(np.maximum(aside - radius_mm, 0), np.maximum(ahead - length / 2, 0))
    return beyond.min()


@pytest.mark.parametrize(
    ("solid", "off_mm"),
    [
        *(("electrode", off_mm) for off_mm in (-9.0, 0.4, 4.0)),
        *(("pencil", -9.0), ("pencil", 4.0), ("cup", -9.0), ("cup", 0.4)),
        *(("bracket", 4.0), ("rod", -9.0)),
    ],
)
def test_it_agrees_with_a_slow_check(solid, off_mm):
    rng = np.random.default_rng(SOLIDS.index(solid))
    motions, cell = wandering(rng), UrdfCell(URDF)
    one = next(one for one in cell.solids if one.name == solid)
    times_s = [np.linspace(0, stage.times_s[-1], 800) for stage in motions.stages]
    poses = [s.at(t) for s, times in zip(motions.stages, times_s, strict=True) for t in times]
    ends_mm = cell.ends([one], np.array(poses))[0]
    # Beside the solid in the middle of the motions, in a random direction.
    near = ends_mm[len(ends_mm) // 2]
    half_mm, share, angle = rng.uniform(6, 11, 3), rng.uniform(), rng.uniform(0, 7)
    direction = np.array(across(near)).T @ [math.cos(angle), math.sin(angle)]
    out_mm = off_mm + one.radius_mm + np.linalg.norm(direction * half_mm)
    tumor = ellipsoid(near[1] + share * (near[0] - near[1]) + out_mm * direction, half_mm)
    cloud_mm = trimesh.remesh.subdivide_to_size(tumor.vertices_mm, tumor.faces, 0.5)[0]
    # The least is not where the axis is farther from the ellipsoid's middle than its shape allows.
    points_mm = np.einsum("sk,nkc->nsc", np.linspace([1, 0], [0, 1], 60), ends_mm)
    distance_mm = np.linalg.norm(points_mm - tumor.box_mm.mean(0), axis=2).min(1)
    likely = ends_mm[distance_mm < distance_mm.min() + np.ptp(half_mm) + one.radius_mm + 1]
    slow_mm = min(signed_mm(tumor, cloud_mm, ends, one.radius_mm) for ends in likely)
    found = of(clearances(URDF, motions, {"tumor_1": tumor}, ()), solid)
    assert found.least_mm == pytest.approx(slow_mm, abs=0.05)
    # There and then it is so near.
    then = next(stage for stage in motions.stages if stage.name == found.stage).at(found.at_s)
    there_mm = cell.ends([one], then[None])[0][0]
    there = signed_mm(tumor, cloud_mm, there_mm, one.radius_mm)
    assert found.least_mm == pytest.approx(there, abs=0.05)
    assert np.linalg.norm(cloud_mm - found.place_mm, axis=1).min() < 0.5


def test_flat_ends_are_flat():
    tip, rear = electrode(HOME)
    along = (tip - rear) / np.linalg.norm(tip - rear)
    u, v = across([tip, rear])
    still = Motions((stage("hold", HOME),))
    ahead = clearances(URDF, still, {"wall": sheet(tip + 5 * along, u, v)}, ())
    assert of(ahead, part="wall").least_mm == pytest.approx(5.0, abs=1e-3)
    beside = clearances(URDF, still, {"wall": sheet(tip + 5 * u, along, v)}, ())
    assert of(beside, part="wall").least_mm == pytest.approx(5.0 - ELECTRODE_RADIUS_MM, abs=1e-3)


# Depth --------------------------------------------------------------------------------------------


def test_a_plunge_and_a_cut_inside_that_crosses_nothing_is_deep():
    tip, rear = electrode(HOME)
    inside = turned(JOINTS[0], 0.15)
    tumor = ellipsoid(electrode(inside).mean(0), [45.0] * 3, 3)
    assert np.linalg.norm([tip, rear] - tumor.box_mm.mean(0), axis=1).min() > 60
    ways = [HOME, inside, turned(JOINTS[0], 0.001, inside), turned(JOINTS[0], 0.002, inside), HOME]
    found = of(
        clearances(URDF, Motions((stage("sweep 1", *ways, cutting=(2,)),)), {"t": tumor}, ()),
        part="t",
    )
    assert found.least_mm == pytest.approx(-45.0, abs=1.0)
    assert found.energised_mm == pytest.approx(-45.0, abs=1.0)


def test_a_fast_sweep_between_two_samples_is_found():
    far = turned(JOINTS[0], 0.4)
    tumor = ellipsoid(electrode(turned(JOINTS[0], 0.2)).mean(0), [4.0] * 3)
    motions = Motions((stage("approach", HOME), stage("sweep 1", HOME, far, seconds=0.02)))
    found = of(clearances(URDF, motions, {"tumor_1": tumor}, ()))
    assert found.least_mm == pytest.approx(-4.0, abs=0.3)
    assert found.stage == "sweep 1"
    assert found.at_s == pytest.approx(0.01, abs=0.001)
    # Nor does it hide between two stages.
    motions = Motions((stage("approach", HOME), stage("sweep 1", far, HOME)))
    tip = of(
        clearances(
            URDF, Motions((stage("approach", HOME), stage("sweep 1", far))), {"t": tumor}, ()
        ),
        part="t",
    )
    assert tip.least_mm == pytest.approx(-4.0, abs=0.3)
    assert (tip.stage, tip.at_s) == ("sweep 1", 0.0)


def test_an_open_structure_has_no_depth():
    tip, rear = electrode(HOME)
    u, v = across([tip, rear])
    still = Motions((stage("hold", HOME),))
    crossed = of(clearances(URDF, still, {"cava": sheet((tip + rear) / 2, u, v)}, ()), part="cava")
    assert crossed.least_mm == 0


# What moves, and what cuts ------------------------------------------------------------------------


def test_what_is_carried_moves_with_the_holder_from_the_lift_on():
    up = turned("holder_shoulder_lift_joint", -0.4)
    cell = UrdfCell(URDF)
    turns, at_mm = cell.frames("holder_tip", np.array([HOME, up]))
    target = electrode(HOME).mean(0)  # where the electrode waits
    start = turns[0] @ turns[1].T @ (target - at_mm[1]) + at_mm[0]
    tumor = ellipsoid(start, [6.0, 5.0, 4.0])
    resting, lifting = stage("hold", HOME, HOME), stage("lift", HOME, up)
    parts = {"tumor_1": tumor}
    found = of(clearances(URDF, Motions((resting, lifting)), parts, ["tumor_1"]))
    assert found.least_mm < -3.5
    assert (found.stage, found.at_s) == ("lift", pytest.approx(1.0, abs=0.05))
    assert np.linalg.norm(np.array(found.place_mm) - target) < 7
    still = of(clearances(URDF, Motions((resting, lifting)), parts, ()))
    distance_mm = of(clearances(URDF, Motions((resting,)), parts, ["tumor_1"])).least_mm
    assert still.least_mm == pytest.approx(distance_mm)
    assert distance_mm > 20
    # Before the lift, nothing is carried.
    coming = stage("grasp", turned("holder_shoulder_pan_joint", 0.2), HOME)
    found = of(clearances(URDF, Motions((coming, resting, lifting)), parts, ["tumor_1"]))
    assert found.least_mm < -3.5
    assert (found.stage, found.at_s) == ("lift", pytest.approx(1.0, abs=0.05))
    arriving = of(clearances(URDF, Motions((coming, lifting)), parts, ["tumor_1"]), "cup")
    unmoved = of(clearances(URDF, Motions((coming,)), parts, ()), "cup")
    assert arriving.least_mm == pytest.approx(unmoved.least_mm, abs=2e-3)
    moved = Motions((stage("pull", HOME, up),))
    assert of(clearances(URDF, moved, parts, ["tumor_1"])).least_mm == pytest.approx(distance_mm)


def test_cutting_and_not_cutting_are_told_apart():
    ways = [turned(JOINTS[0], angle) for angle in (0.0, 0.1, 0.2, 0.3, 0.4)]
    tip, rear = electrode(ways[4])
    tumor = ellipsoid((tip + rear) / 2 + [0.0, 0.0, 12.0], [5.0] * 3)
    cut = Motions((stage("sweep 1", *ways, cutting=(0, 1)),))
    found = clearances(URDF, cut, {"tumor_1": tumor}, ())
    bare = of(found)
    assert bare.least_mm == pytest.approx(12 - 5 - ELECTRODE_RADIUS_MM, abs=0.5)
    nearest = of(clearances(URDF, Motions((stage("hold", *ways[:3]),)), {"tumor_1": tumor}, ()))
    assert bare.energised_mm == pytest.approx(nearest.least_mm)
    assert bare.energised_mm > bare.least_mm + 50
    assert all(one.energised_mm is None for one in found if one.solid != "electrode")
    dead = clearances(URDF, Motions((stage("hold", *ways),)), {"tumor_1": tumor}, ())
    assert of(dead).energised_mm is None
    assert of(dead).least_mm == pytest.approx(bare.least_mm)


# Faults -------------------------------------------------------------------------------------------

NEEDED = {"tumor_1": 5.0, "tumor_2": 4.0, "artery": 2.0}


def seen(solid="electrode", part="tumor_1", least_mm=9.0, energised_mm=9.0):
    return Clearance(solid, part, least_mm, energised_mm, "sweep 1", 1.5, (1.0, 2.0, 3.0))


FREE = [seen(part=part) for part in NEEDED]


@pytest.mark.parametrize(
    ("one", "wrong"),
    [
        (seen(least_mm=5.0), False),
        (seen(least_mm=5.0 - TOLERANCE_MM + 0.01), False),
        (seen(least_mm=5.0 - TOLERANCE_MM - 0.01), True),
        (seen(least_mm=-3.0), True),
        (seen(part="artery", least_mm=1.5), True),
        (seen(part="artery", least_mm=2.5), False),
        (seen("shaft", "tumor_2", 3.0, None), True),
        (seen("shaft", "tumor_1", 3.0, None), True),
        (seen("shaft", "tumor_2", 4.0, None), False),
        *(
            (seen(solid, "tumor_1", -1.0, None), False)
            for solid in ("pencil", "bracket", "rod", "cup")
        ),
        *(
            (seen(solid, "tumor_2", 0.0, None), True)
            for solid in ("pencil", "bracket", "rod", "cup")
        ),
        (seen("cup", "tumor_2", 0.5, None), False),
        (seen("cup", "artery", -0.5, None), True),
        (seen("cup", "ureter", -0.5, None), False),  # nobody asked to keep away from it
        (seen("electrode", "ureter", -0.5), False),
        (seen(least_mm=math.nan), True),
        (seen(energised_mm=math.nan), True),
        (seen(least_mm=math.inf), True),
        (seen("pencil", "ureter", math.nan, None), True),
    ],
)
def test_faults(one, wrong):
    assert faults(FREE, NEEDED, ["tumor_1"]) == []
    found = faults([*FREE, one], NEEDED, ["tumor_1"])
    assert len(found) == wrong
    assert all(one.part in text and one.solid in text for text in found)


def test_what_was_not_looked_at_is_a_fault():
    assert len(faults([], NEEDED, ["tumor_1"])) == len(NEEDED)
    others = [seen("pencil", part) for part in NEEDED]
    assert len(faults(others, NEEDED, ["tumor_1"])) == len(NEEDED)
    assert len(faults(FREE[1:], NEEDED, ["tumor_1"])) == 1
    assert len(faults(FREE, {**NEEDED, "tumor_1": math.nan}, ["tumor_1"])) == 1


def test_distances_that_contradict_each_other_are_a_fault(monkeypatch):
    ends = iter(range(10**9))
    jumping = lambda self, ends_mm, radius_mm: (30.0 if next(ends) % 2 else 90.0, np.zeros(3))  # noqa: E731
    monkeypatch.setattr(check._Surface, "distance", jumping)
    motions = Motions((stage("sweep 1", HOME, turned(JOINTS[0], 0.01)),))
    tumor = ellipsoid([0.0, 0.0, 100.0], [5.0] * 3)
    found = clearances(URDF, motions, {"tumor_1": tumor}, ())
    assert math.isnan(of(found).least_mm)
    assert faults(found, {"tumor_1": 5.0}, ["tumor_1"])


# Bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "damaged",
    [
        "",
        "<robot/>",
        URDF[: len(URDF) // 2],
        URDF.replace("cutter_tool/electrode", "cutter_tool/knife"),
        URDF.replace("holder_tool/cup", "holder_tool/claw"),
        URDF.replace("cutter_elbow_joint", "elbow"),
        URDF.replace('xyz="0 0 1"', 'xyz="0 1 0"'),
        URDF.replace('type="revolute"', 'type="prismatic"'),
        URDF.replace('<parent link="table" />', '<parent link="cutter_tip" />'),
        URDF.replace(cell_urdf(CONFIG).split('radius="')[1].split('"')[0], "0"),
        URDF.replace('rpy="0.0 0.0 0.0"', 'rpy="0.0 nan 0.0"'),
        URDF.replace('rpy="0.0 0.0 0.0"', 'rpy="0.0 0.0"'),
        URDF.replace("cutter_elbow_joint", "x")
        .replace("cutter_wrist_1_joint", "cutter_elbow_joint")
        .replace('"x"', '"cutter_wrist_1_joint"'),
    ],
)
def test_another_urdf_is_refused(damaged):
    assert damaged != URDF
    motions = Motions((stage("hold", HOME),))
    for asked in (
        lambda: clearances(damaged, motions, {}, ()),
        lambda: electrode_poses(damaged, motions),
    ):
        with pytest.raises(ArtifactError):
            asked()


def test_what_cannot_be_checked_is_refused():
    still, ball = Motions((stage("hold", HOME),)), ellipsoid([0.0, 0.0, 9.0], [5.0] * 3)
    nowhere = Motions((stage("hold", HOME * np.nan),))
    endless = Motions((stage("home", *[turned(JOINTS[0], 3.0 * (n % 2)) for n in range(300)]),))
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    for motions, parts, carried in (
        (Motions(()), {"tumor_1": ball}, ()),
        (nowhere, {"tumor_1": ball}, ()),
        (endless, {"tumor_1": ball}, ()),
        (still, {"tumor_1": empty}, ()),
        (still, {"tumor_1": ball}, ["tumor_2"]),
    ):
        with pytest.raises(InputError):
            clearances(URDF, motions, parts, carried)


def test_a_whole_turn_that_ends_where_it_began_has_poses_between():
    motions = Motions((stage("home", HOME, turned(JOINTS[0], 2 * np.pi)),))
    ends_mm, _ = electrode_poses(URDF, motions)
    assert np.linalg.norm(np.diff(ends_mm, axis=0), axis=2).max() <= STEP_MM
    assert np.ptp(ends_mm[:, 0, 0]) > 1000
