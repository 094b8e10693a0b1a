"""MCAP files without an end, as a killed recorder or a full disk leaves them.

Format: https://mcap.dev/spec. A file is magic, records (opcode, length, content), footer, magic;
readers begin at the footer. Here the records that are whole get a footer that says "no index", in
memory, so that the library reads them from the first to the last; the file stays as it is.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

_MAGIC = b"\x89MCAP0\r\n"
_DATA_END = 0x0F
_LAST_OPCODE = 0x0F
# An empty DataEnd, then a footer of three zeros: where a summary would start, and its checksum.
_ENDING = struct.pack("<BQI", _DATA_END, 4, 0) + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + _MAGIC


def is_whole(path: Path) -> bool:
    """Whether the file ends as it should; of one without a beginning too, which is no MCAP."""
    with path.open("rb") as stream:
        begins = stream.read(len(_MAGIC)) == _MAGIC
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(size - len(_MAGIC), 0))
        return not begins or (size > len(_MAGIC) and stream.read() == _MAGIC)


def open_cut(path: Path) -> Any:
    """rosbags' reader, opened on the file's whole records."""
    from rosbags.rosbag2.storage_mcap import McapReader

    reader = McapReader(_Ended(path))  # type: ignore[arg-type]
    reader.open()
    return reader


class _Ended:
    """Stands for a path: what the reader opens has an end."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self, mode: str) -> io.BufferedReader:
        return io.BufferedReader(_EndedFile(self._path))

    def __str__(self) -> str:
        return str(self._path)


class _EndedFile(io.RawIOBase):
    """The first part of a file, followed by the ending."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self._kept = _end_of_records(self._stream)
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._kept + len(_ENDING)}
        self._at = max(start[whence] + offset, 0)
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._kept:
            self._stream.seek(self._at)
            got = self._stream.read(min(len(buffer), self._kept - self._at))
        else:
            begin = self._at - self._kept
            got = _ENDING[begin : begin + len(buffer)]
        buffer[: len(got)] = got
        self._at += len(got)
        return len(got)

    def close(self) -> None:
        self._stream.close()
        super().close()


def _end_of_records(stream: io.BufferedReader) -> int:
    """Behind the last record that is there from its first to its last byte."""
    size = stream.seek(0, io.SEEK_END)
    end = len(_MAGIC)
    while True:
        stream.seek(end)
        head = stream.read(9)
        if len(head) < 9 or not 0 < head[0] < _LAST_OPCODE:
            return end
        beyond = end + 9 + int.from_bytes(head[1:], "little")
        if beyond > size:
            return end
        end = beyond
