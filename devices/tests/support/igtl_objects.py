"""A reader of OpenIGTLink straight from the protocol's documents: it shares nothing with ours."""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from clock import PATIENCE_S


def slow_crc(data: bytes) -> int:
    """CRC-64 of ECMA-182 bit by bit: polynomial 42F0E1EBA9EA3693, register 0."""
    value = 0
    for byte in data:
        for bit in range(7, -1, -1):
            carry = (value >> 63) ^ ((byte >> bit) & 1)
            value = ((value << 1) & (2**64 - 1)) ^ (0x42F0E1EBA9EA3693 if carry else 0)
    return value


@dataclass
class Heard:
    type: str
    device: str
    seconds: float
    content: bytes
    metadata: dict[str, str]


def exactly(sock: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = sock.recv(size - len(data))
        if not piece:
            raise EOFError
        data += piece
    return data


def hear(sock: socket.socket) -> Heard:
    """The next message, header version 2."""
    head = exactly(sock, 58)
    assert int.from_bytes(head[:2], "big") == 2
    kind, device = head[2:14].rstrip(b"\0").decode(), head[14:34].rstrip(b"\0").decode()
    seconds = int.from_bytes(head[34:42], "big") / 2**32
    body = exactly(sock, int.from_bytes(head[42:50], "big"))
    if len(body) < 2000:
        assert int.from_bytes(head[50:58], "big") == slow_crc(body)
    ext, index_size, texts_size = struct.unpack(">HHI", body[:8])
    assert ext == 12
    end = len(body) - index_size - texts_size
    index, texts = body[end : end + index_size], body[end + index_size :]
    metadata = {}
    for n in range(int.from_bytes(index[:2], "big")):
        k, _, v = struct.unpack(">HHI", index[2 + 8 * n : 10 + 8 * n])
        metadata[texts[:k].decode()] = texts[k : k + v].decode()
        texts = texts[k + v :]
    return Heard(kind, device, seconds, body[12:end], metadata)


def hear_all(sock: socket.socket, wanted: int, wait_s: float = PATIENCE_S) -> dict[tuple, Heard]:
    """Messages by type and device, until there are ``wanted`` different ones."""
    sock.settimeout(wait_s)
    messages: dict[tuple, Heard] = {}
    while len(messages) < wanted:
        message = hear(sock)
        messages[message.type, message.device] = message
    return messages


def polydata_by_the_book(content: bytes) -> dict:
    """Points, cells by kind and attributes, as polydata.md lays them out."""
    counts = struct.unpack(">10I", content[:40])
    at = 40
    points = struct.unpack(f">{3 * counts[0]}f", content[at : at + 12 * counts[0]])
    at += 12 * counts[0]
    out: dict = {"points": np.reshape(points, (-1, 3))}
    for n, name in enumerate(("vertices", "lines", "polygons", "strips")):
        number, size = counts[1 + 2 * n : 3 + 2 * n]
        cells, end = [], at + size
        while at < end:
            (length,) = struct.unpack(">I", content[at : at + 4])
            cells.append(struct.unpack(f">{length}I", content[at + 4 : at + 4 + 4 * length]))
            at += 4 + 4 * length
        assert (len(cells), at) == (number, end)
        out[name] = cells
    kinds = [struct.unpack(">BBI", content[at + 6 * n : at + 6 * n + 6]) for n in range(counts[9])]
    at += 6 * counts[9]
    names, start = [], at
    for _ in kinds:
        end = content.index(b"\0", at)
        names.append(content[at:end].decode())
        at = end + 1
    at += (at - start) % 2
    for name, (kind, components, number) in zip(names, kinds, strict=True):
        size = 4 * components * number
        values = struct.unpack(f">{components * number}f", content[at : at + size])
        out[name] = (kind, components, np.array(values))
        at += size
    assert at == len(content)
    return out


class IgtlStatus(NamedTuple):
    """What a STATUS says: ``code`` 1 is well."""

    code: int
    name: str
    text: str


def status_by_the_book(content: bytes) -> IgtlStatus:
    code, _, name = struct.unpack(">Hq20s", content[:30])
    return IgtlStatus(code, name.rstrip(b"\0").decode(), content[30:].split(b"\0")[0].decode())
