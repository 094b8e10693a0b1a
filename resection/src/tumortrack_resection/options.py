"""Options of `plan` and `resect`, shown by the command line. Nothing heavy is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tumortrack.core import store
from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.tracking.options import CameraOptions, PatientOptions

if TYPE_CHECKING:
    from tumortrack_resection.values import ResectionConfig


@dataclass(frozen=True, kw_only=True)
class PlanOptions(PatientOptions):
    """How to plan a resection.

    Attributes:
        method: margin (default) keeps the margin in all directions; published is the paper's
            planner.
        tumor: which one (tumor_1, ...; default: the one that lies farthest out of the organ).
        margin: least distance between tumor and cut in mm (default 5, the paper's; ordinary
            estimates need more, docs/resection.md).
        keep_away: STRUCTURE=MM, again for every structure: refuse a plan whose cuts come nearer
            to it.
        config: JSON file with these and all other choices of the planner (docs/resection.md).
        frame: JSON file that says where the camera is; the plan is then in the robot's frame, whose
            z must point up. Without it, the camera is taken to look straight down.
        stand: height of the organ's lowest point over the table in mm, where no frame is given.
        cell: JSON file with arms, tools, table and their places (docs/resection.md).
        arms: also plan the motions of both arms.
        moved: how far, in mm, the tumor may move before the arms halt; the margin has to cover it
            (docs/resection.md).
        accept_poor: plan on an estimate that `locate` called poor; the plan says so everywhere.
        accept_budget: plan even though the margin does not cover the errors; the plan says so
            everywhere.
    """

    method: Literal["margin", "published"] | None = None
    tumor: str | None = None
    margin: float | None = None
    keep_away: tuple[str, ...] = ()
    config: Path | None = None
    frame: Path | None = None
    stand: float | None = None
    cell: Path | None = None
    arms: bool = True
    moved: float = 2.0
    accept_poor: bool = False
    accept_budget: bool = False

    def resection_config(self) -> ResectionConfig:
        """What the file says, overridden by the options."""
        from tumortrack_resection.values import ResectionConfig

        written = {} if self.config is None else store.read_json(self.config)
        names = {"method": "method", "tumor": "tumor", "margin": "margin_mm"}
        options = {key: getattr(self, name) for name, key in names.items()}
        given = {key: value for key, value in options.items() if value is not None}
        if self.keep_away:
            given["keep_away"] = dict(map(_structure_mm, self.keep_away))
        return from_builtins({**written, **given}, ResectionConfig, str(self.config or "options"))


@dataclass(frozen=True, kw_only=True)
class ResectOptions(CameraOptions):
    """How to carry a plan out.

    Attributes:
        live: MODEL SOURCE: follow the organ meanwhile, as `track` does. The arms halt while there
            is no good estimate, and the plan is made again once the tumor has moved, also of an
            organ that is cut.
        speed: of the arms; 2 is twice as fast as planned.
        moved: the tumor counts as moved once its surface is so many mm from where it was planned
            (root mean square; default: what the plan allows for).
        report: file for states, halts and the budget of errors (default: runs/resect-TIME.json).
    """

    live: tuple[Path, str] | None = None
    speed: float = 1.0
    moved: float | None = None
    report: Path | None = None


def _structure_mm(option: str) -> tuple[str, float]:
    """Of STRUCTURE=MM; InputError for anything else."""
    name, _, text = option.partition("=")
    try:
        return name, float(text)
    except ValueError as error:
        raise InputError(f"--keep-away {option!r} is not STRUCTURE=MM, artery=3 say.") from error
