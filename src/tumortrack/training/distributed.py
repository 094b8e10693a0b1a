"""One training by several processes, as torchrun starts them: each takes its share of every batch.

    torchrun --nproc_per_node=2 -m tumortrack train CASE MODEL

All processes hold the same weights and take the same steps: the mean of their gradients is the
whole batch's, so that the number of processes changes results by rounding alone. A batch norm is
the exception: it sees its process's share. The first process alone validates, writes and reports.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch import Tensor, distributed, nn

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.models.hardware import choose_device

_PATIENCE = timedelta(hours=1)  # while the first process validates, the others wait


class ProcessLost(TumortrackError):
    """Another process of this training has ended."""


@dataclass(frozen=True)
class ProcessGroup:
    """Which of how many processes this is, and the device it computes on."""

    device: torch.device
    rank: int = 0
    size: int = 1
    on_machine: int = 1  # of ``size``, those that share this machine's cores

    @property
    def leads(self) -> bool:
        """Whether this process validates, writes and reports."""
        return self.rank == 0

    def share(self, batch_size: int) -> int:
        """How many samples of a batch are this process's.

        Raises:
            InputError: the batch cannot be shared equally.
        """
        if batch_size % self.size:
            raise InputError(
                f"a batch of {batch_size} cannot be shared by {self.size} processes; choose a "
                "number of processes that divides it."
            )
        return batch_size // self.size

    def numbers(self, steps: range) -> range:
        """The numbers of this process's shares of these steps' batches, in a stream of shares."""
        return range(
            steps.start * self.size + self.rank, steps.stop * self.size + self.rank, self.size
        )

    def mean(self, parameters: Iterable[nn.Parameter], value: Tensor) -> Tensor:
        """Replace gradients by the mean over all processes; returns the value's.

        Raises:
            RankLost: another process has ended.
        """
        if self.size == 1:
            return value
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([*(g.flatten() for g in gradients), value.detach().float().flatten()])
        self._sum(flat)
        flat /= self.size
        parts = flat.split([*(g.numel() for g in gradients), 1])
        for gradient, part in zip(gradients, parts[:-1], strict=True):
            gradient.copy_(part.view_as(gradient))
        return parts[-1][0]

    def agreed(self, elapsed_s: float, stop: bool) -> tuple[float, bool]:
        """The first process's time, and whether any process was asked to stop.

        Raises:
            RankLost: another process has ended.
        """
        if self.size == 1:
            return elapsed_s, stop
        told = torch.tensor([elapsed_s if self.leads else 0.0, float(stop)], dtype=torch.float64)
        told = told.to(self.device)
        self._sum(told)
        elapsed_s, asked = told.tolist()
        return elapsed_s, asked > 0

    def _sum(self, values: Tensor) -> None:
        with self._others_there():
            distributed.all_reduce(values)

    def leave(self) -> None:
        """Part from the others.

        Raises:
            RankLost: another process has ended.
        """
        with self._others_there():
            distributed.destroy_process_group()

    @contextmanager
    def _others_there(self) -> Iterator[None]:
        """Says in our words what Gloo and NCCL say of a process that is gone."""
        try:
            yield
        except RuntimeError as error:
            raise ProcessLost(
                f"process {self.rank} of {self.size} stops: another one of this training has "
                "ended; what it said is the reason. The last checkpoint is whole, and the same "
                "command goes on from it."
            ) from error


@contextmanager
def joined(device: str) -> Iterator[ProcessGroup]:
    """All processes that torchrun started, by NCCL on GPUs and Gloo on CPUs; else this one alone.

    Raises:
        InputError: CUDA asked for where there is none, or more processes than GPUs.
        RankLost: the processes do not find each other.
    """
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
        raise ProcessLost(
            f"the processes of this training do not find each other: {error}"
        ) from error
    ranks = ProcessGroup(chosen, distributed.get_rank(), size, on_machine)
    try:
        yield ranks
    except BaseException:
        with suppress(ProcessLost):  # what ended this process is to be told, not what follows
            ranks.leave()
        raise
    ranks.leave()
