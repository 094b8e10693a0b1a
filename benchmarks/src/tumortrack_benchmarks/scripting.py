"""Shared by scripts: options, kept rows, folders of scenes, the command line."""

from __future__ import annotations

import hashlib
import math
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn, TypeVar

import numpy as np
import pandas as pd
import tyro

import tumortrack as tt
from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.cli.console import model_folder, progress_bar
from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.process import available_cores
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks.document import ReportWriter, make_folder

Options = TypeVar("Options")
NOTHING = "–"  # in a table, of what was not measured


@dataclass(frozen=True)
class KidneyOptions:
    """Of what is measured on random kidneys."""

    out: tyro.conf.Positional[Path]
    """Folder of kidneys, scenes and rows."""
    kidneys: int = 4
    """So many."""
    first: int = 4000  # no other random kidney is so numbered
    """Number of the first."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""

    @property
    def numbers(self) -> range:
        return range(self.first, self.first + self.kidneys)


def command_of(target: str, words: Sequence[str]) -> str:
    """A call of make."""
    return f"make {target} ARGS='{shlex.join(words)}'" if words else f"make {target}"


def begun(
    target: str, document: Path | None, named: Mapping[str, str] = MappingProxyType({})
) -> ReportWriter:
    """The writer of a document's tables, before anything is measured; they name the present call of
    make. ``named``: instead of words of the call. Raises InputError: there is no such document."""
    if document is not None and not document.is_file():
        raise InputError(f"{document} does not exist; --document names a page that shows tables.")
    words = [named.get(word, word) for word in sys.argv[1:]]
    return ReportWriter(document, command_of(target, words))


def kept(
    path: Path, about: dict[str, Any], measure: Callable[[], Iterable[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """The rows in a file if they were measured with the same ``about`` by this version of the
    method, as tables say of them; else measured now, and its folder made."""
    about = {**about, "fingerprint": fingerprint()}
    known = store.read_json(path) if path.is_file() else {}
    if known.get("about") == about and "rows" in known:
        return known["rows"]
    make_folder(path.parent)
    rows = [{key: _plain(value) for key, value in row.items()} for row in measure()]
    store.write_json(path, {"about": about, "rows": rows})
    return rows


def _plain(value: Any) -> Any:
    """As JSON has it: None for NaN."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and math.isnan(value) else value


def together(
    work: Callable[..., list[dict[str, Any]]], arguments: Sequence[tuple[Any, ...]]
) -> list[dict[str, Any]]:
    """The rows of all, in order, made by as many processes as there are cores."""
    rows = []
    with (
        ProcessPoolExecutor(available_cores(), get_context("spawn"), _end_with_parent) as pool,
        progress_bar("organs", len(arguments)) as advance,
    ):
        for found in pool.map(work, *zip(*arguments, strict=True)):
            rows += found
            advance()
    return rows


def _end_with_parent() -> None:
    """A process of a pool waits for work forever, even once its parent was killed."""

    def wait() -> None:
        if (parent := parent_process()) is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


def tracker_of(case: Path) -> Tracker:
    """Of a case's model, or a model's folder."""
    return Tracker(tt.load_model(model_folder(case), "cpu"))


def about_scenes(case: Path, scenes: Sequence[Path], code: Iterable[Path]) -> dict[str, Any]:
    """What rows of a case's scenes depend on, beside the method; ``code``: see ``code_sha256``."""
    about = {"code": code_sha256(code), "case": store.sha256_of(case / store.MANIFEST)}
    return {**about, "scenes": [store.sha256_of(path) for path in scenes]}


def code_sha256(paths: Iterable[Path]) -> str:
    """Of source files: after a change, their measurements are made again."""
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in sorted(paths))).hexdigest()


def cell(value: float, digits: int = 1) -> str:
    return NOTHING if pd.isna(value) else f"{value:.{digits}f}"


def ordered(frame: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Columns that sort, and group, in the order in which their values first appear."""
    return frame.assign(**{key: pd.Categorical(frame[key], frame[key].unique()) for key in columns})


def known(names: Sequence[Any], allowed: Iterable[str]) -> list[Any]:
    """The names, each once. Raises InputError: one is not allowed, or there are none."""
    for name in names:
        if name not in allowed:
            raise InputError(f"{name!r} is not known; allowed: {', '.join(allowed)}.")
    if not names:
        raise InputError(f"nothing to make; choose among {', '.join(allowed)}.")
    return list(dict.fromkeys(names))


def claim(out: Path, name: str, identity: dict[str, Any]) -> None:
    """Write the inputs of a folder of scenes into a file there, or check that they are the same.
    Raises InputError: they are not, or the folder holds other files; StorageError."""
    path = out / name
    if path.exists():
        before = store.read_json(path)
        if differ := [key for key, value in identity.items() if before.get(key) != value]:
            raise InputError(
                f"{out} holds scenes of another {' and '.join(differ)}. Choose another folder, or "
                "remove this one."
            )
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} holds other files. Choose a new or empty folder for the scenes.")
    make_folder(out)
    store.write_json(path, identity)


def run(main: Callable[[Options], None], options: type[Options]) -> NoReturn:
    """Run a script by its command line; errors are one line, and the exit code says which."""
    name = Path(sys.argv[0]).stem
    try:
        main(tyro.cli(options))
    except TumortrackError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print(f"{name}: stopped; the same command goes on.", file=sys.stderr)
        sys.exit(130)
    sys.exit(0)
