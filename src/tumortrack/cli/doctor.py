"""What this machine can do, and how to install what is missing: `doctor`; and `compile`."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, entry_points, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from tyro.conf import Positional

from tumortrack.cli.console import Device, say
from tumortrack.core.errors import TumortrackError
from tumortrack.core.packages import to_install
from tumortrack.core.plugins import plugins
from tumortrack.core.process import available_cores
from tumortrack.core.renamed import hint, table
from tumortrack.native import LIBRARIES, library

# What each distribution is for, and each of its extras; "": what it always needs.
PURPOSES = {
    ("tumortrack", ""): "cases, locating, tracking",
    ("tumortrack", "dicom"): "DICOM segmentations",
    ("tumortrack", "pcd"): ".pcd clouds",
    ("tumortrack-occupancy", ""): "the paper's method: networks and their training",
    ("tumortrack-occupancy", "onnx"): "networks as ONNX files",
    ("tumortrack-occupancy", "tensorboard"): "training curves",
    ("tumortrack-devices", ""): "recordings, ROS 2, the web viewer, 3D Slicer",
    ("tumortrack-devices", "realsense"): "RealSense cameras",
    ("tumortrack-devices", "stereo"): "depth from two pictures",
    ("tumortrack-resection", ""): "plans of a resection",
    ("tumortrack-resection", "arms"): "motions of two arms",
    ("tumortrack-resection", "ur"): "a real arm of Universal Robots",
    ("tumortrack-experiment", ""): "phantoms, calibrations, recordings",
    ("tumortrack-benchmarks", ""): "digital twin, studies, benchmarks",
    ("tumortrack-benchmarks", "fleet"): "many patients on many machines",
}
_MODULES = {  # import names that differ from the package's
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pin": "pinocchio",
    "python-gdcm": "gdcm",
    "scikit-image": "skimage",
    "ur_rtde": "rtde_control",
}
_PARTS = {  # packages that only a part of their extra needs: the rest works without them
    "rosbags": "recordings, and messages of ROS",
    "cyclonedds": "ROS 2",
    "viser": "the web viewer",
    "fastcrc": "OpenIGTLink to 3D Slicer",
    "pyrealsense2": "RealSense cameras",
}
# System libraries, which pip cannot install, and how to.
_SYSTEM = {"pyrealsense2": ("libusb", "apt-get install libusb-1.0-0")}
_ABSENT = " is not installed"
Status = tuple[Literal["ok", "absent", "BROKEN"], str]  # with its text


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what works on this machine, and how to install what is missing.

    The exit status is 1 where something that is installed does not work (BROKEN), else 0: what is
    absent is no fault.
    """

    def run(self) -> None:
        """Print the machine, then each extra's state, found by importing its packages. Raises
        TumortrackError: something that is installed does not work."""
        say(f"tumortrack {version('tumortrack')}, Python {platform.python_version()}")
        say(f"cores: {available_cores()}, {platform.machine()}, {platform.system()}")
        free = shutil.disk_usage(Path.cwd()).free / 2**30
        say(f"free disk here: {free:.1f} GiB" + (" - little" if free < 2 else ""))
        broken = 0
        for state, text in _statuses():
            say(f"{state:8} {text}")
            broken += state == "BROKEN"

        for method in plugins("methods"):
            with suppress(Exception):  # what fails is among the findings
                for line in method.loaded.hardware():
                    say(line)
        for line in old_names():
            say(line)
        if broken:
            raise TumortrackError(
                f"{broken} of what is installed does not work: see BROKEN above. The rest does."
            )


def _statuses() -> Iterator[Status]:
    """Distributions, extras, plug-ins and compiled kernels."""
    for (name, extra), purpose in PURPOSES.items():
        yield from part(name, extra, purpose)
    if find_spec("rclpy"):
        yield "ok", "rclpy: ROS 2 through your own ROS"
    yield from _plug_ins()
    try:
        library()
        yield "ok", f"compiled kernels, in {LIBRARIES}"
    except (ImportError, OSError) as error:
        yield "BROKEN", f"compiled kernels: {error}"


def old_names() -> Iterator[str]:
    """Variables that are set, and entry points of groups, that nothing reads any more."""
    for name in filter(os.environ.__contains__, table()["variables"]):
        yield f"nothing reads {name}{hint('variables', name)}"
    for group in table()["entry_points"]:
        for point in entry_points(group=group):
            yield f"nothing reads {point.value} in {group}{hint('entry_points', group)}"


def _plug_ins() -> Iterator[Status]:
    """What other packages add; each is imported. Working commands are in ``--help``, working
    methods above; of our own distributions only faults are told."""
    from tumortrack.live import spec
    from tumortrack.simulation.deform import installed

    others = (each for group in ("commands", "methods") for each in plugins(group) if each.fault)
    for each in (*spec.extensions(), *installed.extensions(), *others):
        text = f"{each.kind} {each.name} of the package {each.package}"
        if each.fault:
            yield "BROKEN", f"{text}: {each.fault}"
        elif (each.package, "") not in PURPOSES:
            yield "ok", text


def part(name: str, extra: str, purpose: str) -> Iterator[Status]:
    """Whether everything that a distribution, or one of its extras, needs is there and works. A
    fault of a package that only a part of it needs is a status of its own."""
    what = f"{name}[{extra}]" if extra else name
    install = f"{sys.executable} -m {to_install(what)}"
    try:
        needed = list(_needed(name, extra))
    except PackageNotFoundError:
        yield "absent", f"{what}: {purpose}; {install}"
        return
    faults = {package.name: fault for package in needed if (fault := _fault(package))}
    works = [package.name for package in needed if package.name not in faults]
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
    """Its requirements on this machine ("": whatever the extras), those of further extras that it
    names included."""
    for needed in map(Requirement, requires(name) or ()):
        marker = needed.marker
        always = marker is None or marker.evaluate({"extra": ""})
        of_extra = marker is not None and not always and marker.evaluate({"extra": extra})
        if not (of_extra if extra else always):
            continue
        if needed.name == name:
            for other in needed.extras:
                yield from _needed(name, other)
        else:
            yield needed


def _fault(needed: Requirement) -> str:
    """What is wrong with a package; empty: nothing."""
    try:
        present = version(needed.name)
    except PackageNotFoundError:
        return needed.name + _ABSENT
    if not needed.specifier.contains(present, prereleases=True):
        return f"{needed.name} {present} is installed, but {needed.specifier} is supported"
    try:
        import_module(_MODULES.get(needed.name, needed.name.replace("-", "_")))
    except Exception as error:  # a broken installation raises anything
        return f"{needed.name} {present}: {error}"
    return ""


@dataclass(frozen=True, kw_only=True)
class Compile:
    """Nothing is left to compile: kernels are compiled when the package is installed.

    Attributes:
        model: a case, which gets its model if it has none, or a folder that `train` wrote.
        device: of that model.
    """

    model: Positional[Path | None] = None
    device: Device = "auto"

    def run(self) -> None:
        """Say so."""
        from tumortrack.tracking.model_files import load_model

        library()
        if self.model is not None:
            load_model(self.model, self.device)
        say("nothing to compile: the kernels were compiled when tumortrack was installed.")
