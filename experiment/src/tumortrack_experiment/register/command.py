"""`calibrate register`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from tumortrack.core import store
from tumortrack.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class CalibrateRegister:
    """CT to camera, camera to robot, or CT to robot, by the beads of a kit's base; two or all
    three.

    Attributes:
        kit: folder that `phantom-kit` wrote.
        out: folder to write: report.json; of camera and robot also calibration.json, for
            `track --frame`, `plan` and `resect`.
        ct: DICOM folder or volume of the phantom on its base.
        series: which DICOM series, if the folder holds several.
        view: depth image (.png) of the base, a folder of them, or a recording (with --state).
        intrinsics: of a depth image; default: intrinsics.json beside it.
        state: of a recording.
        robot_points: .csv with x,y,z of the places that the robot pointed at, in its base frame,
            and bead (their names), if they are known.
        unit: of these places.
        pointed_at: where the tip touched each bead.
        case: folder that `prepare` wrote: errors are stated at its tumors, else at the organ.
        frame_id: the robot's frame.
        camera_frame_id: what the source's messages call the camera's frame.
        overwrite: replace OUT if it exists.
    """

    kit: Positional[Path]
    out: Positional[Path]
    ct: Path | None = None
    series: str | None = None
    view: Path | None = None
    intrinsics: Path | None = None
    state: str | None = None
    robot_points: Path | None = None
    unit: Literal["mm", "m"] = "mm"
    pointed_at: Literal["top", "middle"] = "top"
    case: Path | None = None
    frame_id: str = "base_link"
    camera_frame_id: str = ""
    overwrite: bool = False

    def run(self) -> None:
        store.check_place(self.out, "registration", self.overwrite)
        if sum(path is not None for path in (self.ct, self.view, self.robot_points)) < 2:
            raise InputError("give at least two of --ct, --view and --robot-points.")

        from tumortrack_experiment.register.build import write_registration

        write_registration(self)
