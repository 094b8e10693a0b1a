"""What reaches the ports from outside: other sites' pages, strangers, and clients that mean harm.
Whatever they do, one that behaves goes on receiving, and memory and threads stay bounded."""

from __future__ import annotations

import contextlib
import http.client
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import msgspec
import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from clock import PATIENCE_S, until
from hostile_clients import MANY, crowd, drip, noise, resident_mb
from igtl_objects import hear
from live_objects import empty_update, small_setting, small_update
from tumortrack_devices.igtl.link import MOST_RECEIVERS
from tumortrack_devices.network import Pace, is_loopback
from tumortrack_devices.sinks.openigtlink import OpenIgtLinkSinkConfig
from tumortrack_devices.sinks.viewer import ViewerSink, ViewerSinkConfig
from tumortrack_devices.viewer.guard import MOST_CONNECTIONS, MOST_PAGES

PROTOCOL = f"viser-v{viser.__version__}"
_ALLOWED_MB = 200  # of growth: 64 connections may each wait for the page's 0.8 MB, 8 for surfaces


@pytest.fixture
def viewer() -> Iterator[ViewerSink]:
    sink = ViewerSinkConfig(port=0).open(replace(small_setting(), arms=True))
    yield sink
    sink.close()


def page(sink: ViewerSink, token: bool = True, **headers: str) -> ClientConnection:
    """A browser's page, as far as the server can tell."""
    url = sink.url if token else f"http://127.0.0.1:{sink.port}"
    origin = {"Origin": f"http://127.0.0.1:{sink.port}"} | headers
    return connect(
        url.replace("http", "ws"),
        subprotocols=[PROTOCOL],  # type: ignore[list-item]
        additional_headers=origin,
        max_size=2**26,
        proxy=None,
        ping_interval=None,  # a browser's page sends none, and who does is cut off
    )


def say(one: ClientConnection, kind: str, **fields: object) -> None:
    one.send(msgspec.msgpack.encode({"type": kind, **fields}))


def change(one: ClientConnection, element: object, value: object) -> None:
    say(one, "GuiUpdateMessage", uuid=element._impl.uuid, updates={"value": value})  # type: ignore[attr-defined]


def look(one: ClientConnection, **other: object) -> None:
    camera: dict[str, object] = {
        "wxyz": [1, 0, 0, 0], "position": [1, 2, 3], "fov": 0.9, "near": 0.5, "far": 2e4,
        "image_height": 600, "image_width": 800, "look_at": [0, 0, 130], "up_direction": [0, -1, 0],
    }  # fmt: skip
    say(one, "ViewerCameraMessage", **(camera | other))


