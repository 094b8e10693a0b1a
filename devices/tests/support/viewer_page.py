"""A page of the viewer, as far as its server can tell: a websocket that sends what viser's does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect

from clock import PATIENCE_S, until
from tumortrack_devices.sinks.viewer import ViewerSink

PROTOCOL = f"viser-v{viser.__version__}"
LOOK = {
    "wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "fov": 0.9, "near": 0.5, "far": 2e4,
    "image_height": 600, "image_width": 800, "look_at": [0, 0, 130], "up_direction": [0, -1, 0],
}  # fmt: skip


def connected(sink: ViewerSink, **headers: str) -> ClientConnection:
    return connect(
        sink.url.replace("http", "ws"),
        subprotocols=[PROTOCOL],  # type: ignore[list-item]
        additional_headers={"Origin": sink.url} | headers,
        max_size=2**26,
        proxy=None,
    )


class Page:
    """Of a visitor who looks; ``elements``: of the panel, by the label that they had at first."""

    def __init__(self, sink: ViewerSink, link: ClientConnection) -> None:
        self._link, self.elements = link, dict[str, str]()
        before = len(sink.server.get_clients())
        self.say("ViewerCameraMessage", **LOOK)
        until(lambda: len(sink.server.get_clients()) > before, "the visitor")
        last = "Axes, region"
        while last not in self.elements:
            for one in self.heard():
                label = (one.get("props") or {}).get("label")
                if label and one["type"].startswith("Gui"):
                    self.elements[label] = one["uuid"]

    def heard(self) -> list[dict[str, Any]]:
        """The next messages, which a browser shows together."""
        data = self._link.recv(PATIENCE_S)
        assert isinstance(data, bytes)
        packed = data[16 : 16 + int.from_bytes(data[8:16], "little")]
        return msgspec.msgpack.decode(zstandard.decompress(packed))["messages"]

    def say(self, kind: str, **fields: object) -> None:
        self._link.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def change(self, label: str, value: object = True) -> None:
        """Press a button, or give an element a value."""
        self.say("GuiUpdateMessage", uuid=self.elements[label], updates={"value": value})

    def click(self, ray: object) -> None:
        """On the scene, along a ray from the origin."""
        ends = {"ray_origin": [0, 0, 0], "ray_direction": list(map(float, ray))}  # type: ignore[call-overload]
        where = {"screen_pos": [[0.5, 0.5]], "modifier": None}
        self.say("ScenePointerMessage", event_type="click", **ends, **where)


@contextmanager
def page(sink: ViewerSink) -> Iterator[Page]:
    with connected(sink) as link:
        yield Page(sink, link)
