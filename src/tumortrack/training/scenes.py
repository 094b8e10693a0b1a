"""Who makes the training scenes: worker processes, or the device that trains."""

from __future__ import annotations

import atexit
import os
import signal
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Literal, Protocol

import torch
from torch.utils.data import DataLoader, Dataset

from tumortrack.core.errors import InputError
from tumortrack.core.process import available_cores
from tumortrack.simulate.batched.plan import BatchPlan
from tumortrack.simulate.batched.stream import DeviceStream, RenderedBatch, SampleChoice, why_not
from tumortrack.simulate.dataset import Batch, SceneStream

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


__all__ = ["Stream", "Tensors", "available_cores", "batches", "default_workers"]

_STANDS_BACK = 10  # how much lower the workers' priority is

# clouds, points, labels, poses (camera_from_ct)
Tensors = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


class Stream(Protocol):
    """Batches by number. Picklable; the same number gives the same batch."""

    def batch(self, index: int) -> Batch:
        """The batch with this number."""
        ...


class _Batches(Dataset[Tensors]):
    """A scene stream as torch's loader wants it."""

    def __init__(self, stream: Stream, period: int) -> None:
        self._stream = stream
        self._period = period

    def __getitem__(self, step: int) -> Tensors:
        batch = self._stream.batch(step % self._period if self._period else step)
        return (
            torch.from_numpy(batch.clouds_mm),
            torch.from_numpy(batch.points_mm),
            torch.from_numpy(batch.labels),
            torch.from_numpy(batch.camera_from_ct),
        )


def batches(
    stream: Stream, steps: range, period: int, workers: int, device: torch.device
) -> Generator[Tensors, None, None]:
    """The batches of these steps, in order, whatever the number of workers; after ``period``
    steps (0: never) they repeat. Close the generator to end the workers."""
    loader = DataLoader(
        _Batches(stream, period),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
        worker_init_fn=quiet_worker,
        pin_memory=device.type == "cuda",  # copies then overlap with the work before
    )
    yield from loader


def default_workers(sharing: int = 1) -> int:
    """As many as there are cores, sixteen at most: they stand back (``quiet_worker``) while the
    network wants its half. ``sharing`` processes of one training have the cores together."""
    return max(1, min(16, available_cores() // sharing))


def network_leaves(workers: int, sharing: int = 1) -> int:
    """How many cores the network leaves to so many workers: half at most."""
    return min(workers, available_cores() // sharing // 2)


def quiet_worker(_: int) -> None:
    """What a process that makes data does first."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    os.nice(_STANDS_BACK)  # a batch is made ahead, a step waits for nobody
    # A worker has nothing to put in order at its end, and native libraries' threads can abort a
    # process that is taken down piece by piece.
    atexit.register(os._exit, 0)
    torch.set_num_threads(1)
