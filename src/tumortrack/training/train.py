"""The training loop, read top to bottom, and what surrounds it: the folder's lock, cores, time,
Ctrl-C, the history.

Data are addressed by step, the only randomness is drawn from (seed, step), and the state is one
atomic file: a run that is killed and started again ends with the weights of one that was not.
Where torchrun started several processes each runs this loop with its part of the batch.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import torch

from tumortrack.core.errors import InputError, StorageError, TumortrackError
from tumortrack.core.process import available_cores, keep_freed_memory
from tumortrack.core.store import write_atomically, writing
from tumortrack.models.folder import check_trainable
from tumortrack.models.model import Model
from tumortrack.simulate.coarse import coarsened
from tumortrack.simulate.scene import SceneStream
from tumortrack.training.distributed import ProcessGroup, process_group
from tumortrack.training.model import load_model, save_model
from tumortrack.training.scenes import Scenes, batches
from tumortrack.training.state import (
    TrainingProgress,
    TrainingRun,
    TrainingState,
    provenance,
    settle_end,
)
from tumortrack.training.task import TrainingTask, task_of

__all__ = ["Interrupted", "TrainingRun", "TrainingStatus", "train"]

REPORT_EVERY_S = 5.0
_MOST = 16  # processes that make scenes; and threads: more only wait, in layers this small
_LOCK = ".lock"
_Item = TypeVar("_Item")
# Of a validation: names and digits in history.jsonl, and tags of TensorBoard
_SCALARS = (
    ("loss", "loss/train", ".5f"),
    ("validation_miou", "miou/validation", ".4f"),
    ("samples_per_s", "speed/samples_per_s", ".1f"),
    ("learning_rate", "learning_rate", ".4g"),
    ("waiting", "speed/waiting", ".3f"),  # fraction of the time that was spent waiting for scenes
)


@dataclass(frozen=True)
class TrainingStatus:
    """What the loop reports while it runs; ``end`` is None while minutes decide."""

    step: int
    end: int | None
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation
    waiting: float = 0.0  # fraction of the time that was spent waiting for scenes
    tre_mm: float | None = None  # of the last validation, where the method knows a motion


class Interrupted(TumortrackError):
    """Ctrl-C: the state is saved, the same command goes on."""

    exit_code = 130

    def __init__(self, step: int, folder: Path) -> None:
        super().__init__(
            f"stopped at step {step}; the state is saved in {folder}. The same "
            "command goes on from there."
        )


Report = Callable[[TrainingStatus], None]


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
    TrainingState(run, device, group).resume(work)  # another run's: refused before the long part
    task = task_of(run, device)
    state = TrainingState(run, device, group)
    state.initialize(task.initialize)
    state.resume(work)
    end = config.steps if state.progress.end is None else state.progress.end
    if end == 0:
        state.keep_if_best(task.miou(state.average))
    else:
        steps = range(state.progress.step, end)
        scenes = _scenes(run, task, group.local_batches(steps), group, workers)
        run_steps(state, scenes, work, report, task)
    if not group.is_main:
        return None
    origin = {**provenance(run, state.progress, device), "scenes": scenes.maker if end else "none"}
    model = task.model(state.best_network(), origin)
    save_model(model, work.parent)
    return model


def _scenes(
    run: TrainingRun, task: TrainingTask, steps: range, group: ProcessGroup, workers: int
) -> Scenes:
    """Of these steps, this process's share."""
    config = run.config
    anatomy_ct, scene = coarsened(run.anatomy_ct, config.scene, config.coarse)
    about = anatomy_ct, run.up_lps, scene, task.points, run.seed
    stream = SceneStream(*about, "train", group.local_size(config.batch_size), task.body)
    period = config.training_pairs // config.batch_size * group.size
    made = batches(stream.batch, steps, period, workers, group.device)
    return Scenes(made, f"{workers} processes")


