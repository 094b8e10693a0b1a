"""What surrounds the steps of a training: the folder's lock, cores, time, Ctrl-C, the history."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch

from tumortrack.core.errors import InputError, StorageError, TumortrackError
from tumortrack.core.process import available_cores, keep_freed_memory
from tumortrack.core.store import write_atomically
from tumortrack.training.run import TrainingProgress

MOST_THREADS = 16  # more only wait for each other in layers this small
_MOST_WORKERS = 16
_LOCK = ".lock"
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class TrainingStatus:
    """What the loop reports while it runs; ``end`` is None while minutes decide."""

    step: int
    end: int | None
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation
    note: str = ""  # on how scenes are made, where a user should know
    waiting: float = 0.0  # fraction of the time that was spent waiting for scenes


class Interrupted(TumortrackError):
    """Ctrl-C: the state is saved, the same command goes on."""

    exit_code = 130

    def __init__(self, step: int, folder: Path) -> None:
        super().__init__(
            f"stopped at step {step}; the state is saved in {folder}. The same "
            "command goes on from there."
        )


@contextmanager
def work_folder(folder: Path, writes: bool = True) -> Iterator[Path]:
    """MODEL/training, locked while in use; removed again if nothing was written into it. Nothing
    is done for a process that only reads (``writes`` is False).

    The lock is the operating system's and ends with its process, however that ends.

    Raises:
        InputError: another process trains in it.
        StorageError: it cannot be made.
    """
    import fcntl

    work = folder / "training"
    if not writes:
        yield work
        return
    try:
        work.mkdir(parents=True, exist_ok=True)
        lock = (work / _LOCK).open("w")
    except OSError as error:
        raise StorageError(f"cannot write into {folder}: {error.strerror}.") from error
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
        workers = max(1, min(_MOST_WORKERS, cores))
    if device.type == "cpu":
        keep_freed_memory()
        granted = os.environ.get("OMP_NUM_THREADS", "")
        most = min(int(granted) if granted.isdigit() else MOST_THREADS, MOST_THREADS)
        torch.set_num_threads(max(1, min(most, cores - min(workers, cores // 2))))
    return workers


class TrainingClock:
    """Time spent in all sessions of a run, and when things are due again."""

    def __init__(self, progress: TrainingProgress) -> None:
        self._progress, self._first_step = progress, progress.step
        self._start, self._before = time.monotonic(), progress.elapsed_s
        self._last: dict[str, float] = {}
        self._waited = 0.0

    def timed(self, source: Iterator[_Item]) -> Iterator[_Item]:
        """The same items; the time spent waiting for them counts."""
        while True:
            began = time.monotonic()
            item = next(source, None)
            self._waited += time.monotonic() - began
            if item is None:
                return
            yield item

    @property
    def waiting(self) -> float:
        """Fraction of this session's time that was spent waiting."""
        return self._waited / self._session_s

    @property
    def rate(self) -> float:
        """Steps per second in this session."""
        return (self._progress.step - self._first_step) / self._session_s

    @property
    def _session_s(self) -> float:
        return max(time.monotonic() - self._start, 1e-9)

    def elapsed(self) -> float:
        return self._before + time.monotonic() - self._start

    def due(self, what: str, every_s: float) -> bool:
        now = time.monotonic()
        if now - self._last.setdefault(what, self._start) < every_s:
            return False
        self._last[what] = now
        return True


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


# Of a validation: tags of TensorBoard, and digits in history.jsonl
_SCALARS = {
    "loss": ("loss/train", ".5f"),
    "validation_miou": ("miou/validation", ".4f"),
    "samples_per_s": ("speed/samples_per_s", ".1f"),
    "learning_rate": ("learning_rate", ".4g"),
    "waiting": ("speed/waiting", ".3f"),  # fraction of the time that was spent waiting for scenes
}


@contextmanager
def history(folder: Path, progress: TrainingProgress) -> Iterator[Callable[..., None]]:
    """history.jsonl and TensorBoard: yields a function that writes a validation's numbers, which
    ``_SCALARS`` names. On resuming, records after the checkpoint are dropped first.

    Raises (entering, writing, leaving):
        StorageError: the disk is full. On leaving after another error, that one is kept.
    """
    from torch.utils.tensorboard import SummaryWriter

    path, files = folder / "history.jsonl", ExitStack()
    with _history_errors(folder):
        if path.exists():
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            whole = [line for line in lines if line.endswith("\n")]
            kept = [line for line in whole if json.loads(line)["step"] <= progress.step]
            write_atomically(path, "".join(kept).encode())
        stream = files.enter_context(path.open("a", buffering=1, encoding="utf-8"))
        board = SummaryWriter(folder / "tensorboard", purge_step=progress.step + 1)
        files.callback(board.close)

    def write(**values: float) -> None:
        line = {"step": progress.step, "elapsed_s": round(progress.elapsed_s, 1)}
        line |= {k: float(f"{values[k]:{digits}}") for k, (_, digits) in _SCALARS.items()}
        with _history_errors(folder):
            stream.write(json.dumps(line) + "\n")
            for name, (tag, _) in _SCALARS.items():
                board.add_scalar(tag, values[name], progress.step)

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
