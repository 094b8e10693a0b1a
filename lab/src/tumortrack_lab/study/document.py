"""Tables in Markdown and as CSV, and documents with marked blocks that are replaced."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from tumortrack.core import store
from tumortrack.core.errors import InputError, StorageError

_SPREAD = ("median", "90 %", "95 %", "worst")


def table_of(frame: pd.DataFrame, left: int = 1) -> str:
    """A frame as Markdown; the first ``left`` columns are left-aligned, numbers right-aligned."""
    rule = ["---" if n < left else "---:" for n in range(len(frame.columns))]
    lines = [list(frame), rule, *frame.astype(str).to_numpy().tolist()]
    cells = ((cell.replace("|", "\\|") for cell in line) for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def spread_mm(of: str, values: pd.Series) -> dict[str, str]:
    """Columns of a row: median, 90 %, 95 % and worst of the known values, mm."""
    known = values.dropna().astype(float)
    return {
        f"{of} {name} mm": f"{known.quantile(share):.1f}" if len(known) else ""
        for name, share in zip(_SPREAD, (0.5, 0.9, 0.95, 1), strict=True)
    }


def spread_words(rows: pd.DataFrame, of: str) -> pd.Series:
    """Median / 95 % / worst of each row with the columns of ``spread_mm``."""
    shown = [f"{of} {name} mm" for name in _SPREAD if name != "90 %"]
    return rows[shown].agg(" / ".join, axis=1).replace(" /  / ", "–")


def beside_rigid(rows: pd.DataFrame, of: str = "'s centre") -> dict[str, pd.Series]:
    """Columns of a short table: errors of the centre, and of both rigid poses'."""
    shown = {"centre, mm: median / 95 % / worst": spread_words(rows, "centre")}
    return shown | {
        name: spread_words(rows, name + of) for name in ("best rigid pose", "rigid fit")
    }


def opening(name: str) -> str:
    return f"<!-- results:{name} -->"


def closing(name: str) -> str:
    return f"<!-- /results:{name} -->"


def fill(document: str, blocks: dict[str, str]) -> str:
    """The document with the text between each block's markers replaced. Raises InputError: a marker
    is missing, double or out of order."""
    for name, text in blocks.items():
        if document.count(opening(name)) != 1 or document.count(closing(name)) != 1:
            raise InputError(
                f"the document needs the markers {opening(name)} and {closing(name)} exactly once "
                f"each; put them where the {name} results belong."
            )
        before, _, rest = document.partition(opening(name))
        if closing(name) not in rest:
            raise InputError(f"{closing(name)} stands before {opening(name)}; put it after.")
        after = rest.partition(closing(name))[2]
        document = f"{before}{opening(name)}\n\n{text.strip()}\n\n{closing(name)}{after}"
    return document


@dataclass(frozen=True)
class ReportWriter:
    """A document with markers (None: nothing is written), and the command that its blocks name."""

    document: Path | None
    command: str

    def block(self, name: str, *texts: str) -> None:
        """Replace a block by the command and these paragraphs."""
        self.write({name: "\n\n".join([f"`{self.command}`", *texts])})

    def write(self, blocks: dict[str, str]) -> None:
        """Replace these blocks, in one step; errors as of ``check`` and ``store``."""
        if self.document is not None:
            store.write_atomically(self.document, self._filled(self.document, blocks).encode())

    def check(self, names: Iterable[str]) -> None:
        """Check, before anything is measured, that these blocks can be filled. Raises InputError:
        no document, or a marker missing."""
        if self.document is not None:
            self._filled(self.document, dict.fromkeys(names, ""))

    def _filled(self, document: Path, blocks: dict[str, str]) -> str:
        try:
            return fill(document.read_text(encoding="utf-8"), blocks)
        except OSError as error:
            raise InputError(f"{document} cannot be read: {error.strerror}.") from error

    def data(self, name: str, rows: pd.DataFrame, words: str) -> str:
        """Write data/NAME.csv beside the document; returns the paragraph that links to it, which
        the site shows as a table."""
        if self.document is not None:
            path = self.document.parent / "data" / f"{name}.csv"
            make_folder(path.parent)
            store.write_atomically(path, rows.to_csv(index=False).encode())
        return f"[{words}: {len(rows)} rows](data/{name}.csv)"

    def image(self, name: str) -> Path:
        """Where a picture goes; its folder is made."""
        assert self.document is not None
        folder = self.document.parent / "images"
        make_folder(folder)
        return folder / f"{name}.png"

    def link(self, image: Path, words: str) -> str:
        return f"![{words}](images/{image.name})"


def make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {folder}: {error.strerror}.") from error
