"""The experiment's commands: `tumortrack` finds them by its entry points' names."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import OmitSubcommandPrefixes, subcommand

from tumortrack_experiment.calibrate.command import (
    CalibrateBoard,
    CalibrateCamera,
    CalibrateHandEye,
)
from tumortrack_experiment.reference.command import Reference
from tumortrack_experiment.register.command import CalibrateRegister

Calibration = (
    Annotated[CalibrateBoard, subcommand("board")]
    | Annotated[CalibrateCamera, subcommand("camera")]
    | Annotated[CalibrateHandEye, subcommand("hand-eye")]
    | Annotated[CalibrateRegister, subcommand("register")]
)


def calibrate(kind: OmitSubcommandPrefixes[Calibration]) -> Calibration:
    """Calibrate a camera, its place on a robot, and a CT's before it, each with its error."""
    return kind


reference = Reference
