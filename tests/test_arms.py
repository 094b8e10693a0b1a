"""Kinematics, collisions and motions of both arms."""

import numpy as np
import pytest

from arm_objects import organ, plan
from tumortrack.plan.arms import dh, ik, urdf
from tumortrack.plan.arms.cell import Cell
from tumortrack.plan.arms.procedure import plan_motions
from tumortrack.plan.motions import JOINTS


@pytest.fixture(scope="module")
def cell():
    return Cell().with_organ(organ())


@pytest.fixture(scope="module")
def motions(cell):
    return plan_motions(plan(), cell, cell.organ)


@pytest.mark.parametrize("model", dh.MODELS.values(), ids=lambda model: model.name)
def test_three_sources_of_kinematics_agree(model):
    import pinocchio as pin
    import ur_analytic_ik

    built = pin.buildModelFromXML(urdf.arm_urdf(model, "one"))
    data, flange = built.createData(), built.getFrameId("one_flange")
    for joints in np.random.default_rng(1).uniform(-np.pi, np.pi, (50, 6)):
        plain = dh.flange_pose(model, joints)
        plain[:3, 3] /= 1000
        pin.framesForwardKinematics(built, data, joints)
        assert np.abs(data.oMf[flange].homogeneous - plain).max() < 1e-9
        other = getattr(ur_analytic_ik, model.name).forward_kinematics(*joints)
        assert np.abs(other - plain).max() < 1e-9


@pytest.mark.parametrize("model", dh.MODELS.values(), ids=lambda model: model.name)
def test_inverse_kinematics_come_back(model):
    for joints in np.random.default_rng(2).uniform(-np.pi, np.pi, (200, 6)):
        pose = dh.flange_pose(model, joints)
        found = ik.branches(model, pose)
        assert 1 <= len(found) <= 8
        assert np.abs(found - joints).max(1).min() < 1e-6
        for branch in found:
            assert np.abs(dh.flange_pose(model, branch) - pose).max() < 1e-6


def test_the_procedure_has_its_stages_without_gaps(cell, motions):
    names = [stage.name for stage in motions.stages]
    assert names == ["approach", "grasp", "hold", "sweep 1", "sweep 2", "release", "home"]
    assert np.array_equal(motions.stages[0].joints_rad[0], cell.home_rad)
    assert np.allclose(motions.stages[-1].joints_rad[-1], cell.home_rad, atol=1e-9)
    for one, other in zip(motions.stages, motions.stages[1:], strict=False):
        assert np.array_equal(one.joints_rad[-1], other.joints_rad[0])
    assert len(JOINTS) == motions.stages[0].joints_rad.shape[1]
