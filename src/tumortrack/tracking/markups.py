"""Markups of 3D Slicer (.mrk.json, .fcsv) as points of the CT.

Slicer shows RAS and writes LPS; either may stand in a file, which says so. Format:
https://slicer.readthedocs.io/en/latest/developer_guide/modules/markups.html
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

import msgspec
import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.tracking.point_table import PointTable, numbers_of

_LPS_FROM = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0)}
_OLD_NUMBERS = {"0": "RAS", "1": "LPS"}  # how .fcsv named them before Slicer 4.11
_COLUMNS = ("label", "description", "ct_x", "ct_y", "ct_z")
_STATUS, _PLACED = 14, "2"  # a field that .fcsv has without naming it, and what it should say


class _ControlPoint(msgspec.Struct, rename="camel"):
    label: str = ""
    description: str = ""
    position: list[float] = []
    position_status: str = "defined"


class _Markup(msgspec.Struct, rename="camel"):
    control_points: list[_ControlPoint] = []
    coordinate_system: str = "missing"
    coordinate_units: str | list[str] = "mm"


class _Markups(msgspec.Struct):
    markups: list[_Markup]


def parse_markups_json(content: bytes, name: str) -> PointTable:
    """Every control point of every markup in the file.

    Raises:
        InputError: not the format, another unit than mm, a coordinate system that is neither LPS
            nor RAS, a position that is no three numbers.
    """
    try:
        data = msgspec.json.decode(content, type=_Markups)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise InputError(f"{name} is no markups file of 3D Slicer: {error}.") from error
    placed, missing = [], []
    for markup in data.markups:
        if set(np.atleast_1d(markup.coordinate_units).tolist()) != {"mm"}:
            raise InputError(f"{name}: the unit is {markup.coordinate_units!r}; it must be mm.")
        signs = _signs(markup.coordinate_system, name)
        for point in markup.control_points:
            if point.position_status != "defined":
                missing.append(point.label)
                continue
            place = numbers_of([str(x) for x in point.position], f"{name}, point {point.label!r}")
            placed.append((point.label, point.description, np.multiply(place, signs)))
    return _table(placed, missing, name)


def parse_fcsv(text: str, name: str) -> PointTable:
    """The points of a fiducial list.

    Raises:
        InputError: no header that names columns and coordinate system, a coordinate system that
            is neither LPS nor RAS, a row without three numbers.
    """
    system = re.search(r"^#\s*CoordinateSystem\s*=\s*(\w+)", text, re.MULTILINE)
    columns = re.search(r"^#\s*columns\s*=(.+)$", text, re.MULTILINE)
    signs = _signs(system.group(1) if system else "missing", name)
    names = [n.strip() for n in columns.group(1).split(",")] if columns else []
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{name}: its header lacks '# columns = id,x,y,z,...'. Save it again.")
    body = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    placed, missing = [], []
    try:
        rows = list(csv.reader(io.StringIO("\n".join(body))))
    except csv.Error as error:
        raise InputError(f"{name} is damaged: {error}. Save it again.") from error
    for row in rows:
        of = dict(zip(names, row, strict=False))
        label = of.get("label", "")
        if len(row) > _STATUS and row[_STATUS] != _PLACED:
            missing.append(label)
            continue
        place = numbers_of([of.get(a, "") for a in "xyz"], f"{name}, point {label!r}")
        placed.append((label, of.get("desc", ""), np.multiply(place, signs)))
    return _table(placed, missing, name)


def _signs(system: str, name: str) -> tuple[float, float, float]:
    known = _OLD_NUMBERS.get(system, system)
    if known not in _LPS_FROM:
        raise InputError(
            f"{name}: its coordinate system is {system}; it must be LPS or RAS. Save it in 3D "
            "Slicer again."
        )
    return _LPS_FROM[known]


def _table(
    placed: Sequence[tuple[str, str, np.ndarray]], missing: list[str], name: str
) -> PointTable:
    points = np.array([place for *_, place in placed]).reshape(-1, 3)
    rows = tuple(
        (label, description, *(f"{number:.5f}" for number in place))
        for label, description, place in placed
    )
    notes: tuple[str, ...] = ()
    if missing:
        notes = (f"{name}: left out what has no place yet: {', '.join(missing)}.",)
    return PointTable(points, _COLUMNS, rows, notes)
