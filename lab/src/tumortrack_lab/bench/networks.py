"""Workloads of the networks: encoder and decoder, frames found anew and followed, volumes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import cycle

import numpy as np
import torch

from tumortrack.core.estimate import Following
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.occupancy.sparse import sparse_margins
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.forms import (
    IN_ONE_PIECE,
    QUERIES,
    Grid,
    OccupancyForms,
    RegistrationForms,
    module_flops,
    weight_bytes,
)
from tumortrack_lab.bench.naive import flowed
from tumortrack_lab.bench.rows import InterleavedTiming, Work, Workload
from tumortrack_lab.bench.subject import LABELLING, BenchSubject

GRID = 400  # voxels along the volume's longest side
_DECODED = (1000, 10_000, 40_000, 400_000)  # queries
_CARRIED = 20_000  # points that a live estimate of a warp holds
_MOVES_MM = 0.5  # of the cloud, from frame to frame
_SLAB = 16_384  # voxels of the volume that the naive form is asked for


def encoders(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A cloud of 1,000 points to what is known of it."""
    for preset in LABELLING:
        forms = subject.occupancy(preset)
        yield Workload(
            rows.ENCODER, preset, "cloud",
            ours=partial(forms.encode, forms.points_mm),
            naive=forms.naive_encoding,
            naive_is="single precision, Python loop of farthest points, neighbours by sorting",
            facts=lambda forms=forms: {"work": forms.encoder_work()},  # type: ignore[misc]
        )  # fmt: skip
    warp, points = subject.registration, subject.cloud("clinic").points_mm

    @torch.inference_mode()
    def facts() -> dict:
        flops = module_flops(lambda: warp.network.flip_hypotheses(torch.tensor(points)[None]))
        moved = weight_bytes(warp.network, 4) + points.nbytes
        return {"work": Work(flops=flops, bytes=moved), "note": "both ways round"}

    ours = partial(warp.encode, points)  # nobody writes it differently
    yield Workload(rows.ENCODER, "clinic", "cloud", ours, facts=facts)


