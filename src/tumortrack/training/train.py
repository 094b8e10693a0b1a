"""The training loop, read top to bottom.

Data are addressed by step, the only randomness is drawn from (seed, step), and the state is one
atomic file: a run that is killed and started again ends with the weights of one that was not.
Where torchrun started several processes each runs this loop with its part of the batch.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path

import torch

from tumortrack.models.config import RegistrationHeadConfig
from tumortrack.models.model import Model, Network
from tumortrack.simulate.dataset import SceneStream
from tumortrack.training.distributed import ProcessGroup, process_group
from tumortrack.training.model import load_model, save_model
from tumortrack.training.occupancy_task import OccupancyTask
from tumortrack.training.registration_task import RegistrationTask
from tumortrack.training.run import TrainingRun, provenance, settle_end
from tumortrack.training.scenes import Scenes, scenes_for
from tumortrack.training.session import (
    Interrupted,
    TrainingClock,
    TrainingStatus,
    ctrl_c,
    divide_cores,
    history,
    work_folder,
)
from tumortrack.training.state import TrainingState
from tumortrack.training.task import TrainingTask

__all__ = ["Interrupted", "TrainingRun", "TrainingStatus", "train"]

REPORT_EVERY_S = 5.0
Report = Callable[[TrainingStatus], None]


def task_of(run: TrainingRun, device: torch.device) -> TrainingTask:
    """The task of a run's method.

    Raises:
        InputError: a part too small to be learnt, deformations that do not fit the network.
    """
    if isinstance(run.config.network.decoder, RegistrationHeadConfig):
        return RegistrationTask(run, device)
    return OccupancyTask(run, device)


def train(run: TrainingRun, folder: Path, report: Report) -> Model:
    """Train until the end, resuming what lies in ``folder``; leaves a model folder.

    Raises:
        ArtifactError: ``folder`` holds another run, or a damaged one.
        InputError: another process trains in ``folder``; a part too small to be learnt.
        StorageError: the disk is full; the last checkpoint is whole.
        Diverged: the loss is not finite any more; the last checkpoint is from before.
        Interrupted: Ctrl-C; a checkpoint is written.
        ProcessLost: another process of this training has ended.
    """
    with process_group(run.device) as group:
        with work_folder(folder, group.is_main) as work:
            trained = _train(run, work, group, report)
        group.all_reduce(0.0, False)  # the folder is written
        return trained or load_model(folder, run.device)


def _train(run: TrainingRun, work: Path, group: ProcessGroup, report: Report) -> Model | None:
    """The model, in the main process."""
    config, device = run.config, group.device
    workers = divide_cores(device, run.workers, group.on_machine)
    task = task_of(run, device)
    state = TrainingState(run, device, group)
    state.initialize(task.initialize)
    state.resume(work)
    stream = SceneStream(
        run.anatomy_ct,
        run.up_lps,
        config.scene,
        task.points,
        run.seed,
        "train",
        group.local_size(config.batch_size),
        task.body,
    )
    steps = group.local_batches(range(state.progress.step, state.progress.end or config.steps))
    period = config.training_pairs // config.batch_size * group.size
    scenes = scenes_for(stream, steps, period, workers, device, run.scenes)
    run_steps(state, scenes, work, report, task.miou)
    if not group.is_main:
        return None
    origin = {**provenance(run, state.progress, device), "scenes": scenes.maker}
    model = task.model(state.best_network(), origin)
    save_model(model, work.parent)
    return model


def run_steps(
    state: TrainingState,
    scenes: Scenes,
    work: Path,
    report: Report,
    miou_of: Callable[[Network], float] | None = None,
) -> None:
    """All steps to the end; the main process writes checkpoints into ``work``, reports and, with
    ``miou_of``, validates.

    Raises: as ``train``.
    """
    run, group, progress = state.run, state.group, state.progress
    clock, miou = TrainingClock(progress), None
    written: AbstractContextManager[Callable[..., None] | None] = (
        history(work, progress) if miou_of and group.is_main else nullcontext()
    )
    source = closing(scenes.batches)
    with written as write, ctrl_c() as stopped, source as loaded:
        for batch in clock.timed(loaded):
            loss = state.step(batch)
            progress.elapsed_s, stop = group.all_reduce(clock.elapsed(), stopped())
            settled = settle_end(run.config, progress, run.minutes)
            done = progress.step == progress.end
            if miou_of and write and (done or progress.step % run.config.validate_every == 0):
                miou = miou_of(state.average)
                state.keep_if_best(miou)
                write(
                    loss=loss,
                    validation_miou=miou,
                    samples_per_s=clock.rate * run.config.batch_size,
                    learning_rate=state.learning_rate,
                    waiting=clock.waiting,
                )
            due = done or settled or stop
            if group.is_main and (due or clock.due("checkpoint", run.checkpoint_every_s)):
                state.save(work)
            if group.is_main and (done or clock.due("report", REPORT_EVERY_S)):
                report(_status(state, clock, loss, miou, scenes.note))
            if done:
                break
            if stop:
                raise Interrupted(progress.step, work.parent)


def _status(
    state: TrainingState, clock: TrainingClock, loss: float, miou: float | None, note: str
) -> TrainingStatus:
    run, progress, rate = state.run, state.progress, clock.rate
    left = ((progress.end or run.config.steps) - progress.step) / rate
    if progress.end is None and run.minutes is not None:
        left = min(left, run.minutes * 60 - progress.elapsed_s)
    about = rate * run.config.batch_size, loss, miou, note, clock.waiting
    return TrainingStatus(progress.step, progress.end, max(left, 0.0), *about)
