"""Who makes the training scenes: worker processes, or the device that trains."""

from __future__ import annotations

import atexit
import os
import signal
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain, islice
from typing import Any, Literal

import torch
from torch.utils.data import DataLoader, Dataset

from tumortrack.core.errors import InputError
from tumortrack.simulate.batched.stream import DeviceStream, RenderedBatch, Tensors, why_not
from tumortrack.simulate.scene import Batch, SceneStream

_LOWER_PRIORITY = 10  # of the workers
_TRIANGLES_AT_ONCE = 8_000_000  # of the scenes that a GPU makes together: some 2 GB


@dataclass(frozen=True)
class Scenes:
    """Batches in the order of their steps, who makes them, and what a user should know of that
    (may be empty). Close the generator to end its processes."""

    batches: Generator[Tensors, None, None]
    maker: str
    note: str = ""


def scenes_for(
    stream: SceneStream,
    steps: range,
    period: int,
    workers: int,
    device: torch.device,
    maker: Literal["auto", "workers", "device"] = "auto",
) -> Scenes:
    """The batches of these steps; after ``period`` steps (0: never) they repeat.

    ``auto`` has a GPU make them where it can; ``device`` has the device do so, whichever it is, and
    raises InputError for a configuration that only the CPU's workers can make.
    """
    reason, on_gpu = why_not(stream), device.type == "cuda"
    if maker == "device" or (maker == "auto" and on_gpu and reason is None):
        if reason is not None:
            raise InputError(f"the device cannot make these scenes. {reason}.")
        at_once = stream.batch_size
        if on_gpu:
            at_once = _TRIANGLES_AT_ONCE // len(stream.anatomy_ct.organ.faces)
        made = batches_on(device, stream, steps, period, workers, at_once)
        return Scenes(made, f"batched on {device.type}")
    note = ""
    if maker == "auto" and on_gpu:
        note = f"scenes come from {workers} processes on the CPU, not from the GPU ({reason})"
    made = batches(stream.batch, steps, period, workers, device)
    return Scenes(made, f"{workers} processes", note)


def batches(
    make: Callable[[int], Batch], steps: range, period: int, workers: int, device: torch.device
) -> Generator[Tensors, None, None]:
    """As ``scenes_for``, by workers. ``make`` makes the batch with a number: picklable, the same
    number gives the same batch. Close the generator to end the workers."""
    pinned = device.type == "cuda"  # copies then overlap with the work before
    indices = ((number,) for number in _numbers(steps, period))
    for batch in _loader(make, indices, workers, ahead=4, pin_memory=pinned):
        yield tuple(batch)


def batches_on(
    device: torch.device, stream: SceneStream, steps: range, period: int, workers: int, at_once: int
) -> Generator[Tensors, None, None]:
    """As ``scenes_for``, on a device, ``at_once`` scenes or somewhat less together, since starting
    a device's work costs as much for one scene as for many. Workers plan ahead, some kB a scene,
    and a thread draws the next clouds' pixels while the network learns."""
    size, made = stream.batch_size, DeviceStream(stream, device)
    indices = _numbers(steps, period)
    groups = iter(lambda: tuple(islice(indices, max(1, at_once // size))), ())
    with ThreadPoolExecutor(1) as thread:
        before: tuple[RenderedBatch, Future[Any]] | None = None
        for plan in chain(_loader(made.plan, groups, workers, ahead=1), [None]):
            coming = None
            if plan is not None:  # the next pictures are taken before a batch is returned
                rendered = made.render(plan)
                coming = rendered, thread.submit(made.sample, rendered)
            if before is not None:
                parts = made.assemble(before[0], before[1].result())
                clouds, points, labels, poses = (part.split(size) for part in parts)
                yield from zip(clouds, points, labels, poses, strict=True)
            before = coming


def _numbers(steps: range, period: int) -> Iterator[int]:
    return (step % period if period else step for step in steps)


class _Made(Dataset[Any]):
    """What a function makes of its arguments, as torch's loader wants it."""

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __getitem__(self, arguments: tuple[int, ...]) -> Any:
        return self._make(*arguments)


def _loader(
    make: Callable[..., Any], arguments: Iterable[Any], workers: int, ahead: int, **more: Any
) -> DataLoader[Any]:
    """What processes, each of which works ``ahead``, make of these arguments, in their order;
    arrays in a tuple become tensors."""
    return DataLoader(
        _Made(make),
        sampler=arguments,
        batch_size=None,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=ahead if workers else None,
        worker_init_fn=_quiet_worker,
        **more,
    )


def _quiet_worker(_: int) -> None:
    """Prepare a process that makes data."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    os.nice(_LOWER_PRIORITY)  # batches are made ahead, the network comes first
    # A worker has nothing to clean up at its end, and native libraries' threads can abort a
    # process that is taken down piece by piece.
    atexit.register(os._exit, 0)
    torch.set_num_threads(1)
