"""The folder of an evaluation's report: whether it may be replaced, and its removal."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from tumortrack.core.errors import InputError
from tumortrack.core.store import read_json, writing

_OURS = {"scenes", "index.html", "report.json"}


def check_place(out: Path, overwrite: bool) -> None:
    """Raises InputError if a report cannot be written there: ``overwrite`` replaces only an empty
    folder, or an earlier report without other files in it."""
    if not out.exists():
        return
    if not overwrite:
        raise InputError(
            f"{out} exists already. Choose another path, or give --overwrite (overwrite=True)."
        )
    if not out.is_dir():
        raise InputError(f"{out} is a file; --overwrite replaces only a report's folder.")
    if not (inside := {path.name for path in out.iterdir()}):
        return
    report = read_json(out / "report.json") if "report.json" in inside else {}
    if not ({"rule", "summary", "scenes"} <= report.keys()):
        raise InputError(
            f"{out} is not a report of `evaluate`, so --overwrite does not replace it. Choose "
            "another path, or move the folder away yourself."
        )
    entries = [entry for entry in report["scenes"] if isinstance(entry, dict)]
    pictures = {f"{entry.get('name')}.png" for entry in entries}
    drawn = {path.name for path in (out / "scenes").glob("*")}
    if strays := sorted((inside - _OURS) | (drawn - pictures)):
        raise InputError(
            f"{out} also holds {', '.join(strays[:3])}, which no report has; --overwrite would "
            "lose it. Move it away first, or choose another path."
        )


def clear(out: Path) -> None:
    """Remove a report's files, and the folders if nothing else is in them."""
    with writing(out):
        for name in ("report.json", "index.html"):  # never an old table beside new pictures
            for file in (out / name, *out.glob(f".{name}.*.part")):  # of an interrupted write
                file.unlink(missing_ok=True)
        for pattern in ("*.png", ".*.png.*.part"):
            for picture in (out / "scenes").glob(pattern):
                picture.unlink()
    for folder in (out / "scenes", out):
        with suppress(OSError):
            folder.rmdir()
