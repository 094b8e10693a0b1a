"""Measured tables (docs/data/*.csv) and the pages that show them.

A table says above its header what made it, one ``# key: value`` a line: ``command``, ``commit``,
``date``, ``machine``, ``sample``, ``interval`` and ``fingerprint``, the method's version. Tables of
other things than the method (trained weights, another machine, an older version) say with which
``version`` they were measured instead, and of which ``weights`` or ``data``.

A page shows a whole table between ``<!-- results:NAME -->`` and ``<!-- /results:NAME -->``, and one
cell between ``<!--=NAME:ROW:COLUMN-->`` and ``<!--/-->``, where ROW is the text of the first
columns, as many as are needed, joined by commas.
"""

from __future__ import annotations

import csv
import io
import platform
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from scipy.stats import binomtest

import tumortrack
from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.core import store
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.process import available_cores

_SPREAD = ("median", "90 %", "95 %", "worst")


def table_of(frame: pd.DataFrame) -> str:
    """A frame as Markdown; columns of numbers are right-aligned."""
    cells = [list(map(str, row)) for row in frame.astype(object).to_numpy()]
    rule = [
        "---:" if all(_NUMBER.match(row[n]) for row in cells) else "---"
        for n in range(len(frame.columns))
    ]
    lines = [list(map(str, frame)), rule, *cells]
    escaped = ((cell.replace("|", "\\|") for cell in line) for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in escaped)


_NUMBER = re.compile(r"-?[\d.]|–|$|nan")


def share_words(count: int, of: int) -> str:
    """A share with its 95 % interval (Wilson's), %."""
    low, high = binomtest(count, of).proportion_ci(method="wilson")
    return f"{100 * count / of:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


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


class MeasuredTable(NamedTuple):
    """``about``: what made it."""

    about: dict[str, str]
    header: list[str]
    rows: list[list[str]]

    @classmethod
    def read(cls, path: Path) -> MeasuredTable:
        """Raises InputError: it is not there."""
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}.") from error
        about = {}
        while text.startswith("#"):
            line, _, text = text.partition("\n")
            key, _, value = line[1:].partition(":")
            about[key.strip()] = value.strip()
        header, *rows = csv.reader(io.StringIO(text, newline=""))
        return cls(about, header, rows)

    def cell(self, row: str, column: str) -> str:
        """Raises InputError: there is no such cell, or more than one."""
        depth = row.count(",") + 1
        found = [each for each in self.rows if row in (each[0], ",".join(each[:depth]))]
        if len(found) != 1 or self.header.count(column) != 1:
            raise InputError(f"{len(found)} rows {row!r}, {self.header.count(column)} {column!r}")
        return found[0][self.header.index(column)]

    @property
    def caption(self) -> str:
        """What made it, in a line."""
        about = dict(self.about)
        command = f"`{made}`; " if (made := about.pop("command", "")) else ""
        return command + "; ".join(f"{key} {value}" for key, value in about.items()) + "."


def cpu_name() -> str:
    """The processor as the system names it."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.exists() else ""
    found = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    return found[1] if found else platform.processor() or platform.machine()


def provenance(command: str, **more: str) -> dict[str, str]:
    """What a table says that is measured now by this version of the method."""
    here = str(Path(__file__).parent)
    asked = ["git", "-C", here, "describe", "--always", "--dirty", "--exclude=*"]
    try:
        commit = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):  # no git, or no checkout
        commit = f"none, version {tumortrack.__version__}"
    return {
        "command": command,
        "fingerprint": fingerprint(),
        "commit": commit,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "machine": f"{cpu_name()}, {available_cores()} cores",
        **more,
    }


def write_table(path: Path, rows: pd.DataFrame, about: Mapping[str, str]) -> None:
    """Atomically. Raises StorageError."""
    make_folder(path.parent)
    above = "".join(f"# {key}: {value}\n" for key, value in about.items())
    store.write_atomically(path, (above + rows.to_csv(index=False)).encode())


_BLOCK = re.compile(r"(<!-- results:([\w-]+) -->\n).*?(<!-- /results:\2 -->)", re.DOTALL)
_CELL = re.compile(r"(<!--=([^:>]+):([^:>]*):([^>]*?)-->).*?(<!--/-->)", re.DOTALL)


def rendered(page: str, data: Path) -> str:
    """A page with its blocks and cells as the tables in ``data`` have them. Raises InputError: a
    table or cell is not there, or nothing says what made it."""

    def known(name: str) -> MeasuredTable:
        table = MeasuredTable.read(data / f"{name}.csv")
        if not table.about:
            raise InputError(f"{data / name}.csv does not say what made it.")
        return table

    def block(found: re.Match[str]) -> str:
        table = known(found[2])
        shown = table_of(pd.DataFrame(table.rows, columns=table.header))
        return f"{found[1]}\n{shown}\n\n{table.caption}\n\n{found[3]}"

    def cell(found: re.Match[str]) -> str:
        table = known(found[2])
        try:
            return found[1] + table.cell(found[3], found[4]) + found[5]
        except InputError as error:
            raise InputError(f"{data / found[2]}.csv has {error}.") from error

    return _CELL.sub(cell, _BLOCK.sub(block, page))


@dataclass(frozen=True)
class ReportWriter:
    """Writes tables into data/ beside a document (None: nothing is written), with the command that
    made them, and the document's blocks and cells."""

    document: Path | None
    command: str

    def tables(self, tables: Mapping[str, pd.DataFrame], **more: str) -> None:
        """Write data/NAME.csv each; ``more``: sample, interval. Raises InputError: no such
        document, or it shows a table that is not there; StorageError."""
        if self.document is None:
            return
        data = self.document.parent / "data"
        for name, rows in tables.items():
            write_table(data / f"{name}.csv", rows, provenance(self.command, **more))
        try:
            page = self.document.read_text(encoding="utf-8")
        except OSError as error:
            raise InputError(f"{self.document} cannot be read: {error.strerror}.") from error
        store.write_atomically(self.document, rendered(page, data).encode())

    def image(self, name: str) -> Path:
        """Where a picture goes; its folder is made."""
        assert self.document is not None
        folder = self.document.parent / "images"
        make_folder(folder)
        return folder / f"{name}.png"


def make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {folder}: {error.strerror}.") from error
