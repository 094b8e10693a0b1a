"""One training by several processes, as torchrun starts them: each takes its part of every batch.

    torchrun --nproc_per_node=2 -m tumortrack train CASE MODEL

All processes hold the same weights and take the same steps: the mean of their gradients is the
whole batch's, so that the number of processes changes results by rounding alone. A batch norm is
the exception: it sees its process's part. The main process alone validates, writes and reports.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch import Tensor, distributed, nn

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.models.hardware import choose_device

_PATIENCE = timedelta(hours=1)  # while the main process validates, the others wait


class ProcessLost(TumortrackError):
    """Another process of this training has ended."""


@dataclass(frozen=True)
class ProcessGroup:
    """Which of how many processes this is, and the device it computes on; whatever waits for the
    others raises ``ProcessLost`` where one has ended."""

    device: torch.device
    rank: int = 0
    size: int = 1
    on_machine: int = 1  # of ``size``, those that share this machine's cores

    @property
    def is_main(self) -> bool:
        """Whether this process validates, writes and reports."""
        return self.rank == 0

    def local_size(self, batch_size: int) -> int:
        """How many samples of a batch are this process's; InputError where it cannot be split."""
        if batch_size % self.size:
            raise InputError(
                f"a batch of {batch_size} cannot be shared by {self.size} processes; choose a "
                "number of processes that divides it."
            )
        return batch_size // self.size

    def local_batches(self, steps: range) -> range:
        """This process's parts of these steps' batches, as numbers in a stream of such parts."""
        start, stop = (step * self.size + self.rank for step in (steps.start, steps.stop))
        return range(start, stop, self.size)

    def mean(self, parameters: Iterable[nn.Parameter], value: Tensor) -> Tensor:
        """Replace gradients by their mean over all processes; returns the mean of ``value``."""
        if self.size == 1:
            return value
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([*(g.flatten() for g in gradients), value.detach().float().flatten()])
        self._together(distributed.all_reduce, flat)
        flat /= self.size
        *parts, mean = flat.split([*(g.numel() for g in gradients), 1])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))
        return mean[0]

    def all_reduce(self, elapsed_s: float, stop: bool) -> tuple[float, bool]:
        """The main process's time, and whether any process is to stop."""
        if self.size == 1:
            return elapsed_s, stop
        mine = [elapsed_s if self.is_main else 0.0, float(stop)]
        total = torch.tensor(mine, dtype=torch.float64).to(self.device)
        self._together(distributed.all_reduce, total)
        elapsed_s, stops = total.tolist()
        return elapsed_s, stops > 0

    def close(self) -> None:
        """Leave the group."""
        self._together(distributed.destroy_process_group)

    def _together(self, call: Callable[..., object], *values: Tensor) -> None:
        """What waits for the others; one error for what Gloo and NCCL raise where one is gone."""
        try:
            call(*values)
        except RuntimeError as error:
            raise ProcessLost(
                f"process {self.rank} of {self.size} stops: another one of this training has "
                "ended; its message is the reason. The last checkpoint is whole, and the same "
                "command goes on from it."
            ) from error


@contextmanager
def process_group(device: str) -> Iterator[ProcessGroup]:
    """All processes that torchrun started, by NCCL on GPUs and Gloo on CPUs; else this one alone.
    Raises InputError for CUDA where there is none, and for more processes than GPUs."""
    chosen = choose_device(device)
    size = int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else 1
    if size == 1:
        yield ProcessGroup(chosen)
        return
    place, on_machine = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
    if chosen.type == "cuda":
        if on_machine > torch.cuda.device_count():
            raise InputError(
                f"{on_machine} processes for {torch.cuda.device_count()} GPUs; start as many "
                "processes as there are GPUs, or give --device cpu."
            )
        chosen = torch.device("cuda", place)
        torch.cuda.set_device(chosen)
    backend = "nccl" if chosen.type == "cuda" else "gloo"
    try:
        distributed.init_process_group(backend, timeout=_PATIENCE)
    except (RuntimeError, ValueError) as error:
        lost = f"the processes of this training do not find each other: {error}"
        raise ProcessLost(lost) from error
    group = ProcessGroup(chosen, distributed.get_rank(), size, on_machine)
    try:
        yield group
    except BaseException:
        with suppress(ProcessLost):  # the first error counts, not what follows from it
            group.close()
        raise
    group.close()
