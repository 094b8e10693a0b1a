"""A message's frame: header, extended header, metadata and checksum; contents are in ``content``.

Header version 2 (protocol 3), which 3D Slicer (since 4.7), PLUS and pyigtl read: version 1 has no
metadata, so nothing could say in which frame a place is given or that a transform is missing.
Version 1 is read too, since clients' requests come in it. All numbers are big-endian.
Source: the protocol's Documents/Protocol/header.md and timestamp.md.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from tumortrack.core.errors import InputError
from tumortrack.live.igtl.crc64 import crc64

HEADER_SIZE = 58
_HEADER = struct.Struct("> H 12s 20s Q Q Q")
_EXTENDED = struct.Struct("> H H I I")
_ENTRY = struct.Struct("> H H I")
_ASCII, _UTF8 = 3, 106  # IANA's numbers of character sets
_NS = 1_000_000_000


class ProtocolError(InputError):
    """Bytes that are no message, or a message that the protocol cannot hold."""


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        type: TRANSFORM, STATUS, POLYDATA, GET_STATUS, ...; at most 12 ASCII characters.
        device: whose it is; at most 20 ASCII characters.
        stamp_ns: since 1970, UTC; 0: unknown. Kept to 1/4 ns.
        content: the type's own bytes.
        metadata: texts by name.
    """

    type: str
    device: str
    stamp_ns: int = 0
    content: bytes = b""
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Header:
    """What the first 58 bytes say; ``body_size`` bytes follow."""

    version: int
    type: str
    device: str
    stamp_ns: int
    body_size: int
    crc: int


def pack(message: Message) -> bytes:
    """The message as it goes over the wire.

    Raises:
        ProtocolError: a name too long or not ASCII, a stamp before 1970 or after 2106.
    """
    keys, values = _packed_metadata(message.metadata)
    extended = _EXTENDED.pack(_EXTENDED.size, len(keys), len(values), 0)
    body = b"".join((extended, message.content, keys, values))
    head = _HEADER.pack(
        2,
        _name(message.type, 12, "type"),
        _name(message.device, 20, "device name"),
        _fixed_point(message.stamp_ns),
        len(body),
        crc64(body),
    )
    return head + body


def unpack_header(data: bytes) -> Header:
    """Read a header.

    Raises:
        ProtocolError: not 58 bytes, an unknown version, names that are no text.
    """
    if len(data) != HEADER_SIZE:
        raise ProtocolError(f"an OpenIGTLink header has {HEADER_SIZE} bytes, not {len(data)}.")
    version, kind, device, stamp, size, crc = _HEADER.unpack(data)
    if version not in (1, 2, 3):
        raise ProtocolError(f"header version {version} is unknown; 1, 2 and 3 are read.")
    try:
        names = [raw.split(b"\0")[0].decode("ascii") for raw in (kind, device)]
    except UnicodeDecodeError as error:
        raise ProtocolError(
            f"the header's type or device name is no ASCII text: {error}."
        ) from error
    return Header(version, names[0], names[1], (stamp * _NS + (1 << 31)) >> 32, size, crc)


def unpack(header: Header, body: bytes) -> Message:
    """The message of a header and the body that followed it.

    Raises:
        ProtocolError: a wrong length or checksum, or sizes inside that do not fit.
    """
    if len(body) != header.body_size:
        raise ProtocolError(
            f"{header.type}: the body has {len(body)} bytes; its header says {header.body_size}."
        )
    if crc64(body) != header.crc:
        raise ProtocolError(f"{header.type} of {header.device!r}: its checksum is wrong (damaged).")
    content, metadata = body, {}
    if header.version > 1:
        try:
            size, keys_size, values_size, _ = _EXTENDED.unpack_from(body)
        except struct.error as error:
            raise ProtocolError(f"{header.type}: its extended header is cut short.") from error
        end = len(body) - keys_size - values_size
        if not _EXTENDED.size <= size <= end:
            raise ProtocolError(f"{header.type}: its extended header's sizes do not fit.")
        content = body[size:end]
        if keys_size:
            metadata = _read_metadata(body[end : end + keys_size], body[end + keys_size :])
    return Message(header.type, header.device, header.stamp_ns, content, metadata)


def _name(text: str, size: int, what: str) -> bytes:
    if not text.isascii() or len(text) > size:
        raise ProtocolError(f"{what} {text!r}: at most {size} ASCII characters are allowed.")
    return text.encode("ascii")


def _fixed_point(stamp_ns: int) -> int:
    """Seconds in the upper 32 bits, their fraction in the lower ones."""
    fixed = ((stamp_ns << 32) + _NS // 2) // _NS
    if not 0 <= fixed < 1 << 64:
        raise ProtocolError(f"stamp {stamp_ns} ns lies before 1970 or after 2106.")
    return fixed


def _packed_metadata(metadata: Mapping[str, str]) -> tuple[bytes, bytes]:
    """The index (count and sizes), and the keys and values themselves."""
    index, texts = [struct.pack("> H", len(metadata))], []
    for key, value in metadata.items():
        name, text = key.encode("ascii"), value.encode("utf-8")
        index.append(_ENTRY.pack(len(name), _ASCII if value.isascii() else _UTF8, len(text)))
        texts += [name, text]
    return b"".join(index), b"".join(texts)


def _read_metadata(index: bytes, texts: bytes) -> dict[str, str]:
    found, at = {}, 0
    try:
        (count,) = struct.unpack_from("> H", index)
        for n in range(count):
            key_size, charset, value_size = _ENTRY.unpack_from(index, 2 + n * _ENTRY.size)
            key = texts[at : at + key_size].decode("ascii")
            value = texts[at + key_size : at + key_size + value_size]
            at += key_size + value_size
            found[key] = value.decode("utf-8" if charset == _UTF8 else "latin-1")
    except (struct.error, UnicodeDecodeError) as error:
        raise ProtocolError(f"the message's metadata are damaged: {error}.") from error
    if at != len(texts):
        raise ProtocolError(f"the metadata's sizes add up to {at} of {len(texts)} bytes.")
    return found
