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
                one = socket.socket()
                open_ones.callback(one.close)
                one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
                one.settimeout(5)
                one.connect(("127.0.0.1", port))
                sockets.append(one)
                one.settimeout(0.05)
                one.sendall(opening)
        yield sockets


def drip(sockets: list[socket.socket], byte: bytes) -> None:
    """One more byte on every connection."""
    for one in sockets:
        with contextlib.suppress(OSError):
            one.send(byte)


def noise(size: int = 300, seed: int = 3) -> bytes:
    return random.Random(seed).randbytes(size)


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20
