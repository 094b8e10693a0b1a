"""A tracked tool (PLUS and others), and what is drawn in 3D Slicer, over OpenIGTLink.

TRANSFORM is a tool's pose, STRING says when it touches. A fiducial (POINT) named as a part is a
touch of that part, and places (POLYDATA) named as a part are an outline of it. They count as soon
as they have not been changed for a moment: they are sent at every movement of the mouse. IMAGEs of
labels beside the TRANSFORM of an ultrasound probe are outlines too.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.evidence import Outline, Touch
from tumortrack.core.geometry import RAS_FROM_LPS, Affine, transform_points
from tumortrack.live.poses import PoseBuffer
from tumortrack.live.values import SinkContext
from tumortrack_devices.igtl import message as igtl
from tumortrack_devices.igtl.link import Link
from tumortrack_devices.igtl.message import Header
from tumortrack_devices.tools.label_planes import LabelPlanes
from tumortrack_devices.tools.tip import Piece, TipConfig, TipTool

_SETTLED_S = 0.5  # a drawn piece that has not changed for so long is meant
_SILENT_S = 5.0  # without a connection, or without the tool's pose, before it is said
_MOST_DEVICES = 20  # that are named
# Behind this machine's clock: a sender that is no more has the same time, and its stamps count.
_LAG_NS, _AHEAD_NS, _OTHER_CLOCK_NS = 100_000_000, 5_000_000, 1_000_000_000
_MOST_DRAWN = 200  # pieces under way
_APART_MM, _MOST_PLACES = 3.0, 100  # of an outline: nearer places share their error
_MEANT = {"1": True, "true": True, "on": True, "0": False, "false": False, "off": False}


class OpenIgtLinkToolConfig(TipConfig, frozen=True, kw_only=True, tag="openigtlink"):
    """``address``: HOST[:PORT] of a server to connect to (PlusServer; 18944), or PORT alone to be
    the server (3D Slicer connects), where 18944 may be the sink's.

    Attributes:
        name: device of the tool's TRANSFORM, of which 20 characters count; empty: there is no tool,
            only what is drawn.
        image: device of IMAGEs of labels (1: the organ, 2: tumor_1, ...), or of masks of ``part``.
        image_to_probe: as of `locate`, from the IMAGE's frame (pixels, or as its own matrix has
            it) to that of the TRANSFORM. Without it and name= that matrix states its pose.
        lag_s: by which stamps of images are late.
        contact: device of a STRING that is 1 while the tip touches, else 0.
        space: ras negates x and y, as 3D Slicer has them; lps takes them as they are. Default: ras
            of who connects to us, lps of a server. An IMAGE that states its pose and that it is LPS
            is taken as it is.
        clock: when a pose or contact was: sender: by its stamp; arrival: as it comes; auto: by its
            stamp if that of the first is at most 0.1 s old, else the clocks differ: as it comes.
        host: as the server: which of this machine's addresses; 0.0.0.0: all.
    """

    target: ClassVar[str] = "address"

    address: str = "18945"
    name: str = ""
    image: str = ""
    image_to_probe: Path | None = None
    lag_s: float = 0.0
    contact: str = "contact"
    space: Literal["", "ras", "lps"] = ""
    clock: Literal["auto", "sender", "arrival"] = "auto"
    host: str = "127.0.0.1"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.port_text.isdecimal() or not 0 <= int(self.port_text) <= 65535:
            raise InputError(f"openigtlink: {self.address!r} is not HOST, HOST:PORT or PORT.")
        self.check_between("openigtlink:", lag_s=(-0.4, 2))  # images and poses wait so long
        placed = bool(self.image and self.name)
        if placed is (self.image_to_probe is None) or (self.lag_s and not placed):
            needed = "name=, image= and image_to_probe=FILE (then also lag_s=), or image= alone"
            raise InputError(f"openigtlink: images need {needed}, if their matrix is their pose.")

    @property
    def server(self) -> str:
        """To connect to; empty: this is the server."""
        host, _, port = self.address.rpartition(":")
        return host or ("" if port.isdecimal() else port)

    @property
    def port_text(self) -> str:
        port = self.address.rpartition(":")[2]
        return "18944" if port == self.server else port

    def open(self, context: SinkContext, name: str) -> OpenIgtLinkTool:
        return OpenIgtLinkTool(self, context, name)


class OpenIgtLinkTool(TipTool):
    """``link``: the connection."""

    def __init__(self, config: OpenIgtLinkToolConfig, context: SinkContext, name: str) -> None:
        super().__init__(config, context, name, "" if config.name or config.image else None)
        self._device, self._image_device, self._contact_device = (
            name[: igtl.LONGEST_DEVICE] for name in (config.name, config.image, config.contact)
        )
        self._came = dict[tuple[str, str], None]()  # types and devices
        expected = {"TRANSFORM": self._device, "IMAGE": self._image_device}
        self._expected = {kind: device for kind, device in expected.items() if device}
        self._absent, self._apart_s = "", time.monotonic()
        self._watched = config.clock == "auto"
        self._stamped: bool | None = {"sender": True, "arrival": False}.get(config.clock)
        ras = config.space == "ras" or not (config.space or config.server)
        self._axes = RAS_FROM_LPS if ras else np.eye(4)
        self._poses, self._lock = PoseBuffer(), threading.Lock()
        # By device and number of the fiducial; when each was changed last; None: it was given.
        self._drawn: dict[tuple[str, int], tuple[Piece, float | None]] = {}
        self._heard_fault, self._server, self._reached_s = "", config.server, time.monotonic()
        about = context.parts, config.part, self._axes, config.image_to_probe
        self._lag_ns, self._planes = round(config.lag_s * 1e9), LabelPlanes(*about)
        self._readers = {
            "TRANSFORM": self._hear_pose,
            "STRING": self._hear_contact,
            "POINT": self._hear_points,
            "POLYDATA": self._hear_outline,
        }
        if config.image:
            self._readers["IMAGE"] = self._hear_image
        self.link = Link(
            *(config.host, int(config.port_text), config.server),
            *(self._heard, self._faulty, self._readers),
        )

    def pose(self, stamp_ns: int) -> Affine:
        return self._poses.at(stamp_ns)

    def refresh(self, stamp_ns: int) -> None:
        fault, self._heard_fault = self._heard_fault, ""
        now_s = time.monotonic()
        if not self.link.receivers:
            self._apart_s = now_s
        elif self._expected and now_s - self._apart_s > _SILENT_S:
            self._absent = self._absent or self._other_words()
            fault = fault or self._absent
        if not self._server or self.link.receivers:
            self._reached_s = now_s
        elif now_s - self._reached_s > _SILENT_S:
            fault = f"nothing answers at {self._server}:{self.link.port}; it is tried again"
        self.trouble = fault or self.trouble

    def drawn(self) -> list[Piece]:
        now_s, done = time.monotonic(), list[Piece]()
        try:
            for piece in self._planes.pieces(self._poses, self._lag_ns):
                done.append(piece)
        except NoEstimate:
            self.trouble = self.trouble or "images are left out, at whose times no pose is known"
        with self._lock:
            for key, (piece, changed_s) in self._drawn.items():
                if changed_s is not None and now_s - changed_s >= _SETTLED_S:
                    done.append(piece)
                    self._drawn[key] = piece, None
        return done

    def close(self) -> None:
        self.link.close()

    def _other_words(self) -> str:
        """What comes, where the tool's pose or images do not."""
        some = [*self._expected.items()], [*self._came]
        missing, others = (", ".join(f"{kind} of {name!r}" for kind, name in one) for one in some)
        return (
            f"it is connected, but no {missing} comes; what comes is {others or 'nothing'}. "
            "Allowed: name= and image= as they are sent"
        )

    def _time_of(self, header: Header) -> int:
        """When what a message says was so, ns, by this machine's clock or the sender's."""
        now_ns = time.time_ns()
        late_ns = now_ns - header.stamp_ns
        if not header.stamp_ns:
            return now_ns
        if self._stamped is None or (self._watched and self._stamped):
            most_ns = _LAG_NS if self._stamped is None else _OTHER_CLOCK_NS
            self._stamped = -most_ns * (most_ns > _LAG_NS) - _AHEAD_NS <= late_ns <= most_ns
            if not self._stamped:
                self._heard_fault = (
                    f"its stamps lie {late_ns * 1e-9:.2f} s behind this machine's clock: poses "
                    "have the time of their arrival. Synchronise both clocks"
                )
        return header.stamp_ns if self._stamped else now_ns

    def _faulty(self, words: str) -> None:
        self._heard_fault = f"a message was ignored: {words}"

    def _heard(self, header: Header, body: bytes) -> None:
        """One message, in the link's thread. Raises ProtocolError."""
        if len(self._came) < _MOST_DEVICES:
            self._came[header.type, header.device] = None
        if self._expected.get(header.type) == header.device:
            del self._expected[header.type]
            self._absent = ""
        if (reader := self._readers.get(header.type)) is not None:
            reader(header, *igtl.unpack_body(header, body))

    def _hear_pose(self, header: Header, content: bytes, metadata: Mapping[str, str]) -> None:
        if header.device != self._device:
            return
        if metadata.get("TransformStatus", "OK") == "OK":
            pose = self._axes @ igtl.unpack_transform(content) @ self._axes
            self._poses.add(self._time_of(header), pose)

    def _hear_image(self, header: Header, content: bytes, _: Mapping[str, str]) -> None:
        """Labels take their time to be found: which clock counts, only poses say."""
        if header.device == self._image_device and not (self._device and self._stamped is None):
            stamped = self._stamped and header.stamp_ns
            self._planes.hear(header.stamp_ns if stamped else time.time_ns(), content)

    def _hear_contact(self, header: Header, content: bytes, _: Mapping[str, str]) -> None:
        if header.device == self._contact_device:
            text = igtl.unpack_string(content).strip().lower()
            if text not in _MEANT:
                raise igtl.ProtocolError(f"{header.device} is {text!r}; allowed: 1 or 0.")
            self.contact(self._time_of(header), _MEANT[text])

    def _hear_points(self, header: Header, content: bytes, _: Mapping[str, str]) -> None:
        for number, (label, group, place_mm) in enumerate(igtl.unpack_points(content)):
            part = self._part(label, group, header.device)
            fields = {"part": part, "tip_mm": self.config.tip_mm}
            self._draw((header.device, number), Touch, place_mm[None], fields)

    def _hear_outline(self, header: Header, content: bytes, _: Mapping[str, str]) -> None:
        places_mm = _thinned(igtl.unpack_polydata_points(content))
        if len(places_mm):
            part = self._part(header.device)
            self._draw((header.device, -1), Outline, places_mm, {"part": part})

    def _part(self, *names: str) -> str:
        parts = self.context.touchable
        if (part := next((one for one in names if one in parts), None)) is None:
            raise igtl.ProtocolError(
                f"{names[0]!r} is drawn, which is no part; allowed: {', '.join(parts)}."
            )
        return part

    def _draw(
        self,
        key: tuple[str, int],
        kind: type[Touch | Outline],
        places: Float[np.ndarray, "n 3"],
        fields: Mapping[str, object],
    ) -> None:
        piece = Piece(kind, transform_points(self._axes, places), fields)
        with self._lock:
            known = (one.places_mm for (name, _), (one, _) in self._drawn.items() if name == key[0])
            if any(np.array_equal(places_mm, piece.places_mm) for places_mm in known):
                return
            if key not in self._drawn and len(self._drawn) >= _MOST_DRAWN:
                raise igtl.ProtocolError(f"more than {_MOST_DRAWN} pieces are drawn.")
            self._drawn[key] = piece, time.monotonic()


def _thinned(places_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """One place of each cell of a grid; the wider, the more there are."""
    width_mm, kept = _APART_MM, places_mm
    while len(places_mm):
        cells = np.floor(np.clip(places_mm / width_mm, -1e9, 1e9)).astype(np.int64)
        kept = places_mm[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
        if len(kept) <= _MOST_PLACES:
            break
        width_mm *= 1.5
    return kept
