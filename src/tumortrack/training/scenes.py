"""Who makes the training scenes: worker processes, or the device that trains."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import torch
from torch.utils.data import DataLoader, Dataset

from tumortrack.core.errors import InputError
from tumortrack.simulate.batched.plan import BatchPlan
from tumortrack.simulate.batched.stream import DeviceStream, RenderedBatch, SampleChoice, why_not
from tumortrack.simulate.dataset import SceneStream
from tumortrack.training.loader import Tensors, batches, quiet_worker

Maker = Literal["auto", "workers", "device"]
_TRIANGLES_AT_ONCE = 8_000_000  # of the scenes that a GPU makes together: some 2 GB


@dataclass(frozen=True)
class Scenes:
    """Batches in the order of their steps, who makes them, and what a user should know of that
    (empty where there is nothing to say). Close the generator to end its processes."""

    batches: Generator[Tensors, None, None]
    maker: str
    note: str = ""


def scenes_for(
    stream: SceneStream,
    steps: range,
    period: int,
    workers: int,
    device: torch.device,
    maker: Maker = "auto",
) -> Scenes:
    """The batches of these steps; after ``period`` steps (0: never) they repeat.

    ``auto`` has a GPU make them where it can; ``device`` has the device do so, whichever it is.

    Raises:
        InputError: ``device``, and a configuration that only the CPU's workers can make.
    """
    reason = why_not(stream)
    if maker == "device" or (maker == "auto" and device.type == "cuda" and reason is None):
        if reason is not None:
            raise InputError(f"the device cannot make these scenes. {reason}.")
        at_once = stream.batch_size
        if device.type == "cuda":
            at_once = _TRIANGLES_AT_ONCE // len(stream.anatomy_ct.organ.faces)
        made = batches_on(device, stream, steps, period, workers, at_once)
        return Scenes(made, f"batched on {device.type}")
    by_workers = batches(stream, steps, period, workers, device)
    note = ""
    if maker == "auto" and device.type == "cuda":
        note = f"scenes come from {workers} processes on the CPU, not from the GPU ({reason})"
    return Scenes(by_workers, f"{workers} processes", note)


class _Plans(Dataset[BatchPlan]):
    def __init__(self, stream: DeviceStream) -> None:
        self._stream = stream

    def __getitem__(self, indices: tuple[int, ...]) -> BatchPlan:
        return self._stream.plan(*indices)


def batches_on(
    device: torch.device,
    stream: SceneStream,
    steps: range,
    period: int,
    workers: int,
    at_once: int,
) -> Generator[Tensors, None, None]:
    """The batches of these steps, made on a device, ``at_once`` scenes or somewhat less together:
    a device's work costs its start, however many scenes it is for. Workers plan ahead, some kB a
    scene, and a thread draws the next clouds' pixels while the batches before are learnt from."""
    size = stream.batch_size
    on_device = DeviceStream(stream, device)

    def groups() -> Iterator[tuple[int, ...]]:
        indices = (step % period if period else step for step in steps)
        while group := tuple(islice(indices, max(1, at_once // size))):
            yield group

    plans = DataLoader(
        _Plans(on_device),
        batch_size=None,
        sampler=groups(),
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=1 if workers else None,
        worker_init_fn=quiet_worker,
    )
    with ThreadPoolExecutor(1) as thread:
        for parts in _finished(on_device, plans, thread):
            clouds, points, labels, poses = (part.split(size) for part in parts)
            yield from zip(clouds, points, labels, poses, strict=True)


def _finished(
    stream: DeviceStream, plans: Iterable[BatchPlan], thread: ThreadPoolExecutor
) -> Iterator[Tensors]:
    """The batches of these plans; the pictures of each are taken before the last is handed out."""
    before: tuple[RenderedBatch, Future[SampleChoice]] | None = None
    for plan in plans:
        rendered = stream.render(plan)
        coming = rendered, thread.submit(stream.sample, rendered)
        if before is not None:
            yield stream.assemble(before[0], before[1].result())
        before = coming
    if before is not None:
        yield stream.assemble(before[0], before[1].result())
