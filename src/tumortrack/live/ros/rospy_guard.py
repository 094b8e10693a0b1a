"""The two ports of rospy's node, made fit for whoever connects.

rospy reads each newcomer's header in the thread that accepts, without a time limit and up to 4 GB
long, serves its XML-RPC interface with a thread for each connection, as many as there are, and
listens on all addresses. ROS 1 knows no users: whoever reaches these ports may stop the node.
"""

from __future__ import annotations

import os
import struct
import threading
import time
from contextlib import suppress
from typing import Any

from tumortrack.live.network import is_loopback

_HANDSHAKE_S = 5.0
_IDLE_S = 30.0  # an XML-RPC client that keeps its connection asks again within that time, or anew
_WAITING = 1024  # connections that the system holds until they are accepted
_LARGEST_HEADER = 2**16  # bytes; one holds a type's definition, some kilobytes
_LARGEST_CALL = 2**20
MOST_CALLERS = 32  # at a time: of XML-RPC, and with an unfinished header; the oldest makes room
MOST_PEERS = 64  # subscribers' connections, each with a thread; further ones are refused
_ADDRESSES = ("ROS_HOSTNAME", "ROS_IP")  # in the order that ROS asks them


def is_open(master_host: str) -> bool:
    """Whether other machines are to reach this node: ``ROS_IP`` or ``ROS_HOSTNAME`` says by which
    address, or the master is on another machine."""
    named = next((os.environ[name] for name in _ADDRESSES if name in os.environ), master_host)
    return not is_loopback(named)


def guard_node(rospy: Any, master_host: str) -> None:
    """Before rospy's node starts: unless it is to be open, it listens on the loopback address.
    rospy takes none of this as an option; ``ROS_IP`` would do for the address, but also for all
    programs that this one starts."""
    import rosgraph
    import rosgraph.xmlrpc
    from rospy.impl import tcpros_base

    if not is_open(master_host):
        rosgraph.network.get_address_override = lambda: "127.0.0.1"
    handler = rosgraph.xmlrpc.SilenceableXMLRPCRequestHandler
    rosgraph.xmlrpc.SilenceableXMLRPCRequestHandler = type(
        "_CallHandler", (_Calls, handler), {"timeout": _IDLE_S}
    )
    server = rosgraph.xmlrpc.ThreadingXMLRPCServer
    rosgraph.xmlrpc.ThreadingXMLRPCServer = type("_CallServer", (_Callers, server), {})
    decode, error = (
        rosgraph.network.decode_ros_handshake_header,
        rospy.exceptions.TransportInitError,
    )
    tcpros_base.read_ros_handshake_header = lambda sock, buffer, size: decode(
        _read_header(sock, buffer, size, error)
    )
    listen = tcpros_base.TCPServer._create_server_sock

    def listen_to_many(server: Any) -> Any:
        sock = listen(server)
        sock.listen(_WAITING)  # 5 in rospy: a crowd at the door kept everybody out for seconds
        return sock

    tcpros_base.TCPServer._create_server_sock = listen_to_many
    accept = tcpros_base.TCPROSServer._tcp_server_callback
    tcpros_base.TCPROSServer._tcp_server_callback = _Peers(accept)


class _Room:
    """A few connections at a time: the oldest makes room for a newcomer."""

    def __init__(self) -> None:
        self._lock, self._open = threading.Lock(), dict[Any, None]()

    def enter(self, sock: Any) -> None:
        with self._lock:
            while len(self._open) >= MOST_CALLERS:
                oldest = next(iter(self._open))
                del self._open[oldest]
                with suppress(OSError):
                    oldest.shutdown(2)  # its thread sees the end, and closes it
            self._open[sock] = None

    def leave(self, sock: Any) -> None:
        with self._lock:
            self._open.pop(sock, None)


class _Callers:
    """Mixed into rospy's XML-RPC server."""

    _room = _Room()

    socket: Any

    def server_activate(self) -> None:
        self.socket.listen(_WAITING)

    def process_request(self, request: Any, client_address: Any) -> None:
        self._room.enter(request)
        super().process_request(request, client_address)  # type: ignore[misc]

    def shutdown_request(self, request: Any) -> None:
        self._room.leave(request)
        super().shutdown_request(request)  # type: ignore[misc]


class _Calls:
    """Mixed into the handler of its requests."""

    headers: Any

    def do_POST(self) -> None:  # noqa: N802 (http.server's name)
        length = self.headers.get("Content-Length", "")
        if "Origin" in self.headers:  # a page of a browser; ROS sends none
            self.send_error(403)  # type: ignore[attr-defined]
        elif not length.isdecimal() or int(length) > _LARGEST_CALL:
            self.send_error(413)  # type: ignore[attr-defined]
        else:
            super().do_POST()  # type: ignore[misc]
            return
        self.close_connection = True


class _Peers:
    """Takes the place of the method that reads a newcomer's header: each in a thread."""

    def __init__(self, accept: Any) -> None:
        self._accept, self._room, self._taken = accept, _Room(), list[Any]()

    def __get__(self, server: Any, _: type) -> Any:
        return lambda sock, address: self._begin(server, sock, address)

    def _begin(self, server: Any, sock: Any, address: Any) -> None:
        self._taken = [one for one in self._taken if one.fileno() >= 0]  # the others are closed
        if len(self._taken) >= MOST_PEERS + MOST_CALLERS:
            sock.close()
            return
        self._taken.append(sock)
        self._room.enter(sock)

        def read() -> None:
            try:
                self._accept(server, sock, address)
            finally:
                self._room.leave(sock)

        threading.Thread(target=read, daemon=True).start()


def _read_header(sock: Any, buffer: Any, size: int, error: type[Exception]) -> bytes:
    """A connection's header with its length before it; what follows goes into the buffer. Raises
    ``error`` for one that is too long, or does not come in time."""
    before, until_s = sock.gettimeout(), time.monotonic() + _HANDSHAKE_S
    data, whole = b"", 4
    try:
        while len(data) < whole:
            sock.settimeout(max(until_s - time.monotonic(), 1e-3))
            piece = sock.recv(size)
            if not piece:
                raise error("the connection ended before its header")
            data += piece
            if len(data) >= 4:
                whole = 4 + struct.unpack("<I", data[:4])[0]
                if whole > _LARGEST_HEADER:
                    raise error(f"a header of {whole} bytes is refused")
        sock.settimeout(before)
    except OSError as late:
        raise error(f"no header came within {_HANDSHAKE_S:g} s ({late})") from late
    buffer.seek(0)
    buffer.truncate()
    buffer.write(data[whole:])
    return data[:whole]
