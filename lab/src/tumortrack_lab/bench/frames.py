"""Rows of a whole frame, found anew and followed."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from tumortrack.core.estimate import Following
from tumortrack.core.types import SensorCloud
from tumortrack_lab.bench import asked as occupancy
from tumortrack_lab.bench import placing as warp
from tumortrack_lab.bench.asked import LABELLING, OccupancyWorkload, asked_of
from tumortrack_lab.bench.placing import QUERIES, Placing
from tumortrack_lab.bench.row import BenchRow, Work
from tumortrack_lab.bench.subject import PRESETS
from tumortrack_lab.bench.turns import Call, in_turns

if TYPE_CHECKING:
    from tumortrack.tracking.tracker import Tracker
    from tumortrack_lab.bench.subject import Subject

FRAME, EVERY, TRACKING = "frame", "frame, every query asked", "tracking frame"
_CARRIED = 20_000  # points that a live estimate of a warp holds
_TIMED = ", timed beside the row `frame`"
_MOVES_MM = 0.5  # of the cloud, from frame to frame


def frame_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """1,000 points to 40,000 labels."""
    share = budget_s / len(PRESETS)
    yield _clinic_frame(subject, threads, share)
    for preset in LABELLING:
        yield from occupancy_frames(asked_of(subject, preset), preset, threads, share)


def occupancy_frames(
    asked: OccupancyWorkload, preset: str, threads: int, budget_s: float
) -> Iterator[BenchRow]:
    """As `locate` does it, and with every query asked."""
    queries = asked.queries(QUERIES)
    ours, every, naive = in_turns(
        lambda: asked.our_frame(queries),
        lambda: asked.every_query(queries),
        asked.naive_frame(queries),
        budget_s=budget_s,
    )
    asked.naive_frame_s = naive
    found, asked_for = asked.our_frame(queries)
    encode = asked.encoder_work()
    for name, timing, labels, count in (
        (FRAME, ours, found, asked_for),
        (EVERY, every, asked.every_query(queries), QUERIES),
    ):
        decode = asked.decoder_work(count)
        yield BenchRow(
            name=name,
            what=preset,
            threads=threads,
            item="frame",
            ours=timing,
            naive=naive,
            naive_is=occupancy.NAIVE,
            work=Work(
                flops=encode.flops + decode.flops,
                bytes=encode.bytes + decode.bytes,
                precision=decode.precision,
            ),
            naive_work=asked.naive_decoder_work(QUERIES),
            agreement=asked.agreement(labels),
            others={"asked": count},
            note="" if count == QUERIES else f"{count:,} places asked for {QUERIES:,} labels",
            device=asked.device,
        )


def _clinic_frame(subject: Subject, threads: int, budget_s: float) -> BenchRow:
    placing = Placing(subject)
    ours, naive = in_turns(placing.ours, placing.naive, budget_s=budget_s)
    estimate = placing.estimate
    places = estimate.cloud.points_mm.astype(float)
    assert estimate.motion is not None
    back = estimate.motion.back(places)
    assert back is not None
    same = placing.plain.labels_where(back) == estimate.cloud.labels
    unknown = 6 + len(estimate.report["motion"]["coefficients"])
    return BenchRow(
        name=FRAME,
        what="clinic",
        threads=threads,
        item="frame",
        ours=ours,
        naive=naive,
        naive_is=warp.NAIVE,
        work=placing.work(unknown, estimate.report["motion"]["steps"], QUERIES),
        agreement=float(same.mean()),
        note="`locate` without its volume: labels, probabilities, surfaces, report; agreement: "
        "points inside, at our motion, against inside tests",
    )


def tracking_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """From frame to frame: a cloud that moves by half a millimetre, to and fro."""
    from tumortrack.tracking.tracker import Tracker

    share = budget_s / len(PRESETS)
    placing = Placing(subject)
    ours = _Following(placing.tracker, placing.cloud.points_mm)
    (timing, naive) = in_turns(ours, placing.naive, budget_s=share)
    steps, coefficients = (ours.last.report["motion"][key] for key in ("steps", "coefficients"))
    yield BenchRow(
        name=TRACKING,
        what="clinic",
        threads=threads,
        item="frame",
        ours=timing,
        naive=naive,
        naive_is=warp.NAIVE + ", every frame from the start",
        work=placing.work(6 + len(coefficients), steps, _CARRIED),
        note=f"steady state: {steps} refinement steps, points carried, surfaces, report",
    )
    for preset in LABELLING:
        asked = asked_of(subject, preset)
        ours = _Following(Tracker(subject.model(preset)), asked.points_mm)
        versions: list[Call] = [ours]
        known = [] if asked.naive_frame_s is None else [asked.naive_frame_s]
        if not known:
            versions.append(asked.naive_frame(asked.queries(QUERIES)))
        timing, naive = [*in_turns(*versions, budget_s=share), *known]
        yield BenchRow(
            name=TRACKING,
            what=preset,
            threads=threads,
            item="frame",
            ours=timing,
            naive=naive,
            naive_is=occupancy.NAIVE + "; every frame from the start" + _TIMED * bool(known),
            note="steady state: labels, surfaces, report",
        )


class _Following:
    """The live loop's frames, one a call."""

    def __init__(self, tracker: Tracker, points_mm: np.ndarray) -> None:
        swing = np.array([_MOVES_MM / 2, 0.0, 0.0], np.float32)
        self._tracker = tracker
        self._frames = cycle([SensorCloud(points_mm + swing), SensorCloud(points_mm - swing)])
        self.last = tracker.follow(next(self._frames), None, Following())

    def __call__(self) -> None:
        self.last = self._tracker.follow(next(self._frames), self.last, Following())
