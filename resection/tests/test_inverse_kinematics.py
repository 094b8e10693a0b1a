"""Inverse kinematics against the plain product of Denavit-Hartenberg transforms, and against
answers of another library."""

import numpy as np
import pytest

from arm_objects import flange_pose
from tumortrack.core.geometry import rigid
from tumortrack_resection.arms.kinematics import MODELS, inverse_kinematics, wrapped

ARMS = pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
DOWN = np.diag([1.0, -1.0, -1.0])
TILTED = np.array([[2.0, -1, 2], [2, 2, -1], [-1, 2, 2]]) / 3

# By ur_analytic_ik 0.1.0.post3 (MIT, https://github.com/Victorlouisdg/ur-analytic-ik), which has
# the same Denavit-Hartenberg parameters built in: NAME.inverse_kinematics(base_from_flange) of a
# pose with this rotation at this position (mm here, metres there), angles brought to -pi..pi.
KNOWN_RAD = [
    ("ur5", DOWN, (-400, 250, 300), [
        [-0.792113, -1.151591, 1.396373, 1.326015, 1.570796, -2.362910],
        [-0.792113, 0.177548, -1.396373, 2.789621, 1.570796, -2.362910],
        [-0.792113, -1.583002, 1.925754, -1.913548, -1.570796, 0.778683],
        [-0.792113, 0.227696, -1.925754, 0.127261, -1.570796, 0.778683],
        [2.816507, 2.913896, 1.925754, 3.014332, 1.570796, 1.245711],
        [2.816507, -1.558590, -1.925754, -1.228045, 1.570796, 1.245711],
        [2.816507, 2.964045, 1.396373, 0.351972, -1.570796, -1.895882],
        [2.816507, -1.990001, -1.396373, 1.815578, -1.570796, -1.895882],
    ]),
    ("ur10e", TILTED, (350, -420, 450), [
        [1.810210, -1.772670, 2.406398, -1.578613, 0.965985, 0.202866],
        [1.810210, 0.453756, -2.406398, 1.007758, 0.965985, 0.202866],
        [1.810210, -1.250429, 2.186224, 1.260913, -0.965985, -2.938727],
        [1.810210, 0.801750, -2.186224, -2.702003, -0.965985, -2.938727],
        [-0.569537, 2.295754, 2.225258, -0.646899, 1.649656, 2.748685],
        [-0.569537, -1.902857, -2.225258, 1.719042, 1.649656, 2.748685],
        [-0.569537, 2.714944, 2.360687, 1.940074, -1.649656, -0.392908],
        [-0.569537, -1.376003, -2.360687, -1.813975, -1.649656, -0.392908],
    ]),
]  # fmt: skip


def _random_joints(n, seed):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))


def _error(model, joints_rad, base_from_flange):
    """The largest entry of what branches miss a pose by: mm and radians."""
    return np.abs(flange_pose(model, joints_rad) - base_from_flange).max()


def _distance(branches_rad, joints_rad):
    """Of the nearest branch: its joint that is farthest away, whole turns aside."""
    return np.abs(wrapped(branches_rad - joints_rad)).max(1).min(initial=np.inf)


@ARMS
def test_every_branch_leads_to_the_pose_and_what_made_it_is_among_them(model):
    made_by = _random_joints(3000, 1)
    poses = flange_pose(model, made_by)
    branches = [inverse_kinematics(model, pose) for pose in poses]
    counts = [len(each) for each in branches]
    assert set(counts) <= {2, 4, 6, 8}
    assert np.abs(np.concatenate(branches)).max() <= np.pi
    assert _error(model, np.concatenate(branches), np.repeat(poses, counts, axis=0)) < 1e-9
    for joints, each in zip(made_by, branches, strict=True):
        # Near a singular pose joints are known less well than the pose.
        singular = np.abs(np.sin(joints[[2, 4]])).min() < 0.01
        assert _distance(each, joints) < (1e-6 if singular else 1e-9)


@pytest.mark.parametrize(("name", "rotation", "position_mm", "known_rad"), KNOWN_RAD)
def test_branches_are_those_of_another_library_in_the_same_order(
    name, rotation, position_mm, known_rad
):
    branches = inverse_kinematics(MODELS[name], rigid(rotation, np.array(position_mm, float)))
    assert branches == pytest.approx(np.array(known_rad), abs=1e-6)


@ARMS
def test_nothing_reaches_beyond_the_arm_or_into_its_base(model):
    d4 = model.d_mm[3]
    for position_mm in ([1.5 * model.reach_mm, 0.0, 200.0], [0.0, 0.99 * d4, 400.0]):
        assert inverse_kinematics(model, rigid(DOWN, np.array(position_mm))).shape == (0, 6)
    assert len(inverse_kinematics(model, rigid(DOWN, np.array([0.0, 1.01 * d4, 400.0]))))
    assert inverse_kinematics(model, np.full((4, 4), np.nan)).shape == (0, 6)


@ARMS
@pytest.mark.parametrize("elbow_rad", [0.0, np.pi])
def test_an_elbow_goes_to_its_ends_and_no_farther(model, elbow_rad):
    longer_mm = model.a_mm.copy()
    longer_mm[2] -= 1e-3  # a longer forearm goes farther out, and folded nearer to the shoulder
    for joints in _random_joints(50, 2):
        joints[2], joints[4] = elbow_rad, 0.5 + abs(joints[4]) / 2  # the wrist is not singular
        pose = flange_pose(model, joints)
        branches = inverse_kinematics(model, pose)
        assert _error(model, branches, pose) < 1e-6
        assert _distance(branches, joints) < 1e-5
        beyond = flange_pose(model._replace(a_mm=longer_mm), joints)
        assert _distance(inverse_kinematics(model, beyond), joints) > 0.01


@ARMS
@pytest.mark.parametrize("off_rad", [0.0, 1e-15, 1e-12, 1e-9, 1e-6])
@pytest.mark.parametrize("middle_rad", [0.0, np.pi])
def test_poses_at_and_near_a_singular_wrist_are_reached(model, middle_rad, off_rad):
    for joints in _random_joints(50, 3):
        joints[4] = middle_rad - off_rad
        pose = flange_pose(model, joints)
        branches = inverse_kinematics(model, pose)
        assert _error(model, branches, pose) < 1e-6
        same = np.abs(wrapped(branches[:, [0, 4]] - joints[[0, 4]])).max(1) < 1e-5
        assert same.any()  # by rule another joint 6, perhaps, but always this shoulder and wrist
