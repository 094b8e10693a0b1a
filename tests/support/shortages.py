"""Commands while something runs short or goes wrong: what each did, a row each in Markdown.

python tests/support/shortages.py FOLDER [NAME ...]

A full disk (a small tmpfs where it may be mounted, else a limit on files), home and caches that
cannot be written, a clock that is set back by an hour while tracking, 3 GB of memory, 64 open
files, two processes on one folder. Each must succeed or end in one clear line, and lose nothing.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from crashes import make_bases, stamps_of
from stories import COMMAND, environment

Row = tuple[str, bool]  # what happened, and whether that is as it must be
_CLOCK = """
import sys, time
real, end = time.time_ns, time.monotonic() + float(sys.argv.pop(1))
time.time_ns = lambda: real() - (3_600_000_000_000 if time.monotonic() > end else 0)
from tumortrack.cli.main import main
main()
"""


def command(*arguments: object, **more: object) -> subprocess.Popen[str]:
    environ = environment() | more.pop("environ", {})  # type: ignore[operator]
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environ,
        **more,  # type: ignore[call-overload]
    )


def said(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and last line; a traceback counts as code 70."""
    output, _ = process.communicate(timeout=600)
    lines = output.strip().splitlines() or [""]
    return 70 if "Traceback" in output else process.returncode, lines[-1]


def locating(base: Path, out: Path) -> tuple[object, ...]:
    return ("locate", base / "model", base / "scenes/0000/cloud.ply", out, "--device", "cpu")


def tracking(base: Path, folder: Path, *sinks: str, seconds: float = 10) -> tuple[object, ...]:
    report = folder / f"report{time.time_ns()}.json"
    source = f"virtual:{base / 'case'}?fps=8"
    return (
        *("track", base / "model", source, *sinks, "--device", "cpu", "--stale", 5),
        *("--seconds", seconds, "--report", report),
    )


def training(base: Path, out: Path) -> tuple[object, ...]:
    options = ("--preset", "quick", "--steps", 12, "--workers", 0, "--device", "cpu")
    return ("train", base / "case", out, *options)


