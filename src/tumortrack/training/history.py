"""The course of a run: history.jsonl and TensorBoard, one record a validation."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from tumortrack.core.errors import StorageError
from tumortrack.core.store import write_atomically
from tumortrack.training.checkpoint import TrainingProgress


@dataclass(frozen=True)
class Record:
    """What one validation adds to a step number and a time."""

    loss: float
    validation_miou: float
    samples_per_s: float
    learning_rate: float
    waiting: float = 0.0  # share of the time that was spent waiting for scenes


class History:
    """Appends records; on resuming, those after the checkpoint are dropped first.

    Raises (entering, writing, leaving):
        StorageError: the disk is full. On leaving after another error, that one is kept.
    """

    def __init__(self, folder: Path, progress: TrainingProgress) -> None:
        self._path = folder / "history.jsonl"
        self._folder = folder
        self._resumed_at = progress.step

    def __enter__(self) -> History:
        from torch.utils.tensorboard import SummaryWriter

        try:
            if self._path.exists():
                lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
                whole = [line for line in lines if line.endswith("\n")]
                kept = [line for line in whole if json.loads(line)["step"] <= self._resumed_at]
                write_atomically(self._path, "".join(kept).encode())
            self._lines = self._path.open("a", buffering=1, encoding="utf-8")
            self._board = SummaryWriter(
                self._folder / "tensorboard", purge_step=self._resumed_at + 1
            )
        except OSError as error:
            raise self._refused(error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        refused: list[OSError] = []
        for close in (self._board.close, self._lines.close):
            try:
                close()
            except OSError as failure:
                refused.append(failure)
        if refused and error is None:
            raise self._refused(refused[0]) from refused[0]

    def write(self, progress: TrainingProgress, record: Record) -> None:
        """One validation's record."""
        line = {
            "step": progress.step,
            "elapsed_s": round(progress.elapsed_s, 1),
            "loss": round(record.loss, 5),
            "validation_miou": round(record.validation_miou, 4),
            "samples_per_s": round(record.samples_per_s, 1),
            "learning_rate": float(f"{record.learning_rate:.4g}"),
            "waiting": round(record.waiting, 3),
        }
        try:
            self._lines.write(json.dumps(line) + "\n")
            for name, value in (
                ("loss/train", record.loss),
                ("miou/validation", record.validation_miou),
                ("speed/samples_per_s", record.samples_per_s),
                ("learning_rate", record.learning_rate),
                ("speed/waiting", record.waiting),
            ):
                self._board.add_scalar(name, value, progress.step)
        except OSError as error:
            raise self._refused(error) from error

    def _refused(self, error: OSError) -> StorageError:
        return StorageError(
            f"cannot write the history in {self._folder}: {error.strerror or error}. "
            "Free some space and give the same command again."
        )
