"""The state of a training run in one file, written atomically: kill -9 loses the steps since."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from tumortrack.core.errors import ArtifactError, InputError, StorageError
from tumortrack.core.store import write_atomically

_FILE = "checkpoint.safetensors"


@dataclass
class TrainingProgress:
    """Where a run stands. ``end`` is the step it will stop at; None while minutes decide."""

    step: int = 0
    elapsed_s: float = 0.0
    end: int | None = None
    best_miou: float = -1.0


def save_checkpoint(
    folder: Path,
    progress: TrainingProgress,
    groups: dict[str, dict[str, torch.Tensor]],
    identity: str,
) -> None:
    """Write progress and tensors; ``identity`` names the run they belong to.

    Raises:
        StorageError: the disk is full; the checkpoint before this one is whole.
    """
    tensors = {
        f"{group}/{name}": tensor.detach().cpu().contiguous()
        for group, members in groups.items()
        for name, tensor in members.items()
    }
    metadata = {"progress": json.dumps(asdict(progress)), "identity": identity}
    write_atomically(folder / _FILE, save(tensors, metadata))


def load_checkpoint(
    folder: Path, identity: str
) -> tuple[TrainingProgress, dict[str, dict[str, torch.Tensor]]] | None:
    """The last checkpoint, or None where there is none.

    Raises:
        ArtifactError: it is damaged, or belongs to a run with another case, configuration or seed.
    """
    path = folder / _FILE
    if not path.exists():
        return None
    groups: dict[str, dict[str, torch.Tensor]] = {}
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            progress = TrainingProgress(**json.loads(metadata["progress"]))
            for key in file.keys():  # noqa: SIM118 - safe_open is no dict
                group, name = key.split("/", 1)
                groups.setdefault(group, {})[name] = file.get_tensor(key)
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        raise ArtifactError(
            f"{path} is damaged: {error}. Remove {folder.parent} and train again."
        ) from error
    if metadata.get("identity") != identity:
        raise ArtifactError(
            f"{folder.parent} holds a run with another case, preset, seed or option. Give the "
            "same command to resume it, or another MODEL folder to start anew."
        )
    return progress, groups


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Adam's moments and step counts, by parameter number."""
    return {
        f"{index}.{name}": value
        for index, state in optimizer.state_dict()["state"].items()
        for name, value in state.items()
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, torch.Tensor]) -> None:
    """Put back what ``optimizer_tensors`` took."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


_LOCK = ".lock"


@contextmanager
def work_folder(folder: Path, writes: bool = True) -> Iterator[Path]:
    """MODEL/training, locked while in use; removed again if nothing was written into it. Nothing
    is done for a process that only reads (``writes`` is False).

    The lock is the operating system's and ends with its process, whatever ended that.

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
