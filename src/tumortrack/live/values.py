"""The values of live tracking, and the interfaces of sources and sinks: a source returns an
``Observation``, the loop makes one ``TrackingResult`` from it, and each sink gets that."""

from __future__ import annotations

import math
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from tumortrack.core.assessment import ErrorBound, Quality, bound_words
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED, Estimate
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import Affine, rigid, transform_points
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.renamed import Renamed
from tumortrack.core.report import Finding
from tumortrack.core.types import Anatomy, DepthFrame, Mesh, SensorCloud

if TYPE_CHECKING:
    from tumortrack.segmentation.tissue import Click, TissueClassifier


class SourceLost(TumortrackError):
    """The source is gone for now: unplugged, killed, unreadable. It will be reopened."""

    exit_code = 3


class SourceEnded(TumortrackError):
    """There are no more frames, as at the end of a recording. Not a fault."""

    exit_code = 0


@dataclass(frozen=True, eq=False)
class Observation:
    """What a source observed at one instant; camera frame, mm.

    ``content`` has the ``stamp_ns`` of its exposure. ``arrived_ns``: when it reached this program,
    by ``time.time_ns``. ``mask``: True in pixels of the depth image where the organ may be.
    ``truth``: the true surfaces, from a simulation. ``frame_id``: the source's name for the camera
    frame; None: this kind of source has no names. ``picture``: grey or RGB, aligned with the depth
    image. ``evidence``: what the source knows beside, new with this frame.
    """

    content: DepthFrame | SensorCloud
    arrived_ns: int
    mask: Bool[np.ndarray, "h w"] | None = None
    truth: Anatomy | None = None
    frame_id: str | None = None
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None
    evidence: tuple[Evidence, ...] = ()

    @property
    def stamp_ns(self) -> int:
        return self.content.stamp_ns


@runtime_checkable
class Source(Protocol):
    """An open source. One thread calls ``read``; another may call ``close``."""

    # The stamp of the frame read last is this machine's time.time_ns, so its age is known.
    host_clock: bool
    lossless: bool  # every frame is processed, not only the newest: the source waits for the loop
    # Simulated or played: where no frame comes, this computer is slow, and no camera is silent.
    on_demand: bool

    @property
    def dropped(self) -> int:
        """Frames lost inside the source, as far as it knows."""

    def read(self, timeout_s: float) -> Observation | None:
        """The newest frame that was not read before; None if none came in time. Raises SourceLost,
        SourceEnded, or InputError: this frame cannot be used; the loop reports it and reads on."""

    def close(self) -> None:
        """Release everything; may be called twice."""


@dataclass(frozen=True, eq=False)
class PublishedFrame:
    """Where results are published. From a calibration file (``calibrated``), where it has them:
    ``camera_frame_id``, the sources' name for the camera frame; ``table_in_camera``, unit normal
    and offset (mm) of the table's plane at the calibration, ``normal @ point = offset``;
    ``error_mm`` and ``error_deg``, bounds of the calibration's error, at the camera and of its
    direction. ``moves``: the camera is meant to move, and each result has its pose."""

    frame_id: str = "camera"
    published_from_camera: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    calibrated: bool = False
    camera_frame_id: str = ""
    table_in_camera: tuple[float, float, float, float] | None = None
    error_mm: float | None = None
    error_deg: float = 0.0
    moves: bool = False

    def of_camera(self, published_from_camera: Affine) -> PublishedFrame:
        """The same frame, for a camera at another pose."""
        if np.array_equal(published_from_camera, self.published_from_camera):
            return self
        return replace(self, published_from_camera=published_from_camera, table_in_camera=None)

    def error_at(self, distance_mm: float) -> float | None:
        """The calibration's error at a distance from the camera, mm; None: it states none."""
        rotation_mm = distance_mm * math.radians(self.error_deg)
        return None if self.error_mm is None else self.error_mm + rotation_mm


