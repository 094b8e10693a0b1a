"""RViz on a screen that nobody sees."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ros1_objects import end

CONFIGURATIONS = Path(__file__).parents[2] / "docs" / "ros"
_SIZE = "1180x720x24"


class Screen:
    """A virtual screen and what it shows."""

    def __init__(self, display: str, folder: Path) -> None:
        self.environment = {
            **os.environ,
            "DISPLAY": display,
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "QT_QPA_PLATFORM": "xcb",
        }
        self._file = folder / "rviz.png"

    def picture(self) -> Path:
        """A screenshot, as a file."""
        subprocess.run(
            ["import", "-silent", "-window", "root", str(self._file)],
            env=self.environment,
            check=True,
            timeout=60,
        )
        return self._file

    def pixels(self) -> np.ndarray:
        """A screenshot (height, width, 3), 0..255."""
        with Image.open(self.picture()) as image:
            return np.asarray(image.convert("RGB"), int)


@contextlib.contextmanager
def rviz(folder: Path, configuration: str | Path = "tumortrack_ros1.rviz") -> Iterator[Screen]:
    """RViz with a configuration, by default a shipped one. Skips where there is no RViz."""
    for program in ("rviz", "Xvfb", "import"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed: `make debian`")
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", _SIZE, "-nolisten", "tcp"],
        pass_fds=[writing],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(writing)
    viewer = None
    try:
        with os.fdopen(reading) as answer:
            screen = Screen(":" + answer.readline().strip(), folder)
        with (folder / "rviz.log").open("w") as log:
            viewer = subprocess.Popen(
                ["rviz", "-d", str(CONFIGURATIONS / configuration), "--splash-screen", ""],
                env=screen.environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        yield screen
    finally:
        if viewer is not None:
            end(viewer)
        end(server)
