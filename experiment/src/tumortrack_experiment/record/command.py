"""`record`: its options."""

from __future__ import annotations

import math
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.live.cameras import CameraSetup
    from tumortrack_experiment.kit_file import Kit


@dataclass(frozen=True, kw_only=True)
class Record:
    """Record an experiment state by state: depth images, pictures, where the camera was.

    Each state of the checklist is set up, looked at and recorded, and can be repeated at once. The
    same command goes on where it was stopped. docs/bench.md shows it.

    Attributes:
        source: where frames come from, as for `track`: realsense?picture=true, ros2:TOPIC, ...
        folder: where the recording goes; in the end all of it is one MCAP there.
        states: the checklist, in its order (default: the kit's states).
        kit: folder or kit.json that `phantom-kit` wrote; stored with the recording.
        frame: JSON file that says where the camera is; stored with the recording.
        moving: the camera moves; where it is comes from file:POSES.csv, tf (ros2:FIXED_FRAME) or
            a robot (ur:HOST), as for `track`. Without --frame, poses are those of the tool.
        intrinsics: JSON with the camera's width, height, fx, fy, cx, cy in pixels, instead of what
            the source says.
        seconds: how long each state is recorded.
        range: depths between NEAR and FAR mm are good (default: a D405's).
        yes: ask nothing: count down before each state, keep it as it is, and go on.
        countdown: so many seconds, with --yes.
    """

    source: Positional[str]
    folder: Positional[Path]
    states: tuple[str, ...] = ()
    kit: Path | None = None
    frame: Path | None = None
    moving: str = ""
    intrinsics: Path | None = None
    seconds: float = 3.0
    range: tuple[float, float] = (70.0, 500.0)
    yes: bool = False
    countdown: float = 3.0

    def run(self) -> None:
        """Until all states are recorded, or the user ends it."""
        from tumortrack.live.workers import SourceWorker
        from tumortrack.sense.files import read_intrinsics
        from tumortrack.tracking.tracker import region_for
        from tumortrack_experiment.record.folder import RecordingFolder
        from tumortrack_experiment.record.guide import Guide

        self._check()
        kit, files = self._files()
        setup = self._setup()
        states = self.states or (kit.states if kit else ())
        folder = RecordingFolder(self.folder, states, setup.published.frame_id, files)
        (config,) = setup.sources.values()
        if folder.missing:
            with closing(SourceWorker(config.open)) as worker:
                guide = Guide(
                    folder=folder,
                    worker=worker,
                    setup=setup,
                    region=region_for(range_mm=self.range),
                    seconds=self.seconds,
                    range_mm=self.range,
                    parts=_parts(kit),
                    countdown_s=self.countdown if self.yes else None,
                    intrinsics=read_intrinsics(self.intrinsics) if self.intrinsics else None,
                )
                guide.record()
        if folder.missing:
            say(f"missing: {', '.join(folder.missing)}. The same command goes on.")
        else:
            say(f"{len(states)} states: {folder.finish()}")

    def _check(self) -> None:
        near_mm, far_mm = self.range
        if not (0.1 <= self.seconds <= 3600 and 0 <= self.countdown <= 3600):
            raise InputError("--seconds must lie in 0.1 to 3600, --countdown in 0 to 3600.")
        if not 0 < near_mm < far_mm < math.inf:
            raise InputError(f"--range {near_mm:g} {far_mm:g}: give NEAR and FAR in mm, NEAR less.")
        if not self.yes and not sys.stdin.isatty():
            raise InputError("this is no terminal, so nobody can be asked. Give --yes.")

    def _files(self) -> tuple[Kit | None, dict[str, bytes]]:
        """The kit, and what is stored with the recording."""
        from tumortrack_experiment.kit_file import KIT_FILE, read_kit

        files, kit = {}, None
        if self.kit is not None:
            kit = read_kit(self.kit)
            path = self.kit / KIT_FILE if self.kit.is_dir() else self.kit
            files[KIT_FILE] = path.read_bytes()
            if strange := [name for name in self.states if name not in kit.states]:
                raise InputError(f"the kit has no state {strange[0]!r}, only {kit.states}.")
        if self.frame is not None and self.frame.is_file():
            files["calibration.json"] = self.frame.read_bytes()
        return kit, files

    def _setup(self) -> CameraSetup:
        from tumortrack.live.cameras import CameraSetup, camera_setup
        from tumortrack.live.spec import POSES, SOURCES
        from tumortrack.live.values import PublishedFrame

        if not self.moving or self.frame is not None:
            return camera_setup((self.source,), None, self.moving, self.frame)
        poses = POSES.parse(self.moving).open()
        published = PublishedFrame(poses.frame_id or "fixed", moves=True)
        return CameraSetup(published, {self.source: SOURCES.parse(self.source)}, poses=poses)


def _parts(kit: Kit | None) -> dict[str, str]:
    """By state, what is set up for it."""
    parts = kit.parts if kit else ()
    states = {part.state for part in parts if part.state}
    return {
        state: ", ".join(f"{part.name} ({part.purpose})" for part in parts if part.state == state)
        for state in states
    }
