"""The same rows on a CUDA device, where there is one; without one there are none."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from tumortrack_lab.bench.asked import LABELLING, OccupancyWorkload
from tumortrack_lab.bench.frames import occupancy_frames
from tumortrack_lab.bench.row import BenchRow
from tumortrack_lab.bench.training import Device, whole_row
from tumortrack_lab.bench.volume import asked_volume

if TYPE_CHECKING:
    from tumortrack_lab.bench.subject import Subject

NAME = "GPU"


def rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """Those of ``rows_on``, if PyTorch sees a device."""
    import torch

    if torch.cuda.is_available():
        yield from rows_on(subject, "cuda", threads, budget_s)


def rows_on(subject: Subject, device: Device, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """Frame and volume of the presets that label points, and a training of each, generator
    included. Both forms bring their labels back to the host, which waits for the device."""
    from tumortrack.training.model import load_model

    share = budget_s / len(LABELLING) / 3
    for preset in LABELLING:
        model: Any = load_model(subject.model_folder(preset), device)  # labels points
        asked = OccupancyWorkload(model, subject.cloud(preset).points_mm, device)
        yield from occupancy_frames(asked, preset, threads, share)
        yield asked_volume(asked, preset, threads, share)
        yield whole_row(subject, preset, device, threads, share)
