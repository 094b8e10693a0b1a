"""The table of a calibration: a line per state, on disk before the next state is located."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msgspec import field

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.margins import Kind, Radius

Miss = tuple[float, float | None]  # outward miss or distance (mm), and s (mm)


class Row(Config, frozen=True):
    """One state, located. ``doubt``: why there is no good estimate; ``misses``: of every tumor, of
    the organ's surface, and of the worst target."""

    scene: str
    sha256: str
    label: tuple[str, str, str]
    doubt: str = ""
    measured: dict[str, float] = field(default_factory=dict)
    misses: dict[Kind, tuple[Miss, ...]] = field(default_factory=dict)

    def score(self, kind: Kind, form: Radius | None = None) -> float:
        """Largest miss, mm; with a ``form`` relative to the size that it gives."""
        misses = self.misses[kind]
        if form is None:
            return max(miss for miss, _ in misses)
        return max(miss / form.size_mm(s or 0.0, self.measured) for miss, s in misses)

    def within(self, kind: Kind, radius: Radius) -> bool:
        """Whether all misses are within their radii."""
        radii = [(miss, radius.at(s, self.measured)) for miss, s in self.misses[kind]]
        return all(at is not None and miss <= at for miss, at in radii)


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
