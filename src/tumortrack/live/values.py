"""The values of live tracking, and what a source and a sink must be.

A source hands over an ``Observation``. The loop makes one ``TrackingResult`` of it. Every sink gets
every result or, if it is slow, the newest. A source or sink is one file: a configuration whose
``open`` makes it. Other packages add their own: see ``live.spec`` and docs/live.md.
"""

from __future__ import annotations

import math
import threading
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED, Estimate, Quality
from tumortrack.core.geometry import transform_points
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.types import Anatomy, DepthFrame, Mesh, SensorCloud
from tumortrack.models.margins import margin_words

if TYPE_CHECKING:
    from tumortrack.sense.region.taught import Click, Taught


class SourceLost(TumortrackError):
    """The source is gone for now: unplugged, killed, unreadable. It is opened again."""

    exit_code = 3


class SourceEnded(TumortrackError):
    """The source has nothing more to give, as a recording at its end. Not a fault."""

    exit_code = 0


@dataclass(frozen=True, eq=False)
class Observation:
    """What a source observed at one instant; camera frame, mm.

    ``content`` has the ``stamp_ns`` of its exposure. ``arrived_ns``: when it reached this program,
    by ``time.time_ns``. ``mask``: of a depth image: True where the organ may be. ``truth``: the
    true surfaces, where the source simulates them. ``frame_id``: what the source calls the camera's
    frame; None: it is of a kind that calls it nothing. ``picture``: what the camera saw in the
    pixels of the depth image: grey, or red, green and blue.
    """

    content: DepthFrame | SensorCloud
    arrived_ns: int
    mask: Bool[np.ndarray, "h w"] | None = None
    truth: Anatomy | None = None
    frame_id: str | None = None
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None

    @property
    def stamp_ns(self) -> int:
        return self.content.stamp_ns


@runtime_checkable
class Source(Protocol):
    """An open source. One thread calls ``read``; another may call ``close``."""

    # Stamps are this machine's time.time_ns, so the age of a frame is known; of the one read last.
    host_clock: bool
    lossless: bool  # every frame is processed, not only the newest: the source waits for the loop

    @property
    def dropped(self) -> int:
        """Frames lost inside the source, as far as it knows."""
        ...

    def read(self, timeout_s: float) -> Observation | None:
        """The newest frame that was not read before; None if none came in time. Raises SourceLost,
        SourceEnded: as they say; InputError: this frame cannot be used; the loop reports it and
        reads on."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


@dataclass(frozen=True, eq=False)
class PublishedFrame:
    """Where results are published. Of a calibration also (``calibrated``), as far as its file
    says it: ``camera_frame_id``, what sources call the camera's frame; ``table_in_camera``: unit
    normal and offset (mm) of the table's plane, ``normal @ point = offset``, when it was made;
    ``error_mm`` and ``error_deg``: bounds of its error, at the camera and of its direction.
    ``moves``: the camera is meant to; then each result has where it was."""

    frame_id: str = "camera"
    published_from_camera: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    calibrated: bool = False
    camera_frame_id: str = ""
    table_in_camera: tuple[float, float, float, float] | None = None
    error_mm: float | None = None
    error_deg: float = 0.0
    moves: bool = False

    def of_camera(self, published_from_camera: Float64[np.ndarray, "4 4"]) -> PublishedFrame:
        """The same frame, for a camera that stands there."""
        if np.array_equal(published_from_camera, self.published_from_camera):
            return self
        return replace(self, published_from_camera=published_from_camera, table_in_camera=None)

    def error_at(self, distance_mm: float) -> float | None:
        """The calibration's error so far from the camera, mm; None: it states none."""
        turned_mm = distance_mm * math.radians(self.error_deg)
        return None if self.error_mm is None else self.error_mm + turned_mm


@dataclass(frozen=True, eq=False)
class CameraView:
    """What one of the cameras saw, and where it was then. ``number``: the camera's, from 1."""

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
    """A surface that moves rigidly: a link of an arm, a table, a planned piece. ``name`` is unique
    within a workcell, with slashes between levels (``cutter/forearm``). Sinks send the surface
    again only if ``mesh`` is another object than before, otherwise its pose alone."""

    name: str
    mesh: Mesh  # in its own frame, mm
    published_from_shape: Float64[np.ndarray, "4 4"]
    colour: tuple[int, int, int]  # 0..255
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Polyline:
    """A line through points of the published frame, mm: a cut, an instrument's path."""

    name: str
    points_mm: Float64[np.ndarray, "n 3"]
    colour: tuple[int, int, int]
    width_mm: float = 1.0


