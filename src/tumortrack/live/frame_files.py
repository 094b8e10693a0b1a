"""What files, and what is live, say of frames: links between them, and the same places in two."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from tumortrack.core.errors import InputError, NoEstimate, readable
from tumortrack.core.frames import CAMERA, Link, fit_link, read_link
from tumortrack.core.geometry import IDENTITY, Points, transform_points
from tumortrack.core.store import read_file
from tumortrack.io.csv_tables import read_rows
from tumortrack.io.plus_files import read_plus
from tumortrack.io.ultrasound_files import recorded_transforms
from tumortrack.live.calibration_file import calibration_keys
from tumortrack.live.poses import FilePoses
from tumortrack.live.spec import POSES

_KEY = re.compile(r"(\w+?)_from_(?!deformed)(\w+)")
_FIXED = ("robot", "fixed", "table", "base")  # what frame_id names
_IN_FOLDERS = ("calibration.json", "report.json", "plan.json", "meta.json")
_LARGEST, _LISTEN_S = 2**26, 5.0  # bytes; a latched tf_static may take over 2 s to come
_CORNERS_MM = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]])  # of a board
_MOST_POSES, _FARTHEST = 200, 1e4  # of a board; errors that mean anything, mm


@dataclass
class KnownFrames:
    """All that was read. ``fits``: links between the same places in two frames; ``tables``: file,
    what moves (empty: unsaid) and its poses."""

    links: list[Link] = field(default_factory=list)
    fits: list[Link] = field(default_factory=list)
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
            case ".mha" | ".mhd" | ".nrrd":
                return self._recording(path)
            case ".json" | ".yaml" | ".yml" | ".calib":
                return self._keys(path, name)
        raise InputError(
            f"{path} says nothing of frames. Allowed: JSON, YAML of easy_handeye, tables (.csv), "
            "PLUS configurations (.xml) and recordings (.mha, .nrrd), folders that commands wrote, "
            "and ros2:FRAME."
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
        for of, to, rows, error_mm in read_plus(path):
            link = read_link(to, of, rows, str(path))
            self.links.append(link._replace(error_mm=error_mm) if _is_error(error_mm) else link)

    def _recording(self, path: Path) -> None:
        for (of, to), poses in recorded_transforms(path).items():
            known = np.reshape(poses, (-1, 4, 4))
            if len(known := known[np.isfinite(known).all((1, 2))]):
                self.links.append(read_link(to, of, known[-1], f"{path}, last frame"))

    def _keys(self, path: Path, name: str) -> None:
        content = calibration_keys(path)
        names = {CAMERA: name or str(content.get("frame", CAMERA))}
        if not (found := [*_links(content, str(path), names, {})]):
            raise InputError(f"{path} has no b_from_a of two frames with 4 x 4 numbers.")
        self.links += found

    def _table(self, path: Path, name: str) -> None:
        table = read_rows(read_file(path, _LARGEST), str(path))
        if "qw" in table.columns:
            self.tables.append((str(path), name, FilePoses(path)))
            return
        ends = [cell[:-2] for cell in table.header if cell.lower().endswith("_x")]
        frames = [end for end in ends if {f"{end}_{x}".lower() for x in "yz"} <= {*table.columns}]
        if len(frames) != 2:
            raise InputError(
                f"{path} has no places in two frames, in columns A_x, A_y, A_z, B_x ..."
            )
        b, a = frames
        of_b, of_a = (table.numbers([f"{end}_{x}".lower() for x in "xyz"]) for end in frames)
        self.fits.append(fit_link(b, a, of_b, of_a, f"{len(table.rows)} touches, {path}"))

    def link_tables(self) -> None:
        """Link what tables have, at the last time that all have. Of a body whose poses are known in
        two frames, such as a board, the times that both have link these frames."""
        tool = "tool" if any("tool" in link[:2] for link in self.links) else CAMERA
        last_ns = min((int(table.stamps_ns[-1]) for _, _, table in self.tables), default=0)
        first: dict[str, FilePoses] = {}
        for file, name, table in self.tables:
            body = name or tool
            if (other := first.setdefault(body, table)) is table:
                try:
                    pose = table.poses.at(last_ns)
                except NoEstimate as error:
                    self.notes.append(f"{file} at {last_ns} ns: {error}")
                    continue
                self.links.append(Link(table.frame_id, body, pose, f"{file} at {last_ns} ns"))
            elif other.frame_id != table.frame_id:
                self.fits.append(_board_link(other, table, f"poses of {body}, {file}"))


def _board_link(one: FilePoses, other: FilePoses, source: str) -> Link:
    """``one``'s frame from the ``other``'s, by where both have a board's corners at the same times.
    Raises InputError: they share no time."""
    corners: list[Points] = []
    for ns in other.stamps_ns[:: len(other.stamps_ns) // _MOST_POSES + 1].tolist():
        with suppress(NoEstimate):
            poses = one.poses.at(ns), other.poses.at(ns)
            corners.append(np.stack([transform_points(pose, _CORNERS_MM) for pose in poses]))
    if not corners:
        raise InputError(f"{source}: the two tables share no time; see the stamps.")
    b, a = np.concatenate(corners, axis=1)
    return fit_link(one.frame_id, other.frame_id, b, a, f"{len(corners)} {source}")


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
