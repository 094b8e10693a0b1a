"""The training loop, read top to bottom.

Data are addressed by step, the only randomness is drawn from (seed, step), and the state is one
atomic file: a run that is killed and started again ends with the weights of one that was not.
Where torchrun started several processes each goes through this loop with its share of the batch.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from pathlib import Path

from tumortrack.models.model import Model
from tumortrack.simulate.dataset import SceneStream
from tumortrack.training.checkpoint import TrainingProgress, work_folder
from tumortrack.training.distributed import ProcessGroup, joined
from tumortrack.training.history import History, Record
from tumortrack.training.model import load_model, save_model
from tumortrack.training.pace import (
    REPORT_EVERY_S,
    Interrupted,
    TrainingClock,
    TrainingStatus,
    ctrl_c,
    use_cores,
)
from tumortrack.training.run import TrainingRun, provenance, run_identity, settle_end
from tumortrack.training.scenes import default_workers, network_leaves, scenes_for
from tumortrack.training.state import TrainingState
from tumortrack.training.task import task_of

__all__ = ["Interrupted", "TrainingRun", "TrainingStatus", "run_identity", "train"]


def train(run: TrainingRun, folder: Path, report: Callable[[TrainingStatus], None]) -> Model:
    """Train until the end, resuming what lies in ``folder``; leaves a model folder.

    Raises:
        ArtifactError: ``folder`` holds another run, or a damaged one.
        InputError: another process trains in ``folder``; a part too small to be learnt.
        StorageError: the disk is full; the last checkpoint is whole.
        Diverged: the loss is no number any more; the last checkpoint is from before.
        Interrupted: Ctrl-C; a checkpoint is written.
        RankLost: another process of this training has ended.
    """
    with joined(run.device) as ranks:
        with work_folder(folder, ranks.leads) as work:
            trained = _train(run, folder, work, ranks, report)
        ranks.agreed(0.0, False)  # the folder is written
        return trained or load_model(folder, run.device)


def _train(
    run: TrainingRun,
    folder: Path,
    work: Path,
    ranks: ProcessGroup,
    report: Callable[[TrainingStatus], None],
) -> Model | None:
    """The model, in the process that leads."""
    config, device = run.config, ranks.device
    workers = default_workers(ranks.on_machine) if run.workers is None else run.workers
    use_cores(device, network_leaves(workers, ranks.on_machine), ranks.on_machine)
    task = task_of(run, device)
    state = TrainingState(run, device, ranks)
    state.know(task.teach)
    state.resume(work)
    stream = SceneStream(
        run.anatomy_ct,
        run.up_lps,
        config.scene,
        task.points,
        run.seed,
        "train",
        ranks.share(config.batch_size),
        task.body,
    )
    steps = ranks.numbers(range(state.progress.step, state.progress.end or config.steps))
    period = config.training_pairs // config.batch_size * ranks.size

    progress, clock, miou = state.progress, TrainingClock(state.progress), None
    scenes = scenes_for(stream, steps, period, workers, device, run.scenes)
    source = closing(scenes.batches)
    written: AbstractContextManager[History | None] = (
        History(work, progress) if ranks.leads else nullcontext()
    )
    with written as history, ctrl_c() as stopped, source as loaded:
        for batch in clock.waits(loaded):
            loss = state.step(batch)
            progress.elapsed_s, stop = ranks.agreed(clock.elapsed(), stopped())
            settled = settle_end(config, progress, run.minutes)
            done = progress.step == progress.end
            if history and (done or progress.step % config.validate_every == 0):
                miou = task.miou(state.average)
                state.keep_if_best(miou)
                speed = clock.rate(progress) * config.batch_size
                record = Record(loss, miou, speed, state.learning_rate, clock.waiting)
                history.write(progress, record)
            if history and (
                done or settled or stop or clock.due("checkpoint", run.checkpoint_every_s)
            ):
                state.save(work)
            if history and (done or clock.due("report", REPORT_EVERY_S)):
                status = _status(run, progress, clock.rate(progress), loss, miou)
                report(replace(status, note=scenes.note, waiting=clock.waiting))
            if done:
                break
            if stop:
                raise Interrupted.at(progress.step, folder)
    if not ranks.leads:
        return None
    origin = {**provenance(run, progress, device), "scenes": scenes.maker}
    model = task.model(state.best_network(), origin)
    save_model(model, folder)
    return model


def _status(
    run: TrainingRun, progress: TrainingProgress, rate: float, loss: float, miou: float | None
) -> TrainingStatus:
    left = ((progress.end or run.config.steps) - progress.step) / rate
    if progress.end is None and run.minutes is not None:
        left = min(left, run.minutes * 60 - progress.elapsed_s)
    speed = rate * run.config.batch_size
    return TrainingStatus(progress.step, progress.end, max(left, 0.0), speed, loss, miou)