@dataclass(frozen=True, eq=False)
class Workcell:
    """What the arms do now, and what is shown with them; published frame, mm.

    ``state``: of the procedure: approach, grasp, hold, sweep 1, ... ``halted``: why the arms stand
    still before their end; empty: they do not. ``joints_rad``: angle by the joint's name.
    ``left_mm``: of the planned margin, once all errors of the moment are taken off; None: unknown.
    ``cutting``: the instrument is on a cut.
    """

    state: str
    halted: str = ""
    joints_rad: Mapping[str, float] = field(default_factory=dict)
    shapes: tuple[RigidShape, ...] = ()
    lines: tuple[Polyline, ...] = ()
    left_mm: float | None = None
    cutting: bool = False

    @property
    def drawn_lines(self) -> list[Polyline]:
        """The lines that have a length."""
        return [line for line in self.lines if len(line.points_mm) > 1]

    @property
    def box_mm(self) -> Float64[np.ndarray, "2 3"] | None:
        """The box round the boxes of all shapes, where they are now; None without any."""
        if not self.shapes:
            return None
        boxes = np.array([shape.mesh.box_mm for shape in self.shapes])  # (n, 2, 3)
        poses = np.array([shape.published_from_shape for shape in self.shapes])
        middles = np.einsum("nij,nj->ni", poses[:, :3, :3], boxes.mean(1)) + poses[:, :3, 3]
        halves = np.einsum("nij,nj->ni", np.abs(poses[:, :3, :3]), np.ptp(boxes, axis=1) / 2)
        return np.stack([(middles - halves).min(0), (middles + halves).max(0)])


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """The loop's result for one frame: an estimate, or the reason why there is none.

    Attributes:
        sequence: number of the result, from 0.
        stamp_ns: of the frame; if none came, the present by the source's clock.
        estimate: camera frame, mm; None where nothing can be said. Never an older one.
        reason: why there is no estimate; empty with one.
        quality: ``poor``: it should not be relied on, and ``warning`` says why.
        observation: what the source saw, of several cameras the one in whose frame the estimate
            is; None if no frame came, or where the camera was is unknown.
        organ: its points that belong to the organ; camera frame.
        seconds: duration of each stage.
        latency_ms: until the result was handed to the sinks, from the stamp (if the source does
            not have this machine's clock: from the arrival; if it waits for the loop: from the
            reading); None if no frame came.
        workcell: what the arms do with it; None without arms.
        dropped: frames so far that newer ones overtook.
        views: of several cameras: what each saw. ``cameras``: which of them the estimate is from,
            and of the others why not; of a scan what each look added. In words; else empty.
        playback: a stored plan is shown; nothing is tracked, and there never is an estimate.
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
    workcell: Workcell | None = None
    dropped: int = 0
    views: tuple[CameraView, ...] = ()
    cameras: str = ""
    playback: bool = False

    @cached_property
    def transformed(self) -> TransformedEstimate | None:
        """The estimate in the published frame: what sinks send."""
        if self.estimate is None:
            return None
        way, cloud = self.published_frame.published_from_camera, self.estimate.cloud
        meshes, structures = (
            {name: one.moved(transform_points(way, one.vertices_mm)) for name, one in some.items()}
            for some in (self.estimate.meshes, self.estimate.structures)
        )
        points_mm = transform_points(way, cloud.points_mm)
        return TransformedEstimate(points_mm, cloud.labels, cloud.probability, meshes, structures)

    def center_mm(self, part: str) -> Float64[np.ndarray, " 3"] | None:
        """The centre of a part's box (of its axes in the camera frame), in the published frame."""
        mesh = None if self.estimate is None else self.estimate.meshes.get(part)
        if mesh is None:
            return None
        center_mm = mesh.box_mm.mean(0, keepdims=True)
        return transform_points(self.published_frame.published_from_camera, center_mm)[0]

    def describe(self) -> str:
        """How good the estimate is, in words for people, or why there is none."""
        if self.estimate is None:
            return f"none, no estimate: {self.reason}"
        by = self.cameras and f"; {self.cameras}"
        if self.quality == "good":
            margins = margin_words(self.estimate.report.margin)
            return f"good: {NO_CHECK_FAILED}; {UNVERIFIED}; {margins}{by}"
        return f"{self.quality}: {self.warning}{by}"


@runtime_checkable
class ArmsController(Protocol):
    """Moves arms by the results. The loop calls it from its own thread alone."""

    @property
    def ended(self) -> bool:
        """The procedure is over; the loop ends too."""
        ...

    def act(self, result: TrackingResult) -> TrackingResult:
        """The result with the present workcell, as sinks get it. Called with every result, with and
        without an estimate."""
        ...

    def abort(self, reason: str) -> None:
        """Stop the arms for good."""
        ...

    def summary(self) -> dict[str, Any]:
        """What they did, for a run's report."""
        ...


