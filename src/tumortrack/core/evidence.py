"""What is known of an organ's place beside clouds of it: touched points, landmarks, outlines, and
where there is no tissue. Camera frame, mm."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, ClassVar, TypeAlias, get_args

import msgspec
import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points
from tumortrack.core.report import Point
from tumortrack.core.types import DepthError, PointNoise, SensorCloud

CAMERA = "camera"  # the frame of images and clouds
_REACH_MM = 2000.0  # of anything that a camera above a patient sees
_LEAST_MM = 3.0  # no camera has an organ nearer
FEWEST_TOUCHES = 12  # without a cloud; `make evidence`: how far off 12, 24 and 48 leave it
_LAST_NS = 2**63 - 1


class _Evidence(Config, frozen=True, kw_only=True, tag_field="kind"):
    """``std_mm``: of each place along any axis, the tracking of the tool included;
    ``shared_std_mm``: of a shift of all places of one ``tool``, as a hand-eye calibration errs, or
    without its name of this piece; 0: it is not shifted. ``stamp_ns``: when; 0: at the time of the
    cloud."""

    lasting: ClassVar[bool] = True  # it holds in later frames too, as the tissue goes

    std_mm: float
    shared_std_mm: float = 0.0
    stamp_ns: int = 0
    tool: str = ""

    def __post_init__(self) -> None:
        self.check_between(self.name, std_mm=(0.05, 50.0), stamp_ns=(0, _LAST_NS))
        for field in ("tip_mm", "point_std_mm", "shared_std_mm"):
            if field in self.__struct_fields__:
                self.check_between(self.name, **{field: (0.0, 50.0)})
        for field in ("place_mm", "places_mm", "point_ct", "points_ct"):
            if field not in self.__struct_fields__ or field in self._left_out:
                continue
            try:
                places = np.array(getattr(self, field))
            except ValueError:  # rows of different lengths
                places = np.zeros(0)
            dimensions = 1 + (field in ("places_mm", "points_ct"))
            right = places.ndim == dimensions and places.shape[-1] == 3 and places.size
            if not right or places.dtype.kind not in "iuf":
                raise InputError(
                    f"{self.name}: {field} is x, y, z, one or more where it is plural."
                )
            if not (np.abs(places) <= _REACH_MM).all():
                raise InputError(
                    f"{self.name}: {field} reaches {np.abs(places).max():g}; allowed: up to "
                    f"{_REACH_MM:g} mm, places in the camera's frame, points of the CT in LPS."
                )
            if not field.endswith("_ct") and np.abs(places).max() < _LEAST_MM:
                raise InputError(f"{self.name}: {field} lies at the camera: is it in metres?")
            msgspec.structs.force_setattr(self, field, _tuples(places))

    @property
    def _left_out(self) -> tuple[str, ...]:
        """Fields that need no value."""
        return ()

    @property
    def name(self) -> str:
        """Of its kind."""
        return str(self.__struct_config__.tag)

    @property
    def places(self) -> tuple[Point, ...]:
        """Camera frame, mm."""
        several = "places_mm" in self.__struct_fields__
        return self.places_mm if several else (self.place_mm,)  # type: ignore[attr-defined]

    def at(self, places_mm: Points, std_mm: float) -> Any:
        """The same at other places, with another deviation; not checked again."""
        moved, places = copy(self), _tuples(places_mm)
        if "places_mm" in self.__struct_fields__:
            msgspec.structs.force_setattr(moved, "places_mm", places)
        else:
            msgspec.structs.force_setattr(moved, "place_mm", places[0])
        msgspec.structs.force_setattr(moved, "std_mm", std_mm)
        return moved


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


class Grasp(_Evidence, frozen=True, kw_only=True, tag="grasp"):
    """A point of the CT (LPS, mm) that a tool holds, which is at a place by now. ``point_std_mm``:
    of which point it is, as the estimate had it when the tool took it. If both are known through
    one calibration, its error cancels: state no ``shared_std_mm``."""

    lasting: ClassVar[bool] = False
    point_ct: Point
    place_mm: Point
    point_std_mm: float = 1.0
    std_mm: float = 1.0


class Outline(_Evidence, frozen=True, kw_only=True, tag="outline"):
    """Places on the border of a part, as in an ultrasound image."""

    places_mm: tuple[Point, ...]
    part: str
    std_mm: float = 1.0


class FreeSpace(_Evidence, frozen=True, kw_only=True, tag="free_space"):
    """Places without tissue, as along the shaft of a tool, which has the radius ``tip_mm``."""

    lasting: ClassVar[bool] = False
    places_mm: tuple[Point, ...]
    tip_mm: float = 0.0
    std_mm: float = 1.0


class Cut(_Evidence, frozen=True, kw_only=True, tag="cut"):
    """Where an electrode has cut: places along all of it that was energised in tissue, some
    millimetres apart at most: of the CT (``points_ct``, LPS, mm), or of the organ as it lay at
    ``stamp_ns`` (``places_mm``). Cuts do not heal: each answer needs all of them. ``kerf_mm``: how
    wide a gap is left. Deviations decide nothing: all places shifted by 4 mm change a tumor's place
    by some tenths of a millimetre."""

    lasting: ClassVar[bool] = False  # what is cut is kept as a body's shape, not as evidence
    places_mm: tuple[Point, ...] = ()
    points_ct: tuple[Point, ...] = ()
    kerf_mm: float = 1.5
    std_mm: float = 1.0

    def __post_init__(self) -> None:
        if len(self._left_out) != 1:
            raise InputError("cut: give places_mm (camera frame) or points_ct (CT), one of them.")
        super().__post_init__()
        self.check_between(self.name, kerf_mm=(0.1, 20.0))

    @property
    def _left_out(self) -> tuple[str, ...]:
        given = {"places_mm": self.places_mm, "points_ct": self.points_ct}
        return tuple(name for name, places in given.items() if not len(places))

    def of_ct(self, points_ct: Points) -> Cut:
        """The same at points of the CT."""
        return msgspec.structs.replace(self, places_mm=(), points_ct=_tuples(points_ct))


Evidence: TypeAlias = Touch | Landmark | Grasp | Outline | FreeSpace | Cut
FREE = str(FreeSpace.__struct_config__.tag)
# Names of kinds that are said again in each frame, as long as they are so.
MOMENTARY = {str(kind.__struct_config__.tag) for kind in get_args(Evidence) if not kind.lasting}


def _tuples(places: np.ndarray) -> Any:
    return tuple(map(_tuples, places)) if places.ndim > 1 else tuple(map(float, places))


def touched(
    evidence: Sequence[Evidence], organ: str
) -> tuple[SensorCloud, tuple[Evidence, ...], tuple[Evidence, ...]]:
    """Where the organ's surface was touched or outlined, as a cloud that no camera saw, with the
    noise that is stated; the pieces of which it is; and the rest. A tip's radius is taken off
    towards the middle of all places. Raises InputError: there are too few."""
    mine = [each for each in evidence
            if isinstance(each, Touch | Outline) and each.part in ("", organ)]  # fmt: skip
    counts = [len(each.places) for each in mine]
    if (count := sum(counts)) < FEWEST_TOUCHES:
        raise InputError(
            f"without a cloud at least {FEWEST_TOUCHES} places on {organ}, touched or outlined, "
            f"are needed, all over what can be reached of it; there are {count}."
        )
    places_mm = np.concatenate([np.array(each.places) for each in mine])
    tips_mm = np.repeat([each.tip_mm if isinstance(each, Touch) else 0.0 for each in mine], counts)
    inwards = places_mm.mean(0) - places_mm
    lengths_mm = np.linalg.norm(inwards, axis=1, keepdims=True)
    places_mm += tips_mm[:, None] * inwards / np.where(lengths_mm > 0, lengths_mm, 1.0)
    shared = dict[str, float]()  # of each tool's shift in the mean of all places
    for number, (each, places) in enumerate(zip(mine, counts, strict=True)):
        tool = each.tool or f"piece {number}"
        shared[tool] = shared.get(tool, 0.0) + each.shared_std_mm * places / count
    shift_mm = float(np.linalg.norm([*shared.values()]))
    # What one tool shares moves all; what several do not share is noise.
    squares_mm2 = [each.std_mm**2 + each.shared_std_mm**2 for each in mine]
    std_mm = float(np.sqrt(max(np.average(squares_mm2, weights=counts) - shift_mm**2, 0.0)))
    std_mm = max(std_mm, min(each.std_mm for each in mine))
    noise = PointNoise(std_mm, std_mm, std_mm / count**0.5, shift_mm)
    cloud = SensorCloud(places_mm.astype(np.float32), noise=noise, depth_error=DepthError())
    return cloud, tuple(mine), tuple(each for each in evidence if each not in mine)
