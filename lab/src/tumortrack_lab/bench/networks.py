"""Workloads of the networks: encoder and decoder, frames found anew and followed, volumes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import cycle

import numpy as np
import torch

from tumortrack.core.estimate import Following
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import grid_over
from tumortrack.occupancy.sparse import sparse_margins
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import occupancy, registration
from tumortrack_lab.bench.counts import module_flops, weight_bytes
from tumortrack_lab.bench.naive.scenes import flowed
from tumortrack_lab.bench.occupancy import IN_ONE_PIECE, OccupancyWorkload
from tumortrack_lab.bench.rows import (
    DECODER,
    ENCODER,
    EVERY,
    FRAME,
    TRACKING,
    VOLUME,
    Work,
    Workload,
)
from tumortrack_lab.bench.subject import LABELLING, QUERIES, BenchSubject
from tumortrack_lab.bench.timing import InterleavedTiming

GRID = 400  # voxels along the volume's longest side
_DECODED = (1000, 10_000, 40_000, 400_000)  # queries
_CARRIED = 20_000  # points that a live estimate of a warp holds
_MOVES_MM = 0.5  # of the cloud, from frame to frame
_SLAB = 16_384  # voxels of the volume that the naive form is asked for
Grid = tuple[np.ndarray, tuple[int, int, int]]  # camera_from_index, shape


def encoders(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A cloud of 1,000 points to what is known of it."""
    for preset in LABELLING:
        labeller = subject.occupancy(preset)
        yield Workload(
            ENCODER, preset, "cloud",
            ours=partial(labeller.inference.encode, labeller.points_mm),
            naive=labeller.naive_encoding(),
            naive_is="single precision, Python loop of farthest points, neighbours by sorting",
            facts=lambda labeller=labeller: {"work": labeller.encoder_work()},  # type: ignore[misc]
        )  # fmt: skip
    method, points = subject.clinic.registration(), subject.cloud("clinic").points_mm

    @torch.inference_mode()
    def facts() -> dict:
        flops = module_flops(lambda: method.network.flip_hypotheses(torch.tensor(points)[None]))
        moved = weight_bytes(method.network, 4) + points.nbytes
        return {"work": Work(flops=flops, bytes=moved), "note": "both ways round"}

    ours = partial(method.propose, points)
    yield Workload(ENCODER, "clinic", "cloud", ours, facts=facts)  # nobody writes it differently


