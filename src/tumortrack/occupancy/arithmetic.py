"""Which arithmetic answers queries: what a device has, and what is usually fastest."""

from __future__ import annotations

import platform
from typing import Literal

import torch

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.models.hardware import has_fast_bfloat16

CHUNK = 2048  # queries at once and core: their activations (2 MB at 512 channels) stay near it
_CHUNK_GPU = 2**17
_CHUNKS = (16, 2**14)  # fewest and most queries at once and core

Numbers = Literal["network", "float32", "bfloat16"]


class Arithmetic(Config, frozen=True):
    """How queries are answered: ``network`` is the network as it is (``torch.autocast``), the
    others are its packed form (``packed``); ``chunk``: queries at once and core."""

    numbers: Numbers
    chunk: int

    def __post_init__(self) -> None:
        if not _CHUNKS[0] <= self.chunk <= _CHUNKS[1]:
            raise InputError(f"chunk is {self.chunk}; {_CHUNKS[0]} to {_CHUNKS[1]} are allowed.")


def can_pack(device: torch.device) -> bool:
    """Whether packed layers exist for the device: oneDNN on an x86 processor."""
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    if device.type != "cpu" or not x86 or not torch.backends.mkldnn.is_available():
        return False
    operators = torch.ops.mkldnn  # private: another PyTorch may lack them
    return all(hasattr(operators, name) for name in ("_reorder_linear_weight", "_linear_pointwise"))


def possible(device: torch.device) -> tuple[Numbers, ...]:
    """What the device has fast instructions for, the usually fastest last."""
    if not can_pack(device):
        return ("network",)
    return ("network", "bfloat16" if has_fast_bfloat16(device) else "float32")


def usual(device: torch.device) -> Arithmetic:
    """What is fastest on most machines; `tumortrack compile` measures."""
    if device.type == "cuda":
        return Arithmetic(numbers="network", chunk=_CHUNK_GPU)
    return Arithmetic(numbers=possible(device)[-1], chunk=CHUNK)
