"""Options that commands and the functions of the public API share; the command line shows these
texts. Nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_type_hints

from tumortrack.core.errors import InputError
from tumortrack.core.patient import UNKNOWN, Patient

if TYPE_CHECKING:
    from tumortrack.models.model import Model
    from tumortrack.sense.region import RegionConfig
    from tumortrack.simulate.scene import SceneConfig

Device = Literal["auto", "cpu", "cuda"]
_Options = TypeVar("_Options")  # a dataclass


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


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `export`.

    Attributes:
        located: folder that `locate` wrote with this case's model: the scene shows its surfaces,
            and the CT and its segmentation where the organ is.
        live: HOST:PORT of a sink `openigtlink`: the scene connects to it, shows what it sends, and
            has the CT follow the organ.
        dicom: folder of the CT's slices that the case's voxels come from.
        series: which of its series, if the folder holds several (UID or number in the list).
        patient: the PatientID of --dicom, where the case has a pseudonym.
    """

    located: Path | None = None
    live: str | None = None
    dicom: Path | None = None
    series: str | None = None
    patient: str | None = None


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Options of `simulate`.

    Attributes:
        scenes: how many.
        seed: of the scenes; they are never those that training sees.
        configuration: of the paper's deformation table; several are mixed.
        falloff: how the table's third number is read (docs/method.md).
        rotations: poses, as in `train`.
        squeeze: also squeeze and bend the organ as a whole.
        noise: with the depth sensor's noise.
        sensor: whose, as in `train`.
        elastic: deform the organ as an elastic body in its bed does (plates, instruments, pulls,
            weight, swelling), instead of by the paper's table.
    """

    scenes: int = 20
    seed: int = 0
    configuration: tuple[Literal[1, 2, 3, 4, 5, 6], ...] = (3,)
    falloff: Literal["sigma", "variance"] = "sigma"
    rotations: Literal["limited", "full"] = "limited"
    squeeze: bool = False
    noise: bool = True
    sensor: Literal["d405", "stereo"] = "d405"
    elastic: bool = False

    def __post_init__(self) -> None:
        if self.scenes < 1:
            raise InputError(f"--scenes {self.scenes} must be at least 1.")

    def scene_config(self) -> SceneConfig:
        from tumortrack.sense.noise import CLEAN, SENSORS
        from tumortrack.simulate import deform
        from tumortrack.simulate.deform.drag import CONFIGURATIONS
        from tumortrack.simulate.scene import PoseConfig, SceneConfig

        models: list[deform.DragConfig | deform.ElasticConfig] = [deform.ElasticConfig()]
        if not self.elastic:
            table = (CONFIGURATIONS[number] for number in self.configuration)
            models = [deform.DragConfig(steps=steps, falloff=self.falloff) for steps in table]
        chains = [deform.ChainConfig(links=(model, deform.StretchConfig())) for model in models]
        return SceneConfig(
            width=848,
            height=480,
            pose=PoseConfig(rotations=self.rotations),
            deform=tuple(chains if self.squeeze else models),
            noise=SENSORS[self.sensor] if self.noise else CLEAN,
        )


def options_from(kind: type[_Options], given: dict[str, Any], what: str) -> _Options:
    """Keyword arguments of a public function as its options. InputError: an unknown one."""
    hints = get_type_hints(kind)
    if unknown := sorted(set(given) - set(hints)):
        raise InputError(f"{what} knows no {unknown[0]!r}; allowed: {', '.join(hints)}.")
    for name, value in given.items():
        if hints[name] == tuple[Path, ...]:
            paths = [value] if isinstance(value, str | Path) else value
            given[name] = tuple(map(Path, paths))
        elif hints[name] == Path | None and value is not None:
            given[name] = Path(value)
    return kind(**given)


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
