"""Points of the CT as read from a file, and how its text becomes numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points of the CT (LPS, mm) and what their file says of each, as text.

    ``notes`` tell what a user must know of how the file was read.
    """

    points_ct: Float64[np.ndarray, "n 3"]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def text_of(content: bytes, name: str) -> str:
    """UTF-8 text, with or without a byte order mark.

    Raises:
        InputError: it is none.
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{name} is no text in UTF-8: {error}. Save it as CSV (UTF-8).") from error


def numbers_of(texts: list[str], where: str) -> tuple[float, float, float]:
    """Three finite numbers; ``where`` names the place in the file.

    Raises:
        InputError: fewer, more, or something else.
    """
    shown = ", ".join(texts)[:80]
    try:
        x, y, z = (float(text) for text in texts)
    except ValueError as error:
        raise InputError(f"{where}: {shown!r} is no point: it takes x, y, z as numbers.") from error
    if not np.isfinite([x, y, z]).all():
        raise InputError(f"{where}: {shown!r} has NaN or infinity; remove the point.")
    return x, y, z