def run_steps(
    state: TrainingState,
    scenes: Scenes,
    work: Path,
    report: Report,
    task: TrainingTask | None = None,
) -> None:
    """All steps to the end; the main process writes checkpoints into ``work``, reports and, with a
    ``task``, validates. Raises as ``train``."""
    run, group, progress = state.run, state.group, state.progress
    clock, miou, tre_mm = TrainingClock(progress), None, None
    with ExitStack() as stack:
        validates = task is not None and group.is_main
        write = stack.enter_context(history(work, progress)) if validates else None
        stopped = stack.enter_context(ctrl_c())
        for batch in clock.timed(stack.enter_context(closing(scenes.batches))):
            loss = state.step(batch)
            clock.count_step()
            progress.elapsed_s, stop = group.all_reduce(clock.elapsed(), stopped())
            settled = settle_end(run.config, progress, run.minutes)
            done = progress.step == progress.end
            if task and write and (done or progress.step % run.config.validate_every == 0):
                miou, tre_mm = task.miou(state.average), task.tre_mm(state.average)
                state.keep_if_best(miou)
                speed = clock.rate() * run.config.batch_size
                write(loss, miou, speed, state.learning_rate, clock.waiting())
            due = done or settled or stop
            if group.is_main and (due or clock.due("checkpoint", run.checkpoint_every_s)):
                state.save(work)
            if group.is_main and (done or clock.due("report", REPORT_EVERY_S)):
                report(replace(_status(state, clock, loss, miou), tre_mm=tre_mm))
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
    about = rate * run.config.batch_size, loss, miou, clock.waiting()
    return TrainingStatus(progress.step, progress.end, max(left, 0.0), *about)


@contextmanager
def work_folder(folder: Path, writes: bool = True) -> Iterator[Path]:
    """MODEL/training, locked while in use, if this process writes; removed again if nothing was
    written into it. The lock is the operating system's and ends with its process, however that
    ends. InputError where another process trains in it, StorageError where it cannot be made."""
    import fcntl

    work = folder / "training"
    if not writes:
        yield work
        return
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
                with suppress(OSError):  # there was more in it before
                    folder.rmdir()


def divide_cores(device: torch.device, workers: int | None, sharing: int = 1) -> int:
    """How many processes make scenes, and set the network's number of threads: on a CPU it gets the
    cores that the workers leave, half of them at least, within OMP_NUM_THREADS.

    Without ``workers`` they are as many as there are cores, sixteen at most: their priority is low
    (see ``scenes``). ``sharing`` processes of one training share the machine.
    """
    cores = available_cores() // sharing
    if workers is None:
        workers = max(1, min(_MOST, cores))
    if device.type == "cpu":
        keep_freed_memory()
        granted = os.environ.get("OMP_NUM_THREADS", "")
        most = min(int(granted) if granted.isdigit() else _MOST, _MOST)
        torch.set_num_threads(max(1, min(most, cores - min(workers, cores // 2))))
    return workers


class TrainingClock:
    """Time spent in all sessions of a run, and when things are due again. A session's time begins
    when its first step is done: before, processes start and kernels are compiled."""

    def __init__(self, progress: TrainingProgress) -> None:
        self._progress, self._first_step = progress, progress.step
        self._start, self._before = time.monotonic(), progress.elapsed_s
        self._first_s = 0.0
        self._last: dict[str, float] = {}
        self._waited = 0.0

    def timed(self, source: Iterator[_Item]) -> Iterator[_Item]:
        """The same items; the time spent waiting for them counts."""
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
        """Fraction of this session's time that was spent waiting."""
        return self._waited / self._session_s()

    def rate(self) -> float:
        """Steps per second in this session; as long as there is only one, by that one's time."""
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
    """Turns Ctrl-C and SIGTERM into a flag that the loop checks after each step."""
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(received)
    except BaseException:
        if "TORCHELASTIC_RUN_ID" in os.environ:
            # torchrun ends the processes that are left; this one's message comes first.
            before[signal.SIGTERM] = signal.SIG_IGN
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def history(folder: Path, progress: TrainingProgress) -> Iterator[Callable[..., None]]:
    """history.jsonl and, where TensorBoard is installed, its curves: yields a function that writes
    a validation's ``_SCALARS``. On resuming, records after the checkpoint are dropped first. A full
    disk raises StorageError, except on leaving after another error, which is kept."""
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
