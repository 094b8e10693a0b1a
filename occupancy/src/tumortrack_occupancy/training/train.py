"""The training loop, and what surrounds it: the folder's lock, cores, time, Ctrl-C, the history.

Data are addressed by step, all randomness is drawn from (seed, step), and the state is one atomic
file: a run that is killed and started again ends with the weights of one that was not.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import torch

from tumortrack.core.errors import InputError, StorageError, TumortrackError
from tumortrack.core.process import available_cores, keep_freed_memory
from tumortrack.core.store import write_atomically, writing
from tumortrack.io.model_folder import check_trainable, is_finished, read_model_manifest, save_model
from tumortrack.registration.method import TrainingStatus
from tumortrack.tracking.model_files import load_model
from tumortrack_occupancy.hardware import choose_device
from tumortrack_occupancy.model import OccupancyModel
from tumortrack_occupancy.training.scenes import Tensors, batches
from tumortrack_occupancy.training.state import (
    TrainingProgress,
    TrainingRun,
    TrainingState,
    fix_last_step,
    provenance,
)
from tumortrack_occupancy.training.stream import SceneStream
from tumortrack_occupancy.training.task import OccupancyTask

__all__ = ["Interrupted", "TrainingRun", "train"]

REPORT_EVERY_S = 5.0
_MOST = 16  # processes that make scenes, and threads: layers this small cannot use more
_LOCK = ".lock"
_Item = TypeVar("_Item")
# Of each validation: name in history.jsonl, tag in TensorBoard, digits in history.jsonl
_SCALARS = (
    ("loss", "loss/train", ".5f"),
    ("validation_loss", "loss/validation", ".5f"),
    ("validation_miou", "miou/validation", ".4f"),
    ("samples_per_s", "speed/samples_per_s", ".1f"),
    ("learning_rate", "learning_rate", ".4g"),
    ("waiting", "speed/waiting", ".3f"),  # fraction of the time spent waiting for scenes
)


class Interrupted(TumortrackError):
    """Ctrl-C: the state is saved, and the same command resumes."""

    exit_code = 130

    def __init__(self, step: int, folder: Path) -> None:
        super().__init__(
            f"stopped at step {step}; the state is saved in {folder}. The same "
            "command goes on from there."
        )


Report = Callable[[TrainingStatus], None]


def train(run: TrainingRun, folder: Path, report: Report) -> OccupancyModel:
    """Train to the end, resuming an unfinished training in ``folder``, and save the model there. A
    finished model of the same run is read instead.

    Raises:
        ArtifactError: ``folder`` holds another run, or a damaged one.
        InputError: another process trains in ``folder``, or it holds another model; a part is too
            small to be learnt.
        StorageError: the disk is full; the last checkpoint is intact.
        Diverged: the loss is not finite any more; the last checkpoint is from before.
        Interrupted: Ctrl-C; a checkpoint is written.
    """
    if is_finished(folder):
        return _finished(run, folder)
    config, device = run.config, choose_device(run.device)
    with work_folder(folder) as work:
        workers = divide_cores(device, run.workers)
        state = TrainingState(run, device)
        state.resume(work)  # another run's is refused before the scenes' slow preparation
        task = OccupancyTask(run, device)
        end = config.steps if state.progress.end is None else state.progress.end
        steps = range(state.progress.step, end)
        run_steps(state, _scenes(run, task, steps, workers), work, report, task)
        origin = {**provenance(run, state.progress, device), "scenes": f"{workers} processes"}
        model = task.model(state.best_network(), origin)
        save_model(model, folder)
        return model


def _finished(run: TrainingRun, folder: Path) -> OccupancyModel:
    """The model in a folder; InputError if it is of another run."""
    done = read_model_manifest(folder)["provenance"]
    if differ := run.differences(done.get("decided_by", {})):
        raise InputError(
            f"{folder} holds a finished model (seed {done['seed']}), whose command differs from "
            f"this one in {differ}. A finished training is not extended: choose another MODEL "
            "folder."
        )
    model = load_model(folder, run.device)
    assert isinstance(model, OccupancyModel)  # as the run is the same
    return model


def _scenes(
    run: TrainingRun, task: OccupancyTask, steps: range, workers: int
) -> Generator[Tensors, None, None]:
    """The batches of these steps."""
    config = run.config
    stream = SceneStream(
        task.shown_ct, run.up_lps, config.scene, task.points, run.seed,
        stream="train", batch_size=config.batch_size, body=task.body,
    )  # fmt: skip
    period = config.training_pairs // config.batch_size
    return batches(stream.batch, steps, period, workers, choose_device(run.device))


def run_steps(
    state: TrainingState,
    scenes: Generator[Tensors, None, None],
    work: Path,
    report: Report,
    task: OccupancyTask | None = None,
) -> None:
    """All steps to the end, with checkpoints in ``work``; validated if there is a ``task``. Raises
    as ``train``."""
    run, progress = state.run, state.progress
    clock, miou = TrainingClock(progress), None
    with ExitStack() as stack:
        write = None if task is None else stack.enter_context(history(work, progress))
        stopped = stack.enter_context(ctrl_c())
        for batch in clock.timed(stack.enter_context(closing(scenes))):
            loss = state.step(batch)
            clock.count_step()
            progress.elapsed_s, stop = clock.elapsed(), stopped()
            end_fixed = fix_last_step(run.config, progress, run.minutes)
            done = progress.step == progress.end
            if task and write and (done or progress.step % run.config.validate_every == 0):
                error, miou = task.validate(state.average)
                state.keep_if_best(miou)
                speed = clock.rate() * run.config.batch_size
                write(loss, error, miou, speed, state.learning_rate, clock.waiting())
            if done or end_fixed or stop or clock.due("checkpoint", run.checkpoint_every_s):
                state.save(work)
            if done or clock.due("report", REPORT_EVERY_S):
                report(_status(state, clock, loss, miou))
            if done:
                break
            if stop:
                raise Interrupted(progress.step, work.parent)


def _status(
    state: TrainingState, clock: TrainingClock, loss: float, miou: float | None
) -> TrainingStatus:
    run, progress, rate = state.run, state.progress, clock.rate()
    left = ((progress.end or run.config.steps) - progress.step) / rate
    if progress.end is None and run.minutes is not None:
        left = min(left, run.minutes * 60 - progress.elapsed_s)
    return TrainingStatus(
        step=progress.step,
        end=progress.end,
        seconds_left=max(left, 0.0),
        samples_per_s=rate * run.config.batch_size,
        loss=loss,
        miou=miou,
        waiting=clock.waiting(),
        warming_up=progress.step < run.config.schedule.warmup_steps,
    )


@contextmanager
def work_folder(folder: Path) -> Iterator[Path]:
    """MODEL/training, locked while in use, and removed again if it stays empty. The lock is the
    operating system's and ends with its process, however that ends. InputError: another process
    trains in it. StorageError: it cannot be made."""
    import fcntl

    work = folder / "training"
    check_trainable(folder)
    with writing(work):
        work.mkdir(parents=True, exist_ok=True)
        lock = (work / _LOCK).open("w")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"another process is training in {folder}. Wait for its end or stop it, or choose "
                "another MODEL folder."
            ) from error
        try:
            yield work
        finally:
            if [path.name for path in work.iterdir()] == [_LOCK]:
                (work / _LOCK).unlink()
                work.rmdir()
                with suppress(OSError):  # it is not empty
                    folder.rmdir()


def divide_cores(device: torch.device, workers: int | None) -> int:
    """Return how many processes make scenes, and set PyTorch's number of threads: on a CPU the
    cores that the workers leave, but at least half of them, within OMP_NUM_THREADS. Without
    ``workers`` there are as many of both as cores, at most 16: the workers' priority is low (see
    ``scenes``), so that they take what the network leaves, which may be next to nothing."""
    cores, reserved = available_cores(), min(workers or 0, available_cores() // 2)
    if workers is None:
        workers = max(1, min(_MOST, cores))
    if device.type == "cpu":
        keep_freed_memory()
        granted = os.environ.get("OMP_NUM_THREADS", "")
        most = min(int(granted) if granted.isdigit() else _MOST, _MOST)
        torch.set_num_threads(max(1, min(most, cores - reserved)))
    return workers


class TrainingClock:
    """Time spent in all sessions of a run, and when things are due again. A session's time begins
    after its first step, which includes starting processes and compiling kernels."""

    def __init__(self, progress: TrainingProgress) -> None:
        self._progress, self._first_step = progress, progress.step
        self._start, self._before = time.monotonic(), progress.elapsed_s
        self._first_s = 0.0
        self._last: dict[str, float] = {}
        self._waited = 0.0

    def timed(self, source: Iterator[_Item]) -> Iterator[_Item]:
        """The same items, counting the time spent waiting for them."""
        began = time.monotonic()
        for item in source:
            self._waited += time.monotonic() - began
            yield item
            began = time.monotonic()

    def count_step(self) -> None:
        """After each step."""
        if not self._first_s:
            self._first_s, self._first_step = self._session_s(), self._progress.step
            self._start, self._waited = time.monotonic(), 0.0

    def elapsed(self) -> float:
        return self._before + self._session_s()

    def waiting(self) -> float:
        """Fraction of this session's time spent waiting."""
        return self._waited / self._session_s()

    def rate(self) -> float:
        """Steps per second in this session; after a single step, by that step's time."""
        steps = self._progress.step - self._first_step
        return steps / self._session_s() if steps else 1 / max(self._first_s, 1e-9)

    def due(self, what: str, every_s: float) -> bool:
        now = time.monotonic()
        if now - self._last.setdefault(what, self._start) < every_s:
            return False
        self._last[what] = now
        return True

    def _session_s(self) -> float:
        return max(time.monotonic() - self._start, 1e-9)


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a flag that the loop checks after each step."""
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def history(folder: Path, progress: TrainingProgress) -> Iterator[Callable[..., None]]:
    """history.jsonl and, if TensorBoard is installed, its curves: yields a function that writes a
    validation's ``_SCALARS``. On resuming, records after the checkpoint are dropped first. A full
    disk raises StorageError, unless another error is already on its way."""
    path, files = folder / "history.jsonl", ExitStack()
    with _history_errors(folder):
        if path.exists():
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            whole = [line for line in lines if line.endswith("\n")]
            kept = [line for line in whole if json.loads(line)["step"] <= progress.step]
            write_atomically(path, "".join(kept).encode())
        stream = files.enter_context(path.open("a", buffering=1, encoding="utf-8"))
        board = None
        if find_spec("tensorboard"):  # an extra; history.jsonl holds the same numbers
            from torch.utils.tensorboard import SummaryWriter

            board = SummaryWriter(folder / "tensorboard", purge_step=progress.step + 1)
            files.callback(board.close)

    def write(*values: float) -> None:
        line = {"step": progress.step, "elapsed_s": round(progress.elapsed_s, 1)}
        for value, (name, _, digits) in zip(values, _SCALARS, strict=True):
            line[name] = float(f"{value:{digits}}")
        with _history_errors(folder):
            stream.write(json.dumps(line) + "\n")
            if board is not None:
                for value, (_, tag, _) in zip(values, _SCALARS, strict=True):
                    board.add_scalar(tag, value, progress.step)

    try:
        yield write
    except BaseException:
        with suppress(OSError):  # the first error counts
            files.close()
        raise
    with _history_errors(folder):
        files.close()


@contextmanager
def _history_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"cannot write the history in {folder}: {error.strerror or error}. "
            "Free some space and give the same command again."
        ) from error
