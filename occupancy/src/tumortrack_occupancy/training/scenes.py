"""Training scenes, made by worker processes while the network learns."""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, nullcontext
from multiprocessing import resource_tracker
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from tumortrack_occupancy.training.stream import Batch

_LOWER_PRIORITY = 10  # of the workers
_AHEAD = 4  # batches that each worker makes before they are asked for

# clouds_mm (b, n, 3), points_mm (b, q, 3), labels (b, q)
Tensors = tuple[Tensor, Tensor, Tensor]


def batches(
    make: Callable[[int], Batch], steps: range, period: int, workers: int, device: torch.device
) -> Generator[Tensors, None, None]:
    """The batches of these steps; after ``period`` steps (0: never) they repeat. ``make`` makes the
    batch with a number: picklable, the same number gives the same batch. Close the generator to end
    the workers; with 0 of them this process makes the batches."""
    numbers = (step % period if period else step for step in steps)
    loader = DataLoader(
        _Made(make),
        sampler=numbers,
        batch_size=None,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=_AHEAD if workers else None,
        worker_init_fn=_quiet_worker,
        pin_memory=device.type == "cuda",  # copies then overlap with the work before
    )
    with _starting_processes(make) if workers else nullcontext():
        made = iter(loader)
    for batch in made:
        yield tuple(batch)


@contextmanager
def _starting_processes(make: Callable[[int], Batch]) -> Iterator[None]:
    """Around the start of processes that do not live without what they are sent: where one ended
    before, this one would wait for good to write to it.

    Ctrl-C, which a terminal sends to all of them, waits for the end of the start, and is never seen
    by the new ones. And they do not run the user's program from its first line, as they would to
    have what it defines, unless ``make`` needs that: without an ``if __name__ == "__main__"`` it
    would train there once more, and fail.
    """
    main = vars(sys.modules["__main__"])
    hidden: dict[str, Any] = {name: main[name] for name in ("__file__", "__spec__") if name in main}
    if b"__main__" in pickle.dumps(make):
        hidden = {}
    resource_tracker.ensure_running()  # its own start would let signals through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    main.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        main.update(hidden)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Made(Dataset[Any]):
    """What a function makes of a number, as torch's loader wants it; arrays become tensors."""

    def __init__(self, make: Callable[[int], Batch]) -> None:
        self._make = make

    def __getitem__(self, number: int) -> Batch:
        return self._make(number)


def _quiet_worker(_: int) -> None:
    """Prepare a process that makes data."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    os.nice(_LOWER_PRIORITY)  # batches are made ahead, the network comes first
    # A worker has nothing to clean up at its end, and native libraries' threads can abort a
    # process that is taken down piece by piece.
    atexit.register(os._exit, 0)
    torch.set_num_threads(1)
