"""What this machine can do, and how to install what is missing: `doctor`."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, entry_points, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from tumortrack.cli.console import say
from tumortrack.core.errors import TumortrackError
from tumortrack.core.process import available_cores

# What each distribution and its extras are for; "" is what it always needs.
PURPOSES = {
    ("tumortrack", ""): "cases, locating, tracking",
    ("tumortrack", "dicom"): "DICOM segmentations",
    ("tumortrack", "pcd"): ".pcd clouds",
    ("tumortrack", "occupancy"): "the paper's method: networks and their training",
    ("tumortrack", "onnx"): "networks as ONNX files",
    ("tumortrack", "tensorboard"): "training curves",
    ("tumortrack-devices", ""): "recordings, ROS 2, the web viewer, 3D Slicer",
    ("tumortrack-devices", "realsense"): "RealSense cameras",
    ("tumortrack-devices", "stereo"): "depth from two pictures",
    ("tumortrack-devices", "ur"): "a camera that an arm of Universal Robots holds",
    ("tumortrack-resection", ""): "plans of a resection",
    ("tumortrack-resection", "arms"): "motions of two arms",
    ("tumortrack-resection", "ur"): "a real arm of Universal Robots",
    ("tumortrack-experiment", ""): "phantoms, calibrations, recordings",
    ("tumortrack-lab", ""): "digital twin, studies, benchmarks",
    ("tumortrack-lab", "fleet"): "many patients on many machines",
}
_MODULES = {  # where it is not named as its package
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pin": "pinocchio",
    "python-gdcm": "gdcm",
    "scikit-fem": "skfem",
    "scikit-image": "skimage",
    "ur_rtde": "rtde_control",
}
# Packages that serve a part alone: without them the rest works.
_PARTS = {
    "rosbags": "recordings, and messages of ROS",
    "cyclonedds": "ROS 2",
    "viser": "the web viewer",
    "fastcrc": "OpenIGTLink to 3D Slicer",
    "pyrealsense2": "RealSense cameras",
}
_ABSENT = " is not installed"
Finding = tuple[Literal["ok", "absent", "BROKEN"], str]  # the state of a part, and what is said
# Libraries of the system that pip cannot bring.
_SYSTEM = {"pyrealsense2": ("libusb", "apt-get install libusb-1.0-0")}


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what works on this machine, and how to install what is missing.

    The exit status is 1 where something that is installed does not work (BROKEN), else 0: what is
    absent is no fault.
    """

    def run(self) -> None:
        """Print the machine, then what of every extra is there, by importing it. Raises
        TumortrackError: something that is installed does not work."""
        say(f"tumortrack {version('tumortrack')}, Python {platform.python_version()}")
        say(f"cores: {available_cores()}, {platform.machine()}, {platform.system()}")
        free = shutil.disk_usage(Path.cwd()).free / 2**30
        say(f"free disk here: {free:.1f} GiB" + (" - little" if free < 2 else ""))
        broken = 0
        for state, text in _findings():
            say(f"{state:8} {text}")
            broken += state == "BROKEN"

        if find_spec("torch"):
            _say_processors()
        if broken:
            raise TumortrackError(
                f"{broken} of what is installed here does not work: see BROKEN above. All else can "
                "be used."
            )


def _say_processors() -> None:
    """What networks can use."""
    import torch

    from tumortrack.occupancy.hardware import has_fast_bfloat16

    has = torch.cpu.get_capabilities()
    names = {"AVX2": "avx2", "AVX-512": "avx512_f", "AMX": "amx_tile"}
    units = [f"{'' if has.get(flag) else 'no '}{unit}" for unit, flag in names.items()]
    fast = has_fast_bfloat16(torch.device("cpu"))
    bf16 = "in hardware, used" if fast else "not in hardware; fp32 is used (slower)"
    say(f"CPU: {', '.join(units)}; bf16: {bf16}")
    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    say(f"CUDA: {cuda}{'' if torch.cuda.is_available() else '; everything runs on the CPU'}")


def _findings() -> Iterator[Finding]:
    """What is there, what is not, and what is and does not work."""
    for (name, extra), purpose in PURPOSES.items():
        yield from part(name, extra, purpose)
    if find_spec("rclpy"):
        yield "ok", "rclpy: ROS 2 through your own ROS"
    yield from _plug_ins()
    try:
        from tumortrack.registration.kernels import carry

        yield "ok", f"compiled kernels are kept in {carry.stats.cache_path}"
    except Exception as error:  # Numba's own, where no folder can be written to
        yield "BROKEN", f"compiled kernels: {error}; set NUMBA_CACHE_DIR to a writable folder"


def _plug_ins() -> Iterator[Finding]:
    """What other packages add; each is imported. Commands that work are in ``--help``, and of our
    own distributions only what does not work is said."""
    from tumortrack.live import spec
    from tumortrack.simulate.deform import installed

    added = [(f"{one.what} {one.kind}", one.package, one.fault) for one in spec.extensions()]
    added += [(f"deformation {d.name}", d.package, d.fault) for d in installed.extensions()]
    for point in entry_points(group="tumortrack.commands"):
        try:
            point.load()
        except Exception as error:  # a foreign package raises anything
            added.append((f"command {point.name}", point.value, str(error)))
    for what, package, fault in added:
        text = f"{what} of the package {package}"
        if fault:
            yield "BROKEN", f"{text}: {fault}"
        elif (package, "") not in PURPOSES:
            yield "ok", text


def part(name: str, extra: str, purpose: str) -> Iterator[Finding]:
    """A distribution, or one of its extras: whether all that it needs is there and works. What is
    wrong with a package that serves a part of it alone stands in a line of its own."""
    what = f"{name}[{extra}]" if extra else name
    install = f"{sys.executable} -m pip install '{what}'"
    try:
        needed = list(_needed(name, extra))
    except PackageNotFoundError:
        yield "absent", f"{what}: {purpose}; {install}"
        return
    faults = {one.name: fault for one in needed if (fault := _fault(one))}
    works = [one.name for one in needed if one.name not in faults]
    parts = _PARTS if works else _SYSTEM
    alone = {name: fault for name, fault in faults.items() if name in parts}
    if rest := [fault for name, fault in faults.items() if name not in alone]:
        absent = extra and all(fault.endswith(_ABSENT) for fault in rest)
        yield "absent" if absent else "BROKEN", f"{what}: {purpose}; {', '.join(rest)}; {install}"
    elif works:
        there = ", ".join(f"{name} {version(name)}" for name in works)
        yield "ok", f"{what}: {purpose}{', but for what follows' if alone else ''}; {there}"
    for package, fault in alone.items():
        library, cure = _SYSTEM.get(package, ("", ""))
        if not (library and library in fault):
            library, cure = "", install
        absent = bool(library) or fault.endswith(_ABSENT)
        yield "absent" if absent else "BROKEN", f"{_PARTS[package]}: {fault}; {cure}"


def _needed(name: str, extra: str) -> Iterator[Requirement]:
    """What it asks for on this machine; of another extra of its own, what that asks for."""
    for one in map(Requirement, requires(name) or ()):
        if not _belongs(one, extra):
            continue
        if one.name == name:
            for other in one.extras:
                yield from _needed(name, other)
        else:
            yield one


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
        return f"{needed.name} {found}: {error}"
    return ""
