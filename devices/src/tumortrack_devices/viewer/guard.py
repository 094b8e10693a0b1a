"""Access control of the viewer's page: who may see it, who may change it, and rate limits.

A browser runs scripts of every page it has open, and those can reach this machine's own ports. So
a request is answered only if it was made for this server's own address (not through a foreign name
that is made to point here: DNS rebinding), by this server's own page or by no page at all. The
page's address holds a token that is new with every start; without it a page shows everything but
changes nothing, except that it can stop the arms: that must always be easy.

viser accepts anything from a client, also uploads and requests to publish the server on the
internet. Only the messages listed here pass.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import logging
import math
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any, Literal
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode, Opcode
from websockets.http11 import Request, Response

from tumortrack_devices.network import Pace, is_loopback

MOST_CONNECTIONS = 64  # at a time, including those that only fetch the page
MOST_PAGES = 8  # each gets every surface: 8 at 15 Hz are some 100 MB/s
LARGEST_MESSAGE = 2**14  # bytes; a page's messages have a few hundred
_FRAMES_PER_S, _BURST_S = 200.0, 5.0  # turning the view sends 50 a second, more after a pause
_BYTES_PER_S, _PIECE = 2**15, 2**10
_OPENING_S = 5.0  # for a complete request
_PING_S = 10.0  # a page that does not respond for twice as long is gone
_FARTHEST_MM = 1e6  # of a camera from the scene
_TEXT = 200  # characters of an element's value

_SILENT = logging.getLogger("tumortrack.viewer.websockets")  # it logs what clients do as errors
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False
_patching = threading.Lock()

_Vector = tuple[float, float, float]


class _CameraMoved(msgspec.Struct, tag="ViewerCameraMessage", forbid_unknown_fields=True):
    wxyz: tuple[float, float, float, float]
    position: _Vector
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: _Vector
    up_direction: _Vector


class _ElementChanged(msgspec.Struct, tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: str
    updates: dict[str, bool | float | str]


class _SceneClicked(msgspec.Struct, tag="ScenePointerMessage", forbid_unknown_fields=True):
    event_type: Literal["click"]
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: list[tuple[float, float]]
    modifier: str | None


_Message = _CameraMoved | _ElementChanged | _SceneClicked
_decoder: msgspec.msgpack.Decoder[_Message] = msgspec.msgpack.Decoder(_Message)


class Guard:
    """Of one server. ``free``: callbacks by viser's identifier of an element that may be used
    without the token; called before viser, which ignores pages that are still loading.
    ``on_refused``: called with a connection whose change was refused without the token."""

    def __init__(self, host: str, protocol: str) -> None:
        self.token = secrets.token_urlsafe(16)
        self.free: dict[str, Callable[[], None]] = {}
        self.on_refused: Callable[[GuardedConnection], None] = lambda _: None
        self.installed = False
        self._protocol = protocol
        self._names = {"localhost", host.lower()}
        if not is_loopback(host):
            own = socket.gethostname().lower()
            self._names |= {own, f"{own}.local"}
        self._pending: dict[GuardedConnection, None] = {}  # without a page yet, oldest first
        self._pages: dict[GuardedConnection, None] = {}

    @contextlib.contextmanager
    def around_start(self) -> Iterator[None]:
        """Guard the websockets server that is started inside: viser has no hook for it."""
        theirs = websockets_server.serve

        def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
            def answer(connection: GuardedConnection, request: Request) -> Response | None:
                refusal = self._refusal(connection, request)
                if refusal is not None:
                    return connection.respond(*refusal)
                request.path = "/"  # the only page; viser need not see the token
                response: Response | None = process_request(connection, request)
                if response is not None:
                    for name, value in _headers(request).items():
                        response.headers[name] = value
                return response

            self.installed = True
            options |= {
                "max_size": LARGEST_MESSAGE, "open_timeout": _OPENING_S, "server_header": None,
                "backlog": 1024,
                "ping_interval": _PING_S, "ping_timeout": _PING_S, "logger": _SILENT,
                "create_connection": lambda *a, **k: GuardedConnection(self, *a, **k),
            }  # fmt: skip
            options["process_request"] = answer
            return theirs(*arguments, **options)

        with _patching:
            websockets_server.serve = guarded  # type: ignore[assignment,misc]
            try:
                yield
            finally:
                websockets_server.serve = theirs  # type: ignore[misc]

    def admit(self, newcomer: GuardedConnection) -> None:
        """Of too many connections, drop the oldest that is no page, so that new ones get in."""
        self._pending[newcomer] = None
        if len(self._pending) + len(self._pages) > MOST_CONNECTIONS:
            oldest = next(iter(self._pending))
            self.forget(oldest)
            oldest.transport.abort()

    def forget(self, connection: GuardedConnection) -> None:
        self._pending.pop(connection, None)
        self._pages.pop(connection, None)

    def _refusal(
        self, connection: GuardedConnection, request: Request
    ) -> tuple[HTTPStatus, str] | None:
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return HTTPStatus.FORBIDDEN, (
                "This is not the viewer's address. Use the one that tumortrack printed at its "
                "start, or the machine's IP address; host=NAME allows a name.\n"
            )
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return HTTPStatus.FORBIDDEN, "Another site's page may not use the viewer.\n"
        given = request.path.partition("?")[0].strip("/")
        connection.may_change = hmac.compare_digest(given.encode(), self.token.encode())
        if "upgrade" not in request.headers:
            return None
        offered = ",".join(request.headers.get_all("Sec-WebSocket-Protocol")).split(",")
        if self._protocol not in [name.strip() for name in offered]:
            return HTTPStatus.BAD_REQUEST, "Only the viewer's own page connects here.\n"
        if len(self._pages) >= MOST_PAGES:
            watching = [page for page in self._pages if not page.may_change]
            if not (connection.may_change and watching):
                return HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_PAGES} pages are open: the most.\n"
            watching[0].transport.abort()
            self.forget(watching[0])
        self._pending.pop(connection, None)
        self._pages[connection] = None
        return None

    def _is_ours(self, host: str) -> bool:
        """One of this machine's names, or an IP address, which no foreign site can have as name."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        with contextlib.suppress(ValueError):
            return bool(ipaddress.ip_address(name))
        return name in self._names

    def passes(self, connection: GuardedConnection, data: bytes | str) -> bool:
        """Whether viser may see a message. Raises ValueError if it is not MessagePack."""
        try:
            message = _decoder.decode(b"" if isinstance(data, str) else data)
        except msgspec.ValidationError:
            return False  # another message of viser, or a malformed one
        except msgspec.DecodeError as error:
            raise ValueError("that is no message") from error
        if isinstance(message, _CameraMoved):
            numbers = (*message.wxyz, *message.position, *message.look_at, *message.up_direction)
            return all(map(_plausible, (*numbers, message.fov, message.near, message.far)))
        if isinstance(message, _ElementChanged):
            if list(message.updates) != ["value"] or not _plausible(message.updates["value"]):
                return False
            free = self.free.get(message.uuid)
            if free is not None:
                free()
            allowed = connection.may_change or free is not None
        else:
            ray = (*message.ray_origin, *message.ray_direction)
            allowed = connection.may_change and all(map(_plausible, ray))
        if not allowed:
            self.on_refused(connection)
        return allowed


