"""What is known of an organ's place beside clouds of it: touched points, landmarks, outlines, and
where there is no tissue. Camera frame, mm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.report import Point

_REACH_MM = 2000.0  # of anything that a camera above a patient sees
_LARGEST_FILE = 10_000_000  # bytes


class _Evidence(Config, frozen=True, kw_only=True, tag_field="kind"):
    """``std_mm``: of each place along any axis, the tracking of the tool included. ``stamp_ns``:
    when; 0: at the time of the cloud. ``tool``: the name of what it is from."""

    std_mm: float
    stamp_ns: int = 0
    tool: str = ""

    def __post_init__(self) -> None:
        self.check_between(self.name, std_mm=(0.05, 50.0))
        for field in ("tip_mm", "point_std_mm"):
            if hasattr(self, field):
                self.check_between(self.name, **{field: (0.0, 50.0)})
        for field in ("place_mm", "places_mm", "point_ct"):
            if not hasattr(self, field):
                continue
            try:
                places = np.array(getattr(self, field))
            except ValueError:  # rows of different lengths
                places = np.zeros(0)
            dimensions = 1 + (field == "places_mm")
            right = places.ndim == dimensions and places.shape[-1] == 3 and places.size
            if not right or places.dtype.kind not in "iuf":
                raise InputError(f"{self.name}: {field} is x, y, z, and places_mm one or more.")
            if not (np.abs(places) <= _REACH_MM).all():
                raise InputError(
                    f"{self.name}: {field} reaches {np.abs(places).max():g}; allowed: up to "
                    f"{_REACH_MM:g}. Places are in the camera's frame, points of the CT in LPS; "
                    "both in mm."
                )
            msgspec.structs.force_setattr(self, field, _tuples(places))

    @property
    def name(self) -> str:
        """Of its kind."""
        return str(self.__struct_config__.tag)

    @property
    def places(self) -> tuple[Point, ...]:
        """Camera frame, mm."""
        return self.places_mm if hasattr(self, "places_mm") else (self.place_mm,)  # type: ignore[attr-defined]


class Touch(_Evidence, frozen=True, kw_only=True, tag="touch"):
    """A tool's tip on the surface of a part (default: the organ), from outside. ``place_mm``: the
    middle of the tip, a ball of radius ``tip_mm``."""

    place_mm: Point
    part: str = ""
    tip_mm: float = 0.0
    std_mm: float = 1.0


class Landmark(_Evidence, frozen=True, kw_only=True, tag="landmark"):
    """A point of the CT (LPS, mm) that was seen, clicked or touched at a place."""

    point_ct: Point
    place_mm: Point
    std_mm: float = 2.0


class Held(_Evidence, frozen=True, kw_only=True, tag="held"):
    """A point of the CT (LPS, mm) that a tool holds, which is at a place by now. ``point_std_mm``:
    of which point it is, as the estimate had it when the tool took it."""

    point_ct: Point
    place_mm: Point
    point_std_mm: float = 1.0
    std_mm: float = 1.0


class Outline(_Evidence, frozen=True, kw_only=True, tag="outline"):
    """Places on the border of a part, as in an ultrasound image."""

    places_mm: tuple[Point, ...]
    part: str
    std_mm: float = 1.0


class Free(_Evidence, frozen=True, kw_only=True, tag="free"):
    """Places without tissue, as along the shaft of a tool, which has the radius ``tip_mm``."""

    places_mm: tuple[Point, ...]
    tip_mm: float = 0.0
    std_mm: float = 1.0


Evidence: TypeAlias = Touch | Landmark | Held | Outline | Free


class EvidenceFile(Config, frozen=True, kw_only=True):
    """A file of it: what there is, in which ``frame`` and ``unit``."""

    frame: str
    unit: str
    evidence: tuple[Evidence, ...]


def _tuples(places: np.ndarray) -> Any:
    return tuple(map(_tuples, places)) if places.ndim > 1 else tuple(map(float, places))


def read_evidence(path: Path) -> tuple[Evidence, ...]:
    """Of a JSON file, see ``EvidenceFile``. Raises InputError: missing, another frame or unit, a
    value that is not allowed."""
    content = store.read_file(path, _LARGEST_FILE)
    try:
        known = from_builtins(json.loads(content), EvidenceFile, str(path))
    except ValueError as error:
        raise InputError(f"{path} is no JSON: {error}.") from error
    if (known.frame, known.unit) != ("camera", "mm"):
        raise InputError(
            f"{path} is in frame {known.frame!r} and unit {known.unit!r}; allowed: frame "
            "'camera' (x right, y down, z forward) and unit 'mm'. Transform it first."
        )
    return known.evidence


def evidence_json(evidence: tuple[Evidence, ...]) -> bytes:
    """What ``read_evidence`` reads."""
    return msgspec.json.encode(EvidenceFile(frame="camera", unit="mm", evidence=evidence))
