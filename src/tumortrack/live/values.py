"""The values of the live loop: what a source saw, what is published of it, who takes part.

A source hands over an ``Observation``; the loop makes one ``TrackingResult`` of it; every sink gets
every result, or the newest if it is slow. Source and sink are each one file with a configuration
whose ``open`` makes it: see ``live.sources`` and ``live.sinks``.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from tumortrack.core.config import Config
from tumortrack.core.errors import TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, DepthFrame, Mesh, SensorCloud

Quality = Literal["good", "poor", "none"]


class SourceLost(TumortrackError):
    """The source is gone for now: unplugged, killed, its file unreadable. Opening it again may
    help, and the loop tries."""

    exit_code = 3


class SourceEnded(TumortrackError):
    """The source has nothing more to give, as a recording at its end. No fault."""

    exit_code = 0


@dataclass(frozen=True, eq=False)
class Observation:
    """What a source saw at one instant; camera frame, mm.

    Attributes:
        content: a depth image or a cloud, with the ``stamp_ns`` of its exposure.
        arrived_ns: when it reached this program, by ``time.time_ns``.
        mask: of a depth image, True where the organ may be; None where nobody said.
        truth: the true surfaces, where the source makes its own world.
    """

    content: DepthFrame | SensorCloud
    arrived_ns: int
    mask: Bool[np.ndarray, "h w"] | None = None
    truth: Anatomy | None = None

    @property
    def stamp_ns(self) -> int:
        return self.content.stamp_ns


@runtime_checkable
class Source(Protocol):
    """An open source. ``read`` is called from one thread, ``close`` perhaps from another."""

    # Stamps are this machine's time.time_ns: the frame's age is known. True of the frame read last;
    # before the first one it may not be known.
    host_clock: bool
    waits: bool  # every frame counts: the loop takes each, instead of the newest

    @property
    def dropped(self) -> int:
        """Frames that never got out of the source, as far as it knows."""
        ...

    def read(self, timeout_s: float) -> Observation | None:
        """The newest frame not yet given; None if none came in time.

        Raises:
            SourceLost: there is nothing to wait for any more.
            SourceEnded: that was all.
            InputError: what came can't be used (a message of another kind, say); the loop says so
                and reads on.
        """
        ...

    def close(self) -> None:
        """Give everything back; may be called twice."""
        ...


@dataclass(frozen=True, eq=False)
class PublishedFrame:
    """In which frame results are published: ``frame_id``, and the way there from the camera."""

    frame_id: str = "camera"
    published_from_camera: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class TransformedEstimate:
    """An estimate in the frame in which it is published, mm."""

    points_mm: Float32[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    probability: Float32[np.ndarray, " n"]
    meshes: dict[str, Mesh]


@dataclass(frozen=True, eq=False)
class RigidShape:
    """A surface that moves as a whole: a link of an arm, a table, a planned piece.

    ``name`` is its own within a workcell, with slashes between levels (``cutter/forearm``).
    Sinks send the surface again only where ``mesh`` is another object than before, and else its
    place alone.
    """

    name: str
    mesh: Mesh  # in its own frame, mm
    published_from_shape: Float64[np.ndarray, "4 4"]
    colour: tuple[int, int, int]  # 0..255
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Polyline:
    """A line through points of the published frame, mm: a cut, an instrument's way."""

    name: str
    points_mm: Float64[np.ndarray, "n 3"]
    colour: tuple[int, int, int]
    width_mm: float = 1.0


