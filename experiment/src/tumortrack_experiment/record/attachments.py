"""Files inside an MCAP: its attachments (https://mcap.dev/spec), which rosbags neither writes nor
reads.

A finished MCAP is: magic, data, summary (schemas, channels, indexes, statistics), footer, magic.
Attachments go to the end of the data, and the summary, a few kilobytes, is written anew.
"""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from tumortrack.core.errors import InputError

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _ATTACHMENT, _ATTACHMENT_INDEX, _STATISTICS, _DATA_END = 0x02, 0x09, 0x0A, 0x0B, 0x0F
_SUMMARY_OFFSET = 0x0E
_END = 9 + 20 + len(_MAGIC)  # bytes from the footer to the end
_COUNT_AT = 8 + 2 + 4  # of attachments, within the statistics
_MEDIA = {".json": "application/json", ".csv": "text/csv"}


def attach(path: Path, files: Mapping[str, bytes]) -> None:
    """Add files to a finished MCAP that has none. Raises InputError: it is not finished."""
    with path.open("r+b") as stream:
        summary_at = _summary_at(path)
        stream.seek(summary_at)
        summary = stream.read()[:-_END]
        # The record before the summary says where the data end: 4 bytes, after its head of 9.
        stream.seek(summary_at - 13)
        indexes = b""
        for name, data in files.items():
            begin, now_ns = stream.tell(), time.time_ns()
            media = _text(_MEDIA.get(Path(name).suffix, "application/octet-stream"))
            head = struct.pack("<QQ", now_ns, now_ns) + _text(name) + media
            content = head + struct.pack("<Q", len(data)) + data
            stream.write(_record(_ATTACHMENT, content + struct.pack("<I", zlib.crc32(content))))
            where = struct.pack("<QQ", begin, stream.tell() - begin)
            sizes = struct.pack("<QQQ", now_ns, now_ns, len(data))
            indexes += _record(_ATTACHMENT_INDEX, where + sizes + _text(name) + media)
        stream.write(_record(_DATA_END, bytes(4)))
        begin = stream.tell()
        for opcode, content in _records(summary):
            if opcode == _STATISTICS:
                count = struct.pack("<I", len(files))
                content = content[:_COUNT_AT] + count + content[_COUNT_AT + 4 :]
            if opcode != _SUMMARY_OFFSET:  # of places that are others now; they may be left out
                stream.write(_record(opcode, content))
        stream.write(indexes + _record(_FOOTER, struct.pack("<QQI", begin, 0, 0)) + _MAGIC)
        stream.truncate()


def attachments_of(path: Path) -> dict[str, bytes]:
    """The attachments of a finished MCAP by name. Raises InputError: it is none, or damaged."""
    found = {}
    try:
        with path.open("rb") as stream:
            stream.seek(_summary_at(path))
            for opcode, content in _records(stream.read()[:-_END]):
                if opcode == _ATTACHMENT_INDEX:
                    stream.seek(struct.unpack_from("<Q", content)[0] + 9)
                    length = struct.unpack_from("<Q", content, 8)[0] - 9
                    body = stream.read(length)
                    if zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
                        raise InputError(f"{path} is damaged: an attachment's checksum differs.")
                    size = struct.unpack_from("<Q", content, 32)[0]
                    name_end = 44 + struct.unpack_from("<I", content, 40)[0]
                    found[content[44:name_end].decode()] = body[-4 - size : -4]
    except (struct.error, UnicodeDecodeError) as error:
        raise InputError(f"{path} is damaged: {error}.") from error
    return found


def _summary_at(path: Path) -> int:
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - _END, 0))
        end = stream.read()
    if len(end) != _END or not end.endswith(_MAGIC) or end[0] != _FOOTER:
        raise InputError(f"{path} is no finished MCAP.")
    return int(struct.unpack_from("<Q", end, 9)[0])


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
