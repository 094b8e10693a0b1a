"""The same rows on a CUDA device, where there is one; without one there are none."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from tumortrack.evaluate.bench.asked import LABELLING, Asked
from tumortrack.evaluate.bench.frames import occupancy_frames
from tumortrack.evaluate.bench.row import Row
from tumortrack.evaluate.bench.volume import asked_volume

if TYPE_CHECKING:
    from tumortrack.evaluate.bench.subject import Subject

NAME = "GPU"


def rows(subject: Subject, threads: int, budget_s: float) -> Iterator[Row]:
    """Frame and volume of the presets that label points. Both forms bring their labels back to
    the host, which waits for the device."""
    import torch

    if not torch.cuda.is_available():
        return
    from tumortrack.learn.model import load_model

    for preset in LABELLING:
        model = load_model(subject.model_folder(preset), "cuda")
        asked = Asked(model, subject.cloud(preset).points_mm, "cuda")
        share = budget_s / len(LABELLING) / 2
        yield from occupancy_frames(asked, preset, threads, share)
        yield asked_volume(asked, preset, threads, share)
