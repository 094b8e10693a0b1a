"""Rows of the network's halves: encoder and decoder."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from tumortrack_lab.bench.asked import IN_ONE_PIECE, LABELLING, NAIVE, OccupancyWorkload, asked_of
from tumortrack_lab.bench.counts import module_flops, weight_bytes
from tumortrack_lab.bench.row import BenchRow, Work
from tumortrack_lab.bench.turns import Call, InterleavedTiming, in_turns

if TYPE_CHECKING:
    from tumortrack_lab.bench.subject import Subject

ENCODER, DECODER = "encoder", "decoder"
DECODED = (1000, 10_000, 40_000, 400_000)  # queries


def encoder_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """A cloud of 1,000 points to what is known of it."""
    import torch

    for preset in LABELLING:
        asked = asked_of(subject, preset)
        with torch.inference_mode():
            ours, naive = in_turns(
                lambda asked=asked: asked.inference.encode(asked.points_mm),  # type: ignore[misc]
                lambda asked=asked: asked.plain.encode(asked.cloud),  # type: ignore[misc]
                budget_s=budget_s / 3,
            )
        yield BenchRow(
            name=ENCODER,
            what=preset,
            threads=threads,
            item="cloud",
            ours=ours,
            naive=naive,
            naive_is="single precision, Python loop of farthest points, neighbours by sorting",
            work=asked.encoder_work(),
        )
    yield _clinic_encoder(subject, threads, budget_s / 3)


def _clinic_encoder(subject: Subject, threads: int, budget_s: float) -> BenchRow:
    """To both placements; nobody writes this part differently."""
    import torch

    registration, points = subject.clinic.registration(), subject.cloud("clinic").points_mm
    network = registration.network
    (ours,) = in_turns(lambda: registration.propose(points), budget_s=budget_s)
    cloud = torch.tensor(points)[None]
    with torch.inference_mode():
        flops = module_flops(lambda: network.flip_hypotheses(cloud))
    moved = weight_bytes(network, 4) + points.nbytes
    return BenchRow(
        name=ENCODER,
        what="clinic",
        threads=threads,
        item="cloud",
        ours=ours,
        work=Work(flops=flops, bytes=moved),
        note="both ways round",
    )


def decoder_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """Labels of 1,000 to 400,000 queries, the cloud being encoded."""
    share = budget_s / len(LABELLING) / len(DECODED)
    for preset in LABELLING:
        asked = asked_of(subject, preset)
        whole: InterleavedTiming | None = None  # of the naive form, in the largest piece
        for count in DECODED:
            row = _decoded(asked, (preset, count), threads, share, whole)
            whole = row.naive
            yield row


def _decoded(
    asked: OccupancyWorkload,
    of: tuple[str, int],
    threads: int,
    budget_s: float,
    whole: InterleavedTiming | None,
) -> BenchRow:
    import torch

    preset, count = of
    latent, queries = asked.inference.encode(asked.points_mm), asked.queries(count)
    first = queries[:IN_ONE_PIECE]
    piece = torch.from_numpy(first)[None]
    scaled = count / piece.shape[1]
    versions: list[Call] = [lambda: asked.inference.logits(latent, queries).argmax(-1)]
    with torch.inference_mode():
        if scaled == 1 or whole is None:
            encoded, whole = asked.plain.encode(asked.cloud), None
            versions.append(lambda: asked.plain.logits(encoded, piece).argmax(-1))
        timings = in_turns(*versions, budget_s=budget_s)
    ours, naive = [*timings, *([] if whole is None else [whole])]
    return BenchRow(
        name=DECODER,
        what=f"{preset}, {count:,} queries",
        threads=threads,
        item="decoding",
        ours=ours,
        naive=naive.times(scaled),
        naive_is=NAIVE,
        work=asked.decoder_work(count),
        naive_work=asked.naive_decoder_work(count),
        agreement=asked.agreement(asked.every_query(first)),
        note="" if scaled == 1 else f"naive: that of {IN_ONE_PIECE:,}, scaled",
    )
