"""Tables that users give, as CSV."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Callable, Sequence
from decimal import Decimal, DecimalException
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64, Int64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.core.store import read_file

T = TypeVar("T")
COLUMNS = "stamp_ns,frame_id,x_mm,y_mm,z_mm,qw,qx,qy,qz"
CONTACT = ",contact"  # one more, of a tool: 1 while its tip touches, else 0
_NOT_UNIT = 1e-3  # tolerance of a quaternion's length: files have few digits
_LARGEST_TABLE = 256 * 2**20  # bytes
_ABOVE = re.compile(r"((#.*|sep=.)?\r?\n)*")  # Excel states its separator so
_DECIMAL = re.compile(r"^(-?\d*),(\d+)$")
_UTF16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE


class Rows(NamedTuple):
    """A table's header, and each row's line in the file and cells, as many as there are columns."""

    name: str
    header: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]

    @property
    def columns(self) -> dict[str, int]:
        """Places of the columns by name, in lower case."""
        return {cell.lower(): place for place, cell in enumerate(self.header)}

    def column(self, name: str, read: Callable[[str, str], T]) -> list[T]:
        """Its cells, by ``number_in`` or ``whole_in``, whose errors name line and column."""
        at = self.columns[name]
        return [
            read(row[at], f"{self.name}, line {line}, column {name}") for line, row in self.rows
        ]

    def numbers(self, names: Sequence[str]) -> Float64[np.ndarray, "rows columns"]:
        """Of several columns. Raises InputError."""
        return np.reshape(
            [self.column(name, number_in) for name in names], (len(names), len(self.rows))
        ).T


def read_rows(
    content: bytes, name: str, needed: Sequence[str] = (), further: Sequence[str] | None = None
) -> Rows:
    """A table as spreadsheets write it: UTF-8, or UTF-16 with its mark; separated by commas, or by
    semicolons or tabs, and then perhaps with decimal commas. Spaces round cells, empty rows,
    separators at the ends of rows, and lines above the header that begin with # do not count.

    Raises InputError: no text or table, no header, a column twice, a row with more or fewer cells,
    a ``needed`` column is missing, or one is neither that nor ``further`` (None: all are allowed).
    """
    text = text_of(content, name)
    above = _ABOVE.match(text).end()  # type: ignore[union-attr]  # it matches what is empty, too
    top = text[above:].partition("\n")[0]
    between = max(";\t,", key=top.count) if "," not in top else ","
    text = "\n" * text.count("\n", 0, above) + text[above:]  # lines keep their numbers
    reader = csv.reader(
        io.StringIO(text, newline=""), strict=True, skipinitialspace=True, delimiter=between
    )
    try:
        read = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
        if between != ",":
            read = [(line, [_DECIMAL.sub(r"\1.\2", cell) for cell in row]) for line, row in read]
    except csv.Error as error:
        raise InputError(f"{name}, line {reader.line_num}: {error}. Export it again.") from error
    lines = [(line, row) for line, row in read if any(row)]
    if len(lines) < 2:
        raise InputError(f"{name} has no rows; it needs a header, and a line for each of them.")
    header = lines[0][1]
    while not header[-1]:
        header.pop()
    lower, kept = [cell.lower() for cell in header], []
    if doubled := [cell for cell in lower if lower.count(cell) > 1]:
        raise InputError(
            f"{name} has the column {doubled[0]!r} twice; columns must have different names."
        )
    strange = [] if further is None else [c for c in lower if c not in (*needed, *further)]
    if strange or (missing := [column for column in needed if column not in lower]):
        fault = f"has the column {strange[0]!r}" if strange else f"lacks {', '.join(missing)}"
        allowed = f", and perhaps {', '.join(further)}" if further else ""
        raise InputError(f"{name} {fault}; its columns must be {', '.join(needed)}{allowed}.")
    for line, row in lines[1:]:
        while len(row) > len(header) and not row[-1]:
            row.pop()
        if len(row) != len(header):
            raise InputError(f"{name}, line {line}: {len(row)} values in {len(header)} columns.")
        kept.append((line, tuple(row)))
    return Rows(name, tuple(header), tuple(kept))


def text_of(content: bytes, name: str) -> str:
    """Text in UTF-8, with or without a byte order mark, or in UTF-16 with one."""
    try:
        return content.decode("utf-16" if content.startswith(_UTF16) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{name} is no text in UTF-8: {error}. Save it as CSV (UTF-8).") from error


def number_in(text: str, where: str) -> float:
    """``where``: file, line and column, for the message."""
    try:
        if "_" in text:  # which Python alone takes
            raise ValueError
        return float(text)
    except ValueError as error:
        raise InputError(f"{where}: {text[:40]!r} is no number.") from error


def whole_in(text: str, where: str) -> int:
    """To the last digit, also of 1.7e18."""
    try:
        number = Decimal(text)
        if number == number.to_integral_value() and abs(number) < 2**63:
            return int(number)
    except DecimalException:  # no number, or an exponent beyond its own range
        pass
    raise InputError(f"{where}: {text[:40]!r} is no whole number, or beyond 63 bits.")


class PoseTable(NamedTuple):
    """Rising stamps, of each one pose in the frame ``frame_id``, mm, and, where the table says it,
    whether a tip touches."""

    frame_id: str
    stamps_ns: Int64[np.ndarray, " n"]
    poses: Float64[np.ndarray, "n 4 4"]
    touches: list[bool]


def read_pose_table(path: Path) -> PoseTable:
    """A table of stamped poses (docs/conventions.md). Raises InputError: there is none, or it is
    damaged."""
    names, contact = COLUMNS.split(","), CONTACT[1:]
    table = read_rows(read_file(path, _LARGEST_TABLE), str(path), names, [contact])
    stamps_ns = np.array(table.column("stamp_ns", whole_in), np.int64)
    frames = set(table.column("frame_id", lambda text, _: text))
    numbers = table.numbers(names[2:])
    touches = table.numbers([contact] if contact in table.columns else [])
    lengths = np.linalg.norm(numbers[:, 3:], axis=1)
    faults = {
        "contact must be 0 or 1": np.isin(touches, (0, 1)).all(),
        "stamps must rise": (np.diff(stamps_ns) > 0).all(),
        "frame_id must be one name, in every row": len(frames) == 1 and "" not in frames,
        "places must be finite": np.isfinite(numbers).all(),
        "qw, qx, qy, qz must have length 1": (np.abs(lengths - 1) < _NOT_UNIT).all(),
    }
    if wrong := [what for what, met in faults.items() if not met]:
        raise InputError(f"{path} is not a table of poses: {wrong[0]}.")
    from scipy.spatial.transform import Rotation  # slow to import

    turns = Rotation.from_quat(numbers[:, 3:], scalar_first=True).as_matrix()
    poses = np.array([*map(rigid, turns, numbers[:, :3])])
    return PoseTable(frames.pop(), stamps_ns, poses, (touches.ravel() == 1).tolist())
