"""What reaches the ports from outside: other sites' pages, strangers, and clients that mean harm.
Whatever they do, one that behaves goes on receiving, and memory and threads stay bounded."""

from __future__ import annotations

import contextlib
import http.client
import random
import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus

from clock import PATIENCE_S, Clock, until
from igtl_objects import hear
from live_objects import small_setting, small_update
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack_devices.igtl.link import MOST_RECEIVERS
from tumortrack_devices.network import Pace, is_loopback
from tumortrack_devices.sinks.openigtlink import OpenIgtLinkSinkConfig
from tumortrack_devices.sinks.viewer import ViewerSink, ViewerSinkConfig
from viewer_page import connected, page
from workcell_objects import Arms

_ALLOWED_MB = 200  # of growth


@pytest.fixture
def viewer() -> Iterator[ViewerSink]:
    sink = ViewerSinkConfig(port=0).open(replace(small_setting(), controller=Arms()))
    yield sink
    sink.close()


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("127.0.0.1:{port}", None, 200),
        ("localhost:{port}", "http://localhost:{port}", 200),
        ("localhost:9000", "http://localhost:9000", 200),  # a port that SSH forwards
        ("[::1]:{port}", None, 200),
        ("tumors.example:{port}", None, 403),  # a foreign name that is made to point here
        ("tumors.example:{port}", "http://tumors.example:{port}", 403),
        ("127.0.0.1:{port}", "http://tumors.example", 403),
        ("127.0.0.1:{port}", "http://127.0.0.1:1", 403),  # another server of this machine
        ("127.0.0.1:{port}", "null", 403),
        ("127.0.0.1.example:{port}", None, 403),
        ("192.168.1.4:{port}", None, 403),
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
    elif origin is not None:  # nor by a websocket
        with refused(InvalidStatus, 403):
            connected(viewer, **headers)


def test_a_page_changes_what_is_shown_stops_the_arms_and_publishes_nothing(viewer, monkeypatch):
    left = []
    monkeypatch.setattr("viser.ViserServer.request_share_url", lambda *_: left.append("published"))
    with page(viewer) as visitor:
        visitor.say("ShareUrlRequest")  # viser would publish the server on the internet
        visitor.change("Kidney", 0.1)
        until(lambda: viewer.panel.options.organ == 0.1, "the change")
        visitor.change("Stop the arms for good")
        until(lambda: viewer.panel.abort.disabled, "the stop")
    assert not left


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


def test_ports_are_this_machines_alone_unless_told_otherwise_and_then_it_is_said(viewer):
    assert listening(viewer.port) == {"0100007F"}
    with pytest.raises(InputError):
        ViewerSinkConfig(port=viewer.port).open(small_setting())  # taken
    for host, address in (("127.0.0.1", "0100007F"), ("0.0.0.0", "00000000")):
        sink = OpenIgtLinkSinkConfig(port=0, host=host).open(small_setting())
        with contextlib.closing(sink):
            assert listening(sink.link.port) == {address}
            assert ("anyone in this network" in sink.notes[-1]) is (host == "0.0.0.0")


def test_loopback_is_known_by_any_of_its_names():
    assert all(map(is_loopback, ("127.0.0.1", "127.9.9.9", "::1", "localhost", "LOCALHOST")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.4", "robot", "")))


def test_pace_lets_a_second_pass_and_then_holds_back(monkeypatch):
    monkeypatch.setattr("tumortrack_devices.network.time", Clock())
    pace = Pace(100)
    waits = [pace.wait_s() for _ in range(300)]
    assert waits[:100] == pytest.approx([0.0] * 100, abs=1e-6)
    assert waits[100:] == pytest.approx([0.01 * n for n in range(1, 201)], abs=1e-6)


# Harm: clients that are many, silent, slow, deaf, or say no message

MANY = 1000


@contextlib.contextmanager
def crowd(port: int, count: int = MANY, opening: bytes = b"") -> Iterator[list[socket.socket]]:
    """``count`` connections at once that say ``opening``, stay, and read nothing."""
    with contextlib.ExitStack() as open_ones:
        sockets = []
        for _ in range(count):
            with contextlib.suppress(OSError):  # refused, or thrown out at once
                client = socket.socket()
                open_ones.callback(client.close)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
                client.settimeout(5)
                client.connect(("127.0.0.1", port))
                sockets.append(client)
                client.settimeout(0.05)
                client.sendall(opening)
        yield sockets


def drip(sockets: list[socket.socket], byte: bytes) -> None:
    """One more byte on every connection."""
    for client in sockets:
        with contextlib.suppress(OSError):
            client.send(byte)


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


class Counting(threading.Thread):
    """Takes what comes, and counts it."""

    def __init__(self, one: socket.socket) -> None:
        super().__init__(daemon=True)
        self.count, self._one = 0, one
        self.start()

    def run(self) -> None:
        with contextlib.suppress(Exception):  # it is over
            while True:
                hear(self._one)
                self.count += 1


def header(kind: bytes, size: int) -> bytes:
    return struct.pack(">H12s20sQQQ", 1, kind, b"", 0, size, 0)


OPENINGS = (
    header(b"GET_STATUS", 2**63),
    header(b"GET_POLYDATA", 0) * 2000,  # asks without end, takes nothing
    header(b"IMAGE", 2**16 - 1),  # and then nothing
)


@pytest.mark.slow
def test_who_behaves_goes_on_receiving_whatever_others_do():
    sink = OpenIgtLinkSinkConfig(port=0, mesh_hz=1000).open(small_setting())
    port, number = sink.link.port, 0

    def client() -> socket.socket:
        return socket.create_connection(("127.0.0.1", port), PATIENCE_S)

    def goes_on(results: int = 5) -> None:
        """That many more results arrive."""
        before = counting.count

        def further() -> bool:
            nonlocal number
            number += 1
            sink.publish(small_update(number))
            return counting.count >= before + results

        until(further, "the good client's results")
        assert len(sink.link.receivers) <= MOST_RECEIVERS

    def joins() -> bool:
        """Another who behaves; as long as the room is full it is turned away."""
        with contextlib.suppress(OSError, EOFError, struct.error, AssertionError), client() as one:
            one.settimeout(PATIENCE_S)
            hear(one)
            return True
        return False

    with contextlib.closing(sink), client() as good:
        until(lambda: sink.link.receivers, "the good one")
        counting = Counting(good)
        goes_on()
        before_mb = resident_mb()
        with crowd(port) as silent:
            goes_on()
            drip(silent, b"G")
            goes_on()
        with crowd(port, MANY, random.Random(3).randbytes(300)):
            goes_on()
        for opening in OPENINGS:
            with crowd(port, 100, opening) as slow:
                for byte in (b"a", b"\0", b"\n"):
                    drip(slow, byte)
                    goes_on(2)
        until(joins, "another")
        assert resident_mb() - before_mb < _ALLOWED_MB
