"""The training loop, read top to bottom.

Data are addressed by step, the only randomness is drawn from (seed, step), and the state is one
atomic file: a run that is killed and started again ends with the weights of one that was not.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from tumortrack.learn.checkpoint import Progress
from tumortrack.learn.course import course_of
from tumortrack.learn.history import History, Record
from tumortrack.learn.loader import default_workers
from tumortrack.learn.model import Model, choose_device, save_model
from tumortrack.learn.pace import REPORT_EVERY_S, Clock, Interrupted, Status, ctrl_c, use_cores
from tumortrack.learn.run import Run, provenance, run_identity
from tumortrack.learn.scenes import scenes_for
from tumortrack.learn.schedule import settle_end
from tumortrack.learn.state import TrainingState
from tumortrack.learn.work import work_folder
from tumortrack.simulate.dataset import SceneStream

__all__ = ["Interrupted", "Run", "Status", "run_identity", "train"]


def train(run: Run, folder: Path, report: Callable[[Status], None]) -> Model:
    """Train until the end, resuming what lies in ``folder``; leaves a model folder.

    Raises:
        ArtifactError: ``folder`` holds another run, or a damaged one.
        InputError: another process trains in ``folder``; a part too small to be learnt.
        StorageError: the disk is full; the last checkpoint is whole.
        Diverged: the loss is no number any more; the last checkpoint is from before.
        Interrupted: Ctrl-C; a checkpoint is written.
    """
    with work_folder(folder) as work:
        return _train(run, folder, work, report)


def _train(run: Run, folder: Path, work: Path, report: Callable[[Status], None]) -> Model:
    config, device = run.config, choose_device(run.device)
    workers = default_workers(config.network) if run.workers is None else run.workers
    use_cores(device, workers)
    course = course_of(run, device)
    state = TrainingState(run, device)
    state.know(course.teach)
    state.resume(work)
    stream = SceneStream(
        run.anatomy_ct,
        run.up_lps,
        config.scene,
        course.points,
        run.seed,
        "train",
        config.batch_size,
        course.body,
    )
    steps = range(state.progress.step, state.progress.end or config.steps)
    period = config.training_pairs // config.batch_size

    progress, clock, miou = state.progress, Clock(state.progress), None
    scenes = scenes_for(stream, steps, period, workers, device, run.scenes)
    source = closing(scenes.batches)
    with History(work, progress) as history, ctrl_c() as stopped, source as loaded:
        for batch in loaded:
            loss = state.step(batch)
            progress.elapsed_s = clock.elapsed()
            settled = settle_end(config, progress, run.minutes)
            done, stop = progress.step == progress.end, stopped()
            if done or progress.step % config.validate_every == 0:
                miou = course.miou(state.average)
                state.keep_if_best(miou)
                speed = clock.rate(progress) * config.batch_size
                history.write(progress, Record(loss, miou, speed, state.learning_rate))
            if done or settled or stop or clock.due("checkpoint", run.checkpoint_every_s):
                state.save(work)
            if done or clock.due("report", REPORT_EVERY_S):
                report(_status(run, progress, clock.rate(progress), loss, miou, scenes.note))
            if done:
                break
            if stop:
                raise Interrupted.at(progress.step, folder)
    origin = {**provenance(run, progress, device), "scenes": scenes.maker}
    model = course.model(state.best_network(), origin)
    save_model(model, folder)
    return model


def _status(
    run: Run, progress: Progress, rate: float, loss: float, miou: float | None, note: str
) -> Status:
    left = ((progress.end or run.config.steps) - progress.step) / rate
    if progress.end is None and run.minutes is not None:
        left = min(left, run.minutes * 60 - progress.elapsed_s)
    speed = rate * run.config.batch_size
    return Status(progress.step, progress.end, max(left, 0.0), speed, loss, miou, note)
