"""Who makes the training scenes: worker processes, or the device that trains."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Literal

import torch
from torch.utils.data import DataLoader, Dataset

from tumortrack.learn.loader import Tensors, batches, quiet_worker
from tumortrack.simulate.batched.plan import Plan
from tumortrack.simulate.batched.stream import DeviceStream, why_not
from tumortrack.simulate.dataset import SceneStream

Maker = Literal["auto", "workers", "device"]


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
        made = _on_device(DeviceStream(stream, device), steps, period, workers)
        return Scenes(made, f"batched on {device.type}")
    by_workers = batches(stream, steps, period, workers, device)
    note = ""
    if maker == "auto" and device.type == "cuda":
        note = f"scenes come from {workers} processes on the CPU, not from the GPU ({reason})"
    return Scenes(by_workers, f"{workers} processes", note)


class _Plans(Dataset[Plan]):
    def __init__(self, stream: DeviceStream, period: int) -> None:
        self._stream, self._period = stream, period

    def __getitem__(self, step: int) -> Plan:
        return self._stream.plan(step % self._period if self._period else step)


def _on_device(
    stream: DeviceStream, steps: range, period: int, workers: int
) -> Generator[Tensors, None, None]:
    """Workers plan ahead, some kB a batch; the device makes the scenes."""
    plans = DataLoader(
        _Plans(stream, period),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
        worker_init_fn=quiet_worker,
    )
    for plan in plans:
        yield stream.made(plan)
