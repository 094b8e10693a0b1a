"""The same workloads on a CUDA device, where there is one; without one there are none."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import torch

from tumortrack.training.model import load_model
from tumortrack_lab.bench.networks import occupancy_frames, occupancy_volume
from tumortrack_lab.bench.occupancy import OccupancyWorkload
from tumortrack_lab.bench.rows import Workload
from tumortrack_lab.bench.subject import LABELLING, BenchSubject
from tumortrack_lab.bench.training import whole_training


def workloads(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
    """Those of ``workloads_on``, if PyTorch sees a device."""
    if torch.cuda.is_available():
        yield from workloads_on(subject, "cuda", budget_s)


def workloads_on(
    subject: BenchSubject, device: Literal["cpu", "cuda"], budget_s: float
) -> Iterator[Workload]:
    """Frame and volume of the presets that label points, and a training of each, generator
    included. Both forms bring their labels back to the host, which waits for the device."""
    for preset in LABELLING:
        model = load_model(subject.model_folder(preset), device)
        asked = OccupancyWorkload(model, subject.cloud(preset).points_mm, device)
        yield from occupancy_frames(asked, preset)
        yield occupancy_volume(asked, preset)
        yield whole_training(subject, preset, device, budget_s)
