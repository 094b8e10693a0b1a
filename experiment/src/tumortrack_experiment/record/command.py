"""`record`: its options."""

from __future__ import annotations

import math
import sys
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.live.cameras import CameraSetup


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
            the source says; `calibrate camera` writes it, with a correction of depth that is
            applied before anything is recorded.
        only: record these states of the checklist now, and leave the others for later; one that is
            finished is recorded anew.
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
    only: tuple[str, ...] = ()
    seconds: float = 3.0
    range: tuple[float, float] = (70.0, 500.0)  # of its data sheet, at 848 x 480
    yes: bool = False
    countdown: float = 3.0

    def run(self) -> None:
        """Until all states are recorded, or the user ends it."""
        from tumortrack.io.depth_files import read_camera
        from tumortrack.live.workers import SourceWorker
        from tumortrack_experiment.kit_file import KIT_FILE, kit_path, read_kit
        from tumortrack_experiment.record.folder import RecordingFolder
        from tumortrack_experiment.record.guide import Guide, GuideConfig

        near_mm, far_mm = self.range
        if not (0.1 <= self.seconds <= 3600 and 0 < near_mm < far_mm < math.inf):
            raise InputError("--seconds must lie in 0.1 to 3600; --range is NEAR FAR, mm.")
        if not self.yes and not sys.stdin.isatty():
            raise InputError("this is no terminal, so nobody can be asked. Give --yes.")
        kit = read_kit(self.kit) if self.kit else None
        known = kit.states if kit else self.states
        states = self.states or known
        if strange := [name for name in states if name not in known]:
            raise InputError(f"the kit has no state {strange[0]!r}; it has {', '.join(known)}.")
        setup = self._setup()
        beside = {"calibration.json": self.frame, "intrinsics.json": self.intrinsics}
        beside |= {KIT_FILE: kit_path(self.kit)} if self.kit else {}
        files = {name: path.read_bytes() for name, path in beside.items() if path}
        intrinsics, correction = read_camera(self.intrinsics)
        how = GuideConfig(self.seconds, self.range, self.yes, self.countdown)
        folder = RecordingFolder(self.folder, states, setup.published.frame_id, files)
        if now := folder.to_record(self.only):
            (config,) = setup.sources.values()
            with closing(SourceWorker(config.open)) as worker, ExitStack() as ending:
                ending.callback(folder.drop)
                Guide(how, folder, worker, setup, kit, intrinsics, correction).record(now)
        if missing := folder.to_record():
            say(f"missing: {', '.join(missing)}. The same command goes on.")
        else:
            say(f"{len(states)} states: {folder.finish()}")

    def _setup(self) -> CameraSetup:
        from tumortrack.live.cameras import CameraSetup, camera_setup
        from tumortrack.live.spec import POSES, SOURCES
        from tumortrack.live.values import PublishedFrame

        if not self.moving or self.frame is not None:
            return camera_setup((self.source,), None, self.moving, self.frame)
        poses = POSES.parse(self.moving).open()
        published = PublishedFrame(poses.frame_id or "fixed", calibrated=True, moves=True)
        return CameraSetup(published, {self.source: SOURCES.parse(self.source)}, poses=poses)
