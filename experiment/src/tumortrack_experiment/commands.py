"""The experiment's commands: `tumortrack` finds them by its entry points' names."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import OmitSubcommandPrefixes, subcommand

from tumortrack_experiment.calibrate.command import (
    CalibrateBoard,
    CalibrateCamera,
    CalibrateHandEye,
)

Calibration = (
    Annotated[CalibrateBoard, subcommand("board")]
    | Annotated[CalibrateCamera, subcommand("camera")]
    | Annotated[CalibrateHandEye, subcommand("hand-eye")]
)


def calibrate(kind: OmitSubcommandPrefixes[Calibration]) -> Calibration:
    """Calibrate a camera, and its place on a robot, each with the error that is left."""
    return kind
