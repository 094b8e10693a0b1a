"""Files of evidence: JSON, or a table with a row for each place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import CAMERA, Evidence
from tumortrack.io.csv_tables import number_in, read_rows, whole_in

_LARGEST_FILE = 10_000_000  # bytes


class EvidenceFile(Config, frozen=True, kw_only=True):
    """A file of it: what there is, in which ``frame`` and ``unit``. ``still_since_ns``: since when
    the organ has not moved; evidence with an earlier stamp is refused."""

    frame: str
    unit: str
    evidence: tuple[Evidence, ...]
    still_since_ns: int = 0


def read_evidence(path: Path, with_camera: bool = True) -> tuple[str, tuple[Evidence, ...]]:
    """Of a JSON file, see ``EvidenceFile``, or a table (.csv), a row for each place: the frame, and
    the pieces. ``with_camera``: there are images or clouds, in whose frame they must be. Raises
    InputError: missing, another frame or unit, a value that is not allowed."""
    if path.suffix.lower() in (".csv", ".tsv", ".txt"):
        return _table(path, with_camera)
    known = _checked(store.read_json(path), str(path), with_camera)
    if not known.evidence:
        raise InputError(f"{path} holds no evidence. Leave it out, or add some.")
    for number, each in enumerate(known.evidence, start=1):
        if 0 < each.stamp_ns < known.still_since_ns:
            raise InputError(
                f"{path}: {each.name} {number} is of {each.stamp_ns} ns, before the organ lay "
                f"still (still_since_ns: {known.still_since_ns}). Leave it out, or take it again."
            )
    return known.frame, known.evidence


def _checked(given: dict[str, Any], where: str, with_camera: bool) -> EvidenceFile:
    known = from_builtins(given, EvidenceFile, where)
    wrong_frame = known.frame != CAMERA if with_camera else not known.frame.isprintable()
    if wrong_frame or not known.frame or known.unit != "mm":
        raise InputError(
            f"{where} is in frame {known.frame!r} and unit {known.unit!r}; allowed: frame 'camera' "
            "(x right, y down, z forward; without a cloud any other, by its name) and unit 'mm'. "
            "Transform it first."
        )
    return known


_PLACE, _POINT = ("x_mm", "y_mm", "z_mm"), ("x_ct_mm", "y_ct_mm", "z_ct_mm")
_SIZES = ("std_mm", "shared_std_mm", "tip_mm", "point_std_mm", "kerf_mm")
_NEEDED = ("piece", "frame", "kind", *_PLACE)
_READ: dict[str, Callable[[str, str], float]] = {
    **dict.fromkeys((*_PLACE, *_POINT, *_SIZES), number_in),
    "stamp_ns": whole_in,
}
_FURTHER = (*_READ, "part", "tool")
_OF_PLACES = ("outline", "free_space", "cut")
_OF_CT = "ct"  # frame of a table's cuts that are in the CT (LPS)


def _table(path: Path, with_camera: bool) -> tuple[str, tuple[Evidence, ...]]:
    """From a table, in which rows of one ``piece`` are places of one."""
    table = read_rows(store.read_file(path, _LARGEST_FILE), str(path), _NEEDED, _FURTHER)
    pieces: dict[str, tuple[str, dict[str, Any], list[Any]]] = {}
    for line, row in table.rows:
        where = f"{path}, line {line}"
        given = _cells(dict(zip(table.columns, row, strict=True)), where)
        piece, place = given.pop("piece"), [given.pop(n) for n in _PLACE]
        if _POINT[0] in given:
            given["point_ct"] = [given.pop(n, None) for n in _POINT]
        _, known, places = pieces.setdefault(piece, (where, given, []))
        if given != known or (places and given["kind"] not in _OF_PLACES):
            raise InputError(
                f"{where}: piece {piece} has a row before; only an outline or free places have "
                "several, which differ in x, y and z alone. Give another piece another name."
            )
        places.append(place)
    found, frames = list[Evidence](), set[str]()
    for where, given, places in pieces.values():
        several = given["kind"] in _OF_PLACES
        given |= {"places_mm": places} if several else {"place_mm": places[0]}
        if given["kind"] == "cut" and given["frame"] == _OF_CT:
            given |= {"frame": CAMERA, "points_ct": given.pop("places_mm")}
        whole = {"frame": given.pop("frame"), "unit": "mm", "evidence": [given]}
        one = _checked(whole, where, with_camera)
        found, frames = [*found, *one.evidence], frames | {one.frame}
    if len(frames) > 1:
        raise InputError(f"{path} has places in frames {', '.join(sorted(frames))}; give one.")
    return frames.pop(), tuple(found)


def _cells(row: dict[str, str], where: str) -> dict[str, Any]:
    """What a row says, by column."""
    if empty := [name for name in _NEEDED if not row[name]]:
        raise InputError(f"{where}, column {empty[0]}: it is empty; every row needs it.")
    return {
        name: _READ[name](text, f"{where}, column {name}") if name in _READ else text
        for name, text in row.items()
        if text
    }


def evidence_json(evidence: tuple[Evidence, ...]) -> bytes:
    """What ``read_evidence`` reads."""
    return msgspec.json.encode(EvidenceFile(frame="camera", unit="mm", evidence=evidence))
