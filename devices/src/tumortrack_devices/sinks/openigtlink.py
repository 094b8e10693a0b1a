"""OpenIGTLink: positions of tumors, surfaces and status for 3D Slicer, PLUS and other receivers.

Slicer takes what it receives as RAS. Our files are LPS and declared so; to coincide with them,
x and y are sent negated (``space="lps"``: as they are).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import ClassVar, Literal

import numpy as np

from tumortrack.core.assessment import centre_label
from tumortrack.core.colours import TO_CUT, name_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS, transform_points
from tumortrack.core.mesh_query import rough_margin
from tumortrack.core.types import Mesh
from tumortrack.io.run_folder import CENTRES, CT, MARGIN
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack_devices.extra_status import ExtraStatus
from tumortrack_devices.igtl import message as igtl
from tumortrack_devices.igtl.link import Link
from tumortrack_devices.igtl.message import Message
from tumortrack_devices.network import Rate, is_loopback

STATUS_DEVICE, CLOUD_DEVICE, ARMS_DEVICE = "tumortrack", "occupancy", "arms"
TOUCH_DEVICE = "next_touch"
_TIP = "/tip"  # the end of the names of shapes at tool tips
_NOTHING = igtl.pack_polydata(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
_Content = tuple[str, str, bytes, dict[str, str]]  # type, device, content, own metadata


class OpenIgtLinkSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="openigtlink"):
    """A server that 3D Slicer connects to, or, with ``connect``, a client of one.

    Attributes:
        port: the protocol's default is 18944; 0: a free one.
        host: which of this machine's addresses to serve; 0.0.0.0: all, for other machines.
        connect: host of a server to connect to instead.
        mesh_hz: limit for surfaces; 0: none.
        cloud_hz: limit for the labelled cloud; 0: none.
        space: ras negates x and y, for 3D Slicer; lps sends what is published.
    """

    target: ClassVar[str] = "port"

    port: int = 18944
    host: str = "127.0.0.1"
    connect: str = ""
    mesh_hz: float = 10.0
    cloud_hz: float = 0.0
    space: Literal["ras", "lps"] = "ras"

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535 or (self.connect and not self.port):
            raise InputError(f"openigtlink: port {self.port} must lie in 1..65535.")
        self.check_ranges("openigtlink:", "0 (none)", mesh_hz=1000, cloud_hz=1000)

    def open(self, context: SinkContext) -> OpenIgtLinkSink:
        if long := [name for name in context.parts if len(name) > igtl.LONGEST_DEVICE]:
            raise InputError(
                f"openigtlink: {long[0]!r} has {len(long[0])} letters, and OpenIGTLink allows "
                f"{igtl.LONGEST_DEVICE}. Prepare the case with a shorter --name."
            )
        return OpenIgtLinkSink(self, context)


class OpenIgtLinkSink:
    """Per result: STATUS ``tumortrack``, TRANSFORM of each tumor, POINT ``tumors`` (their centres,
    labelled with how far off they are at most), POINT ``next_touch`` (the best places of the organ
    to touch next, from the first advice on), and POLYDATA of each part and, round each tumor, of a
    shell as far off as it may be.

    With a motion TRANSFORM ``ct`` is the organ's pose. Without an estimate STATUS says why, no
    transform is sent, not to a new receiver either, and all else is empty.

    With arms also STATUS ``arms`` (OK: its name is their state; not ready: halted, and why; not
    present: unknown), and a TRANSFORM of each tool tip, named as its shape (``cutter/tip``): from
    the tip's own frame, while it is known.
    """

    def __init__(self, config: OpenIgtLinkSinkConfig, context: SinkContext) -> None:
        self._config, self._context = config, context
        self._axes = RAS_FROM_LPS if config.space == "ras" else np.eye(4)
        self.link = Link(config.host, config.port, config.connect)
        self._mesh_rate, self._cloud_rate = Rate(config.mesh_hz), Rate(config.cloud_hz)
        self._margins: set[str] = set()  # all so far
        self._extra_status, self._advised = ExtraStatus(), False
        self._next, self._closed = 0, False

    @property
    def notes(self) -> tuple[str, ...]:
        host, port = self._config.host, self.link.port
        if self._config.connect:
            return ()
        if is_loopback(host):
            return (f"serving on {host}:{port}, this machine alone",)
        return (f"anyone in this network can see the patient's organ on port {port} of {host}",)

    def publish(self, result: TrackingResult) -> None:
        self._send(result, igtl.OK if result.estimate is not None else igtl.NOT_FOUND)
        self._next = result.sequence + 1

    def close(self) -> None:
        """Send that tracking has ended, so that nothing looks current."""
        if not self._closed:
            self._closed = True
            frame, why = self._context.published_frame, "tracking has ended"
            over = TrackingResult(self._next, time.time_ns(), reason=why, published_frame=frame)
            self._send(over, igtl.EXITING)
            self.link.close()

    def _send(self, result: TrackingResult, code: int) -> None:
        about = {"frame_id": result.published_frame.frame_id, "sequence": str(result.sequence)}
        about |= {"patient": self._context.patient.id, "side": self._context.patient.side}
        contents = [
            *self._statuses(result, code),
            *self._transforms(result),
            *self._centres(result),
            *self._touches(result),
            *self._surfaces(result),
            *self._cloud(result),
        ]
        self.link.send(
            [
                Message(kind, device, result.stamp_ns, content, about | more)
                for kind, device, content, more in contents
            ],
            whole=["TRANSFORM"],
        )

    def _statuses(self, result: TrackingResult, code: int) -> Iterator[_Content]:
        name, text = str(result.quality), result.describe()
        if result.estimate is None:
            name, text = "no estimate", result.reason
        more = {"quality": str(result.quality)}
        if result.latency_ms is not None:
            more["latency_ms"] = f"{result.latency_ms:.1f}"
        yield "STATUS", STATUS_DEVICE, igtl.pack_status(code, name, text), more
        control = result.control
        if self._context.controller is None:
            return
        status, more = (igtl.NOT_PRESENT, "unknown", "nothing is known of the arms"), {}
        if control is not None:
            code = igtl.NOT_READY if control.stopped else igtl.OK
            status, more = (code, control.state, control.stopped), {"state": control.state}
        yield "STATUS", ARMS_DEVICE, igtl.pack_status(*status), more

    def _transforms(self, result: TrackingResult) -> Iterator[_Content]:
        poses = {name: result.part_pose(name) for name in self._context.parts[1:]}
        if self._context.anatomy_ct is not None:
            poses[CT] = result.published_from_ct
        control = None if self._context.controller is None else result.control
        shapes = () if control is None else control.shapes
        tips = {s.name: s.published_from_shape for s in shapes if s.name.endswith(_TIP)}
        for name, pose in (poses | tips).items():
            if pose is not None:
                sent = igtl.pack_transform(self._axes @ pose @ self._axes)
                yield "TRANSFORM", name, sent, {"TransformStatus": "OK"}

    def _centres(self, result: TrackingResult) -> Iterator[_Content]:
        tumors = self._context.parts[1:]
        centres = {n: mm for n in tumors if (mm := result.center_mm(n)) is not None}
        labels = [centre_label(name, result.bounds, result.quality != "good") for name in centres]
        points_mm = transform_points(self._axes, np.reshape([*centres.values()], (-1, 3)))
        if tumors:
            colours = [name_colour(name) for name in centres]
            yield "POINT", CENTRES, igtl.pack_points(points_mm, labels, colours), {}

    def _touches(self, result: TrackingResult) -> Iterator[_Content]:
        self._extra_status.update(result)
        touches = self._extra_status.touches
        self._advised |= bool(touches)
        if self._advised:
            places_mm = np.reshape([touch.place_mm for touch in touches], (-1, 3))
            labels = [touch.label for touch in touches]
            content = transform_points(self._axes, places_mm), labels, [TO_CUT] * len(touches)
            yield "POINT", TOUCH_DEVICE, igtl.pack_points(*content), {}

    def _surfaces(self, result: TrackingResult) -> Iterator[_Content]:
        """Surfaces that are gone are emptied at once; others wait until they are due."""
        estimate = result.transformed
        contents: dict[str, bytes] = {}
        if self._config.mesh_hz:
            due = estimate is None or self._mesh_rate.due()
            meshes = {**estimate.meshes, **estimate.structures} if estimate else {}
            for name in (*self._context.parts, *self._context.structures):
                if (mesh := meshes.get(name)) is None:
                    contents[name] = _NOTHING
                elif due:
                    contents[name] = self._surface(mesh)
            for name in self._context.parts[1:]:  # as far off as the tumor may be
                mesh, bound, shell = meshes.get(name), result.bounds.get(name), name + MARGIN
                if mesh is None or bound is None:
                    contents |= {shell: _NOTHING} if shell in self._margins else {}
                elif due:
                    self._margins.add(shell)
                    contents[shell] = self._surface(rough_margin(mesh, bound.error_bound95_mm))
        for name, content in contents.items():
            yield "POLYDATA", name, content, {}

    def _cloud(self, result: TrackingResult) -> Iterator[_Content]:
        estimate, content = result.transformed, _NOTHING
        if not self._config.cloud_hz or (estimate is not None and not self._cloud_rate.due()):
            return
        if estimate is not None:
            # Each point is a line of length 0: Slicer shows only points of cells, and its reader
            # does not support cells of one point.
            segments = np.repeat(np.arange(len(estimate.points_mm))[:, None], 2, axis=1)
            content = igtl.pack_polydata(
                transform_points(self._axes, estimate.points_mm),
                np.zeros((0, 3), np.int32),
                segments,
                label=estimate.labels,
                probability=estimate.probability,
            )
        yield "POLYDATA", CLOUD_DEVICE, content, {}

    def _surface(self, mesh: Mesh) -> bytes:
        return igtl.pack_polydata(transform_points(self._axes, mesh.vertices_mm), mesh.faces)
