"""A tool with a tip: from its poses and contacts to touches, what it holds, and where its shaft is.

Places are in the published frame, mm, until a frame's camera sees them. A contact is one touch: the
mean of its first poses.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Cut, Evidence, FreeSpace, Grasp, Landmark, Touch
from tumortrack.core.geometry import Affine, Points, swept_places, transform_points, unit
from tumortrack.core.report import Point
from tumortrack.live.tools import Tool, ToolConfig
from tumortrack.live.values import CameraView, SinkContext

_MEAN_NS, _STEP_NS = 100_000_000, 20_000_000  # a touch is the mean of its first poses
_BOUNCE_NS = 100_000_000  # contact again so soon is the same one: faster than anybody taps
_LATE_NS = (0, 25_000_000, 50_000_000)  # a pose so long before a frame stands for its own
_KEPT_NS = 1_000_000_000  # a touch waits so long for a frame in which the organ is found
_SWEEP_MM = 3.0  # between two touches of a sweep
_SHAFT_MM = 5.0  # between places along a shaft
_CUT_MM = 1.5  # between places of a cut: as finely as a tracker keeps them
_CUT_AT_ONCE, _LONGEST_CUT_NS = 25, 10_000_000_000  # poses in one piece; before a frame: hidden
_GRASP_MM = 10.0  # from the tip to the next vertex of the organ: jaws are that long
_REACH_MM = 2000.0  # of a point of the CT
_LARGEST_STD_MM = 50.0  # of evidence
_MOST_CHANGES = 1000  # of contact, between two frames
_NO_POSE = "where it is at the time of a frame or touch is not known"


class TipConfig(ToolConfig, frozen=True, kw_only=True):
    """Options of every tool.

    Attributes:
        tip: middle of its tip in its own frame, X,Y,Z in mm.
        tip_mm: radius of tip and shaft.
        std_mm: of the tip's place, one standard deviation along any axis, without the calibration.
        part: what it touches; empty: the organ.
        holds: from contact to release it holds the tissue that it took.
        sweep: while it touches, there is a touch every 3 mm.
        point: of the CT (LPS, mm), which it touches: a landmark.
        shaft_mm: length of its shaft, where no tissue is: from the tip towards the tool's origin,
            or, where that is the tip, along -z. 0: unknown.
        electrode_mm: length of its bare electrode, from the tip likewise: while it is energised
            (its contact says so), all of that cuts. 0: it does not cut.
        kerf_mm: width of the gap that it leaves.
    """

    tip: Point = (0.0, 0.0, 0.0)
    tip_mm: float = 0.0
    std_mm: float = 1.0
    part: str = ""
    holds: bool = False
    sweep: bool = False
    point: Point | None = None
    shaft_mm: float = 0.0
    electrode_mm: float = 0.0
    kerf_mm: float = 1.5

    def __post_init__(self) -> None:
        what = f"{self.__struct_config__.tag}:"
        self.check_between(what, tip=(-1000, 1000), tip_mm=(0, 50), std_mm=(0.05, 50))
        if self.shaft_mm:
            self.check_between(what, shaft_mm=(self.electrode_mm + _SHAFT_MM, 500))
        if self.point is not None:
            self.check_between(what, point=(-_REACH_MM, _REACH_MM))
        self.check_between(what, electrode_mm=(0, 200), kerf_mm=(0.1, 20))
        cuts = self.electrode_mm > 0
        if self.holds + self.sweep + cuts + (self.point is not None) > 1:
            raise InputError(f"{what} holds, sweep, point and electrode_mm exclude each other.")


class Piece(NamedTuple):
    """Evidence of a ``kind`` to be: its places in the published frame, mm, and its other fields.
    ``stamp_ns``: when; 0: at the time of the frame that gets it."""

    kind: type[Evidence]
    places_mm: Float64[np.ndarray, "n 3"]
    fields: Mapping[str, Any]
    stamp_ns: int = 0


class TipTool(Tool):
    """Of whatever kind; that adds ``pose``, and ``contact`` or ``drawn``.

    With ``frame_id``, that of its poses, or empty, if only the calibration says it. Raises
    InputError: it is another one than that of the results, or not known.
    """

    def __init__(
        self, config: TipConfig, context: SinkContext, name: str, frame_id: str | None = None
    ) -> None:
        super().__init__()
        self.config, self.context, self.name = config, context, name
        self._bare_mm = config.electrode_mm
        if config.part and config.part not in context.touchable:
            parts = ", ".join(context.touchable)
            raise InputError(f"there is no part {config.part!r}; this organ has {parts}.")
        if frame_id == "" and not context.published_frame.calibrated:
            raise InputError("give --frame FILE: where the camera is in the frame of its poses.")
        if frame_id:
            self.check_frame(frame_id)
        self._changes = deque[tuple[int, bool]](maxlen=_MOST_CHANGES)
        self._contact = False  # as told last
        self._on, self._began_ns, self._changed_ns = False, 0, -_BOUNCE_NS  # as followed
        self._told_ns, self._told_mm = 0, np.zeros(3)  # so far a contact is told; its last touch
        self._clicks, self._fault = 0, ""  # of which the next frame tells
        self._point: dict[str, Any] | None = None  # of the CT, that it holds
        self._waiting: list[tuple[int, Piece]] = []  # that no estimate knows yet; since when
        self._cuts = list[Piece]()  # since the last frame
        self._ends: tuple[int, Points] | None = None  # of the electrode, as followed last, and when

    def check_frame(self, frame_id: str) -> None:
        """Raises InputError: its poses are in another frame than the results."""
        if frame_id != (published := self.context.published_frame.frame_id):
            raise InputError(
                f"its poses are in frame {frame_id!r}, and results in {published!r}. Give "
                "--frame FILE with that frame_id: where the camera is there."
            )

    def contact(self, stamp_ns: int, touches: bool) -> None:
        """Say whether the tip touches; from one thread."""
        if touches is not self._contact:
            self._contact = touches
            self._changes.append((stamp_ns, touches))

    def refresh(self, stamp_ns: int) -> None:
        """Called before anything is asked of the frame of this stamp."""

    @abstractmethod
    def pose(self, stamp_ns: int) -> Affine:
        """Published frame from tool, without waiting. Raises NoEstimate: it is unknown."""

    def drawn(self) -> list[Piece]:
        """Whole pieces since the last call."""
        return []

    def touched(self) -> None:
        self._clicks += 1

    def evidence(self, view: CameraView) -> list[Evidence]:
        now_ns, given = view.seen.stamp_ns, list[Evidence]()
        for piece in self._pieces(now_ns):
            try:
                given.append(self._seen_by(view, piece))
            except InputError as error:
                self.counts["dropped"] += 1
                self.trouble = str(error)
        return given

    def located(self, view: CameraView, estimate: Estimate) -> None:
        """What waited is in an estimate by now; what was taken is the point of the CT that is
        there."""
        self._waiting, motion = [], estimate.motion
        wanted = self._on and self.config.holds and self._point is None
        if not wanted or motion is None or estimate.quality != "good":
            return
        if (tip_mm := self._tip(view.seen.stamp_ns)) is None:
            return
        tip_mm = transform_points(_camera_from_published(view), tip_mm[:1])
        away_mm = np.linalg.norm(estimate.organ_mesh.vertices_mm - tip_mm, axis=1).min()
        if away_mm > _GRASP_MM:
            self._fault = "it holds nothing of the organ, which is more than 1 cm away"
            return
        point_ct = motion.inverse(tip_mm)
        std_mm = None if point_ct is None else motion.std_mm(point_ct)
        if point_ct is not None and std_mm is not None:
            std = min(float(std_mm[0]), _LARGEST_STD_MM)
            self._point = {"point_ct": point_ct[0], "point_std_mm": std}

    def _pieces(self, now_ns: int) -> list[Piece]:
        self.trouble, self._fault = self._fault, ""
        self.refresh(now_ns)
        for piece in self.drawn():
            self._add(piece, now_ns)
        while self._changes and self._changes[0][0] <= now_ns:
            self._change(*self._changes.popleft())
        while self._clicks:
            self._clicks -= 1
            self._click(now_ns)
        if self._on:
            self._touch(now_ns)
        fresh = [one for one in self._waiting if abs(now_ns - one[0]) <= _KEPT_NS]
        self.counts["dropped"] += len(self._waiting) - len(fresh)
        self._waiting, given = fresh, [*(piece for _, piece in fresh), *self._cuts]
        self._cuts = []
        if self._on and self._point and (tip_mm := self._tip(now_ns)) is not None:
            given.append(Piece(Grasp, tip_mm[:1], self._point))
            self.counts["grasp"] += 1
        if self.config.shaft_mm and (shaft_mm := self._tip(now_ns)) is not None:
            given.append(Piece(FreeSpace, shaft_mm[1:], {"tip_mm": self.config.tip_mm}))
            self.counts["free_space"] += 1
        return given

    def _seen_by(self, view: CameraView, piece: Piece) -> Evidence:
        """In the frame of a view's camera. The calibration's error, its bound taken for one
        standard deviation, is shared by all pieces: their number does not lessen it. Of what is
        held, a camera that stands still shows both through the same error: which point was taken,
        and where it is by now; so only its way counts."""
        places_mm = transform_points(_camera_from_published(view), piece.places_mm)
        farthest_mm = float(np.linalg.norm(places_mm, axis=1).max())
        published = self.context.published_frame
        cancels = piece.kind is Grasp and not published.moves
        error_mm = 0.0 if cancels else published.error_at(farthest_mm) or 0.0
        single = "place_mm" in piece.kind.__struct_fields__
        places = {"place_mm": places_mm[0]} if single else {"places_mm": places_mm}
        about = {
            "std_mm": self.config.std_mm,
            "shared_std_mm": error_mm,
            "stamp_ns": piece.stamp_ns,
            "tool": self.name,
        }
        return piece.kind(**places, **piece.fields, **about)  # type: ignore[arg-type]

    def _click(self, now_ns: int) -> None:
        if self.config.holds or self._bare_mm:
            self._change(now_ns, not self._on)
        elif not self._on:
            self._change(now_ns, True)
            self._change(now_ns, False)

    def _change(self, stamp_ns: int, on: bool) -> None:
        if on and not 0 <= stamp_ns - self._changed_ns < _BOUNCE_NS:
            self._began_ns, self._told_ns, self._point = stamp_ns, 0, None
        if self._on and not on:
            self._touch(stamp_ns, over=True)
        if self._bare_mm and on and not self._on:
            self._told_ns, self._ends = stamp_ns - _STEP_NS, None
        self._on, self._changed_ns = on, stamp_ns

    def _touch(self, now_ns: int, over: bool = False) -> None:
        """The touches of a contact that are known by now; ``over``: it ends now."""
        if self._bare_mm:
            return self._cut(now_ns)
        end_ns = self._began_ns + _MEAN_NS
        if self.config.holds or (now_ns < end_ns and not over):
            return
        if not self._told_ns:
            self._told_ns = min(end_ns, now_ns)
            times_ns = range(self._began_ns, self._told_ns + 1, _STEP_NS)
            tips_mm = [tip_mm[0] for t in times_ns if (tip_mm := self._tip(t)) is not None]
            if tips_mm:
                self._touches(np.mean(tips_mm, axis=0), self._began_ns)
            self.counts["dropped"] += not tips_mm
        if self.config.sweep:
            first_ns = max(self._told_ns, now_ns - _KEPT_NS) + _STEP_NS
            for self._told_ns in range(first_ns, now_ns + 1, _STEP_NS):
                tip_mm = self._tip(self._told_ns)
                if tip_mm is not None and np.linalg.norm(tip_mm[0] - self._told_mm) >= _SWEEP_MM:
                    self._touches(tip_mm[0], self._told_ns)

    def _cut(self, now_ns: int) -> None:
        """What the energised electrode has swept until now, as far as its poses are known."""
        if self._told_ns > now_ns:  # the clock was set back
            self._told_ns, self._ends = now_ns, None
        first_ns = max(self._told_ns, now_ns - _LONGEST_CUT_NS) + _STEP_NS
        left_out, away_mm = first_ns - self._told_ns > _STEP_NS, np.array([0, self._bare_mm])
        swept = [] if self._ends is None else [self._ends]
        for self._told_ns in range(first_ns, now_ns + 1, _STEP_NS):
            if (ends_mm := self._along(self._told_ns, away_mm)) is None:
                continue
            if swept and self._told_ns - swept[-1][0] > _BOUNCE_NS:
                swept = self._sweep(swept)[:0]
            elif len(swept) > _CUT_AT_ONCE:
                swept = self._sweep(swept)[-1:]
            swept.append((self._told_ns, ends_mm))
        self._sweep(swept)
        known_ns = self._began_ns if self._ends is None else self._ends[0]
        if left_out or now_ns - known_ns > _BOUNCE_NS:
            self.context.controls.cut.set()

    def _sweep(self, swept: list[tuple[int, Points]]) -> list[tuple[int, Points]]:
        """A piece of these ends of the electrode, if there is a new one."""
        if swept and (self._ends is None or swept[-1][0] > self._ends[0]):
            self._ends = swept[-1]
            places_mm = swept_places(np.array([ends_mm for _, ends_mm in swept]), _CUT_MM)
            fields = {"kerf_mm": self.config.kerf_mm}
            self._cuts.append(Piece(Cut, places_mm, fields, swept[-1][0]))
            self.counts["cut"] += 1
        return swept

    def _touches(self, place_mm: Float64[np.ndarray, " 3"], stamp_ns: int) -> None:
        config, self._told_mm = self.config, place_mm
        kind: type[Evidence] = Touch
        fields: dict[str, Any] = {"part": config.part, "tip_mm": config.tip_mm}
        if config.point is not None:
            kind, fields = Landmark, {"point_ct": config.point}
        self._add(Piece(kind, place_mm[None], fields, stamp_ns), stamp_ns)

    def _add(self, piece: Piece, stamp_ns: int) -> None:
        self.counts[str(piece.kind.__struct_config__.tag)] += 1
        self._waiting.append((stamp_ns, piece))

    def _tip(self, stamp_ns: int) -> Points | None:
        """The tip, and places along the shaft behind what cuts, published frame; None: unknown."""
        shaft_mm = np.arange(self._bare_mm + _SHAFT_MM, self.config.shaft_mm + 1e-9, _SHAFT_MM)
        return self._along(stamp_ns, np.append(0.0, shaft_mm))

    def _along(self, stamp_ns: int, away_mm: Float64[np.ndarray, " n"]) -> Points | None:
        """Places so far from the tip along the tool, published frame; None: unknown."""
        tip_mm = np.array(self.config.tip)
        along = unit(-tip_mm) if tip_mm.any() else np.array([0.0, 0.0, -1.0])
        for late_ns in _LATE_NS:
            with suppress(NoEstimate):
                pose = self.pose(stamp_ns - late_ns)
                return transform_points(pose, tip_mm + away_mm[:, None] * along)
        self.trouble = self.trouble or _NO_POSE
        return None


def _camera_from_published(view: CameraView) -> Affine:
    return np.linalg.inv(view.published_from_camera)