@contextmanager
def small_disk(folder: Path, options: str) -> Iterator[Path]:
    """A tmpfs; PermissionError where none may be mounted."""
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]).returncode:
        raise PermissionError("no tmpfs may be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def inside(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def full_disk_locate(base: Path, folder: Path) -> Row:
    """`locate` onto a disk of 100 kB"""
    with small_disk(folder / "disk", "size=100k") as disk:
        code, line = said(command(*locating(base, disk / "run")))
        left = inside(disk)
    return f"exit {code}: {line}; left behind: {left or 'nothing'}", code == 2 and not left


def full_disk_train(base: Path, folder: Path) -> Row:
    """`train` onto a disk of 2 MB"""
    with small_disk(folder / "disk", "size=2m") as disk:
        code, line = said(command("train", base / "case", disk / "model"))
        left = inside(disk)
    return f"exit {code}: {line}; left behind: {left or 'nothing'}", code == 2 and not left


def full_disk_record(base: Path, folder: Path) -> Row:
    """`track` with a recording onto a disk of 20 MB"""
    with small_disk(folder / "disk", "size=20m") as disk:
        tape = f"recording:{disk / 'tape'}"
        code, _ = said(command(*tracking(base, folder, tape)))
        frames = len(stamps_of(disk / "tape"))
    report = json.loads(next(folder.glob("report*.json")).read_text())
    results = report["estimates"]["good"] + report["estimates"]["poor"]
    error = report["sinks"][tape]["last_error"]
    good = code == 0 and frames > 10 and results > 2 * frames and "No space left" in error
    text = (
        f"exit {code}: {results} estimates went on, {frames} frames are played; the sink: {error}"
    )
    return text, good


def read_only_home(base: Path, folder: Path) -> Row:
    """`locate` with home and caches read-only"""
    with small_disk(folder / "home", "size=1m,ro") as home:
        environ = {"HOME": str(home), "XDG_CACHE_HOME": str(home / "c"), "MPLCONFIGDIR": ""}
        environ |= {"NUMBA_CACHE_DIR": str(home / "numba"), "XDG_CONFIG_HOME": str(home)}
        code, line = said(command(*locating(base, folder / "run"), environ=environ))
    return f"exit {code}: {line}", code in (0, 4)  # 4: located, and poor


def clock_set_back(base: Path, folder: Path) -> Row:
    """The clock is set back by an hour during `track`"""
    arguments = map(str, tracking(base, folder, seconds=25))
    done = subprocess.run(
        [sys.executable, "-c", _CLOCK, "25", *arguments],
        capture_output=True,
        text=True,
        env=environment(),
    )
    report = json.loads(next(folder.glob("report*.json")).read_text())
    counts = f"{report['clock_jumps']} jump noticed, {report['estimates']['good']} good, "
    counts += f"{report['no_estimate']} none ({'; '.join(report['reasons'])})"
    good = done.returncode == 0 and report["clock_jumps"] == 1 and not report["defects"]
    return f"exit {done.returncode}: {counts}", good


def _limited(what: int, limit: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(what, (limit, limit))


def memory_of_3_gb(base: Path, folder: Path) -> Row:
    """`train`, `locate` and `track` with 3 GB of memory (RLIMIT_DATA)"""
    limit = _limited(resource.RLIMIT_DATA, 3 * 2**30)
    return _all_of(base, folder, preexec_fn=limit)


def handles_64(base: Path, folder: Path) -> Row:
    """`train`, `locate`, and `track` with viewer, OpenIGTLink and a recording, 64 open files"""
    return _all_of(base, folder, preexec_fn=_limited(resource.RLIMIT_NOFILE, 64))


def _all_of(base: Path, folder: Path, **how: object) -> Row:
    sinks = ("viewer:0", "openigtlink:0", f"recording:{folder / 'tape'}")
    ends = [
        said(command(*arguments, **how))
        for arguments in (
            training(base, folder / "model"),
            locating(base, folder / "run"),
            tracking(base, folder, *sinks),
        )
    ]
    text = "; ".join(f"exit {code}: {line}" for code, line in ends)
    return text, all(code in (0, 4) for code, _ in ends) and len(stamps_of(folder / "tape")) > 10


def two_trainings(base: Path, folder: Path) -> Row:
    """Two trainings into one folder"""
    return _one_of_two(_together(training(base, folder / "model")), folder, {"model"})


def two_locates(base: Path, folder: Path) -> Row:
    """Two `locate` into one folder"""
    return _one_of_two(_together(locating(base, folder / "run")), folder, {"run"})


def two_recordings(base: Path, folder: Path) -> Row:
    """Two recordings into one folder"""
    tape = folder / "tape"
    ends = _together(tracking(base, folder, f"recording:{tape}"))
    frames = len(stamps_of(tape))
    for report in folder.glob("report*.json"):
        report.unlink()
    text, good = _one_of_two(ends, folder, {"tape"})
    return f"{text}; {frames} frames are played", good and frames > 10


def _together(arguments: tuple[object, ...]) -> list[tuple[int, str]]:
    both = [command(*arguments), command(*arguments)]
    return sorted(said(one) for one in both)


def _one_of_two(ends: list[tuple[int, str]], folder: Path, expected: set[str]) -> Row:
    (code, _), (other, line) = ends
    strays = inside(folder) - expected
    text = f"one: exit {code}; the other: exit {other}: {line}"
    return text + (f"; left behind: {strays}" if strays else ""), (
        code == 0 and other == 2 and not strays
    )


ALL = (
    *(full_disk_locate, full_disk_train, full_disk_record, read_only_home, clock_set_back),
    *(memory_of_3_gb, handles_64, two_trainings, two_locates, two_recordings),
)


def main(folder: Path, names: list[str]) -> int:
    base, wrong = make_bases(folder), 0
    print("| what was done | what happened | |\n|---|---|---|")
    for test in ALL:
        if names and test.__name__ not in names:
            continue
        place = folder / test.__name__
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        try:
            text, good = test(base, place)
        except PermissionError as error:
            text, good = f"not tried: {error}", True
        wrong += not good
        text = text.replace(str(place) + os.sep, "").replace(str(place), ".")
        print(f"| {test.__doc__} | {text} | {'as it must be' if good else 'WRONG'} |", flush=True)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), sys.argv[2:]))
