"""Options that commands and the public API share; the command line shows their docstrings as help.
Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_type_hints

from tumortrack.core.errors import InputError
from tumortrack.core.patient import UNKNOWN, Patient

if TYPE_CHECKING:
    from tumortrack.core.types import DepthError
    from tumortrack.registration.base_model import Model
    from tumortrack.segmentation import RegionConfig
    from tumortrack.simulation.scene import SceneConfig

Device = Literal["auto", "cpu", "cuda"]
# ``simulation.noise.SENSORS``, and the cameras of simulation/sensors.toml.
SimulatedSensor = Literal[
    "d405", "stereo", "d405-measured", "d435", "zed", "azure-kinect", "l515", "flexx2",
    "structured-light", "endoscope",
]  # fmt: skip
_CLEAR_MM = 10.0  # from the nearest depth that a camera sees to the organ
_Options = TypeVar("_Options")  # a dataclass


@dataclass(frozen=True, kw_only=True)
class PatientOptions:
    """Options of commands that work on one patient.

    Attributes:
        patient: the expected patient; data of another or an unknown one are refused.
        side: the expected side of the patient; the other or an unknown one is refused.
    """

    patient: str | None = None
    side: Literal["left", "right"] | None = None

    @property
    def stated(self) -> Patient:
        """Raises InputError for ``unknown`` as an identifier, and for an invalid one: an empty
        variable in a script, for example, must not count as no patient stated."""
        if self.patient == UNKNOWN:
            raise InputError(f"--patient {UNKNOWN} is nobody. Leave it out, or say who it is.")
        return Patient(UNKNOWN if self.patient is None else self.patient, self.side or UNKNOWN)


@dataclass(frozen=True, kw_only=True)
class RegionOptions(PatientOptions):
    """Options of commands that look for an organ in depth images.

    Attributes:
        range: keep depths between NEAR and FAR mm (default: the range of the model's scenes).
        box: keep what is in a box: two opposite corners X Y Z X Y Z, camera frame, mm.
        whole: take everything in range and box for the organ, without searching for it.
        depth_error: how far off depths may be, all alike: MM that the camera's calibration leaves,
            or the kind of a camera that nobody calibrated (d405-measured, d435, zed, ...). Default:
            depth_left_mm of the intrinsics; else that of most cameras.
    """

    range: tuple[float, float] | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    whole: bool = False
    depth_error: str = ""

    @property
    def stated_error(self) -> DepthError | None:
        """Raises InputError: it is neither mm nor a camera."""
        if self.depth_error == "":
            return None
        from tumortrack.simulation.sensors import depth_error_of

        return depth_error_of(self.depth_error)

    def region(self, model: Model) -> RegionConfig:
        """Raises InputError: an invalid range or box."""
        from tumortrack.tracking.tracker import region_for

        box = None if self.box is None else (self.box[:3], self.box[3:])
        return region_for(model, range_mm=self.range, box_mm=box, whole=self.whole)


@dataclass(frozen=True, kw_only=True)
class LocateOptions(RegionOptions):
    """Options of `locate`.

    Attributes:
        poses: JSON with fixed_from_camera (4 x 4 rows for each view, in their order), unit (mm or
            m) and frame_id: where the camera was, for example in a robot's base frame. A .csv is of
            the ultrasound probe instead: a pose for each mask.
        at: COLUMN ROW of a pixel of the depth image that shows the organ, from 0 at the upper left.
        mask: image of the depth image's size, 0 outside the organ.
        grid: voxels along the longest side of the labelled volume, up to 400.
        seed: of the random points and queries.
        unit: of a cloud's coordinates.
        depth_unit: mm per step of a depth image. Default: depth_unit_mm of the intrinsics file,
            else 0.1 (a D405's), of floats 1000 (metres). Many cameras have 1.
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels: once for all views, or once
            for each, in their order.
        evidence: JSON or CSV with what else is known of where the organ lies: touched points,
            landmarks, outlines (docs/evidence.md); or tracked ultrasound: a sequence (.mha, .mhd,
            .nrrd), or with --poses TABLE.csv a folder or pattern of masks. Repeatable. Needs a
            model of preset elastic.
        frame: of ultrasound: JSON file with the camera's pose in the frame of the probe's poses, as
            for `track`.
        masks: of a sequence's frames: a folder or pattern of images, a segmentation or sequence.
        mask_part: the part that all masks show (tumor_1); else their values say it.
        mm_per_pixel: of ultrasound: a pixel's width, and its height where that differs.
        image_to_probe: of ultrasound: JSON with probe_from_image (4 x 4 rows) and unit, or a PLUS
            configuration (.xml).
        advise: part for which it says what to learn next (default: the tumor that is least sure).
        map: points of the CT to map to the camera frame (OUT/points.csv): a .csv with columns
            x,y,z (LPS, mm), or 3D Slicer's .mrk.json or .fcsv. Needs a model of preset elastic.
        case: the model's case; the page's slices then show its CT moved to the organ (preset
            elastic). Takes a second or two longer.
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
    evidence: tuple[Path, ...] = ()
    frame: Path | None = None
    masks: Path | None = None
    mask_part: str = ""
    mm_per_pixel: tuple[float, ...] = ()
    image_to_probe: Path | None = None
    advise: str = ""
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
        frame: JSON file with the camera's pose; results are then in the robot's frame.
        views: further cameras that do not move; frames taken at about the same time are combined.
        poses: JSON with the poses of all cameras, as for `locate`, SOURCE's first; results are in
            its frame, unless --frame gives another.
        moving: SOURCE's camera moves; its pose in each frame comes from file:POSES.csv, tf
            (ros2:FIXED_FRAME) or a robot (ur:HOST). If those are poses of a tool, --frame has
            tool_from_camera.
        tool: NAME=KIND:..., a tool that touches or holds the organ, or outlines that are drawn
            (file:TABLE.csv, ur:HOST, ros2:TF_FRAME, crtk:/PSM1, openigtlink:HOST:PORT); repeatable.
        advise: as for `locate`.
        scan: with --moving: begin with three looks at the organ at rest, 30 degrees apart, within
            5 s; tracking starts from all three together.
        smoothing: time constant in s of a mean over past estimates; the lag is in the report.
        rescan: search for the organ as in a first frame after so many s.
        stale: refuse a camera's frames that are older than so many s; a pause is reported after
            four fifths of it.
        frozen: refuse an image that repeats bit for bit for so many s; 0: it may repeat, as from a
            simulated camera without noise.
        give_up: end after so many s without a frame from an open camera.
        seconds: end so many s after the first frame, or after as long without one (at least 5 s);
            0: never.
        report: file for latencies, counts and reasons (default: runs/track-TIME.json).
        seed: of the random points.
    """

    frame: Path | None = None
    views: tuple[str, ...] = ()
    poses: Path | None = None
    moving: str = ""
    tool: tuple[str, ...] = ()
    advise: str = ""
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
        format: a scene for 3D Slicer, or a body for a simulator: tetrahedra with parts and presumed
            stiffness, and surfaces, as legacy VTK (for SOFA) or USD (for newton), in mm.
            Takes only --located, which adds where the organ is and the modes of its uncertainty.
        located: folder that `locate` wrote with this case's model: the scene shows its surfaces,
            and the CT and its segmentation where the organ is.
        live: HOST:PORT of a sink `openigtlink`: the scene connects to it, shows what it sends, and
            has the CT follow the organ.
        dicom: folder of the CT's slices that the case's voxels come from.
        series: which of its series, if the folder holds several (UID or number in the list).
        patient: the PatientID of --dicom, where the case has a pseudonym.
    """

    format: Literal["slicer", "vtk", "usd"] = "slicer"
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
        sensor: whose. d405 and stereo are as in `train`; all others have the noise that is
            published of them, of which much is assumed (docs/method.md). A camera that cannot see
            so near has the organ farther off.
        uncalibrated: the camera errs as its kind does without calibration, by what SEED draws.
        tissue: it sees tissue: wet for stereo (twice the noise, 12 % lost), too deep for time of
            flight (8 to 15 mm). Not of d405 and stereo, nor is uncalibrated.
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
    sensor: SimulatedSensor = "d405"
    uncalibrated: bool = False
    tissue: bool = False
    elastic: bool = False

    def __post_init__(self) -> None:
        if self.scenes < 1:
            raise InputError(f"--scenes {self.scenes} must be at least 1.")

    def scene_config(self) -> SceneConfig:
        from tumortrack.core.cloud import CloudConfig
        from tumortrack.simulation import deform
        from tumortrack.simulation.deform.drag import CONFIGURATIONS
        from tumortrack.simulation.noise import CLEAN
        from tumortrack.simulation.scene import PoseConfig, SceneConfig
        from tumortrack.simulation.sensors import simulated

        models: list[deform.DragConfig | deform.ElasticConfig] = [deform.ElasticConfig()]
        if not self.elastic:
            table = (CONFIGURATIONS[number] for number in self.configuration)
            models = [deform.DragConfig(steps=steps, falloff=self.falloff) for steps in table]
        noise = simulated(
            self.sensor, unit=self.seed, uncalibrated=self.uncalibrated, tissue=self.tissue
        )
        cloud, (low_mm, high_mm) = CloudConfig(), PoseConfig().nearest_mm
        farther_mm = max(0.0, noise.nearest_mm + _CLEAR_MM - low_mm)
        chains = [deform.ChainConfig(links=(model, deform.StretchConfig())) for model in models]
        return SceneConfig(
            width=848,
            height=480,
            pose=PoseConfig(
                rotations=self.rotations, nearest_mm=(low_mm + farther_mm, high_mm + farther_mm)
            ),
            deform=tuple(chains if self.squeeze else models),
            noise=noise if self.noise else CLEAN,
            cloud=CloudConfig(near_mm=cloud.near_mm + farther_mm, far_mm=cloud.far_mm + farther_mm),
        )


def options_from(kind: type[_Options], given: dict[str, Any], what: str) -> _Options:
    """Keyword arguments of a public function as its options. InputError: an unknown one."""
    hints = get_type_hints(kind)
    if unknown := sorted(set(given) - set(hints)):
        raise InputError(f"{what} knows no {unknown[0]!r}; allowed: {', '.join(hints)}.")
    for name, value in given.items():
        if hints[name] == tuple[Path, ...]:
            paths = [value] if isinstance(value, str | Path) else value or ()
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
    """A given model's folder, or that of the model in a given case. A missing one is made, within
    ``making()``, which yields the ``progress`` of ``case_model``. Raises as ``load_case`` and
    ``case_model`` do."""
    from tumortrack.io.case import Case, holds_case, load_case
    from tumortrack.io.model_folder import is_model_of

    if not holds_case(given):
        return given
    folder = given / Case.MODEL
    if not is_model_of(folder, given):
        with making() as progress:
            from tumortrack.tracking.model_files import case_model

            case_model(load_case(given), progress=progress)
    return folder