@dataclass(frozen=True, eq=False)
class Workcell:
    """What arms do at this moment, and what is shown with them; published frame, mm.

    Attributes:
        state: of the procedure: approach, grasp, hold, sweep 1, ...
        halted: why the arms stand still though they have not ended; empty: they don't.
        joints_rad: angle by joint's name; empty without arms.
    """

    state: str
    halted: str = ""
    joints_rad: Mapping[str, float] = field(default_factory=dict)
    shapes: tuple[RigidShape, ...] = ()
    lines: tuple[Polyline, ...] = ()


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """What the loop says about one frame: an estimate, or the reason why there is none.

    Attributes:
        sequence: counts up by one an update, from 0.
        stamp_ns: of the frame; where none came, of the moment, by ``time.time_ns``.
        estimate: camera frame, mm; None where nothing can be said. Never an older one.
        reason: why there is no estimate; empty with one.
        quality: none without an estimate; poor where it should not be relied on: ``warning``
            then says why.
        seen, organ: the frame, and those of its points that were taken for the organ's; camera
            frame.
        frames: where it is published.
        seconds: time of each stage.
        workcell: what arms do with it; None without arms.
        latency_ms: from the stamp (of a source without this machine's clock: from the arrival; of
            one that waits for the loop: from the taking) to the moment at which the update was
            handed to the sinks; None where no frame came.
    """

    sequence: int
    stamp_ns: int
    estimate: Estimate | None = None
    reason: str = ""
    quality: Quality = "none"
    warning: str = ""
    seen: Observation | None = None
    organ: SensorCloud | None = None
    frames: PublishedFrame = field(default_factory=PublishedFrame)
    seconds: Mapping[str, float] = field(default_factory=dict)
    latency_ms: float | None = None
    workcell: Workcell | None = None

    @cached_property
    def placed(self) -> TransformedEstimate | None:
        """The estimate in the published frame: what sinks send."""
        if self.estimate is None:
            return None
        way = self.frames.published_from_camera
        cloud = self.estimate.cloud
        meshes = {
            name: mesh.moved(transform_points(way, mesh.vertices_mm))
            for name, mesh in self.estimate.meshes.items()
        }
        points_mm = transform_points(way, cloud.points_mm)
        return TransformedEstimate(points_mm, cloud.labels, cloud.probability, meshes)


@runtime_checkable
class Companion(Protocol):
    """Who acts on estimates as part of the loop: arms. Called from the loop's thread alone."""

    @property
    def ended(self) -> bool:
        """There is nothing more to do; the loop ends too."""
        ...

    def act(self, update: TrackingResult) -> TrackingResult:
        """The update as sinks get it, with the workcell as it is now. Called with every update,
        also where there is no estimate."""
        ...

    def abort(self, reason: str) -> None:
        """Stop for good."""
        ...


class Controls:
    """What the user asks of the running loop, from whichever thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.aborted = threading.Event()  # arms stop for good
        self._picked_mm: Float64[np.ndarray, " 3"] | None = None

    def pick(self, point_mm: Float64[np.ndarray, " 3"] | None) -> None:
        """This point (camera frame, mm) lies on the organ: take the piece that it is on. None:
        choose again without."""
        with self._lock:
            self._picked_mm = point_mm

    @property
    def picked_mm(self) -> Float64[np.ndarray, " 3"] | None:
        with self._lock:
            return self._picked_mm


@dataclass(frozen=True, eq=False)
class SinkContext:
    """What a sink may know from the start. ``anatomy_ct``: the organ in the CT (LPS, mm), where
    the model has it: estimates then have a motion, and their meshes its triangles. ``arms``:
    updates may carry a workcell."""

    parts: tuple[str, ...]
    frames: PublishedFrame
    anatomy_ct: Anatomy | None = None
    controls: Controls = field(default_factory=Controls)
    arms: bool = False


@runtime_checkable
class Sink(Protocol):
    """An open sink. ``publish`` and ``close`` are called from one thread of its own, so it may
    take its time; an error it raises is counted and said, and the loop goes on."""

    def publish(self, update: TrackingResult) -> None: ...

    def close(self) -> None:
        """Flush and give everything back; may be called twice."""
        ...


@runtime_checkable
class Counting(Protocol):
    """A sink that has more to say of its updates, for the run's report."""

    @property
    def counts(self) -> dict[str, int]: ...


class SourceConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of every source's configuration. ``target`` names the field that stands before the
    question mark in ``kind:target?key=value``; empty: the kind has none."""

    target: ClassVar[str] = ""

    @abstractmethod
    def open(self) -> Source:
        """Raises SourceLost where what it needs is not there now, InputError where it never can
        be."""


class SinkConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of every sink's configuration; ``target`` as in ``SourceConfig``. ``waiting``: how many
    updates may wait for it before it loses some; 1: it gets the newest."""

    target: ClassVar[str] = ""
    waiting: ClassVar[int] = 1

    @abstractmethod
    def open(self, setting: SinkContext) -> Sink:
        """Raises InputError where it cannot work: a port taken, a folder that exists."""
