"""Training batches from worker processes."""

from __future__ import annotations

import atexit
import os
import signal
from collections.abc import Generator
from typing import Protocol

import torch
from torch.utils.data import DataLoader, Dataset

from tumortrack.learn.cores import available_cores
from tumortrack.learn.network import NetworkConfig
from tumortrack.simulate.dataset import Batch

__all__ = ["Stream", "Tensors", "available_cores", "batches", "default_workers"]

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


def default_workers(network: NetworkConfig) -> int:
    """Half of the cores make scenes (one at least, sixteen at most); all of them for a warp, whose
    steps cost a fraction of its scenes."""
    cores = available_cores()
    return max(1, min(16, cores if network.warps else cores // 2))


def quiet_worker(_: int) -> None:
    """What a process that makes data does first."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    # A worker has nothing to put in order at its end, and native libraries' threads can abort a
    # process that is taken down piece by piece.
    atexit.register(os._exit, 0)
    torch.set_num_threads(1)
