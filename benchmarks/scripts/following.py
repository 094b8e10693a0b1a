"""How well a moving organ is followed, frame by frame: at camera rate, after jumps, by two cameras.

    make following ARGS='OUT --kidneys 4'

Random kidneys breathe and are pushed in the virtual source's room, seen 30 times a second (of the
scene's time) by one camera, by two, or by one while the organ jumps aside and turns every few
seconds. Each frame goes through what `track` does with it. The same command goes on where it was
stopped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import FAR_MM
from tumortrack.core.geometry import Affine, perpendicular, rigid, unit
from tumortrack.io.case import load_case
from tumortrack.live.values import CameraView, Observation, PublishedFrame, SinkContext
from tumortrack.live.views import ViewsLocator
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.tracker import region_for
from tumortrack_benchmarks import judging, scripting
from tumortrack_benchmarks.document import share_words, table_of
from tumortrack_benchmarks.judging import centers_off_mm
from tumortrack_benchmarks.physics.scenes import random_case
from tumortrack_benchmarks.scripting import KidneyOptions, cell
from tumortrack_devices import player
from tumortrack_devices.player import ScenePlayer, ScenePlayerConfig

_HZ = 30.0
_ASIDE_MM, _TURN_DEGREES = 25.0, 40.0  # of a jump, over the table
_EVERY_S = 2.3  # jumps, at all times between searches as in a first frame, which are each second
_SECOND_DEGREES = 45.0  # of the second camera's view, aside
_JUMPING = "room_from_organ", "room_from_rod"
KINDS = "one camera", "two cameras", "jumps"


@dataclass(frozen=True)
class Options(KidneyOptions):
    """Follow random kidneys."""

    seconds: float = 12.0
    """Of each kind of scene: two pushes."""


def main(options: Options) -> None:
    """Follow, then the table."""
    writer = scripting.begun("following", options.document)
    for number in options.numbers:  # before processes share them
        random_case(options.out / str(number), number)
    work = [(options.out, n, kind, options.seconds) for n in options.numbers for kind in KINDS]
    rows = pd.DataFrame(scripting.together(_rows, work))
    shown = table(rows)
    print(table_of(shown))
    frames = f"{options.kidneys} organs, {len(rows)} frames at {_HZ:g} Hz"
    writer.tables({"following": shown}, sample=frames)


def _rows(out: Path, number: int, kind: str, seconds: float) -> list[dict[str, Any]]:
    folder = out / str(number)
    code = [Path(each.__file__) for each in (judging, player)]
    about = scripting.about_scenes(folder / "case", [], [*code, Path(__file__)])
    path = folder / "following" / f"{kind.replace(' ', '-')}.json"
    measure = frames(folder / "case", number, kind, seconds)
    rows = scripting.kept(path, {**about, "seconds": seconds}, lambda: measure)
    return [{"kidney": number, "kind": kind, **row} for row in rows]


def frames(folder: Path, seed: int, kind: str, seconds: float) -> Iterator[dict[str, Any]]:
    """A row for each frame: the verdict, how far off the farthest tumor is, and how long ago the
    organ jumped."""
    tracker, case = scripting.tracker_of(folder), load_case(folder)
    still = ScenePlayerConfig(sway_mm=0.0, sway_degrees=0.0)  # the cameras
    room = ScenePlayer(case.anatomy, case.up_lps, still, seed)
    follower, region = Follower(tracker, FollowerConfig()), region_for(tracker.model)
    context = SinkContext(tracker.model.parts, PublishedFrame(), tracker.anatomy_ct)
    locator = ViewsLocator(follower, context, region, 0.0, seed)
    up, aside = unit(np.array(case.up_lps)), np.eye(4)
    jump = _turned(case.anatomy.organ.box_mm.mean(0), up, _TURN_DEGREES)
    jump[:3, 3] += _ASIDE_MM * perpendicular(up)
    for number in range(round(seconds * _HZ)):
        t_s = number / _HZ
        instant, jumps = room.state_at(t_s), int(t_s / _EVERY_S) if kind == "jumps" else 0
        if jumps % 2:  # the instrument with it
            poses = {name: jump @ getattr(instant, name) for name in _JUMPING}
            instant = replace(instant, **poses)
        truth, stamp_ns = room.truth(instant), round(1e9 * (1 + t_s))
        if number == 0:
            aside = _turned(truth.organ.box_mm.mean(0), np.eye(3)[1], _SECOND_DEGREES)
        views = []
        for camera, place in enumerate([np.eye(4), aside][: 1 + (kind == "two cameras")]):
            pose = place @ instant.camera_from_room
            there = replace(instant, camera_from_room=pose, t_s=t_s + 1e-6 * camera)  # other noise
            seen = Observation(room.frame(there, room.truth(there), stamp_ns), stamp_ns)
            views.append(CameraView(camera + 1, seen, np.linalg.inv(place)))
        row: dict[str, Any] = {"quality": "none", "off_mm": None}
        try:
            found = locator.locate(locator.find(views, {}, {})[0])
            off_mm = max(centers_off_mm(found.meshes, truth).values())
            row = {"quality": found.quality, "off_mm": off_mm}
        except NoEstimate:
            follower.lose()
        yield {**row, "jumps": jumps, "since_s": t_s - jumps * _EVERY_S}


def _turned(middle_mm: np.ndarray, axis: np.ndarray, degrees: float) -> Affine:
    """A rotation about a place."""
    turn = Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()
    return rigid(turn, middle_mm - turn @ middle_mm)


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each kind of scene. After a jump an answer is right from the first one whose
    tumors are all less than 5 mm off."""
    lines = []
    for kind, some in rows.groupby("kind", sort=False):
        good, off_mm = some.quality == "good", some.off_mm.astype(float)
        right = some[(off_mm <= FAR_MM) & (some.jumps > 0)]
        after_s = right.groupby(["kidney", "jumps"]).since_s.min()
        jumps = len(some[some.jumps > 0][["kidney", "jumps"]].drop_duplicates())
        wrong = int((good & (off_mm > FAR_MM)).sum())
        lines.append({
            "scene": kind, "frames": len(some), "median, mm": cell(off_mm.median()),
            "95 %": cell(off_mm.quantile(0.95)), "worst": cell(off_mm.max()),
            "no answer %": cell(100 * (some.quality == "none").mean()),
            "good %": cell(100 * good.mean()),
            "95 % of good": cell(off_mm[good].quantile(0.95)),
            "over 5 mm, % of good": share_words(wrong, int(good.sum())) if good.any() else "–",
            "jumps": jumps, "right again": len(after_s),
            "after, s: median": cell(after_s.median(), 2), "longest": cell(after_s.max(), 2),
        })  # fmt: skip
    return pd.DataFrame(lines)


if __name__ == "__main__":
    scripting.run(main, Options)
