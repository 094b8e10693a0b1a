"""What files, and what is live, say of frames: links between them, and the same places in two."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, NoEstimate, readable
from tumortrack.core.evidence import Landmark
from tumortrack.core.frames import CAMERA, Link, fit_link, read_link
from tumortrack.core.geometry import IDENTITY, Points, transform_points
from tumortrack.core.store import read_file
from tumortrack.io.csv_tables import read_rows, text_of
from tumortrack.io.evidence_files import read_evidence
from tumortrack.live.calibration_file import calibration_keys
from tumortrack.live.poses import FilePoses
from tumortrack.live.spec import POSES

_KEY = re.compile(r"(\w+?)_from_(?!deformed)(\w+)")
_FIXED = ("robot", "fixed", "table", "base")  # what frame_id names
_IN_FOLDERS = ("calibration.json", "report.json", "plan.json", "meta.json")
_LARGEST, _LISTEN_S = 2**26, 5.0  # bytes; a latched tf_static may take over 2 s to come
_CORNERS_MM = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]])  # of a board
_MOST_POSES, _FARTHEST = 200, 1e4  # of a board; errors that mean anything, mm


class Fit(NamedTuple):
    """A link between the same places, mm, in its frames."""

    link: Link
    places_a: Points
    places_b: Points


@dataclass
class KnownFrames:
    """All that was read. ``frames``: also those without a link; ``tables``: file, what moves
    (empty: unsaid) and its poses."""

    links: list[Link] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    fits: list[Fit] = field(default_factory=list)
    tables: list[tuple[str, str, FilePoses]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, text: str) -> None:
        """[NAME=]FILE, a folder that a command wrote, or a camera's pose such as ros2:base_link.
        NAME: of the camera, or of what a table's poses are of. Raises InputError."""
        name, path = "", Path(text)
        if "=" in text and not path.exists():
            name, _, text = text.partition("=")
            path = Path(text)
        if re.match(r"\w+:", text) and not path.exists():
            return self._listen(text)
        if path.is_dir():
            if not (inside := [path / file for file in _IN_FOLDERS if (path / file).is_file()]):
                raise InputError(f"{path} has none of {', '.join(_IN_FOLDERS)}.")
            return self._keys(inside[0], name)
        match path.suffix.lower():
            case ".csv" | ".tsv" | ".txt":
                return self._table(path, name)
            case ".xml":
                return self._plus(path)
            case ".json" | ".yaml" | ".yml" | ".calib":
                return self._keys(path, name)
        raise InputError(
            f"{path} says nothing of frames. Allowed: JSON, YAML of easy_handeye, tables (.csv), "
            "PLUS configurations (.xml), folders that commands wrote, and ros2:FRAME."
        )

    def _listen(self, text: str) -> None:
        source = POSES.parse(text).open()
        try:
            found = source.known(_LISTEN_S)
        finally:
            source.close()
        if not found:
            raise InputError(f"{text}: no frame was heard of within {_LISTEN_S:g} s.")
        self.links += [Link(b, a, b_from_a, text) for (b, a), b_from_a in found.items()]

    def _plus(self, path: Path) -> None:
        text = text_of(read_file(path, _LARGEST), str(path))
        if "<!DOCTYPE" in text:  # entities grow
            raise InputError(f"{path} has a DOCTYPE, which PLUS does not write; remove it.")
        with readable(path, "cannot be read as a configuration of PLUS"):
            for each in ElementTree.fromstring(text).iter("Transform"):
                rows = np.array(each.attrib["Matrix"].split(), float).reshape(4, 4)
                link = read_link(each.attrib["To"], each.attrib["From"], rows, str(path))
                error_mm = float(each.get("Error", "nan"))
                stated = link._replace(error_mm=error_mm) if _is_error(error_mm) else link
                self.links.append(stated)

    def _keys(self, path: Path, name: str) -> None:
        content = calibration_keys(path)
        if "evidence" in content and "frame" in content:
            return self._evidence(path)
        names = {CAMERA: name or str(content.get("frame", CAMERA))}
        if not (found := [*_links(content, str(path), names, {})]):
            raise InputError(f"{path} has no b_from_a of two frames with 4 x 4 numbers.")
        self.links += found
        return None

    def _evidence(self, path: Path) -> None:
        frame, evidence = read_evidence(path, with_camera=False)
        self.frames.append(frame)
        marks = [each for each in evidence if isinstance(each, Landmark)]
        if len(marks) > 2:
            places = np.array([[m.place_mm for m in marks], [m.point_ct for m in marks]])
            self._fit(frame, "ct", places, f"{len(marks)} landmarks, {path}")

    def _table(self, path: Path, name: str) -> None:
        table = read_rows(read_file(path, _LARGEST), str(path))
        if "piece" in table.columns:
            return self._evidence(path)
        if "qw" in table.columns:
            self.tables.append((str(path), name, FilePoses(path)))
            return None
        ends = [cell[:-2] for cell in table.header if cell.lower().endswith("_x")]
        frames = [end for end in ends if {f"{end}_{x}".lower() for x in "yz"} <= {*table.columns}]
        if len(frames) < 2:
            raise InputError(
                f"{path} has no places in two frames, in columns A_x, A_y, A_z, B_x ..."
            )
        places = np.array([table.numbers([f"{end}_{x}".lower() for x in "xyz"]) for end in frames])
        for n, frame in enumerate(frames[1:], start=1):
            what = f"{len(table.rows)} touches, {path}"
            self._fit(frames[0], frame, places[[0, n]], what)
        return None

    def _fit(self, b: str, a: str, places: Float64[np.ndarray, "2 n 3"], source: str) -> None:
        self.fits.append(Fit(fit_link(b, a, places[0], places[1], source), places[1], places[0]))

    def at(self, stamp_ns: int) -> None:
        """Link what tables have, at one time (0: the last that all have). Of a body whose poses
        are known in two frames, such as a board, the times that both have link these frames."""
        tool = "tool" if any("tool" in link[:2] for link in self.links) else CAMERA
        last_ns = min((int(table.stamps_ns[-1]) for _, _, table in self.tables), default=0)
        first: dict[str, tuple[str, FilePoses]] = {}
        for file, name, table in self.tables:
            body, stamp_ns = name or tool, stamp_ns or last_ns
            if body not in first:
                first[body] = file, table
                try:
                    pose = table.poses.at(stamp_ns)
                except NoEstimate as error:
                    self.notes.append(f"{file} at {stamp_ns} ns: {error}")
                    continue
                self.links.append(Link(table.frame_id, body, pose, f"{file} at {stamp_ns} ns"))
            elif (other := first[body][1]).frame_id != table.frame_id:
                corners: list[Points] = []
                for ns in table.stamps_ns[:: len(table.stamps_ns) // _MOST_POSES + 1].tolist():
                    with suppress(NoEstimate):
                        poses = other.poses.at(ns), table.poses.at(ns)
                        corners.append(np.stack([transform_points(p, _CORNERS_MM) for p in poses]))
                if not corners:
                    raise InputError(f"{first[body][0]} and {file} share no time; see the stamps.")
                what = f"{len(corners)} poses of {body}, {file}"
                self._fit(other.frame_id, table.frame_id, np.concatenate(corners, axis=1), what)


def _links(
    content: dict[str, Any], source: str, names: dict[str, str], about: dict[str, Any]
) -> Iterator[Link]:
    """Of all entries ``b_from_a``, also of objects within; ``about``: what holds of them."""
    if isinstance(fixed := content.get("frame_id"), str) and fixed:
        names = names | dict.fromkeys(_FIXED, fixed.removeprefix("/"))
    if unit := content.get("unit", content.get("units")):
        about = about | {"metres": unit == "m"}
    stated = {key: content.get(key) for key in ("error_mm", "error_deg")}
    about = about | {key: float(n) for key, n in stated.items() if _is_error(n)}
    camera = names[CAMERA]
    if isinstance(same := content.get("camera_frame_id"), str) and same not in ("", camera):
        yield Link(camera, same, IDENTITY, f"camera_frame_id, {source}", 0.0)
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _links(value, source, names, about)
        elif (ends := _KEY.fullmatch(key)) and np.ndim(np.array(value, object)) > 1:
            with readable(source, f"has a {key} that cannot be read"):
                poses = np.array(value, float).reshape(-1, 4, 4)
            b, a = (names.get(end.replace("view", CAMERA), end) for end in ends.groups())
            for number, rows in enumerate(poses, start=1):
                if (of := a if number == 1 else f"{a}_{number}") != b:
                    yield read_link(b, of, rows, source, **about)


def _is_error(number: object) -> TypeGuard[float]:
    return isinstance(number, int | float) and 0 < number < _FARTHEST
