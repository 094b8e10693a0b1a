"""Points of the CT that a user asks about (vessels, margins, planned cuts): reading them, checking
them, and writing where they are now.

points.csv: a header and columns, mm: ct_x, ct_y, ct_z or x, y, z or l, p, s (all LPS), or r, a, s
(RAS). Further columns are kept. Markups of 3D Slicer (.mrk.json, .fcsv) say which of the two they
hold: https://slicer.readthedocs.io/en/latest/developer_guide/modules/markups.html
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.errors import InputError, NoEstimate, readable
from tumortrack.core.estimate import Motion
from tumortrack.core.store import read_file
from tumortrack.io.csv_tables import number_in, read_rows, text_of

FAR_MM = 100.0  # from the organ's box: hardly a point that the user means
_NEAR_MM = 20.0  # of the organ's box, where points in other units or axes are looked for
_LARGEST_MM = 1e7  # coordinate in any scanner's frame
_MOST_BYTES = 64 * 2**20
_CT = ("ct_x", "ct_y", "ct_z")
_NAMINGS = {_CT: "LPS", ("x", "y", "z"): "LPS", ("l", "p", "s"): "LPS", ("r", "a", "s"): "RAS"}
_NOT_PLACED = "0", "0.0", "false", "no"  # as programs write it in that column
_DEFINED = "defined"  # a column of 3D Slicer's tables: 0 where a point was never placed
_ADDED = ("camera_x", "camera_y", "camera_z", "std_mm")
_LPS_FROM = {"LPS": (1, 1, 1), "RAS": (-1, -1, 1)}
_OLD_NUMBERS = {"0": "RAS", "1": "LPS"}  # how .fcsv named them before Slicer 4.11
_STATUS, _PLACED = 14, "2"  # an unnamed field of .fcsv, and its value for a placed point


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points of the CT (LPS, mm) with the columns of their file as text, and ``notes`` for the user
    on how it was read."""

    points_ct: Float64[np.ndarray, "n 3"]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def read_points(path: Path) -> PointTable:
    """Read a .csv, .fcsv or .mrk.json. Raises InputError: no such file, another format or unit, no
    points, a number that is not finite, or a coordinate system other than LPS and RAS."""
    content = read_file(path, _MOST_BYTES, "Give the points in several files.")
    name = path.name.lower()
    parse = next((parse for end, parse in _PARSERS.items() if name.endswith(end)), None)
    if parse is None:
        raise InputError(f"{path}: points come as .csv, or from 3D Slicer as .fcsv or .mrk.json.")
    table = parse(content, str(path))
    if len(table.points_ct) == 0:
        raise InputError(f"{path} holds no points.")
    return table


def _parse_csv(content: bytes, name: str) -> PointTable:
    table = read_rows(content, name)
    columns, header = table.columns, table.header
    naming = next((names for names in _NAMINGS if set(names) <= columns.keys()), None)
    if naming is None:
        raise InputError(
            f"{name}: its first line is {','.join(header)[:80]!r}; it must name the columns x,y,z "
            "(or ct_x,ct_y,ct_z: LPS, mm), separated by commas."
        )
    place = columns.get(_DEFINED)
    rows = [row for row in table.rows if place is None or row[1][place].lower() not in _NOT_PLACED]
    without = len(table.rows) - len(rows)
    points_ct = table._replace(rows=tuple(rows)).numbers(naming) * _LPS_FROM[_NAMINGS[naming]]
    _check_size(points_ct, [f"{name}, line {line}" for line, _ in rows])
    # The file may be the output for an earlier frame, whose results are replaced.
    kept = [n for column, n in columns.items() if column not in _ADDED]
    notes = []
    if replaced := ", ".join(column for column in header if column.lower() in _ADDED):
        notes.append(f"{name}: its columns {replaced} give way to the answer's.")
    if without:
        count = f"{without} of {len(table.rows)} points"
        notes.append(f"{name}: left out {count} that have no place yet ({_DEFINED} is 0).")
    return PointTable(
        points_ct,
        tuple(header[n] for n in kept),
        tuple(tuple(row[n] for n in kept) for _, row in rows),
        tuple(notes),
    )


class _ControlPoint(msgspec.Struct, rename="camel"):
    label: str = ""
    description: str = ""
    position: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    position_status: str = "defined"


class _Markup(msgspec.Struct, rename="camel"):
    control_points: list[_ControlPoint] = []
    coordinate_system: str = "missing"
    coordinate_units: str | list[str] = "mm"


class _Markups(msgspec.Struct):
    markups: list[_Markup]


class _Fiducial(NamedTuple):
    label: str
    description: str
    point_ct: np.ndarray | None  # None: it has no place yet


def _parse_markups(content: bytes, name: str) -> PointTable:
    """All control points of all markups in the file."""
    with readable(name, "is no markups file of 3D Slicer"):
        data = msgspec.json.decode(content, type=_Markups)
    points: list[_Fiducial] = []
    for markup in data.markups:
        if set(np.atleast_1d(markup.coordinate_units).tolist()) != {"mm"}:
            raise InputError(f"{name}: the unit is {markup.coordinate_units!r}; it must be mm.")
        signs = _signs(markup.coordinate_system, name)
        for point in markup.control_points:
            place = signs * point.position if point.position_status == "defined" else None
            points.append(_Fiducial(point.label, point.description, place))
    return _fiducials(points, name)


