"""Other makers' programs: rclpy, ur_rtde, 3D Slicer's core, newton, ... (`make clients`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import needs

IDENTITY = Path(__file__).parent
FOLDER = IDENTITY.parents[1] / ".clients"


def environment(package: str, module: str = "") -> dict[str, str]:
    """Of a process that uses this package: what a ROS's setup.bash sets, and the tests' modules.
    Without it (or its ``module``: what was installed is older) the test is skipped, with the
    package's name."""
    site = FOLDER / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"
    if not (FOLDER / ".installed").exists() or not (site / module).is_dir():
        needs.missing(f"{package}: make clients (Python 3.11 on x86-64)")
    libraries = [FOLDER / "lib", *sorted(site.glob("ros_*.libs"))]
    paths = [IDENTITY, site, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        **os.environ,
        "AMENT_PREFIX_PATH": str(FOLDER),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "ROS_LOG_DIR": str(FOLDER / "log"),
        "WARP_CACHE_PATH": str(FOLDER / "warp"),  # kernels, compiled once
    }


def said(environment: dict[str, str], script: str, *arguments: object) -> list[Any]:
    """What a script of this folder says: each line of its standard output, which is JSON."""
    command = [sys.executable, str(IDENTITY / script), *map(str, arguments)]
    run = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=600, env=environment
    )
    assert run.returncode == 0, run.stderr
    return [json.loads(line) for line in run.stdout.splitlines() if line[:1] in "[{"]