@dataclass(eq=False)
class Controls:
    """What the user asks of the running loop; from any thread. ``picked_mm``: this point (published
    frame) lies on the organ: track the piece that it is on. ``aborted``: the arms stop for good.
    ``clicks``: what clicks in pictures showed; ``taught``: what follows from them, as far as they
    can be told apart; ``colour``: how far, in words."""

    picked_mm: Float64[np.ndarray, " 3"] | None = None
    aborted: threading.Event = field(default_factory=threading.Event)
    clicks: tuple[Click, ...] = ()
    taught: Taught | None = None
    colour: str = ""

    def click(self, seen: Observation, place_mm: Float[np.ndarray, " 3"], organ: bool) -> None:
        """The user clicked on this place (camera frame), and says whether it is the organ's. Raises
        InputError: there is no picture, or it shows too little there; then nothing changes."""
        from tumortrack.sense.camera import project
        from tumortrack.sense.region.taught import look, teach

        if seen.picture is None or not isinstance(seen.content, DepthFrame):
            raise InputError(
                "this source gives no picture to learn colours from (realsense?picture=true, "
                "ros2:TOPIC?picture=TOPIC, stereo)."
            )
        ((column, row),), _ = project(place_mm[None], seen.content.intrinsics)
        new = look(seen.content, seen.picture, (round(row), round(column)), organ)
        self.clicks, self.taught = (*self.clicks, new), None
        try:
            self.taught = teach(self.clicks)
            said = f"in use: {100 * self.taught.right:.0f} % of a click are told by the others"
        except InputError as error:
            said = f"not in use: {error}"
        count = sum(one.organ for one in self.clicks)
        beside = len(self.clicks) - count
        self.colour = f"clicks: {count} on the organ, {beside} beside it; {said}"

    def forget(self) -> None:
        """Whatever was clicked on."""
        self.picked_mm, self.clicks, self.taught, self.colour = None, (), None, ""


@dataclass(frozen=True, eq=False)
class SinkContext:
    """What a sink knows when it is opened. ``parts``: the model's, the organ first. ``anatomy_ct``:
    the organ in the CT (LPS, mm), if the model has it: estimates then have a motion, and their
    meshes its triangles. ``arms``: results may have a workcell. ``patient``: whose organ the model
    is of. ``cameras``: where several stand still, published frame. ``tip_mm``: where the tool's tip
    of an arm (cutter, holder) is, by the arm's six joints; published frame. ``corrected``: depths
    are corrected before sinks see them."""

    parts: tuple[str, ...]
    published_frame: PublishedFrame
    anatomy_ct: Anatomy | None = None
    controls: Controls = field(default_factory=Controls)
    arms: bool = False
    patient: Patient = NOBODY
    cameras: tuple[Float64[np.ndarray, "4 4"], ...] = ()
    tip_mm: Callable[[str, Float64[np.ndarray, " 6"]], Float64[np.ndarray, " 3"]] | None = None
    corrected: bool = False

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of what else moves with the organ."""
        return () if self.anatomy_ct is None else tuple(self.anatomy_ct.structures)


@runtime_checkable
class Sink(Protocol):
    """An open sink. Both methods are called from one thread of its own, so they may take their
    time. Errors are counted and reported, and the loop goes on. A ``counts: dict[str, int]``, if
    there is one, goes into the run's report; ``notes``, lines of text, are told when it is open."""

    def publish(self, result: TrackingResult) -> None: ...

    def close(self) -> None:
        """Flush and release everything; may be called twice."""
        ...


class SourceConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of every source's configuration; its fields are the options on the command line, its
    ``tag`` is the kind's name. ``target`` names the field that stands before the question mark in
    ``kind:target?key=value``; empty: there is none."""

    target: ClassVar[str] = ""

    def patient(self) -> Patient:
        """Whose organ it shows, as far as it says so. Raises TumortrackError: what it says cannot
        be read."""
        return NOBODY

    @abstractmethod
    def open(self) -> Source:
        """Raises SourceLost if what it needs is missing now, InputError if it can never work."""


class SinkConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of every sink's configuration, as ``SourceConfig``. ``queue_size``: how many results
    wait for a slow sink before the oldest is dropped; 1: it gets the newest."""

    target: ClassVar[str] = ""
    queue_size: ClassVar[int] = 1

    @abstractmethod
    def open(self, context: SinkContext) -> Sink:
        """Raises InputError if it cannot work: a port is taken, a folder exists."""