def _parse_fcsv(content: bytes, name: str) -> PointTable:
    """The points of a fiducial list; its header names the columns and the coordinate system."""
    text = text_of(content, name)
    system = re.search(r"^#\s*CoordinateSystem\s*=\s*(\w+)", text, re.MULTILINE)
    columns = re.search(r"^#\s*columns\s*=(.+)$", text, re.MULTILINE)
    signs = _signs(system.group(1) if system else "missing", name)
    names = [n.strip() for n in columns.group(1).split(",")] if columns else []
    if not columns or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise InputError(f"{name}: its header lacks '# columns = id,x,y,z,...'. Save it again.")
    points: list[_Fiducial] = []
    with readable(name, "is damaged"):  # below the header # may begin a name
        rows = [row for row in csv.reader(io.StringIO(text[columns.end() :])) if any(row)]
    for row in rows:
        cells, place = dict(zip(names, row, strict=False)), None
        label = cells.get("label", "")
        if len(row) <= _STATUS or row[_STATUS] == _PLACED:
            where = f"{name}, point {label!r}"
            place = signs * [number_in(cells.get(axis, ""), where) for axis in "xyz"]
        points.append(_Fiducial(label, cells.get("desc", ""), place))
    return _fiducials(points, name)


def _signs(system: str, name: str) -> np.ndarray:
    known = _OLD_NUMBERS.get(system, system)
    if known not in _LPS_FROM:
        raise InputError(f"{name}: its coordinate system is {system}; it must be LPS or RAS.")
    return np.array(_LPS_FROM[known], float)


def _fiducials(points: list[_Fiducial], name: str) -> PointTable:
    missing = [point.label for point in points if point.point_ct is None]
    placed = [(point[:2], point.point_ct) for point in points if point.point_ct is not None]
    points_ct = np.reshape([place for _, place in placed], (-1, 3))
    _check_size(points_ct, [f"{name}, point {about[0]!r}" for about, _ in placed])
    note = f"{name}: left out {len(missing)} that have no place yet: {', '.join(missing)}."
    rows = tuple((*about, *(f"{x:.5f}" for x in place)) for about, place in placed)
    return PointTable(points_ct, ("label", "description", *_CT), rows, (note,) * bool(missing))


_PARSERS = {".json": _parse_markups, ".fcsv": _parse_fcsv, ".csv": _parse_csv}


def _check_size(points_ct: Float[np.ndarray, "n 3"], where: list[str]) -> None:
    for point_ct, place in zip(points_ct.tolist(), where, strict=True):
        if not all(abs(number) < _LARGEST_MM for number in point_ct):  # also false for NaN
            raise InputError(
                f"{place}: {point_ct} is NaN, infinite or more than {_LARGEST_MM / 1e6:g} km away."
            )


def check_near_organ(
    points_ct: Float[np.ndarray, "n 3"], organ_box_ct: Float[np.ndarray, "2 3"], name: str
) -> tuple[str, ...]:
    """Notes on points far from the organ in the CT. Raises InputError: all are, or they are near
    the organ only if read as RAS or as metres."""
    lower, upper = organ_box_ct

    def distance(scale: Any = 1.0) -> np.ndarray:
        scaled = points_ct * scale
        return np.linalg.norm(scaled - np.clip(scaled, lower, upper), axis=1)

    def share_near(scale: Any = 1.0) -> float:
        return float((distance(scale) <= _NEAR_MM).mean())

    box = f"the organ in the CT, {lower.round().tolist()} to {upper.round().tolist()} mm (LPS)"
    tiny = len(points_ct) > 1 and np.abs(points_ct).max() < 1  # metres, near the origin
    if (tiny or share_near() == 0) and share_near(1000) >= 0.5:
        raise InputError(
            f"{name}: the points are in metres, it seems: times 1000 they lie at {box}. Give mm."
        )
    if share_near() == 0 and share_near([-1, -1, 1]) >= 0.5:
        raise InputError(
            f"{name}: the points are RAS, it seems: with the other sign of x and y they lie at "
            f"{box}. Turn them to LPS, or name their columns r,a,s."
        )
    far = distance() > FAR_MM
    away = f"more than {FAR_MM:g} mm away from {box}"
    if far.all():
        raise InputError(f"{name}: every point lies {away}. Give them in the CT's frame.")
    if not far.any():
        return ()
    count = f"{far.sum()} of {len(far)} points"
    return (f"{name}: {count} lie {away}; nothing is known of how they moved.",)


def camera_table(table: PointTable, motion: Motion | None) -> bytes:
    """The table as CSV with camera_x, camera_y, camera_z and, if the motion knows it, std_mm.
    Raises InputError: there is no motion; NoEstimate: a point's place is not finite."""
    if motion is None:
        raise InputError("this estimate does not know where points of the CT are.")
    camera_mm, std_mm = motion.forward(table.points_ct), motion.std_mm(table.points_ct)
    added = camera_mm if std_mm is None else np.column_stack([camera_mm, std_mm])
    if not np.isfinite(added).all():
        raise NoEstimate("the motion carries some of the points to no place that is a number.")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*table.columns, *_ADDED[: added.shape[1]]])
    for row, numbers in zip(table.rows, added, strict=True):
        writer.writerow([*row, *(f"{number:.4f}" for number in numbers)])
    return stream.getvalue().encode()
