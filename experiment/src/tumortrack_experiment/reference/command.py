"""`reference`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tumortrack.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Make a scene of what a camera saw of a phantom's state, with a second CT of that state as
    its truth, laid on each other by the base's beads: what `evaluate` and `margins` read.

    Attributes:
        ct: DICOM folder or volume of the phantom on its base, in that state.
        recording: folder that `tumortrack record` wrote, or with a folder of depth images a state.
        scenes: folder to write the scene into, as SCENES/STATE.
        kit: folder that `phantom-kit` wrote.
        case: folder that `prepare` wrote, of which the kit was made.
        state: which of the recording's; may be left out if it has one.
        series: which DICOM series, if the folder holds several.
        organ_hu: HU window of the organ: low (inclusive; half way from air, as its surface then
            lies where it is) and high.
        tumor_hu: HU window of the tumors.
        targets: .csv with ct_x,ct_y,ct_z: beads cast into the organ, as in the case's CT. By
            default those that its CT shows.
        target_mm: their diameter; without it there are none.
        moves: camera or base are moved between states; each state is registered by itself.
    """

    ct: Positional[Path]
    recording: Positional[Path]
    scenes: Positional[Path]
    kit: Path
    case: Path
    state: str | None = None
    series: str | None = None
    organ_hu: Annotated[tuple[float, float], arg(aliases=["--kidney-hu"])] = (-480.0, 300.0)
    tumor_hu: tuple[float, float] = (300.0, 1000.0)
    targets: Path | None = None
    target_mm: float | None = None
    moves: bool = False

    def run(self) -> None:
        if self.targets is not None and self.target_mm is None:
            raise InputError("--targets needs --target-mm, the diameter of these beads.")

        from tumortrack_experiment.reference.build import write_reference

        write_reference(self)