def gone(one: ClientConnection) -> None:
    """The server ends this connection."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            one.recv(PATIENCE_S)


# Whose page it is


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("127.0.0.1:{port}", None, 200),
        ("localhost:{port}", "http://localhost:{port}", 200),
        ("[::1]:{port}", None, 200),
        ("tumors.example:{port}", None, 403),  # a foreign name that is made to point here
        ("tumors.example:{port}", "http://tumors.example:{port}", 403),
        ("127.0.0.1:{port}", "http://tumors.example", 403),
        ("127.0.0.1:{port}", "http://127.0.0.1:1", 403),  # another server of this machine
        ("127.0.0.1:{port}", "null", 403),
        ("127.0.0.1.example:{port}", None, 403),
        ("", None, 403),
    ],
)
def test_only_the_servers_own_page_is_answered(viewer, host, origin, status):
    headers = {"Host": host.format(port=viewer.port)}
    if origin is not None:
        headers["Origin"] = origin.format(port=viewer.port)
    caller = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=PATIENCE_S)
    caller.request("GET", "/", headers=headers)
    answer = caller.getresponse()
    body = answer.read()
    assert answer.status == status
    assert (b"<title>Viser" in body) == (status == 200)
    if status == 200:
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]


def test_another_sites_page_cannot_connect_even_with_the_token(viewer):
    with pytest.raises(InvalidStatus, match="403"):
        page(viewer, Origin="http://tumors.example")
    with pytest.raises(InvalidStatus, match="403"):
        page(viewer, Host=f"tumors.example:{viewer.port}")
    with pytest.raises(InvalidStatus, match="400"):  # nor what is no page of ours
        connect(viewer.url.replace("http", "ws"), proxy=None)


def test_without_the_token_nothing_changes_and_the_arms_are_stopped(viewer):
    panel, controls = viewer._panel, viewer._context.controls
    before = panel.options
    with page(viewer, token=False) as stranger:
        look(stranger)
        until(viewer._server.get_clients, "the page")
        change(stranger, panel._shown["organ"], 0.1)
        change(stranger, panel.clicks[True], True)
        say(stranger, "ShareUrlRequest")  # viser would publish the server on the internet
        say(stranger, "ScenePointerMessage", event_type="click", ray_origin=[0, 0, 0],
            ray_direction=[0, 0, 1], screen_pos=[[0.5, 0.5]], modifier=None)  # fmt: skip
        until(lambda: any(one.notice_due_s for one in viewer._guard._pages), "the notice")
        assert not controls.aborted.is_set()
        change(stranger, panel.abort, True)  # what came before it has been seen by then
        until(controls.aborted.is_set, "the stop")
    assert panel.options == before
    assert viewer._asked is None
    assert viewer._server._share_tunnel is None
    with page(viewer) as owner:
        change(owner, panel._shown["organ"], 0.1)
        until(lambda: panel.options.organ == 0.1, "the change")
        look(owner)  # only those who look may click
        until(lambda: len(viewer._server.get_clients()) == 1)
        change(owner, panel.clicks[True], True)
        until(lambda: viewer._asked, "the choice")


def test_a_page_with_the_token_of_an_earlier_run_only_watches(viewer):
    old = viewer.url[:-3] + "abc"
    with connect(old.replace("http", "ws"), subprotocols=[PROTOCOL], proxy=None) as one:  # type: ignore[list-item]
        change(one, viewer._panel._shown["organ"], 0.1)
        change(one, viewer._panel.abort, True)
        until(viewer._context.controls.aborted.is_set, "the stop")
    assert viewer._panel.options.organ != 0.1


def test_numbers_that_are_none_reach_nobody(viewer):
    """What a visitor's camera says goes into the meshes that everybody gets."""
    with page(viewer) as one:
        look(one, position=[float("nan"), 0, 0])
        look(one, position=[1e30, 0, 0])
        change(one, viewer._panel._shown["organ"], float("inf"))
        say(
            one,
            "GuiUpdateMessage",
            uuid=viewer._panel.clicks[True]._impl.uuid,
            updates={"removed": True},
        )
        look(one, position=[7, 8, 9])
        until(lambda: viewer._server.get_clients(), "the last look")
    assert viewer._panel.options.organ <= 1
    with page(viewer) as other:
        other.send(b"\xc1" * 300)  # which no message of msgpack has
        gone(other)


def test_whoever_has_the_token_gets_in_where_strangers_fill_the_room(viewer):
    with contextlib.ExitStack() as strangers:
        watching = [strangers.enter_context(page(viewer, token=False)) for _ in range(MOST_PAGES)]
        with pytest.raises(InvalidStatus, match="503"):
            page(viewer, token=False)
        with page(viewer) as owner:
            change(owner, viewer._panel._shown["organ"], 0.1)
            until(lambda: viewer._panel.options.organ == 0.1, "the change")
        gone(watching[0])


# Where they listen


