"""What this machine can do, and how to install what is missing: `doctor`."""

from __future__ import annotations

import platform
import shutil
import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement

from tumortrack.cli.console import say
from tumortrack.core.process import available_cores

# What each distribution and its extras are for; "" is what it always needs.
PURPOSES = {
    ("tumortrack", ""): "cases, training, locating, planning",
    ("tumortrack", "live"): "cameras, ROS 2, the web viewer, 3D Slicer, DICOM segmentations",
    ("tumortrack", "stereo"): "depth from two pictures",
    ("tumortrack", "arms"): "motions of two arms",
    ("tumortrack", "ur"): "a real arm of Universal Robots",
    ("tumortrack", "pcd"): ".pcd clouds",
    ("tumortrack", "onnx"): "networks as ONNX files",
    ("tumortrack", "tensorboard"): "training curves",
    ("tumortrack-experiment", ""): "phantoms, calibrations, recordings",
    ("tumortrack-lab", ""): "digital twin, studies, benchmarks",
    ("tumortrack-lab", "fleet"): "many patients on many machines",
}
_MODULES = {  # where it is not named as its package
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pin": "pinocchio",
    "scikit-fem": "skfem",
    "scikit-image": "skimage",
    "ur_rtde": "rtde_control",
}
_ABSENT = " is not installed"
_CURES = {"pyrealsense2": " (apt-get install libusb-1.0-0)"}


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what works on this machine, and how to install what is missing."""

    def run(self) -> None:
        """Print the machine, then what of every extra is there, by importing it."""
        from tumortrack.live.spec import extensions

        say(f"tumortrack {version('tumortrack')}, Python {platform.python_version()}")
        say(f"cores: {available_cores()}, {platform.machine()}, {platform.system()}")
        free = shutil.disk_usage(Path.cwd()).free / 2**30
        say(f"free disk here: {free:.1f} GiB" + (" - little" if free < 2 else ""))
        for (name, extra), purpose in PURPOSES.items():
            say(part(name, extra, purpose))
        if find_spec("rclpy"):
            say("ok       rclpy: ROS 2 through your own ROS")
        for one in extensions():
            state, fault = ("BROKEN  ", f": {one.fault}") if one.fault else ("ok      ", "")
            say(f"{state} {one.what} {one.kind} of the package {one.package}{fault}")
        try:
            from tumortrack.registration.kernels import carry

            say(f"ok       compiled kernels are kept in {carry.stats.cache_path}")
        except Exception as error:  # Numba's own, where no folder can be written to
            say(f"BROKEN   compiled kernels: {error}; set NUMBA_CACHE_DIR to a writable folder")

        import torch

        from tumortrack.models.hardware import has_fast_bfloat16

        has = torch.cpu.get_capabilities()
        names = {"AVX2": "avx2", "AVX-512": "avx512_f", "AMX": "amx_tile"}
        units = [f"{'' if has.get(flag) else 'no '}{unit}" for unit, flag in names.items()]
        fast = has_fast_bfloat16(torch.device("cpu"))
        bf16 = "in hardware, used" if fast else "not in hardware; fp32 is used (slower)"
        say(f"CPU: {', '.join(units)}; bf16: {bf16}")
        if torch.cuda.is_available():
            say(f"CUDA: {torch.cuda.get_device_name()}")
        else:
            say("CUDA: none; everything runs on the CPU")


def part(name: str, extra: str, purpose: str) -> str:
    """A distribution, or one of its extras: whether all that it needs is there and works."""
    what = f"{name}[{extra}]" if extra else name
    install = f"{sys.executable} -m pip install '{what}'"
    try:
        needed = [one for one in map(Requirement, requires(name) or ()) if _belongs(one, extra)]
    except PackageNotFoundError:
        return f"absent   {what}: {purpose}; {install}"
    if faults := [fault for one in needed if (fault := _fault(one))]:
        absent = extra and all(fault.endswith(_ABSENT) for fault in faults)
        state = "absent  " if absent else "BROKEN  "
        return f"{state} {what}: {purpose}; {', '.join(faults)}; {install}"
    found = ", ".join(f"{one.name} {version(one.name)}" for one in needed)
    return f"ok       {what}: {purpose}; {found}"


def _belongs(needed: Requirement, extra: str) -> bool:
    """Whether this machine needs it for that extra; "": always."""
    marker = needed.marker
    if marker is None or marker.evaluate({"extra": ""}):
        return not extra
    return marker.evaluate({"extra": extra})


def _fault(needed: Requirement) -> str:
    """What is wrong with a package; empty: nothing."""
    try:
        found = version(needed.name)
    except PackageNotFoundError:
        return needed.name + _ABSENT
    if not needed.specifier.contains(found, prereleases=True):
        return f"{needed.name} {found} is installed, but {needed.specifier} is supported"
    try:
        import_module(_MODULES.get(needed.name, needed.name.replace("-", "_")))
    except Exception as error:  # whatever a broken installation raises is the finding
        return f"{needed.name} {found}: {error}{_CURES.get(needed.name, '')}"
    return ""
