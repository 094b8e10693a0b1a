"""Files inside an MCAP: its attachments (https://mcap.dev/spec), which rosbags neither writes nor
reads. They go to the end of the data; the summary behind, of a few kilobytes, is written anew."""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from tumortrack.core.errors import InputError

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _ATTACHMENT, _INDEX, _STATISTICS, _OFFSETS, _DATA_END = 0x02, 0x09, 0x0A, 0x0B, 0x0E, 0x0F
_END = 9 + 20 + len(_MAGIC)  # bytes from the footer to the end
_DATA_END_BYTES = 9 + 4
_COUNT_AT = 8 + 2 + 4  # of attachments, within the statistics


def attach(path: Path, files: Mapping[str, bytes]) -> None:
    """Add files to a finished MCAP that has none; it is on the disk then, also for a power cut.
    Raises InputError: it is not finished."""
    begin, records = _summary(path)
    indexes = b""
    with path.open("r+b") as stream:
        stream.seek(begin - _DATA_END_BYTES)
        for name, data in files.items():
            at, now_ns, names = stream.tell(), time.time_ns(), _text(name) + _text("")
            times = struct.pack("<QQ", now_ns, now_ns)
            content = times + names + struct.pack("<Q", len(data)) + data
            stream.write(_record(_ATTACHMENT, content + struct.pack("<I", zlib.crc32(content))))
            where = struct.pack("<QQ", at, stream.tell() - at)
            indexes += _record(_INDEX, where + times + struct.pack("<Q", len(data)) + names)
        stream.write(_record(_DATA_END, bytes(4)))
        begin = stream.tell()
        for opcode, content in records:
            if opcode == _STATISTICS:
                count = struct.pack("<I", len(files))
                content = content[:_COUNT_AT] + count + content[_COUNT_AT + 4 :]
            if opcode != _OFFSETS:  # of places that are others now; they may be left out
                stream.write(_record(opcode, content))
        stream.write(indexes + _record(_FOOTER, struct.pack("<QQI", begin, 0, 0)) + _MAGIC)
        stream.truncate()
        stream.flush()
        os.fsync(stream.fileno())


def attachments_of(path: Path) -> dict[str, bytes]:
    """The attachments of a finished MCAP by name. Raises InputError: it is none, or damaged."""
    found = {}
    try:
        with path.open("rb") as stream:
            for opcode, content in _summary(path)[1]:
                if opcode == _INDEX:
                    at, length, _, _, size, name_size = struct.unpack_from("<5QI", content)
                    stream.seek(at + 9)
                    body = stream.read(length - 9)
                    if zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
                        raise InputError(f"{path} is damaged: an attachment's checksum differs.")
                    found[content[44 : 44 + name_size].decode()] = body[-4 - size : -4]
    except (struct.error, UnicodeDecodeError, MemoryError, OverflowError) as error:
        raise InputError(f"{path} is damaged: {error}.") from error
    return found


def _summary(path: Path) -> tuple[int, list[tuple[int, bytes]]]:
    """Where it begins, and its records."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - _END, 0))
        end = stream.read()
        if len(end) != _END or not end.endswith(_MAGIC) or end[0] != _FOOTER:
            raise InputError(f"{path} is no finished MCAP.")
        (begin,) = struct.unpack_from("<Q", end, 9)
        stream.seek(begin)
        return begin, list(_records(stream.read()[:-_END]))


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield opcode, data[at + 9 : at + 9 + length]
        at += 9 + length


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()
