"""Points of the CT that a user asks about (vessels, margins, planned cuts): read, check, answer.

points.csv: a header, columns separated by commas, coordinates in mm in one of four namings:
ct_x, ct_y, ct_z or x, y, z or l, p, s (all LPS), or r, a, s (RAS, turned to LPS here). Further
columns (label, name, ...) are kept as they are.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Motion
from tumortrack.tracking.markups import parse_fcsv, parse_markups_json
from tumortrack.tracking.point_table import PointTable, numbers_of, text_of

FAR_MM = 100.0  # from the organ's box: such a point is hardly meant
_NEAR_MM = 20.0  # a point about the organ, where another reading of the file is weighed
_MOST_BYTES = 64 * 2**20
_NAMINGS: dict[tuple[str, str, str], tuple[int, int, int]] = {
    ("ct_x", "ct_y", "ct_z"): (1, 1, 1),
    ("x", "y", "z"): (1, 1, 1),
    ("l", "p", "s"): (1, 1, 1),
    ("r", "a", "s"): (-1, -1, 1),
}
_ANSWER = ("camera_x", "camera_y", "camera_z", "std_mm")


def read_points(path: Path) -> PointTable:
    """Read points.csv, or a 3D Slicer markups file (.fcsv, .mrk.json).

    Raises:
        InputError: no such file, another format, no points, a value that is no finite number, or
            a Slicer file whose coordinate system is neither LPS nor RAS.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path} is larger than 64 MiB; give the points in several files.")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    name = path.name.lower()
    if name.endswith(".json"):
        table = parse_markups_json(content, str(path))
    elif name.endswith(".fcsv"):
        table = parse_fcsv(text_of(content, str(path)), str(path))
    elif name.endswith(".csv"):
        table = _parse_csv(text_of(content, str(path)), str(path))
    else:
        raise InputError(f"{path}: points come as .csv, or from 3D Slicer as .fcsv or .mrk.json.")
    if len(table.points_ct) == 0:
        raise InputError(f"{path} holds no points.")
    return table


def _parse_csv(text: str, name: str) -> PointTable:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{name}, line {reader.line_num}: {error}. Export it again.") from error
    if not lines:
        raise InputError(f"{name} is empty; it needs a header with x,y,z and a line a point.")
    header = [cell.strip() for cell in lines[0][1]]
    lower = [cell.lower() for cell in header]
    if len(set(lower)) < len(lower):
        raise InputError(f"{name}: its columns {','.join(header)} must have different names.")
    naming = next((names for names in _NAMINGS if set(names) <= set(lower)), None)
    if naming is None:
        raise InputError(
            f"{name}: its first line is {','.join(header)[:80]!r}; it must name the columns x,y,z "
            "(or ct_x,ct_y,ct_z: LPS, mm), separated by commas."
        )
    where, kept = [lower.index(axis) for axis in naming], []
    points = np.empty((len(lines) - 1, 3))
    for number, (line, row) in enumerate(lines[1:]):
        if len(row) != len(header):
            raise InputError(f"{name}, line {line}: {len(row)} values in {len(header)} columns.")
        points[number] = numbers_of([row[n] for n in where], f"{name}, line {line}")
        kept.append(row)
    # An answer to an earlier frame may be asked again: the old one gives way.
    stay = [n for n, column in enumerate(lower) if column not in _ANSWER]
    gone = [column for column in header if column.lower() in _ANSWER]
    notes = (f"{name}: its columns {', '.join(gone)} give way to the answer's.",) if gone else ()
    return PointTable(
        points * np.array(_NAMINGS[naming], float),
        tuple(header[n] for n in stay),
        tuple(tuple(row[n] for n in stay) for row in kept),
        notes,
    )


def check_near_organ(
    points_ct: Float[np.ndarray, "n 3"], organ_box_ct: Float[np.ndarray, "2 3"], name: str
) -> tuple[str, ...]:
    """Notes on points that lie far from the organ in the CT.

    Raises:
        InputError: all do, or they lie about the organ only if read as RAS or as metres.
    """
    lower, upper = organ_box_ct

    def distance(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - np.clip(points, lower, upper), axis=1)

    def share_near(points: np.ndarray) -> float:
        return float((distance(points) <= _NEAR_MM).mean())

    box = f"the organ in the CT, {lower.round().tolist()} to {upper.round().tolist()} mm (LPS)"
    tiny = len(points_ct) > 1 and np.abs(points_ct).max() < 1  # as metres are, round the origin
    if (tiny or share_near(points_ct) == 0) and share_near(1000 * points_ct) >= 0.5:
        raise InputError(
            f"{name}: the points are in metres, it seems: times 1000 they lie at {box}. Give mm."
        )
    if share_near(points_ct) == 0 and share_near(points_ct * [-1, -1, 1]) >= 0.5:
        raise InputError(
            f"{name}: the points are RAS, it seems: with the other sign of x and y they lie at "
            f"{box}. Turn them to LPS, or name their columns r,a,s."
        )
    far = distance(points_ct) > FAR_MM
    if far.all():
        raise InputError(
            f"{name}: every point lies more than {FAR_MM:g} mm away from {box}. Points must be in "
            "the frame of the CT that the case was made from, LPS, mm."
        )
    if far.any():
        return (
            f"{name}: {far.sum()} of {len(far)} points lie more than {FAR_MM:g} mm away from "
            f"{box}; nothing is known of how they moved.",
        )
    return ()


def camera_table(table: PointTable, motion: Motion | None) -> bytes:
    """The table as CSV with camera_x, camera_y, camera_z and, where the motion knows it, std_mm.

    Raises:
        InputError: there is no motion.
        NoEstimate: the motion has no answer for a point.
    """
    if motion is None:
        raise InputError("this estimate does not know where points of the CT are.")
    camera_mm, std_mm = motion.carry(table.points_ct), motion.std_mm(table.points_ct)
    answer = camera_mm if std_mm is None else np.column_stack([camera_mm, std_mm])
    if not np.isfinite(answer).all():
        raise NoEstimate("the motion carries some of the points to no place that is a number.")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*table.columns, *_ANSWER[: answer.shape[1]]])
    for row, numbers in zip(table.rows, answer, strict=True):
        writer.writerow([*row, *(f"{number:.4f}" for number in numbers)])
    return stream.getvalue().encode()
