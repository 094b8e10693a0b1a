"""Where a training keeps its state: MODEL/training, of one process at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tumortrack.core.errors import InputError, StorageError

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