class GuardedConnection(ServerConnection):
    """``may_change``: its address has the token; ``notice_due_s``: no further notice before."""

    def __init__(self, guard: Guard, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._guard = guard
        self._frames, self._bytes = Pace(_FRAMES_PER_S, _BURST_S), Pace(_BYTES_PER_S, _BURST_S)
        self.may_change, self.notice_due_s = False, 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._guard.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._guard.forget(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        for start in range(0, len(data), _PIECE):
            if self.transport.is_closing():
                return
            piece = data[start : start + _PIECE]
            if self._bytes.wait_s(len(piece)):
                self.transport.abort()  # headers without end, and the like
            else:
                super().data_received(piece)

    def process_event(self, event: Any) -> None:
        ping = getattr(event, "opcode", None) is Opcode.PING  # never sent by browsers
        if ping or self._frames.wait_s():
            self.transport.abort()
        else:
            super().process_event(event)

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that passes."""
        while True:
            data = await super().recv(decode)
            try:
                if self._guard.passes(self, data):
                    return data
            except ValueError:
                await self.close(CloseCode.UNSUPPORTED_DATA)


def _plausible(value: bool | float | str) -> bool:
    if isinstance(value, str):
        return len(value) <= _TEXT
    return math.isfinite(value) and abs(value) <= _FARTHEST_MM


def _headers(request: Request) -> dict[str, str]:
    """The page talks only to this server, is in no frame, and does not leak its address."""
    host = request.headers["Host"]
    policy = f"connect-src 'self' ws://{host} wss://{host} blob: data:; frame-ancestors 'none'"
    return {
        "Content-Security-Policy": policy,
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
