"""Shared by scripts: options, kept rows, the command line."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

import tyro

from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack_lab.study.document import ReportWriter, make_folder

Options = TypeVar("Options")


@dataclass(frozen=True, kw_only=True)
class KeptOptions:
    """What the scripts' options have in common."""

    out: Path
    """Where cases, models and rows are kept."""
    document: Path
    """The page beside which the tables go, and which shows them."""

    def begin(self, target: str) -> ReportWriter:
        """Make the folder; returns the writer of the document's tables. Raises InputError: there
        is no such document."""
        writer = begun(target, self.document)
        self.out.mkdir(parents=True, exist_ok=True)
        return writer


def begun(target: str, document: Path | None) -> ReportWriter:
    """The writer of a document's tables. Raises InputError: there is no such document."""
    check_page(document)
    return ReportWriter(document, make_command(target))


def check_page(document: Path | None) -> None:
    """Called before anything is measured. Raises InputError: there is no such document."""
    if document is not None and not document.is_file():
        raise InputError(f"{document} does not exist; --document names a page that shows tables.")


def kept(path: Path, about: dict, measure: Callable[[], list[dict]]) -> list[dict]:
    """The rows in a file if they were measured with the same ``about`` by this version of the
    method, as tables say of them; else measured now, and its folder made."""
    about = {**about, "fingerprint": fingerprint()}
    known = store.read_json(path) if path.is_file() else {}
    if known.get("about") == about and "rows" in known:
        return known["rows"]
    make_folder(path.parent)
    rows = measure()
    store.write_json(path, {"about": about, "rows": rows})
    return rows


def make_command(target: str) -> str:
    """The present call of make, which tables name."""
    given = f" ARGS='{shlex.join(sys.argv[1:])}'" if sys.argv[1:] else ""
    return f"make {target}{given}"


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
