"""How followers do in sequences: every frame's error, stated spread and verdict; tables; a plot.

A method is made for a tracker and a sequence, and then sees one look after the other: what each
camera saw at that moment, and where the cameras are, as a calibration says.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float64

from tumortrack.core import store
from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud
from tumortrack.report.drawing import new_figure, save
from tumortrack.report.metrics import surface_distances
from tumortrack.sense.region import Hints, RegionConfig, organ_points
from tumortrack.tracking.tracker import Follower, FollowerConfig, Tracker, region_for
from tumortrack_lab.study.document import table
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world.films import Film
from tumortrack_lab.world.paths import KINDS

# The twin's D1, D2, D3 leave 4, 7 and 10 mm at most beside their best rigid pose (median of five
# organs; largest displacement of the surface). Bounds lie half way.
STATES = {"at rest": 1.5, "D1": 5.8, "D2": 8.8, "D3": np.inf}
WRONG_MM = 3.0  # a centre farther off must not be called good
_SURFACES_EVERY = 3  # frames: a Hausdorff distance takes as long as locating
_NOTHING_KNOWN = Hints()
_PHASES = ("at rest", "loaded", "held", "released", "at rest")


class Look(NamedTuple):
    """One moment: a depth image a camera, and the cameras' poses; the first one's is the frame in
    which answers are given."""

    frames: tuple[DepthFrame, ...]
    first_from_camera: Float64[np.ndarray, "views 4 4"]


Locate = Callable[[Look], Estimate]


def track(tracker: Tracker) -> Locate:
    """The first camera's images as `tumortrack track` follows them."""
    region, follower = region_for(tracker.model), Follower(tracker, FollowerConfig())

    def locate(look: Look) -> Estimate:
        frame = look.frames[0]
        try:
            cloud = _organ(frame, region, Hints(last_box_mm=follower.last_box_mm(frame.stamp_ns)))
        except NoEstimate:
            follower.forget()
            raise
        return follower.locate(cloud, frame)

    return locate


def first_look(tracker: Tracker) -> Locate:
    """Each image of the first camera as if it were the first: no memory."""
    region = region_for(tracker.model)
    return lambda look: tracker.follow(_organ(look.frames[0], region), seen=look.frames[0])


def laid_together(tracker: Tracker) -> Locate:
    """The organ's points of all cameras in one cloud, each time without memory."""
    region = region_for(tracker.model)

    def locate(look: Look) -> Estimate:
        pairs = zip(look.frames, look.first_from_camera, strict=True)
        clouds = [(pose, _organ(frame, region).points_mm) for frame, pose in pairs]
        points = np.concatenate([transform_points(pose, mm.astype(float)) for pose, mm in clouds])
        rng = np.random.default_rng(0)
        few = rng.choice(len(points), min(len(points), region.crop.n_points), replace=False)
        cloud = SensorCloud(points[few].astype(np.float32), look.frames[0].stamp_ns)
        return tracker.follow(cloud, seen=look.frames[0])

    return locate


def _organ(frame: DepthFrame, region: RegionConfig, hints: Hints = _NOTHING_KNOWN) -> SensorCloud:
    rng = np.random.default_rng((0, frame.stamp_ns))  # as the live loop's
    return organ_points(frame, region, hints, rng).cloud


METHODS: dict[str, Callable[[Tracker], Locate]] = {
    "track": track, "first-look": first_look, "laid-together": laid_together,
}  # fmt: skip


def judge(locate: Locate, film: Film) -> list[dict[str, Any]]:
    """A row a frame and tumor: quality, error of its centre and, in every third frame, its surface
    (Hausdorff), stated deviations, and how far the best rigid pose has the centre off; mm. What
    needs an estimate is absent where there is none."""
    poses, sites, rows = film.first_from_camera(), tumor_sites_of(film.rest), []
    for number, time_s in enumerate(film.seconds.tolist()):
        about: dict[str, Any] = {
            "time_s": time_s,
            "bend_mm": float(film.bend_mm[number]),
            "hidden_share": float(film.hidden_share[number]),
        }
        motion, parts = None, {}
        try:
            estimate = locate(Look(film.looks(number), poses))
            about |= {"quality": estimate.quality, "reason": estimate.reason}
            motion, parts = estimate.motion, estimate.report["parts"]
            about["margin"] = estimate.report.get("margin")
        except NoEstimate as error:
            about |= {"quality": "none", "reason": str(error)}
        if motion is not None:
            off_mm = motion.carry(film.targets_ct) - film.targets_mm[number]
            about["targets_mm"] = float(np.linalg.norm(off_mm, axis=1).mean())
        pose, truth = film.camera_from_ct[number], film.truth(number)
        for name, rest, true in zip(
            film.rest.names[1:], film.rest.tumors, truth.tumors, strict=True
        ):
            row = {**about, "tumor": name, "site": sites[name].kind}
            row["rigid_center_mm"] = _center_mm(transform_points(pose, rest.vertices_mm), true)
            if motion is not None:
                found = rest.moved(motion.carry(rest.vertices_mm))
                row["center_mm"] = _center_mm(found.vertices_mm, true)
                if number % _SURFACES_EVERY == 0:
                    row["hausdorff_mm"] = surface_distances(found, true, 2.0).hausdorff_mm
                row |= {key: parts[name].get(key) for key in ("center_std_mm", "surface_std_mm")}
            rows.append(row)
    return rows


