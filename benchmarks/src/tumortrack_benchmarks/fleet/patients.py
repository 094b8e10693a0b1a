"""LIST: a CSV table with a row a patient: name, input, options that differ from the defaults."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from tumortrack.case.options import PrepareOptions
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack_benchmarks.fleet.run import File

_LARGEST = 64 * 2**20  # bytes
MISSING = "missing"  # instead of a sha256: no file has it
# Options of `prepare`, ``name`` under another name: a list's is the row's.
_OF_PREPARE = (
    *("organ_name", "side", "up", "patient", "organ", "tumor", "series", "unit", "min_tumor_ml"),
    *("organ_hu", "tumor_hu", "rotations", "tilt", "sensor"),
)
Some = Annotated[int, Meta(ge=1)]


@dataclass(frozen=True, kw_only=True)
class Patient:
    """A row of a list. ``input``: what `prepare` takes; ``prepare``: its options; ``seed``: of
    states; ``margin_states``: simulated, for calibrating margins; ``test_states``: others, for
    evaluating the model; ``views``: of each of these."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    input: Path
    seed: Annotated[int, Meta(ge=0)] = 0
    margin_states: Some = 14
    test_states: Some = 14
    views: Some = 2
    prepare: dict[str, Any] = field(default_factory=dict)


COLUMNS = (*(each.name for each in fields(Patient) if each.name != "prepare"), *_OF_PREPARE)


def read_list(path: Path) -> list[Patient]:
    """The patients of a list; inputs are relative to it. Whether they exist is not checked here.
    Raises InputError: no such file, or unusable rows: all are named, with their lines."""
    try:
        text = store.read_file(path, _LARGEST, "Split the list.").decode("utf-8-sig")
        reader = csv.DictReader(io.StringIO(text, newline=""), strict=True, restkey="")
        head = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = head
        wrong = [f"line 1: there is no column {n}" for n in COLUMNS[:2] if n not in head]
        wrong += [
            f"line 1: {name!r} is no option, or stands there twice; allowed: {', '.join(COLUMNS)}"
            for name in dict.fromkeys(head)
            if name not in COLUMNS or head.count(name) > 1
        ]
        patients: dict[str, Patient] = {}
        for row in reader if not wrong else ():
            try:
                patient = _patient(row, path.parent)
                if patient.name in patients:
                    raise InputError(f"{patient.name} has a row already")
                patients[patient.name] = patient
            except (InputError, msgspec.ValidationError) as error:
                wrong.append(f"line {reader.line_num}: {str(error).rstrip('.')}")
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"{path} is no CSV table in UTF-8: {error}.") from error
    if wrong:
        raise InputError(f"{path} cannot be used:\n  " + "\n  ".join(wrong))
    if not patients:
        raise InputError(f"{path} lists no patients; give a row each under name,input.")
    return list(patients.values())


def _patient(row: dict[str, Any], folder: Path) -> Patient:
    """Raises InputError, msgspec.ValidationError: a cell that is not allowed."""
    if "" in row or None in row.values():
        raise InputError("it has more or fewer cells than columns")
    given = {name: cell.strip() for name, cell in row.items() if cell.strip()}
    asked = {name: given.pop(name) for name in _OF_PREPARE if name in given}
    if "organ_name" in asked:
        asked["name"] = asked.pop("organ_name")
    asked |= {key: asked[key].split() for key in ("organ_hu", "tumor_hu") if key in asked}
    options = msgspec.convert(asked, PrepareOptions, strict=False)  # of words, numbers
    prepare = {key: getattr(options, key) for key in asked}
    if "input" in given:
        given["input"] = folder / given["input"]
    return msgspec.convert({**given, "prepare": prepare}, Patient, strict=False)


def hashed(path: Path) -> File:
    """A user's file or folder with its content's sha256, computed each time (about a second for a
    folder of CT slices); where it cannot be read, with ``MISSING``."""
    try:
        return File(str(path.absolute()), store.sha256_of(path))
    except OSError:
        return File(str(path.absolute()), MISSING)
