"""The table of a calibration: a line per state, on disk before the next state is located."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.tracking.fingerprint import fingerprint


class Row(Config, frozen=True):
    """One state, located. ``ratio``: of a good answer, the farthest that a vertex of its tumors is
    off, over their bound; ``doubt``: why there is none."""

    scene: str
    sha256: str
    ratio: float | None = None
    doubt: str = ""


@contextmanager
def open_table(
    path: Path, head: dict[str, Any]
) -> Iterator[tuple[list[Row], Callable[[Row], None]]]:
    """The rows of a table, and a function that adds one, which is on disk when it returns. A line
    that a killed process left unfinished is dropped. Raises InputError: the table has another
    ``head``, or another process is filling it; StorageError: the disk refused."""
    with store.writing(path):
        stream = path.open("a+b")
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{path} is being filled by another process.") from error
        stream.seek(0)
        content = stream.read()
        whole = content[: content.rfind(b"\n") + 1]
        begun = json.dumps(head, allow_nan=False).encode().startswith(content)
        known_head, rows = (head, []) if begun else _parsed(whole, path)  # foreign: left as it is
        stream.truncate(len(whole))

        def add(data: object) -> None:
            with store.writing(path):
                stream.write(json.dumps(data, allow_nan=False).encode() + b"\n")
                stream.flush()
                os.fsync(stream.fileno())

        if not whole:
            add(head)
        if differ := [name for name in head if known_head.get(name) != head[name]]:
            raise InputError(
                f"{path} was begun with another {' and '.join(differ)}. Remove it, or give another "
                "--out."
            )
        yield rows, lambda row: add(to_builtins(row))


def _parsed(content: bytes, path: Path) -> tuple[dict[str, Any], list[Row]]:
    try:
        head, *lines = [json.loads(line) for line in content.splitlines()]
        return dict(head), [from_builtins(line, Row, str(path)) for line in lines]
    except (ValueError, TypeError) as error:
        raise InputError(f"{path} is not a table of `tumortrack margins`: {error}.") from error


def head_of(model_sha256: str, seed: int) -> dict[str, Any]:
    """What every row depends on besides its scene."""
    return {"model_sha256": model_sha256, "fingerprint": fingerprint(), "seed": seed}
