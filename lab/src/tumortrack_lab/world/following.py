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
from tumortrack.sense.region import Hints, organ_points
from tumortrack.tracking.tracker import Follower, FollowerConfig, Tracker, region_for
from tumortrack_lab.study.document import table
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world.films import Film
from tumortrack_lab.world.paths import KINDS

# The twin's D1, D2, D3 leave 4, 7 and 10 mm at most beside their best rigid pose (median of five
# organs; largest displacement of the surface). Bounds lie half way.
SEVERITIES = {"at rest": 1.5, "D1": 5.8, "D2": 8.8, "D3": np.inf}
WRONG_MM = 3.0  # a centre farther off must not be called good
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
        rng = np.random.default_rng((0, frame.stamp_ns))
        hints = Hints(last_box_mm=follower.last_box_mm(frame.stamp_ns))
        try:
            cloud = organ_points(frame, region, hints, rng).cloud
        except NoEstimate:
            follower.forget()
            raise
        return follower.locate(cloud, frame)

    return locate


def first_look(tracker: Tracker) -> Locate:
    """Each image of the first camera as if it were the first: no memory."""
    region = region_for(tracker.model)

    def locate(look: Look) -> Estimate:
        frame = look.frames[0]
        rng = np.random.default_rng((0, frame.stamp_ns))
        return tracker.follow(organ_points(frame, region, Hints(), rng).cloud, seen=frame)

    return locate


def laid_together(tracker: Tracker) -> Locate:
    """The organ's points of all cameras in one cloud, each time without memory."""
    region = region_for(tracker.model)

    def locate(look: Look) -> Estimate:
        rng = np.random.default_rng((0, look.frames[0].stamp_ns))
        clouds = []
        for frame, pose in zip(look.frames, look.first_from_camera, strict=True):
            points = organ_points(frame, region, Hints(), rng).cloud.points_mm
            clouds.append(transform_points(pose, points.astype(float)))
        points = np.concatenate(clouds)
        few = rng.choice(len(points), min(len(points), region.crop.n_points), replace=False)
        cloud = SensorCloud(points[few].astype(np.float32), look.frames[0].stamp_ns)
        return tracker.follow(cloud, seen=look.frames[0])

    return locate


METHODS: dict[str, Callable[[Tracker], Locate]] = {
    "track": track, "first look": first_look, "laid together": laid_together,
}  # fmt: skip


def judge(tracker: Tracker, film: Film, method: str) -> list[dict[str, Any]]:
    """A row a frame and tumor: quality, errors of its centre and surface (Hausdorff), stated
    deviations, and the errors of the best rigid pose; mm. Without an estimate they are absent."""
    locate, poses = METHODS[method](tracker), film.first_from_camera()
    sites, rows = tumor_sites_of(film.rest), []
    for number, time_s in enumerate(film.seconds.tolist()):
        about = {
            "time_s": time_s,
            "bend_mm": float(film.bend_mm[number]),
            "hidden_share": float(film.hidden_share[number]),
            "quality": "none",
            "reason": "",
        }
        estimate: Estimate | None = None
        try:
            estimate = locate(Look(film.looks(number), poses))
            about |= {"quality": estimate.quality, "reason": estimate.reason}
        except NoEstimate as error:
            about["reason"] = str(error)
        truth, best = film.truth(number), film.camera_from_ct[number]
        if estimate is not None and estimate.motion is not None:
            carried = estimate.motion.carry(film.targets_ct)
            off = np.linalg.norm(carried - film.targets_mm[number], axis=1)
            about["targets_mm"] = float(off.mean())
            about["rarity"] = estimate.report.get("motion", {}).get("rarity")
        for name, rest, true in zip(
            film.rest.names[1:], film.rest.tumors, truth.tumors, strict=True
        ):
            rigid = rest.moved(transform_points(best, rest.vertices_mm))
            row = {**about, "tumor": name, "site": sites[name].kind}
            row |= _errors(rigid, true, "rigid_")
            if estimate is not None and estimate.motion is not None:
                carried = estimate.motion.carry(rest.vertices_mm)
                row |= _errors(rest.moved(carried), true, "")
                part = estimate.report["parts"][name]
                row |= {k: part.get(k) for k in ("center_std_mm", "surface_std_mm")}
                row["margin"] = estimate.report.get("margin")
            rows.append(row)
    return rows


