"""Options that commands and the functions of the public API share; the command line shows these
texts. Nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tumortrack.core.errors import InputError
from tumortrack.core.patient import UNKNOWN, Patient

if TYPE_CHECKING:
    from tumortrack.models.model import Model
    from tumortrack.sense.region import RegionConfig

Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True, kw_only=True)
class PatientOptions:
    """Options of commands that work on one patient.

    Attributes:
        patient: the patient you mean; what belongs to another or an unknown one is refused.
        side: the side you mean, the patient's own; the other or an unknown one is refused.
    """

    patient: str | None = None
    side: Literal["left", "right"] | None = None

    @property
    def stated(self) -> Patient:
        """Raises InputError for an identifier that is none: of an empty variable in a script, say,
        which must not pass for nothing stated."""
        if self.patient == UNKNOWN:
            raise InputError(f"--patient {UNKNOWN} is nobody. Leave it out, or say who it is.")
        return Patient(UNKNOWN if self.patient is None else self.patient, self.side or UNKNOWN)


@dataclass(frozen=True, kw_only=True)
class RegionOptions(PatientOptions):
    """Options of commands that look for an organ in depth images.

    Attributes:
        range: keep depths between NEAR and FAR mm (default: those that the model has learned).
        box: keep what lies in a box: two opposite corners X Y Z X Y Z, camera frame, mm.
        whole: what is in range and box is the organ alone; do not look for it among other things.
    """

    range: tuple[float, float] | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    whole: bool = False

    def region(self, model: Model) -> RegionConfig:
        """Raises InputError: a range or box that is none."""
        from tumortrack.tracking.tracker import region_for

        box = None if self.box is None else (self.box[:3], self.box[3:])
        return region_for(model, range_mm=self.range, box_mm=box, whole=self.whole)


@dataclass(frozen=True, kw_only=True)
class LocateOptions(RegionOptions):
    """Options of `locate`.

    Attributes:
        poses: JSON with fixed_from_camera (4 x 4 rows for each view, in their order), unit (mm or
            m) and frame_id: where the camera was, in a robot's base, say.
        at: COLUMN ROW of a pixel of the depth image that shows the organ, from 0 at the upper left.
        mask: image of the depth image's size, 0 where the organ is not.
        grid: voxels along the longest side of the labelled volume, up to 400.
        seed: of the random points and queries.
        unit: of a cloud's numbers.
        depth_unit: of a depth image: mm a step. Default: what the intrinsics file says
            (depth_unit_mm), else 0.1 (a D405's), of floats 1000 (metres). Many cameras have 1.
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels: once for all views, or again
            and again, once for each in their order.
        map: points of the CT whose present places to write (OUT/points.csv): a .csv with columns
            x,y,z (LPS, mm), or 3D Slicer's .mrk.json or .fcsv. Needs a model of preset clinic.
        case: the model's case, whose CT the page's slices then show where it lies now (preset
            clinic); a second or two longer.
        device: auto takes CUDA if there is a GPU.
    """

    poses: Path | None = None
    at: tuple[int, int] | None = None
    mask: Path | None = None
    grid: int = 160
    seed: int = 0
    unit: Literal["mm", "m"] = "mm"
    depth_unit: float | None = None
    intrinsics: tuple[Path, ...] = ()
    map: Path | None = None
    case: Path | None = None
    device: Device = "auto"


@dataclass(frozen=True, kw_only=True)
class CameraOptions(RegionOptions):
    """Options of commands that follow an organ.

    Attributes:
        intrinsics: JSON with the camera's width, height, fx, fy, cx, cy in pixels, instead of what
            the source says, and perhaps a correction of depths, as `calibrate camera` writes it.
        device: auto takes CUDA if there is a GPU.
    """

    intrinsics: Path | None = None
    device: Device = "auto"


@dataclass(frozen=True, kw_only=True)
class TrackOptions(CameraOptions):
    """Options of `track`.

    Attributes:
        frame: JSON file that says where the camera is; results are then in the robot's frame.
        views: further cameras that stand still; what all see at about one moment is laid together.
        poses: JSON that says where all cameras stand, as for `locate`, SOURCE's first; results are
            in its frame, unless --frame gives another.
        moving: SOURCE's camera moves; where it is in each frame comes from file:POSES.csv, tf
            (ros2:FIXED_FRAME) or a robot (ur:HOST). Where that gives poses of a
            tool, --frame has tool_from_camera.
        scan: with --moving: begin with three looks at the organ at rest, from 30 degrees apart,
            within 5 s; what they show together is what the following starts from.
        smoothing: time constant in s of a mean over past estimates; the lag is in the report.
        rescan: every so many s, search for the organ as in a first frame.
        stale: frames older than so many s are refused; a pause is reported after four fifths of it.
        frozen: an image that repeats bit for bit for so many s is refused; 0: it may repeat, as
            of a simulated camera without noise.
        give_up: end after so many s without a frame.
        seconds: end so many s after the first frame, and without one after as many (but 5 at
            least: cameras take time to open); 0: never.
        report: file for latencies, counts and reasons (default: runs/track-TIME.json).
        seed: of the random points.
    """

    frame: Path | None = None
    views: tuple[str, ...] = ()
    poses: Path | None = None
    moving: str = ""
    scan: bool = False
    smoothing: float = 0.0
    rescan: float = 1.0
    stale: float = 0.5
    frozen: float = 0.25
    give_up: float = 60.0
    seconds: float = 0.0
    report: Path | None = None
    seed: int = 0


def check_grid(grid: int) -> None:
    from tumortrack.core.estimate import LARGEST_GRID

    if not 8 <= grid <= LARGEST_GRID:
        raise InputError(f"--grid {grid} is not allowed; choose 8 to {LARGEST_GRID}.")


def model_folder(
    given: Path, making: Callable[[], AbstractContextManager[Any]] = nullcontext
) -> Path:
    """The folder of a given model; of a case the one that it holds, made now where there is none,
    within ``making()``, which yields what ``case_model`` takes as progress. Raises as ``load_case``
    and ``case_model`` do."""
    from tumortrack.imaging.case import Case, holds_case, load_case
    from tumortrack.models.folder import is_model_of

    if not holds_case(given):
        return given
    kept = given / Case.MODEL
    if not is_model_of(kept, given):
        with making() as progress:
            from tumortrack.tracking.model_files import case_model

            case_model(load_case(given), progress=progress)
    return kept