def listening(port: int) -> set[str]:
    """Addresses on which this machine listens at a port, as the kernel writes them."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError), open(table) as lines:
            for line in list(lines)[1:]:
                address, state = line.split()[1], line.split()[3]
                if state == "0A" and int(address.rsplit(":")[-1], 16) == port:
                    found.add(address.split(":")[0])
    return found


LOOPBACK, ANY = "0100007F", "00000000"


def test_ports_are_this_machines_alone_unless_told_otherwise_and_then_it_is_said():
    for config, options in (
        (ViewerSinkConfig, "stop the arms at http"),
        (OpenIgtLinkSinkConfig, "see the patient's organ"),
    ):
        closed = config(port=0).open(replace(small_setting(), arms=True))
        opened = config(port=0, host="0.0.0.0").open(replace(small_setting(), arms=True))
        try:
            for sink, address in ((closed, LOOPBACK), (opened, ANY)):
                port = sink.port if isinstance(sink, ViewerSink) else sink.link.port
                assert listening(port) == {address}
            assert "anyone" not in " ".join(closed.notes)
            assert "anyone in this network" in opened.notes[-1]
            assert options in opened.notes[-1]
        finally:
            closed.close()
            opened.close()


def test_loopback_is_known_by_any_of_its_names():
    assert all(map(is_loopback, ("127.0.0.1", "127.9.9.9", "::1", "localhost", "LOCALHOST")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.4", "robot", "")))


def test_pace_lets_a_second_pass_and_then_holds_back():
    pace = Pace(100)
    waits = [pace.wait_s() for _ in range(300)]
    assert waits[:99] == [0.0] * 99
    assert waits[-1] == pytest.approx(2.0, abs=1)
    assert Pace(100).wait_s(1000) > 8


# Harm


@dataclass
class Served:
    """A sink, its ports with what a request there begins with, and one who behaves."""

    publish: Callable[[int], None]
    heard: Callable[[], int]  # results that arrived
    joined: Callable[[], contextlib.AbstractContextManager[object]]  # another who behaves
    held: Callable[[], int]  # connections the server keeps
    most: int
    ports: dict[int, tuple[bytes, ...]]


class Counting(threading.Thread):
    """Takes what comes, and counts it."""

    def __init__(self, take: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self.count, self._take = 0, take
        self.start()

    def run(self) -> None:
        with contextlib.suppress(Exception):  # it is over
            while True:
                self._take()
                self.count += 1


@contextlib.contextmanager
def viewer_served() -> Iterator[Served]:
    sink = ViewerSinkConfig(port=0, hz=60).open(small_setting())
    good = page(sink)
    counting = Counting(good.recv)

    def held() -> int:
        return len(sink._guard._pending) + len(sink._guard._pages)

    @contextlib.contextmanager
    def joined() -> Iterator[object]:
        with page(sink) as other:
            assert other.recv(PATIENCE_S)
            yield other

    upgrade = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{sink.port}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n"
        f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n"
    ).encode()
    openings = (
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ",  # goes on for ever
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9000000000000\r\n\r\n",
        b"GET /" + b"a" * 2**20,
        upgrade,  # and takes nothing
        upgrade + b"\x82\xff\x7f\xff\xff\xff\xff\xff\xff\xff",  # a frame of 2**63 bytes
        upgrade + b"\x89\x80\0\0\0\0" * 2**16,  # pings
        upgrade + b"\x82\x81\0\0\0\0\x01" * 2**14,  # messages that are none
    )
    try:
        yield Served(
            lambda n: sink.publish(small_update(n) if n % 2 else empty_update(n)),
            lambda: counting.count, joined, held, MOST_CONNECTIONS, {sink.port: openings},
        )  # fmt: skip
    finally:
        good.close()
        sink.close()


@contextlib.contextmanager
def openigtlink_served() -> Iterator[Served]:
    sink = OpenIgtLinkSinkConfig(port=0, mesh_hz=1000).open(small_setting())

    @contextlib.contextmanager
    def client() -> Iterator[socket.socket]:
        with socket.create_connection(("127.0.0.1", sink.link.port), PATIENCE_S) as one:
            yield one

    def header(kind: bytes, size: int) -> bytes:
        return struct.pack(">H12s20sQQQ", 1, kind, b"", 0, size, 0)

    openings = (
        header(b"GET_STATUS", 2**63),
        header(b"GET_POLYDATA", 0) * 2000,  # asks without end, takes nothing
        header(b"IMAGE", 2**16 - 1),  # and then nothing
    )

    @contextlib.contextmanager
    def joined() -> Iterator[object]:
        def first() -> socket.socket:
            while True:  # as long as the room is full it is turned away
                try:
                    one = socket.create_connection(("127.0.0.1", sink.link.port), PATIENCE_S)
                    one.settimeout(PATIENCE_S)
                    hear(one)
                    return one
                except (OSError, EOFError, struct.error, AssertionError):
                    one.close()

        with first() as one:
            yield one

    with client() as good:
        until(lambda: sink.link.receivers, "the good one")
        counting = Counting(lambda: hear(good))
        try:
            yield Served(
                lambda n: sink.publish(small_update(n)), lambda: counting.count,
                joined, lambda: len(sink.link.receivers), MOST_RECEIVERS,
                {sink.link.port: openings},
            )  # fmt: skip
        finally:
            sink.close()


SERVED = {"viewer": viewer_served, "openigtlink": openigtlink_served}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(SERVED))
def test_who_behaves_goes_on_receiving_whatever_others_do(kind):
    with SERVED[kind]() as served:
        number = 0

        def goes_on(results: int = 5) -> None:
            """That many more results arrive."""
            before = served.heard()

            def further() -> bool:
                nonlocal number
                number += 1
                served.publish(number)
                return served.heard() >= before + results

            until(further, "the good client's results")
            assert served.held() <= served.most

        goes_on()
        before_mb = resident_mb()
        for port, openings in served.ports.items():
            with crowd(port) as silent:
                goes_on()
                drip(silent, b"G")
                goes_on()
            with crowd(port, MANY, noise()):
                goes_on()
            for opening in openings:
                with crowd(port, 100, opening) as slow:
                    for byte in (b"a", b"\0", b"\n"):
                        drip(slow, byte)
                        goes_on(2)
            with served.joined():
                goes_on()
        assert resident_mb() - before_mb < _ALLOWED_MB