def _errors(found: Mesh, true: Mesh, prefix: str) -> dict[str, float]:
    off_mm = found.vertices_mm.mean(0) - true.vertices_mm.mean(0)  # the same vertices
    return {
        f"{prefix}center_mm": float(np.linalg.norm(off_mm)),
        f"{prefix}hausdorff_mm": surface_distances(found, true, 2.0).hausdorff_mm,
    }


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
    """Markdown: errors by kind, severity and site, and how methods' verdicts hold."""
    rows = rows.assign(severity=_severity(rows["bend_mm"]))
    frames = rows.groupby(["method", "organ", "sequence", "time_s"], sort=False)
    worst = frames.agg(
        kind=("kind", "first"), quality=("quality", "first"), center_mm=("center_mm", "max")
    ).reset_index()
    head = ["method", "kind", "frames", "good, %", "poor, %", "good and over 3 mm, %", "longest, s"]
    body = []
    for (method, kind), mine in _sorted(worst, ["method", "kind"]):
        wrong = (mine["quality"] == "good") & (mine["center_mm"] > WRONG_MM)
        shares = [(mine["quality"] == q).mean() for q in ("good", "poor")] + [wrong.mean()]
        longest = max(
            _longest_s(one["time_s"], wrong[one.index])
            for _, one in mine.groupby(["organ", "sequence"])
        )
        cells = [f"{100 * share:.0f}" for share in shares]
        body.append([method, kind, str(len(mine)), *cells, f"{longest:.1f}"])
    verdicts = table(head, body, 2)
    head = ["kind", "state", "tumor", "frames", "best rigid pose"]
    methods = sorted(set(rows["method"]))
    head += [f"{method}: {what}" for method in methods for what in ("centre", "Hausdorff")]
    body = []
    every = pd.concat([rows.assign(kind="all"), rows])
    for (kind, severity, site), mine in _sorted(every, ["kind", "severity", "site"]):
        count = mine[mine["method"] == methods[0]]
        cells = [kind, severity, site, str(len(count)), _of_organs(count, "rigid_center_mm")]
        for method in methods:
            its = mine[mine["method"] == method]
            cells += [_of_organs(its, key) for key in ("center_mm", "hausdorff_mm")]
        body.append(cells)
    return (
        f"{table(head, body, 3)}\n\nmm: median over the organs of the median over all frames with "
        "an estimate (of whatever quality), and the worst organ's. State: by the largest "
        f"displacement beside the best rigid pose, up to {', '.join(_bounds())} mm, and more.\n\n"
        f"{verdicts}\n\nOver 3 mm: the centre of any tumor; longest: run of such frames.\n"
    )


def _bounds() -> list[str]:
    return [f"{bound:g}" for bound in SEVERITIES.values() if np.isfinite(bound)]


def _severity(bend_mm: pd.Series) -> np.ndarray:
    bounds = np.array(list(SEVERITIES.values()))
    return np.array(list(SEVERITIES))[np.searchsorted(bounds, bend_mm)]


def _sorted(rows: pd.DataFrame, keys: list[str]) -> list[tuple[tuple[str, ...], pd.DataFrame]]:
    order = ["all", *KINDS, *SEVERITIES]
    groups = [(key, mine) for key, mine in rows.groupby(keys) if len(mine)]
    return sorted(groups, key=lambda one: [(k not in order, k in order and order.index(k), k)
                                           for k in one[0]])  # fmt: skip


def _of_organs(rows: pd.DataFrame, key: str) -> str:
    medians = rows.groupby("organ")[key].median().dropna()
    return f"{medians.median():.1f} [{medians.max():.1f}]" if len(medians) else "–"


def _longest_s(time_s: pd.Series, wrong: pd.Series) -> float:
    """The longest unbroken run of wrong frames, from the first to the one that ends it."""
    times, flags = time_s.to_numpy(), wrong.to_numpy()
    begun, longest = None, 0.0
    for now, flag in zip([*times, times[-1]], [*flags, False], strict=True):
        if flag and begun is None:
            begun = now
        elif not flag and begun is not None:
            longest, begun = max(longest, now - begun), None
    return longest


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Error of centres against time under a press: medians over sequences, phases made equally
    long; and how far the organ is bent."""
    rows = rows[rows["kind"] == "press"]
    if rows.empty:
        return
    figure = new_figure(9.4, 4.2)
    left = figure.add_axes((0.07, 0.12, 0.68, 0.83))
    step = np.round(rows["phase"] * 5) / 5
    for site, line in (("endophytic", "-"), ("exophytic", ":")):
        for number, method in enumerate(sorted(set(rows["method"]))):
            mine = rows[(rows["method"] == method) & (rows["site"] == site)]
            if len(mine):
                middle = mine["center_mm"].groupby(step[mine.index]).median()
                left.plot(middle.index, middle, line, color=f"C{number}", label=f"{method}, {site}")
    bend = rows["bend_mm"].groupby(step).median() / 5
    left.fill_between(bend.index, bend, color="0.85", label="largest bend, a fifth", zorder=0)
    left.set_xticks(np.arange(5) + 0.5, _PHASES)
    left.set_ylabel("error of a tumor's centre, mm (median)")
    left.set_ylim(bottom=0)
    figure.legend(loc="upper right", frameon=False, fontsize=8.5)
    save(figure, path)
