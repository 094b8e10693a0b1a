"""Rows of a whole frame, found anew and followed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from tumortrack.evaluate.bench import asked as occupancy
from tumortrack.evaluate.bench import placing as warp
from tumortrack.evaluate.bench.asked import Asked, asked_of
from tumortrack.evaluate.bench.placing import QUERIES, Placing
from tumortrack.evaluate.bench.row import Row, Work
from tumortrack.evaluate.bench.subject import PRESETS
from tumortrack.evaluate.bench.turns import in_turns

if TYPE_CHECKING:
    from tumortrack.evaluate.bench.subject import Subject

FRAME, TRACKING = "frame", "tracking frame"
_MOVES_MM = 0.5  # of the cloud, from frame to frame


def frame_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[Row]:
    """1,000 points to 40,000 labels."""
    for preset in PRESETS:
        share = budget_s / len(PRESETS)
        if preset == "clinic":
            yield _clinic_frame(subject, threads, share)
        else:
            yield occupancy_frame(asked_of(subject, preset), preset, threads, share)


def occupancy_frame(asked: Asked, preset: str, threads: int, budget_s: float) -> Row:
    queries = asked.queries(QUERIES)
    ours, naive = in_turns(asked.our_frame(queries), asked.naive_frame(queries), budget_s=budget_s)
    labels, count = asked.frame_labels(queries)
    encode, decode = asked.encoder_work(), asked.decoder_work(count)
    return Row(
        name=FRAME,
        what=preset,
        threads=threads,
        item="frame",
        ours=ours,
        naive=naive,
        naive_is=occupancy.NAIVE,
        work=Work(
            flops=encode.flops + decode.flops,
            bytes=encode.bytes + decode.bytes,
            precision=decode.precision,
        ),
        naive_work=asked.naive_decoder_work(QUERIES),
        agreement=float((labels == asked.naive_labels(queries)).mean()),
        others={"asked": count},
        note=f"{count:,} points asked",
        device=asked.device,
    )


def _clinic_frame(subject: Subject, threads: int, budget_s: float) -> Row:
    placing = Placing(subject)
    ours, naive = in_turns(placing.ours, placing.naive, budget_s=budget_s)
    estimate = placing.estimate
    places = estimate.cloud.points_mm.astype(float)
    assert estimate.motion is not None
    back = estimate.motion.back(places)
    assert back is not None
    same = placing.plain.labels_where(back) == estimate.cloud.labels
    unknown = 6 + len(estimate.report["motion"]["coefficients"])
    return Row(
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


def tracking_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[Row]:
    """The default preset from frame to frame: a cloud that moves by half a millimetre."""
    from tumortrack.core.types import SensorCloud
    from tumortrack.track.estimate import Following

    placing = Placing(subject)
    points, how = placing.cloud.points_mm, Following()
    swing = np.array([_MOVES_MM, 0.0, 0.0], np.float32)
    frames = [SensorCloud(points + sign * swing / 2) for sign in (1, -1)]
    last = [placing.tracker.follow(frames[0], None, how)]
    turn = [0]

    def ours() -> None:
        turn[0] = 1 - turn[0]
        last[0] = placing.tracker.follow(frames[turn[0]], last[0], how)

    ours_s, naive = in_turns(ours, placing.naive, budget_s=budget_s)
    steps = last[0].report["motion"]["steps"]
    unknown = 6 + len(last[0].report["motion"]["coefficients"])
    yield Row(
        name=TRACKING,
        what="clinic",
        threads=threads,
        item="frame",
        ours=ours_s,
        naive=naive,
        naive_is=warp.NAIVE + ", every frame from the start",
        work=placing.work(unknown, steps, 20_000),
        note=f"steady state: {steps} refinement steps, 20,000 points carried, surfaces, report",
    )