def _center_mm(found_mm: np.ndarray, true: Mesh) -> float:
    return float(np.linalg.norm(found_mm.mean(0) - true.vertices_mm.mean(0)))  # the same vertices


def rows_in(out: Path) -> list[dict[str, Any]]:
    """Of all sequences and methods that were judged in a folder."""
    rows = []
    for path in sorted(out.glob("*-[0-9]*/*.json")):
        kept = store.read_json(path)
        if "rows" in kept:
            kind, about = path.parent.name.partition("-")[0], {"method": path.stem}
            about |= {"organ": out.name, "sequence": path.parent.name, "kind": kind}
            phases = store.read_json(path.parent / "meta.json")["phases_s"]
            rows += [
                {**about, **row, "phase": np.interp(row["time_s"], phases, range(len(phases)))}
                for row in kept["rows"]
            ]
    return rows


def summary(rows: pd.DataFrame) -> str:
    """Markdown: errors by kind, state and site, and how far verdicts can be relied on."""
    bound = np.array(list(STATES.values()))
    state = np.array(list(STATES))[np.searchsorted(bound, rows["bend_mm"])]
    rows = pd.concat([rows.assign(kind="all", state=state), rows.assign(state=state)])
    rows["kind"] = pd.Categorical(rows["kind"], ["all", *KINDS])
    rows["state"] = pd.Categorical(rows["state"], list(STATES))
    methods = sorted(set(rows["method"]))
    head = ["kind", "state", "tumor", "frames", "best rigid pose"]
    head += [f"{method}: {what}" for method in methods for what in ("centre", "Hausdorff")]
    body = []
    for (kind, severity, site), mine in rows.groupby(["kind", "state", "site"], observed=True):
        each = [mine[mine["method"] == method] for method in methods]
        cells = [kind, severity, site, str(len(each[0])), _of_organs(each[0], "rigid_center_mm")]
        for its in each:
            cells += [_of_organs(its, key) for key in ("center_mm", "hausdorff_mm")]
        body.append(cells)
    errors = table(head, body, 3)
    head = ["method", "kind", "frames", "good, %", "poor, %", "good and over 3 mm, %", "longest, s"]
    body, keys = [], ["method", "kind", "organ", "sequence", "time_s"]
    picked = {"quality": ("quality", "first"), "center_mm": ("center_mm", "max")}
    frames = rows.groupby(keys, observed=True).agg(**picked).reset_index()
    frames["wrong"] = (frames["quality"] == "good") & (frames["center_mm"] > WRONG_MM)
    for (method, kind), mine in frames.groupby(["method", "kind"], observed=True):
        shares = [(mine["quality"] == q).mean() for q in ("good", "poor")] + [mine["wrong"].mean()]
        each = [one for _, one in mine.groupby(["organ", "sequence"], observed=True)]
        longest = max(longest_s(one["time_s"].tolist(), one["wrong"].tolist()) for one in each)
        cells = [f"{100 * share:.0f}" for share in shares]
        body.append([method, kind, str(len(mine)), *cells, f"{longest:.1f}"])
    return (
        f"{errors}\n\nmm: median over organs of the median over all frames with an estimate "
        "(good or poor), and the worst organ's. State: by the largest displacement beside the best "
        f"rigid pose, up to {', '.join(f'{mm:g}' for mm in bound[:-1])} mm, and more.\n\n"
        f"{table(head, body, 2)}\n\nOver 3 mm: the centre of any tumor; longest: without a break."
        "\n"
    )


def longest_s(times_s: list[float], wrong: list[bool]) -> float:
    """How long the longest unbroken run of wrong frames lasted, until the frame that ended it."""
    begun, longest = None, 0.0
    for now, is_wrong in zip([*times_s, times_s[-1]], [*wrong, False], strict=True):
        if is_wrong and begun is None:
            begun = now
        elif not is_wrong and begun is not None:
            longest, begun = max(longest, now - begun), None
    return longest


def _of_organs(rows: pd.DataFrame, key: str) -> str:
    medians = rows.groupby("organ")[key].median().dropna()
    return f"{medians.median():.1f} [{medians.max():.1f}]" if len(medians) else "–"


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Error of centres against time under a press: medians over sequences, phases made equally
    long; and how far the organ is bent."""
    rows = rows[rows["kind"] == "press"]
    step = np.floor(rows["phase"] * 4) / 4 + 0.125
    figure = new_figure(9.4, 4.2)
    axes = figure.add_axes((0.07, 0.12, 0.68, 0.83))
    for number, (method, mine) in enumerate(rows.groupby("method")):
        for site, line in (("endophytic", "-"), ("exophytic", ":")):
            errors = mine["center_mm"][mine["site"] == site]
            middle = errors.groupby(step[errors.index]).median()
            axes.plot(middle.index, middle, line, color=f"C{number}", label=f"{method}, {site}")
    bend = rows["bend_mm"].groupby(step).median() / 5
    axes.fill_between(bend.index, bend, color="0.85", label="largest bend, a fifth", zorder=0)
    axes.set_xticks(np.arange(len(_PHASES)) + 0.5, _PHASES)
    axes.set(ylabel="error of a tumor's centre, mm (median)", ylim=(0, None))
    figure.legend(loc="upper right", frameon=False, fontsize=8.5)
    save(figure, path)
