"""`calibrate register`."""

from __future__ import annotations

from dataclasses import dataclass

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack_experiment.register.options import RegisterOptions


@dataclass(frozen=True, kw_only=True)
class CalibrateRegister(RegisterOptions):
    """CT to camera, camera to robot, or CT to robot, by the beads of a kit's base; two or all
    three."""

    def run(self) -> None:
        store.check_place(self.out, "registration", self.overwrite)
        if sum(path is not None for path in (self.ct, self.view, self.robot_points)) < 2:
            raise InputError("give at least two of --ct, --view and --robot-points.")

        from tumortrack_experiment.register.build import write_registration

        write_registration(self)
