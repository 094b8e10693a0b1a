"""OpenIGTLink over TCP to many receivers, none of which can delay the sender.

One thread serves all. A message that a receiver has not taken yet is replaced by the next one of
its type and device. So a slow receiver skips messages and still gets the last ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Callable, Collection

from tumortrack.core.errors import InputError
from tumortrack_devices.igtl import message as igtl
from tumortrack_devices.igtl.message import Header, Message, ProtocolError, pack
from tumortrack_devices.network import Pace

_LARGEST_REQUEST = 2**16  # bytes
_LARGEST_HEARD = 2**24  # bytes: an image of 4,000 x 4,000 labels, a surface of 400,000 points
_LARGEST_SKIPPED = 2**30  # an image or volume beside what is heard
MOST_RECEIVERS = 16  # further ones are refused: each may hold half a megabyte
_REQUESTS_PER_S = 100.0
_HEARD_PER_S = 5000.0  # some tens of tools of a tracker at some hundred Hz
_MOST_ANSWERS = 100  # waiting for one receiver, which may only ask and never read
_STALLED_S = 10.0  # a receiver that takes no piece for this long is dropped
_RETRY_S = 1.0  # between attempts to connect
_PATIENCE_S = 1.0  # at the end, with receivers that have not taken all
_PIECE = 2**14  # bytes
_BUFFER = 2**19  # of the socket: about one result, so that what waits there is not old

Key = tuple[str, str]  # type and device


class Link:
    """Sends messages to all receivers; a new one gets the newest of each type and device.

    With ``connect`` it is a client of that host's server, and retries until that is there;
    otherwise it is the server on ``host``. ``port``: the server's. ``heard``: gets each message
    that comes, whole and undamaged, in this link's thread, and may raise ProtocolError; of a type
    that is not ``wanted``, a large one comes without its body. ``faulty``: what was wrong with one,
    in words. Raises InputError: the port is taken, the host's
    name is unknown, or fastcrc is missing."""

    def __init__(
        self,
        host: str,
        port: int,
        connect: str = "",
        heard: Callable[[Header, bytes], None] | None = None,
        faulty: Callable[[str], None] = lambda _: None,
        wanted: Collection[str] = (),
    ) -> None:
        igtl.crc64(b"")  # a missing package is reported before anything is opened
        self._heard, self._faulty, self._wanted = heard, faulty, wanted
        self._listener: socket.socket | None = None
        self.port = port
        try:
            if connect:
                socket.getaddrinfo(connect, port)
            else:
                self._listener = socket.create_server((host, port), backlog=16)
                self.port = self._listener.getsockname()[1]
        except (OSError, ValueError) as error:  # ValueError: a name that cannot be one
            fault = f"there is no host {connect!r}: {error}."
            if not connect:
                cure = "Choose another port, or end the program that has it."
                fault = f"cannot listen on {host}:{port}: {error}. {cure}"
            raise InputError(f"openigtlink: {fault}") from error
        # Changed by the thread only.
        self._newest: dict[Key, bytes] = {}
        self.receivers: list[_Receiver] = []
        self._loop, self._closing = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(
            target=self._run, args=(connect,), name="openigtlink", daemon=True
        )
        self._thread.start()

    def send(self, messages: list[Message], whole: Collection[str] = ()) -> None:
        """Returns at once. ``whole``: types of which these are all that holds now; no receiver gets
        an older one from now on. Raises ProtocolError, and sends none, if the protocol cannot hold
        one of them."""
        self._call(self._offer, {(m.type, m.device): pack(m) for m in messages}, whole)

    def close(self) -> None:
        """Give receivers up to a second to take what waits for them; may be called twice."""
        self._call(self._closing.set)
        self._thread.join()
        if self._listener is not None:  # the thread may have ended before it listened
            self._listener.close()

    def _call(self, function: Callable[..., object], *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # closed
            self._loop.call_soon_threadsafe(function, *arguments)

    def _offer(self, packed: dict[Key, bytes], whole: Collection[str]) -> None:
        for known in (self._newest, *(receiver.waiting for receiver in self.receivers)):
            for key in [key for key in known if key[0] in whole and key not in packed]:
                del known[key]
        self._newest.update(packed)
        for receiver in self.receivers:
            receiver.offer(packed)

    def _run(self, connect: str) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve_all(connect))

    async def _serve_all(self, connect: str) -> None:
        serving = asyncio.create_task(self._visit(connect) if connect else self._accept())
        await self._closing.wait()
        until_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until_s and any(receiver.busy for receiver in self.receivers):
            await asyncio.sleep(0.01)
        serving.cancel()
        while self.receivers:
            self.receivers[0].writer.transport.abort()
            await asyncio.sleep(0)

    async def _accept(self) -> None:
        server = await asyncio.start_server(self._serve, sock=self._listener, backlog=1024)
        await server.serve_forever()

    async def _visit(self, host: str) -> None:
        while True:
            with contextlib.suppress(OSError):  # not there yet
                async with asyncio.timeout(_RETRY_S):
                    reader, writer = await asyncio.open_connection(host, self.port)
                await self._serve(reader, writer)
            await asyncio.sleep(_RETRY_S)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, until it ends."""
        if len(self.receivers) >= MOST_RECEIVERS:
            writer.transport.abort()
            return
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        writer.transport.set_write_buffer_limits(high=0)  # ``drain`` waits for the socket itself
        receiver = _Receiver(writer, self._newest)
        self.receivers.append(receiver)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._receive(reader, receiver))
                group.create_task(receiver.send())
        except* (OSError, EOFError):
            pass  # it is gone, or stalled
        except* ProtocolError as errors:
            self._faulty(str(errors.exceptions[0]))  # it uses another protocol
        finally:
            self.receivers.remove(receiver)
            writer.transport.abort()

    async def _receive(self, reader: asyncio.StreamReader, receiver: _Receiver) -> None:
        hears = self._heard is not None
        pace = Pace(_HEARD_PER_S if hears else _REQUESTS_PER_S)
        largest = _LARGEST_HEARD if hears else _LARGEST_REQUEST
        while True:
            await asyncio.sleep(pace.wait_s())
            header = igtl.unpack_header(await reader.readexactly(igtl.HEADER_SIZE))
            most = largest if header.type in self._wanted else _LARGEST_REQUEST
            if self._heard and most < header.body_size <= _LARGEST_SKIPPED:
                for left in range(header.body_size, 0, -_PIECE):
                    await reader.readexactly(min(left, _PIECE))
                if header.type in self._wanted:
                    self._faulty(f"{header.type} of {header.body_size} bytes is too large.")
                else:
                    self._heard(header, b"")
                continue
            if header.body_size > largest:
                raise ProtocolError(f"a message of {header.body_size} bytes is refused.")
            body = await reader.readexactly(header.body_size)
            for key, answer in self._answers(header, body).items():
                if key in receiver.waiting or len(receiver.waiting) < _MOST_ANSWERS:
                    receiver.offer({key: answer})

    def _answers(self, header: Header, body: bytes) -> dict[Key, bytes]:
        """To GET_...: the newest messages of that type (and device, if it names one), or an empty
        one. To STT_...: success, since everything is sent anyway; to STP_...: failure. Other
        messages are ignored here."""
        try:
            igtl.check_body(header, body)
        except ProtocolError as error:
            self._faulty(str(error))
            content = igtl.pack_status(igtl.CHECKSUM_ERROR, "checksum", str(error))
            return {("STATUS", ""): pack(Message("STATUS", "", 0, content))}
        if self._heard is not None:
            try:
                self._heard(header, body)
            except ProtocolError as error:
                self._faulty(str(error))
        verb, _, kind = header.type.partition("_")
        if not kind or verb not in ("GET", "STT", "STP"):
            return {}
        if verb != "GET":
            answer = Message(f"RTS_{kind}", header.device, 0, bytes([verb == "STP"]))
            return {(answer.type, answer.device): pack(answer)}
        # The type may be cut to fit: GET_TRANSFOR, GET_TRANS.
        answers = {
            (full, device): message
            for (full, device), message in self._newest.items()
            if full.startswith(kind) and header.device in ("", device)
        }
        return answers or {(kind, header.device): pack(Message(kind, header.device))}


class _Receiver:
    """A connection, and what waits for it."""

    def __init__(self, writer: asyncio.StreamWriter, newest: dict[Key, bytes]) -> None:
        self.writer = writer
        self.waiting: dict[Key, bytes] = {}
        self.busy = False
        self._came = asyncio.Event()
        self.offer(newest)

    def offer(self, packed: dict[Key, bytes]) -> None:
        """Send these, replacing what waits of the same type and device."""
        if packed:
            self.waiting.update(packed)
            self.busy = True
            self._came.set()

    async def send(self) -> None:
        """Raises TimeoutError if the receiver stalls."""
        while await self._came.wait():
            while self.waiting:
                message = self.waiting.pop(next(iter(self.waiting)))
                for start in range(0, len(message), _PIECE):
                    self.writer.write(message[start : start + _PIECE])
                    async with asyncio.timeout(_STALLED_S):
                        await self.writer.drain()
            self._came.clear()
            self.busy = False
