"""Frames sent over ROS 2 from within a test, on a graph that does not leave this machine."""

from __future__ import annotations

import os
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

from live_objects import small_anatomy, small_frame
from tumortrack.core.types import SensorCloud
from tumortrack.track.live import Seen
from tumortrack.track.ros.bus import Bus, open_bus
from tumortrack.track.ros.messages import Messages
from tumortrack.track.ros.observed import messages_seen

DOMAIN = str(1 + secrets.randbelow(100))  # ports of domains beyond reach into the ephemeral ones


@contextmanager
def own_graph() -> Iterator[None]:
    """ROS's environment for tests: the other programs of this machine are not heard."""
    said = {"ROS_DOMAIN_ID": DOMAIN, "ROS_LOCALHOST_ONLY": "1"}
    with mock.patch.dict(os.environ, said):
        os.environ.pop("CYCLONEDDS_URI", None)
        yield


class Frames:
    """Sends frames on topics under ``place``."""

    def __init__(self, bus: Bus, messages: Messages, place: str) -> None:
        self._bus, self._messages, self.place = bus, messages, place
        self._publishers: dict = {}

    def send(self, seen: Seen, leave_out: tuple[str, ...] = ()) -> None:
        """The image last: what belongs to it is there by then."""
        for suffix, kind, message in reversed(messages_seen(seen, self._messages)):
            if suffix in leave_out:
                continue
            if suffix not in self._publishers:
                self._publishers[suffix] = self._bus.publisher(f"{self.place}/{suffix}", kind)
            self._publishers[suffix].publish(self._messages.to_bytes(message))


@contextmanager
def sending(kind: str, hz: float = 50) -> Iterator[str]:
    """Small frames (``image``) or clouds, stamped as they are sent; yields their topic."""
    messages = Messages()
    place = f"/camera_{secrets.token_hex(4)}"
    over = threading.Event()

    def send() -> None:
        bus = open_bus("dds", messages)
        frames = Frames(bus, messages, place)
        while not over.wait(1 / hz):
            now_ns = time.time_ns()
            cloud = SensorCloud(small_anatomy().organ.vertices_mm, now_ns)
            frames.send(Seen(small_frame(now_ns) if kind == "image" else cloud, now_ns))
        bus.close()

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield f"{place}/{'depth/image_rect' if kind == 'image' else 'points'}"
    finally:
        over.set()
        thread.join()
