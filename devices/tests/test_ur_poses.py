"""The arm that tests of poses talk to is one for the maker's interface as well: real ur_rtde."""

import needs
from clock import until
from rtde_arm import RtdeArm


def test_ur_rtde_hears_the_same_arm():
    rtde = needs.module("rtde_receive", "pip install 'tumortrack-resection[ur]'")
    arm = RtdeArm()
    try:
        receive = rtde.RTDEReceiveInterface(arm.host)
        arm.say("push 3.5")
        until(lambda: receive.getActualTCPForce()[1] == 3.5, "the force")
        assert receive.getActualTCPPose() == [0.4, 0.0, 0.5, 0.0, 0.0, 0.0]
        assert receive.getSafetyMode() == 1
        receive.disconnect()
    finally:
        arm.close()