def decoders(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """Labels of 1,000 to 400,000 queries, the cloud being encoded."""
    for preset in LABELLING:
        whole: object = None  # seconds of the naive form, in the largest piece
        for count in _DECODED:
            one = _decoder(subject.occupancy(preset), preset, count, whole)
            yield one
            whole = one.naive


def _decoder(forms: OccupancyForms, preset: str, count: int, whole: object) -> Workload:
    first = forms.queries(count)[:IN_ONE_PIECE]
    scaled = count / len(first)
    known = whole if scaled != 1 and isinstance(whole, InterleavedTiming) else None
    note = "" if scaled == 1 else f"naive: that of {IN_ONE_PIECE:,}, scaled"
    return Workload(
        rows.DECODER, f"{preset}, {count:,} queries", "decoding",
        ours=forms.labelling(count),
        naive=known or forms.naive_decoding(first),
        naive_is=forms.naive_is,
        naive_share=scaled,
        facts=lambda: {
            "work": forms.decoder_work(count),
            "agreement": forms.agreement(forms.every_query(first)),
            "note": note,
        },
    )  # fmt: skip


def frames(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """1,000 points to 40,000 labels."""
    warp = subject.registration
    yield Workload(
        rows.FRAME, "clinic", "frame", warp.ours, warp.naive, warp.naive_is,
        facts=lambda: {
            "work": warp.work(warp.estimate.report, QUERIES),
            "agreement": warp.agreement(),
            "note": "`locate` without its volume: labels, probabilities, surfaces, report; "
            "agreement: points inside, at our motion, against inside tests",
        },
    )  # fmt: skip
    for preset in LABELLING:
        yield from occupancy_frames(subject.occupancy(preset), preset)


def occupancy_frames(forms: OccupancyForms, preset: str) -> Iterator[Workload]:
    """As `locate` does it, and with every query asked."""
    queries = forms.queries(QUERIES)

    def facts(every: bool) -> dict:
        found, places = (forms.every_query(queries), QUERIES) if every else forms.our_frame(queries)
        return {
            "work": forms.frame_work(places),
            "agreement": forms.agreement(found),
            "others": {"asked": places},
            "note": "" if every else f"{places:,} places asked for {QUERIES:,} labels",
            "device": forms.device,
        }

    ask_all = partial(forms.every_query, queries)
    every = Workload(rows.EVERY, preset, "frame", ask_all, facts=partial(facts, True))
    one = Workload(
        rows.FRAME, preset, "frame",
        ours=partial(forms.our_frame, queries),
        naive=forms.naive_frame(queries),
        naive_is=forms.naive_is,
        facts=partial(facts, False),
        beside=(every,),
    )  # fmt: skip
    yield one
    assert isinstance(one.naive, InterleavedTiming)
    forms.naive_frame_s = one.naive


def tracking(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """From frame to frame: a cloud that moves by half a millimetre, to and fro."""
    warp = subject.registration
    ours = _LiveFrames(warp.tracker, warp.cloud.points_mm)

    def facts() -> dict:
        steps = ours.last.report["motion"]["steps"]
        note = f"steady state: {steps} refinement steps, points carried, surfaces, report"
        return {"work": warp.work(ours.last.report, _CARRIED), "note": note}

    naive_is = warp.naive_is + ", every frame from the start"
    yield Workload(rows.TRACKING, "clinic", "frame", ours, warp.naive, naive_is, facts=facts)
    for preset in LABELLING:
        forms = subject.occupancy(preset)
        known = forms.naive_frame_s
        beside = ", timed beside the row `frame`" if known else ""
        yield Workload(
            rows.TRACKING, preset, "frame",
            ours=_LiveFrames(Tracker(subject.model(preset)), forms.points_mm),
            naive=known or forms.naive_frame(forms.queries(QUERIES)),
            naive_is=f"{forms.naive_is}; every frame from the start{beside}",
            facts=lambda: {"note": "steady state: labels, surfaces, report"},
        )  # fmt: skip


class _LiveFrames:
    """The live loop's frames, one a call."""

    def __init__(self, tracker: Tracker, points_mm: np.ndarray) -> None:
        swing = np.array([_MOVES_MM / 2, 0.0, 0.0], np.float32)
        self._tracker = tracker
        self._frames = cycle([SensorCloud(points_mm + swing), SensorCloud(points_mm - swing)])
        self.last = tracker.follow(next(self._frames), None, Following())

    def __call__(self) -> None:
        self.last = self._tracker.follow(next(self._frames), self.last, Following())


def volumes(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """From what is known of the cloud to a label in every voxel: 400 along the longest side."""
    yield _registered_volume(subject.registration)
    for preset in LABELLING:
        yield occupancy_volume(subject.occupancy(preset), preset)


def _registered_volume(warp: RegistrationForms) -> Workload:
    grid = warp.grid(GRID)
    index, points = _slab(grid)
    voxels, faces = int(np.prod(grid[1])), sum(len(part.faces) for part in warp.anatomy.parts)
    motion = warp.estimate.report["motion"]
    camera_from_ct, state = (np.array(motion[k]) for k in ("camera_from_ct", "coefficients"))

    def naive() -> np.ndarray:
        rest = (points - camera_from_ct[:3, 3]) @ camera_from_ct[:3, :3]
        return warp.plain.labels_where(flowed(warp.plain.body, -state, rest))

    def facts() -> dict:
        # Each column of voxels is crossed by triangles, every voxel written once.
        flops = 60.0 * faces + 40.0 * grid[1][0] * grid[1][1]
        labels = label_grid(warp.anatomy, *grid)[tuple(index.T)]
        return {
            "work": Work(flops=flops, bytes=float(voxels + 36 * faces)),
            "agreement": float((naive() == labels).mean()),
            "others": {"voxels": voxels},
            "note": "the moved surfaces filled",
        }

    naive_is = f"every voxel carried back, inside tests; {len(points):,} voxels, scaled"
    return Workload(
        rows.VOLUME, "clinic", "volume", partial(label_grid, warp.anatomy, *grid), naive, naive_is,
        naive_share=voxels / len(points), facts=facts,
    )  # fmt: skip


def occupancy_volume(forms: OccupancyForms, preset: str) -> Workload:
    grid = forms.grid(GRID)
    index, points = _slab(grid)
    voxels, logits, labels = int(np.prod(grid[1])), forms.counted(), np.zeros(0, np.uint8)

    def filled() -> None:
        nonlocal labels
        logits.places = 0
        labels = sparse_margins(logits, *grid)[1]

    def facts() -> dict:
        return {
            "work": forms.decoder_work(logits.places, voxels),
            "agreement": float((forms.naive_labels(points) == labels[tuple(index.T)]).mean()),
            "others": {"voxels": voxels, "asked": logits.places},
            "note": f"{logits.places:,} of {voxels:,} voxels asked",
            "device": forms.device,
        }

    spread = f"{len(points):,} voxels spread over the volume, scaled"
    return Workload(
        rows.VOLUME, preset, "volume", filled, forms.naive_frame(points),
        f"dense; {forms.naive_is}; {spread}", naive_share=voxels / len(points), facts=facts,
    )  # fmt: skip


def _slab(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Indices and places (n, 3) of random voxels."""
    camera_from_index, shape = grid
    index = np.random.default_rng(0).integers(0, shape, (_SLAB, 3))
    return index, transform_points(camera_from_index, index.astype(float)).astype(np.float32)
