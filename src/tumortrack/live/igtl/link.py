"""OpenIGTLink over TCP to many receivers, none of which can delay the sender.

One thread serves all sockets. A message that a receiver has not taken yet is replaced by the next
one of its type and device. So a slow receiver skips messages and still gets the last ones; at most
one of each type and device waits for it, besides the one that is being sent.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from dataclasses import dataclass, field

from tumortrack.core.errors import InputError
from tumortrack.live.igtl.message import (
    CHECKSUM_ERROR,
    HEADER_SIZE,
    Header,
    IgtlStatus,
    Message,
    ProtocolError,
    check_body,
    crc64,
    pack,
    pack_status,
    unpack_header,
)

_LARGEST_REQUEST = 2**16  # bytes; what a receiver sends is small
_MOST_ANSWERS = 100  # that wait for a receiver: one that only asks gets no more
_STALLED_S = 10.0  # a receiver that takes nothing for so long is gone
_RETRY_S = 1.0  # between tries to connect
_PIECE = 2**18  # bytes handed to the socket in one go
_BUFFER = 2**19  # of the socket: about one result, so that what waits there is not old

Key = tuple[str, str]  # type and device


@dataclass(eq=False)
class _Receiver:
    socket: socket.socket
    name: str
    waiting: dict[Key, bytes] = field(default_factory=dict)
    sending: memoryview = field(default_factory=lambda: memoryview(b""))
    received: bytearray = field(default_factory=bytearray)
    progress_s: float = field(default_factory=time.monotonic)

    @property
    def busy(self) -> bool:
        return bool(self.sending or self.waiting)


class Link:
    """Sends messages to whoever is connected; a newcomer gets the newest of each kind.

    With ``connect`` it goes to that host's server itself, again and again until it is there;
    otherwise it is the server on ``host``.

    Raises:
        InputError: the port is taken, the host's name is unknown, or fastcrc is missing.
    """

    def __init__(self, host: str, port: int, connect: str = "") -> None:
        crc64(b"")  # a missing package is reported before anything is opened
        self._lock = threading.Lock()
        self._newest: dict[Key, bytes] = {}
        self._receivers: dict[socket.socket, _Receiver] = {}
        self._server = _checked(connect, port) if connect else None
        self._next_try_s = 0.0
        self._closing = False
        self._selector = selectors.DefaultSelector()
        self._listener = None if connect else _listen(host, port)
        if self._listener is not None:
            self._selector.register(self._listener, selectors.EVENT_READ)
        self._wake_writer, self._wake_reader = socket.socketpair()
        self._wake_writer.setblocking(False)
        self._wake_reader.setblocking(False)
        self._selector.register(self._wake_reader, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="openigtlink", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The server's port; that of ``connect`` otherwise."""
        return self._listener.getsockname()[1] if self._listener else self._server[1]  # type: ignore[index]

    @property
    def receivers(self) -> int:
        with self._lock:
            return len(self._receivers)

    def send(self, messages: list[Message]) -> None:
        """Hand these over; returns at once.

        Raises:
            ProtocolError: a message that the protocol cannot hold; then none is sent.
        """
        packed = {(m.type, m.device): pack(m) for m in messages}
        with self._lock:
            self._newest.update(packed)
            for receiver in self._receivers.values():
                receiver.waiting.update(packed)
        self._wake_thread()

    def close(self, patience_s: float = 1.0) -> None:
        """Let receivers take what waits for them, for so long at most, and go; may be called
        twice."""
        until = time.monotonic() + patience_s
        while time.monotonic() < until and self._thread.is_alive():
            with self._lock:
                if not any(receiver.busy for receiver in self._receivers.values()):
                    break
            time.sleep(0.01)
        self._closing = True
        self._wake_thread()
        self._thread.join()

    def _wake_thread(self) -> None:
        with contextlib.suppress(OSError):  # full: it is awake already; closed: it is over
            self._wake_writer.send(b"x")

    def _run(self) -> None:
        while not self._closing:
            if self._server is not None and not self._receivers:
                self._connect(self._server)
            for key, events in self._selector.select(0.2):
                if key.fileobj is self._wake_reader:
                    self._wake_reader.recv(4096)
                elif key.fileobj is self._listener:
                    self._accept()
                elif (receiver := self._receivers.get(key.fileobj)) is not None:  # type: ignore[call-overload]
                    self._serve(receiver, events)
            self._update_interest()
        for receiver in list(self._receivers.values()):
            self._drop(receiver)
        for one in (self._listener, self._wake_writer, self._wake_reader, self._selector):
            if one is not None:
                one.close()

    def _connect(self, server: tuple[str, int]) -> None:
        if time.monotonic() < self._next_try_s:
            return
        self._next_try_s = time.monotonic() + _RETRY_S
        with contextlib.suppress(OSError):  # not there yet
            self._add(socket.create_connection(server, timeout=_RETRY_S), server[0])

    def _accept(self) -> None:
        assert self._listener is not None
        with contextlib.suppress(OSError):  # gone before it was let in
            one, address = self._listener.accept()
            self._add(one, str(address[0]))

    def _add(self, one: socket.socket, name: str) -> None:
        one.setblocking(False)
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        with self._lock:
            self._receivers[one] = _Receiver(one, name, dict(self._newest))
        self._selector.register(one, selectors.EVENT_READ)

    def _drop(self, receiver: _Receiver) -> None:
        with self._lock:
            self._receivers.pop(receiver.socket, None)
        self._selector.unregister(receiver.socket)
        receiver.socket.close()

    def _update_interest(self) -> None:
        """Wait for receivers that have something to take; drop the dead ones."""
        now = time.monotonic()
        for receiver in list(self._receivers.values()):
            with self._lock:
                busy = receiver.busy
            if not busy:
                receiver.progress_s = now
            elif now - receiver.progress_s > _STALLED_S:
                self._drop(receiver)
                continue
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if busy else 0)
            if self._selector.get_key(receiver.socket).events != wanted:
                self._selector.modify(receiver.socket, wanted)

    def _serve(self, receiver: _Receiver, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                self._receive(receiver)
            if events & selectors.EVENT_WRITE:
                self._send_waiting(receiver)
        except BlockingIOError:
            pass  # it was only nearly ready
        except (OSError, ProtocolError):
            self._drop(receiver)  # gone, or it speaks another language

    def _send_waiting(self, receiver: _Receiver) -> None:
        if not receiver.sending:
            with self._lock:
                if not receiver.waiting:
                    return
                key = next(iter(receiver.waiting))
                receiver.sending = memoryview(receiver.waiting.pop(key))
        sent = receiver.socket.send(receiver.sending[:_PIECE])
        receiver.sending = receiver.sending[sent:]
        receiver.progress_s = time.monotonic()

    def _receive(self, receiver: _Receiver) -> None:
        data = receiver.socket.recv(65536)
        if not data:
            raise ConnectionError("closed by the receiver")
        receiver.received += data
        while len(receiver.received) >= HEADER_SIZE:
            header = unpack_header(bytes(receiver.received[:HEADER_SIZE]))
            if header.body_size > _LARGEST_REQUEST:
                raise ProtocolError(f"a request of {header.body_size} bytes is refused.")
            end = HEADER_SIZE + header.body_size
            if len(receiver.received) < end:
                return
            body = bytes(receiver.received[HEADER_SIZE:end])
            del receiver.received[:end]
            for key, answer in self._answers(header, body).items():
                with self._lock:
                    if key in receiver.waiting or len(receiver.waiting) < _MOST_ANSWERS:
                        receiver.waiting[key] = answer

    def _answers(self, header: Header, body: bytes) -> dict[Key, bytes]:
        """To GET_...: the newest of that type (of that device, if it names one), an empty message
        where there is none. To STT_...: done, since everything is sent anyway; to STP_...: not
        done. Whatever else comes is not for us."""
        try:
            check_body(header, body)
        except ProtocolError as error:
            wrong = IgtlStatus(CHECKSUM_ERROR, "checksum", str(error))
            return {("STATUS", ""): pack(Message("STATUS", "", 0, pack_status(wrong)))}
        verb, _, kind = header.type.partition("_")
        if not kind or verb not in ("GET", "STT", "STP"):
            return {}
        if verb != "GET":
            answer = Message(f"RTS_{kind}", header.device, 0, bytes([verb == "STP"]))
            return {(answer.type, answer.device): pack(answer)}
        with self._lock:
            # The type may be cut to fit: GET_TRANSFOR, GET_TRANS.
            found = {
                (full, device): message
                for (full, device), message in self._newest.items()
                if full.startswith(kind) and header.device in ("", device)
            }
        return found or {(kind, header.device): pack(Message(kind, header.device))}


def _listen(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server((host, port), backlog=16)
    except (OSError, ValueError) as error:  # ValueError: a name that cannot be one
        raise InputError(
            f"openigtlink: cannot listen on {host}:{port}: {error}. Choose another port, or end "
            "the program that has it."
        ) from error


def _checked(host: str, port: int) -> tuple[str, int]:
    try:
        socket.getaddrinfo(host, port)
    except (OSError, ValueError) as error:
        raise InputError(f"openigtlink: there is no host {host!r}: {error}.") from error
    return host, port
