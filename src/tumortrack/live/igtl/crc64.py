"""The checksum of OpenIGTLink: CRC-64 of ECMA-182, register 0 at the start, nothing turned round.

Source: ECMA-182 (1992), annex B; the protocol's Documents/Protocol/header.md.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

_POLYNOMIAL = 0x42F0E1EBA9EA3693
_MASK = (1 << 64) - 1


def _tables() -> np.ndarray:
    """(8, 256): row n carries a byte over n more bytes, so that eight are taken in one step."""
    first = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = ((value << 1) ^ (_POLYNOMIAL if value >> 63 else 0)) & _MASK
        first.append(value)
    rows = [first]
    for _ in range(7):
        rows.append([((v << 8) & _MASK) ^ first[v >> 56] for v in rows[-1]])
    return np.array(rows, np.uint64)


@cache
def _kernel() -> tuple[Callable[[np.ndarray, np.ndarray], np.uint64], np.ndarray]:
    import numba  # here: whoever only reads configurations does not wait for it

    @numba.njit(cache=True, nogil=True)
    def crc(data, tables):  # type: ignore[no-untyped-def]
        value = np.uint64(0)
        low, eight = np.uint64(0xFF), np.uint64(8)
        whole = len(data) // 8 * 8
        for at in range(0, whole, 8):
            word = np.uint64(0)
            for n in range(8):
                word = (word << eight) | np.uint64(data[at + n])
            word ^= value
            value = np.uint64(0)
            for n in range(8):
                value ^= tables[n, (word >> np.uint64(8 * n)) & low]
        for at in range(whole, len(data)):
            top = (value >> np.uint64(56)) ^ np.uint64(data[at])
            value = (value << eight) ^ tables[0, top]
        return value

    return crc, _tables()


def crc64(data: bytes | bytearray | memoryview) -> int:
    """Checksum of a message's body."""
    crc, tables = _kernel()
    return int(crc(np.frombuffer(data, np.uint8), tables))
