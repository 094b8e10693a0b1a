"""The course of a run: history.jsonl and TensorBoard, one record a validation."""

from __future__ import annotations

import json
from pathlib import Path

from tumortrack.core.errors import StorageError
from tumortrack.core.store import write_atomically
from tumortrack.learn.checkpoint import Progress


class History:
    """Appends records; on resuming, those after the checkpoint are dropped first."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self._path = folder / "history.jsonl"
        self._folder = folder
        self._resumed_at = progress.step

    def __enter__(self) -> History:
        from torch.utils.tensorboard import SummaryWriter

        if self._path.exists():
            lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
            whole = [line for line in lines if line.endswith("\n")]
            kept = [line for line in whole if json.loads(line)["step"] <= self._resumed_at]
            write_atomically(self._path, "".join(kept).encode())
        self._board = SummaryWriter(self._folder / "tensorboard", purge_step=self._resumed_at + 1)
        self._lines = self._path.open("a", buffering=1, encoding="utf-8")
        return self

    def __exit__(self, *_: object) -> None:
        self._board.close()
        self._lines.close()

    def write(self, progress: Progress, loss: float, miou: float) -> None:
        """One validation's record.

        Raises:
            StorageError: the disk is full.
        """
        record = {
            "step": progress.step,
            "elapsed_s": round(progress.elapsed_s, 1),
            "loss": round(loss, 5),
            "validation_miou": round(miou, 4),
        }
        try:
            self._lines.write(json.dumps(record) + "\n")
        except OSError as error:
            raise StorageError(f"cannot write {self._path}: {error.strerror}.") from error
        self._board.add_scalar("loss/train", loss, progress.step)
        self._board.add_scalar("miou/validation", miou, progress.step)
