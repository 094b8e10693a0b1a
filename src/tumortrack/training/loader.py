"""Training batches from worker processes."""

from __future__ import annotations

import atexit
import os
import signal
from collections.abc import Generator
from typing import Protocol

import torch
from torch.utils.data import DataLoader, Dataset

from tumortrack.core.process import available_cores
from tumortrack.simulate.dataset import Batch

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
