"""Clients that mean harm, or are broken: many, silent, slow, deaf, and saying no message."""

from __future__ import annotations

import contextlib
import random
import socket
from collections.abc import Iterator
from pathlib import Path

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


def noise(size: int = 300, seed: int = 3) -> bytes:
    return random.Random(seed).randbytes(size)


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20
