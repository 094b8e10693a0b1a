"""LIST: a CSV table with a row for each patient: a name, an input, and options that differ from the
defaults."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.imaging.options import PrepareOptions
from tumortrack_lab.fleet.task import File

_LARGEST = 64 * 2**20  # bytes
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
MISSING = "missing"  # instead of a sha256: no file has it


# Options of `prepare`, ``name`` under another name: a list's is the row's.
_OF_PREPARE = (
    *("organ_name", "side", "up", "patient", "organ", "tumor", "series", "unit", "min_tumor_ml"),
    *("organ_hu", "tumor_hu", "rotations", "tilt", "sensor"),
)
_LEAST = {"seed": 0, "margin_states": 1, "test_states": 1, "views": 1}  # of the later steps
COLUMNS = ("name", "input", *_OF_PREPARE, *_LEAST)


@dataclass(frozen=True, kw_only=True)
class Patient:
    """A row of a list.

    Attributes:
        source: what `prepare` takes.
        prepare: its options.
        seed: of states.
        margin_states: simulated states for calibrating margins.
        test_states: other states, for evaluating the model.
        views: of each of these.
    """

    name: str
    source: Path
    prepare: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    margin_states: int = 14
    test_states: int = 14
    views: int = 2


def read_list(path: Path) -> list[Patient]:
    """The patients of a list; paths are relative to it. Whether inputs exist is not checked here.

    Raises:
        InputError: no such file, or unusable rows: all of them are named, with their lines.
    """
    try:
        text = store.read_file(path, _LARGEST, "Split the list.").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8: {error}.") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    patients: dict[str, Patient] = {}
    try:
        head = [cell.strip() for cell in next(reader, [])]
        wrong = _wrong_head(head)
        for row in reader if not wrong else ():
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            try:
                patient = _patient(head, cells, path.parent)
                if patient.name in patients:
                    raise InputError(f"{patient.name} has a row already")
                patients[patient.name] = patient
            except (InputError, msgspec.ValidationError) as error:
                wrong.append(f"line {reader.line_num}: {str(error).rstrip('.')}")
    except csv.Error as error:
        raise InputError(f"{path} is no CSV table: line {reader.line_num}: {error}.") from error
    if wrong:
        raise InputError(f"{path} cannot be used:\n  " + "\n  ".join(wrong))
    if not patients:
        raise InputError(f"{path} lists no patients; give a row each under name,input.")
    return list(patients.values())


def _wrong_head(head: list[str]) -> list[str]:
    wrong = [f"line 1: the column {name} is missing" for name in COLUMNS[:2] if name not in head]
    for name in dict.fromkeys(head):
        if name not in COLUMNS:
            wrong.append(f"line 1: there is no option {name!r}; allowed: {', '.join(COLUMNS)}")
        elif head.count(name) > 1:
            wrong.append(f"line 1: the column {name} stands there twice")
    return wrong


def _patient(head: list[str], cells: list[str], folder: Path) -> Patient:
    """Raises InputError, msgspec.ValidationError: a cell that is not allowed."""
    if len(cells) != len(head):
        raise InputError(f"{len(cells)} cells under {len(head)} columns")
    given = {name: cell for name, cell in zip(head, cells, strict=True) if cell}
    name, source = given.pop("name", ""), given.pop("input", "")
    if not _NAME.fullmatch(name):
        raise InputError(f"the name {name!r} is not allowed: letters, digits, . _ - (64 at most)")
    if not source:
        raise InputError(f"{name} has no input")
    steps = {column: given.pop(column) for column in _LEAST if column in given}
    for column, cell in steps.items():
        if not cell.isdecimal() or int(cell) < _LEAST[column]:
            raise InputError(
                f"{column} {cell!r} is not a whole number of at least {_LEAST[column]}"
            )
    asked: dict[str, Any] = {"name" if key == "organ_name" else key: v for key, v in given.items()}
    asked |= {key: asked[key].split() for key in ("organ_hu", "tumor_hu") if key in asked}
    options = msgspec.convert(asked, PrepareOptions, strict=False)  # of words, numbers
    prepare = {key: getattr(options, key) for key in asked}
    counts = {column: int(cell) for column, cell in steps.items()}
    return Patient(name=name, source=folder / source, prepare=prepare, **counts)


def hashed(path: Path) -> File:
    """A user's file or folder with its content's sha256, computed each time (about a second for a
    folder of CT slices); where it cannot be read, with ``MISSING``."""
    try:
        return File(str(path.absolute()), store.sha256_of(path))
    except OSError:
        return File(str(path.absolute()), MISSING)
