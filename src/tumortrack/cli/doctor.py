"""What works on this machine."""

from __future__ import annotations

import platform
import shutil
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from tumortrack.cli.console import say
from tumortrack.core.process import available_cores
from tumortrack.live.spec import extensions

_LIBRARIES = {
    "torch": "training and locating",
    "numba": "rendering, deforming and refining",
    "SimpleITK": "DICOM",
    "nibabel": "NIfTI",
    "embreex": "ray visibility",
    "manifold3d": "mesh unions",
    "skimage": "surfaces",
    "trimesh": "mesh files",
    "pypcd4": ".pcd clouds",
    "plotly": "3-D page",
}
_OPTIONAL = {
    "viser": "web viewer",
    "rosbags": "ROS messages and recordings",
    "cyclonedds": "ROS 2 without ROS",
    "rclpy": "ROS 2 through your ROS",
    "rospy": "ROS 1",
    "pyrealsense2": "RealSense cameras",
    "highdicom": "DICOM segmentations",
    "pinocchio": "arms: kinematics and collisions",
    "toppra": "arms: timing",
    "ruckig": "arms: homing",
    "ur_analytic_ik": "arms: inverse kinematics",
    "rtde_control": "real arms of Universal Robots",
}
_DISTRIBUTIONS = {"skimage": "scikit-image"}


def examine() -> None:
    """Print the machine, each library by importing it, and what bf16 and CUDA offer."""
    say(f"tumortrack {version('tumortrack')}, Python {platform.python_version()}")
    say(f"cores: {available_cores()}, {platform.machine()}, {platform.system()}")
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    say(f"free disk here: {free:.1f} GiB" + (" - little" if free < 2 else ""))
    for name, purpose in _LIBRARIES.items():
        try:
            import_module(name)
            say(f"ok       {name} {version(_DISTRIBUTIONS.get(name, name))} ({purpose})")
        except Exception as error:  # whatever a broken installation raises is the finding
            say(f"BROKEN   {name} ({purpose}): {error}")
    for name, purpose in _OPTIONAL.items():
        say(f"{'ok      ' if find_spec(name) else 'absent  '} {name} ({purpose})")
    for one in extensions():
        state, fault = ("BROKEN  ", f": {one.fault}") if one.fault else ("ok      ", "")
        say(f"{state} {one.what} {one.kind} of the package {one.package}{fault}")
    _examine_torch()


def _examine_torch() -> None:
    import torch

    from tumortrack.models.hardware import has_fast_bfloat16

    fast = has_fast_bfloat16(torch.device("cpu"))
    say(f"CPU bf16: {'in hardware, used' if fast else 'not in hardware; fp32 is used (slower)'}")
    if torch.cuda.is_available():
        say(f"CUDA: {torch.cuda.get_device_name()}")
    else:
        say("CUDA: none; everything runs on the CPU")