def decoders(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """Labels of 1,000 to 400,000 queries, the cloud being encoded."""
    for preset in LABELLING:
        labeller = subject.occupancy(preset)
        whole: object = None  # seconds of the naive form, in the largest piece
        for count in _DECODED:
            one = _decoder(labeller, preset, count, whole)
            yield one
            whole = one.naive


def _decoder(labeller: OccupancyWorkload, preset: str, count: int, whole: object) -> Workload:
    logits, queries = labeller.counted(), labeller.queries(count)
    first = queries[:IN_ONE_PIECE]
    scaled = count / len(first)
    known = whole if scaled != 1 and isinstance(whole, InterleavedTiming) else None

    def facts() -> dict:
        return {
            "work": labeller.decoder_work(count),
            "naive_work": labeller.naive_decoder_work(count),
            "agreement": labeller.agreement(labeller.every_query(first)),
            "note": "" if scaled == 1 else f"naive: that of {IN_ONE_PIECE:,}, scaled",
        }

    return Workload(
        DECODER, f"{preset}, {count:,} queries", "decoding",
        ours=lambda: logits(queries).argmax(-1),
        naive=known or labeller.naive_decoding(first),
        naive_is=occupancy.NAIVE,
        naive_share=scaled,
        facts=facts,
    )  # fmt: skip


def frames(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """1,000 points to 40,000 labels."""
    registered = subject.registration
    yield Workload(
        FRAME, "clinic", "frame", registered.ours, registered.naive, registration.NAIVE,
        facts=lambda: {
            "work": registered.work(registered.estimate.report, QUERIES),
            "agreement": _inside_agreement(subject),
            "note": "`locate` without its volume: labels, probabilities, surfaces, report; "
            "agreement: points inside, at our motion, against inside tests",
        },
    )  # fmt: skip
    for preset in LABELLING:
        yield from occupancy_frames(subject.occupancy(preset), preset)


def _inside_agreement(subject: BenchSubject) -> float:
    registered = subject.registration
    cloud = registered.estimate.cloud
    back = registered.back(cloud.points_mm.astype(float))
    return float((registered.plain.labels_where(back) == cloud.labels).mean())


def occupancy_frames(labeller: OccupancyWorkload, preset: str) -> Iterator[Workload]:
    """As `locate` does it, and with every query labeller."""
    queries = labeller.queries(QUERIES)

    def facts(every: bool) -> dict:
        found, places = (
            (labeller.every_query(queries), QUERIES) if every else labeller.our_frame(queries)
        )
        return {
            "work": labeller.frame_work(places),
            "naive_work": labeller.naive_decoder_work(QUERIES),
            "agreement": labeller.agreement(found),
            "others": {"asked": places},
            "note": "" if every else f"{places:,} places asked for {QUERIES:,} labels",
            "device": labeller.device,
        }

    every = Workload(
        EVERY, preset, "frame", partial(labeller.every_query, queries), facts=partial(facts, True)
    )
    one = Workload(
        FRAME, preset, "frame",
        ours=partial(labeller.our_frame, queries),
        naive=labeller.naive_frame(queries),
        naive_is=occupancy.NAIVE,
        facts=partial(facts, False),
        beside=(every,),
    )  # fmt: skip
    yield one
    assert isinstance(one.naive, InterleavedTiming)
    labeller.naive_frame_s = one.naive


def tracking(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """From frame to frame: a cloud that moves by half a millimetre, to and fro."""
    registered = subject.registration
    ours = _LiveFrames(registered.tracker, registered.cloud.points_mm)

    def facts() -> dict:
        steps = ours.last.report["motion"]["steps"]
        note = f"steady state: {steps} refinement steps, points carried, surfaces, report"
        return {"work": registered.work(ours.last.report, _CARRIED), "note": note}

    naive_is = registration.NAIVE + ", every frame from the start"
    yield Workload(TRACKING, "clinic", "frame", ours, registered.naive, naive_is, facts=facts)
    for preset in LABELLING:
        labeller = subject.occupancy(preset)
        known = labeller.naive_frame_s
        beside = ", timed beside the row `frame`" if known else ""
        yield Workload(
            TRACKING, preset, "frame",
            ours=_LiveFrames(Tracker(subject.model(preset)), labeller.points_mm),
            naive=known or labeller.naive_frame(labeller.queries(QUERIES)),
            naive_is=f"{occupancy.NAIVE}; every frame from the start{beside}",
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
    yield _registered_volume(subject)
    for preset in LABELLING:
        yield occupancy_volume(subject.occupancy(preset), preset)


def _registered_volume(subject: BenchSubject) -> Workload:
    registered = subject.registration
    anatomy = Anatomy(tuple(registered.estimate.meshes.values()))
    grid = grid_over(anatomy.organ.vertices_mm, GRID)
    index, points = _slab(grid)
    voxels, faces = int(np.prod(grid[1])), sum(len(part.faces) for part in anatomy.parts)
    motion, plain = registered.estimate.report["motion"], registered.plain
    camera_from_ct, state = (np.array(motion[k]) for k in ("camera_from_ct", "coefficients"))

    def naive() -> np.ndarray:
        rest = (points - camera_from_ct[:3, 3]) @ camera_from_ct[:3, :3]
        return plain.labels_where(flowed(plain.body, -state, rest))

    def facts() -> dict:
        # Each column of voxels is crossed by triangles, every voxel written once.
        flops = 60.0 * faces + 40.0 * grid[1][0] * grid[1][1]
        return {
            "work": Work(flops=flops, bytes=float(voxels + 36 * faces)),
            "agreement": float((naive() == label_grid(anatomy, *grid)[tuple(index.T)]).mean()),
            "others": {"voxels": voxels},
            "note": "the moved surfaces filled",
        }

    return Workload(
        VOLUME, "clinic", "volume",
        ours=partial(label_grid, anatomy, *grid),
        naive=naive,
        naive_is=f"every voxel carried back, inside tests; {len(points):,} voxels, scaled",
        naive_share=voxels / len(points),
        facts=facts,
    )  # fmt: skip


def occupancy_volume(labeller: OccupancyWorkload, preset: str) -> Workload:
    grid = organ_grid(labeller, GRID)
    index, points = _slab(grid)
    voxels, logits, labels = int(np.prod(grid[1])), labeller.counted(), np.zeros(0, np.uint8)

    def filled() -> None:
        nonlocal labels
        logits.places = 0
        labels = sparse_margins(logits, *grid)[1]

    def facts() -> dict:
        return {
            "work": labeller.decoder_work(logits.places, voxels),
            "naive_work": labeller.naive_decoder_work(voxels),
            "agreement": float((labeller.naive_labels(points) == labels[tuple(index.T)]).mean()),
            "others": {"voxels": voxels, "asked": logits.places},
            "note": f"{logits.places:,} of {voxels:,} voxels asked",
            "device": labeller.device,
        }

    spread = f"{len(points):,} voxels spread over the volume, scaled"
    return Workload(
        VOLUME, preset, "volume",
        ours=filled,
        naive=labeller.naive_frame(points),
        naive_is=f"dense; {occupancy.NAIVE}; {spread}",
        naive_share=voxels / len(points),
        facts=facts,
    )  # fmt: skip


def organ_grid(labeller: OccupancyWorkload, grid: int) -> Grid:
    """Voxels over the organ, as `locate` lays them: about the points that are inside."""
    queries = labeller.queries(QUERIES)
    return grid_over(queries[labeller.every_query(queries) > 0], grid)


def _slab(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Indices and places (n, 3) of random voxels."""
    camera_from_index, shape = grid
    index = np.random.default_rng(0).integers(0, shape, (_SLAB, 3))
    return index, transform_points(camera_from_index, index.astype(float)).astype(np.float32)
