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

_NICENESS = 10  # of the workers
_AHEAD = 4  # batches that each worker prefetches

# clouds_mm (b, n, 3), points_mm (b, q, 3), labels (b, q)
Tensors = tuple[Tensor, Tensor, Tensor]


def batches(
    make: Callable[[int], Batch], steps: range, period: int, workers: int, device: torch.device
) -> Generator[Tensors, None, None]:
    """The batches of these steps; after ``period`` steps (0: never) they repeat. ``make`` returns
    the batch of a number, always the same one, and is picklable. Close the generator to end the
    workers; with 0 workers this process makes the batches."""
    numbers = (step % period if period else step for step in steps)
    loader = DataLoader(
        _Batches(make),
        sampler=numbers,
        batch_size=None,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=_AHEAD if workers else None,
        worker_init_fn=_init_worker,
        pin_memory=device.type == "cuda",  # copies then overlap with the work before
    )
    with _starting_processes(make) if workers else nullcontext():
        made = iter(loader)
    for batch in made:
        yield tuple(batch)


@contextmanager
def _starting_processes(make: Callable[[int], Batch]) -> Iterator[None]:
    """Start worker processes in this context. They must not end before they have read their data:
    this process would wait forever to write to them.

    So Ctrl-C, which a terminal sends to all processes, is blocked until they have started, and they
    never see it. And they do not run the user's script, as spawned processes do, unless ``make`` is
    defined there: a script without ``if __name__ == "__main__"`` would start a training in each
    worker, which fails.
    """
    main = vars(sys.modules["__main__"])
    hidden: dict[str, Any] = {name: main[name] for name in ("__file__", "__spec__") if name in main}
    if b"__main__" in pickle.dumps(make):
        hidden = {}
    resource_tracker.ensure_running()  # starting it later would unblock the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    main.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        main.update(hidden)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Batches(Dataset[Any]):
    """The function ``make`` as a dataset; the loader turns arrays into tensors."""

    def __init__(self, make: Callable[[int], Batch]) -> None:
        self._make = make

    def __getitem__(self, number: int) -> Batch:
        return self._make(number)


def _init_worker(_: int) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICENESS)  # batches are made ahead, the network comes first
    # A worker has nothing to clean up, and threads of native libraries can abort a process during
    # the interpreter's shutdown.
    atexit.register(os._exit, 0)
    torch.set_num_threads(1)