@dataclass(frozen=True, eq=False)
class CameraView:
    """What one of several cameras saw, and its pose then. ``number``: of the camera, from 1."""

    number: int
    seen: Observation
    published_from_camera: Float64[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class TransformedEstimate:
    """An estimate in the published frame, mm."""

    points_mm: Float32[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    probability: Float32[np.ndarray, " n"]
    meshes: dict[str, Mesh]
    structures: dict[str, Mesh] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RigidShape:
    """A surface that moves rigidly. ``name``: unique among a controller's shapes, with slashes
    between levels. ``still``: it neither moves nor deforms. Sinks need to send the surface again
    only when ``mesh`` is another object."""

    name: str
    mesh: Mesh  # in its own frame, mm
    published_from_shape: Float64[np.ndarray, "4 4"]
    colour: tuple[int, int, int]  # 0..255
    opacity: float = 1.0
    still: bool = False


@dataclass(frozen=True, eq=False)
class Polyline:
    """A line through points of the published frame, mm."""

    name: str
    points_mm: Float64[np.ndarray, "n 3"]
    colour: tuple[int, int, int]
    width_mm: float = 1.0


@dataclass(frozen=True, eq=False)
class ControlState:
    """What a controller does, and what is shown with it; published frame, mm.

    ``state``: its stage, in a word or two. ``stopped``: why it has stopped early, in words; empty:
    it has not. ``note``: what else a person must know, in words. ``line``: all of this, for a
    terminal. ``kind``: equal where nothing but numbers differs. ``joints_rad``: angle by name of
    the joint.
    """

    state: str
    stopped: str = ""
    note: str = ""
    line: str = ""
    kind: object = None
    joints_rad: Mapping[str, float] = field(default_factory=dict)
    shapes: tuple[RigidShape, ...] = ()
    lines: tuple[Polyline, ...] = ()

    @property
    def drawn_lines(self) -> list[Polyline]:
        return [line for line in self.lines if len(line.points_mm) > 1]

    @property
    def box_mm(self) -> Float64[np.ndarray, "2 3"] | None:
        """Of the boxes of all shapes; None without any."""
        if not self.shapes:
            return None
        boxes = np.array([shape.mesh.box_mm for shape in self.shapes])  # (n, 2, 3)
        poses = np.array([shape.published_from_shape for shape in self.shapes])
        centres = np.einsum("nij,nj->ni", poses[:, :3, :3], boxes.mean(1)) + poses[:, :3, 3]
        halves = np.einsum("nij,nj->ni", np.abs(poses[:, :3, :3]), np.ptp(boxes, axis=1) / 2)
        return np.stack([(centres - halves).min(0), (centres + halves).max(0)])


@dataclass(frozen=True, eq=False)
class TrackingResult(Renamed):
    """The loop's result for one frame: an estimate, or the reason why there is none.

    Attributes:
        sequence: number of the result, from 0; a sink that gets only the newest (``queue_size`` 1)
            sees the last one again, with no estimate, once the loop has said nothing for 2 s.
        stamp_ns: of the frame; without one, the present time on the source's clock.
        estimate: camera frame, mm; None if there is none. Never an older one.
        reason: why there is no estimate; empty with one.
        quality: the verdict. ``poor``: do not rely on it; ``warning`` says why.
        observation: what the source saw; of several cameras, the one in whose frame the estimate
            is. None without a frame, or if the camera's pose is unknown.
        organ: the points that belong to the organ; camera frame.
        seconds: duration of each stage.
        latency_ms: from the stamp to the handover to the sinks (without this machine's clock: from
            the arrival; from a lossless source: from the reading); None without a frame.
        control: what the controller does with it; None without one.
        dropped: frames so far that newer ones replaced.
        views: of several cameras, what each saw.
        cameras: in words, which cameras the estimate is from and why not from the others; of a
            scan, what each view added; else empty.
        playback: what was stored is shown: nothing is tracked, and there never is an estimate.
        finding: what ``reason`` or ``warning`` says, by its kind.
        evidence: what became known with this frame, camera frame.
    """

    sequence: int
    stamp_ns: int
    estimate: Estimate | None = None
    reason: str = ""
    quality: Quality = "none"
    warning: str = ""
    observation: Observation | None = None
    organ: SensorCloud | None = None
    published_frame: PublishedFrame = field(default_factory=PublishedFrame)
    seconds: Mapping[str, float] = field(default_factory=dict)
    latency_ms: float | None = None
    control: ControlState | None = None
    dropped: int = 0
    views: tuple[CameraView, ...] = ()
    cameras: str = ""
    playback: bool = False
    finding: Finding | None = None
    evidence: tuple[Evidence, ...] = ()

    @cached_property
    def transformed(self) -> TransformedEstimate | None:
        """Surfaces and points in the published frame. Centres: ``center_mm``, as the box of a
        turned surface has another middle."""
        if self.estimate is None:
            return None
        pose, cloud = self.published_frame.published_from_camera, self.estimate.cloud
        meshes, structures = (
            {
                name: m.with_vertices(transform_points(pose, m.vertices_mm))
                for name, m in group.items()
            }
            for group in (self.estimate.meshes, self.estimate.structures)
        )
        points_mm = transform_points(pose, cloud.points_mm)
        return TransformedEstimate(points_mm, cloud.labels, cloud.probability, meshes, structures)

    @property
    def bounds(self) -> Mapping[str, ErrorBound]:
        """How far off each part is at most (``bounds[part].error_bound95_mm``); of a good answer,
        as far as it is known: a part may be missing."""
        if self.estimate is None or self.quality != "good":
            return {}
        return self.estimate.assessment.bounds

    @property
    def camera_views(self) -> tuple[CameraView, ...]:
        """What each camera saw, also of a single one."""
        if self.views or self.observation is None:
            return self.views
        return (CameraView(1, self.observation, self.published_frame.published_from_camera),)

    def center_mm(self, part: str) -> Float64[np.ndarray, " 3"] | None:
        """The centre of a part's bounding box in the camera frame, carried to the published one."""
        mesh = None if self.estimate is None else self.estimate.meshes.get(part)
        if mesh is None:
            return None
        center_mm = mesh.box_mm.mean(0, keepdims=True)
        return transform_points(self.published_frame.published_from_camera, center_mm)[0]

    @property
    def published_from_ct(self) -> Affine | None:
        """The organ's pose without its deformation; None without a motion."""
        if self.estimate is None or (motion := self.estimate.report.motion) is None:
            return None
        return self.published_frame.published_from_camera @ np.array(motion.camera_from_ct)

    def part_pose(self, part: str) -> Affine | None:
        """A part's pose in the published frame: the origin is the centre of its box; the axes are
        the CT's, rotated with the organ, or without a motion those of the published frame."""
        center_mm, pose = self.center_mm(part), self.published_from_ct
        turn = np.eye(3) if pose is None else pose[:3, :3]
        return None if center_mm is None else rigid(turn, center_mm)

    @property
    def extra_status(self) -> str:
        """``cameras``, how much evidence is in use or was left out, and at how many places it was
        cut, in words."""
        told = () if self.estimate is None else self.estimate.report.evidence
        out = sum(piece.rejected for piece in told)
        words = f"evidence: {len(told) - out} in use, {out} left out" if told else ""
        cut = None if self.estimate is None else self.estimate.report.cut
        known = "" if cut is None else f"cut: {cut.known} places, {cut.places} in use"
        return "; ".join(filter(None, (self.cameras, words, known)))

    def describe(self) -> str:
        """How good the estimate is, in words, or why there is none."""
        if self.estimate is None:
            return f"none, no estimate: {self.reason}"
        by = self.extra_status and f"; {self.extra_status}"
        if self.quality == "good":
            bounds = bound_words(self.bounds)
            return f"good: {NO_CHECK_FAILED}; {UNVERIFIED}{bounds and f'; {bounds}'}{by}"
        return f"{self.quality}: {self.warning}{by}"


# Why a controller is stopped: by the user's ``Controls``, by a defect, as tracking has ended, or as
# the program is interrupted
StopReason = Literal["aborted", "defect", "ended", "interrupted"]


@runtime_checkable
class Controller(Protocol):
    """Moves something by the results. The loop calls it from its own thread only."""

    @property
    def ended(self) -> bool:
        """It is done; the loop ends too."""

    def act(self, result: TrackingResult) -> TrackingResult:
        """The result with its present state, for the sinks. Called with every result, with and
        without an estimate."""

    def evidence(self, camera_from_published: Affine, stamp_ns: int) -> tuple[Evidence, ...]:
        """What it knows of the organ's place in a frame; its camera's frame."""

    def stop(self, why: StopReason, words: str = "") -> None:
        """Stop for good. ``words``: of a defect."""

    def summary(self) -> dict[str, Any]:
        """What it did: further keys of the run's report."""


@dataclass(eq=False)
class Controls:
    """What the user asks of the running loop; from any thread. ``picked_mm``: a point on the organ
    (published frame): track the piece that it is on. ``aborted``: the controller stops for good.
    ``clicks``: colours at clicks in pictures; ``tissue_classifier``: the classifier learned from
    them, if they can be separated; ``colour``: its state in words. ``touched``: names of tools of
    which the user says that they touch now, or take, or let go. ``acknowledged``: evidence that
    contradicts was wrong, and what was said to be cut without a place was not cut. ``cut``: it is
    being cut, and nothing is known of where. ``forgotten``: by ``forget``, also the last estimate
    and all evidence but cuts: the organ is searched for again."""

    picked_mm: Float64[np.ndarray, " 3"] | None = None
    aborted: threading.Event = field(default_factory=threading.Event)
    clicks: tuple[Click, ...] = ()
    tissue_classifier: TissueClassifier | None = None
    colour: str = ""
    touched: deque[str] = field(default_factory=deque)
    acknowledged: threading.Event = field(default_factory=threading.Event)
    cut: threading.Event = field(default_factory=threading.Event)
    forgotten: threading.Event = field(default_factory=threading.Event)

    def click(self, seen: Observation, place_mm: Float[np.ndarray, " 3"], organ: bool) -> None:
        """The user clicked on this place (camera frame): on the ``organ``, or beside it. Raises
        InputError, and changes nothing: there is no picture, or it shows too little there."""
        from tumortrack.core.camera import project
        from tumortrack.segmentation.tissue import sample_click, train_tissue_classifier

        if seen.picture is None or not isinstance(seen.content, DepthFrame):
            raise InputError(
                "this source gives no picture to learn colours from (realsense?picture=true, "
                "ros2:TOPIC?picture=TOPIC, stereo)."
            )
        ((column, row),), _ = project(place_mm[None], seen.content.intrinsics)
        new = sample_click(seen.content, seen.picture, (round(row), round(column)), organ)
        clicks, trained = (*self.clicks, new), None
        try:
            trained = train_tissue_classifier(clicks)
            state = f"in use: {100 * trained.right:.0f} % of a click are told by the others"
        except InputError as error:
            state = f"not in use: {error}"
        count = sum(click.organ for click in clicks)
        # At once: no frame in between may be without what former clicks trained.
        self.clicks, self.tissue_classifier, self.colour = (
            clicks,
            trained,
            f"clicks: {count} on the organ, {len(clicks) - count} beside it; {state}",
        )

    def forget(self) -> None:
        self.picked_mm, self.clicks, self.tissue_classifier, self.colour = None, (), None, ""
        self.forgotten.set()


@dataclass(frozen=True, eq=False)
class SinkContext(Renamed):
    """What a sink knows when it is opened. ``parts``: of the model, the organ first, then the
    tumors; ``published_frame``: its name may change with the first frame, see each result's.
    ``anatomy_ct``: the organ in the CT (LPS, mm), if the model has it: estimates then have a
    motion, and their meshes its triangles. ``controller``: acts on results, which then have its
    state. ``patient``: of the model. ``cameras``: poses of several fixed cameras, published frame.
    ``corrected``: depths are corrected before sinks see them. ``tools``: names of what touches."""

    parts: tuple[str, ...]
    published_frame: PublishedFrame
    anatomy_ct: Anatomy | None = None
    controls: Controls = field(default_factory=Controls)
    controller: Controller | None = None
    patient: Patient = NOBODY
    cameras: tuple[Float64[np.ndarray, "4 4"], ...] = ()
    corrected: bool = False
    tools: tuple[str, ...] = ()

    @property
    def touchable(self) -> tuple[str, ...]:
        """Names of parts and structures that can be touched and outlined."""
        return self.parts if self.anatomy_ct is None else tuple(self.anatomy_ct.closed)

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the structures that move with the organ."""
        return () if self.anatomy_ct is None else tuple(self.anatomy_ct.structures)


@runtime_checkable
class Sink(Protocol):
    """An open sink. Both methods are called from one thread of its own and may take their time.
    Errors are counted and reported, and the loop goes on. An optional ``counts: dict[str, int]``
    goes into the run's report; optional ``notes``, lines of text, are printed when it is open."""

    def publish(self, result: TrackingResult) -> None: ...

    def close(self) -> None:
        """Flush and release everything; may be called twice."""


class SourceConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of source configurations. Its fields are the options on the command line, its ``tag`` is
    the kind. ``target`` names the field before the question mark in ``kind:target?key=value``;
    empty: there is none."""

    target: ClassVar[str] = ""

    def patient(self) -> Patient:
        """The patient, where the source states one. Raises TumortrackError: it cannot be read."""
        return NOBODY

    @classmethod
    def describe(cls, path: Path) -> list[str]:
        """What a file or folder that this kind plays holds, for `inspect`. Raises InputError: it
        cannot be played."""
        raise InputError(f"{path} cannot be played.")

    @abstractmethod
    def open(self) -> Source:
        """Raises SourceLost if something is missing now, InputError if it can never work."""


class SinkConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of sink configurations, as ``SourceConfig``. ``queue_size``: how many results wait for a
    slow sink before the oldest is dropped; 1: it gets the newest."""

    target: ClassVar[str] = ""
    queue_size: ClassVar[int] = 1

    def made_path(self) -> Path | None:
        """What ``open`` makes on the disk; it is removed if the run's start fails."""
        return None

    @abstractmethod
    def open(self, context: SinkContext) -> Sink:
        """Raises InputError if it cannot work: a port is taken, a folder exists."""
