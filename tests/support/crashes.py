"""Commands that are killed (kill -9), run short of something, or meet another of their kind.

python tests/support/crashes.py FOLDER [--times 20] [--seed 0] [--only NAME ...]    (`make crash`)

Each must succeed or end in one clear line, and lose nothing; a row in Markdown says what it did.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clock import PATIENCE_S, until
from harness import Child, Ending, Work, base_in, command, new_command
from tumortrack.core.errors import TumortrackError
from tumortrack.core.store import read_json, read_manifest

_LONG_S = 12.0  # within which commands are interrupted
_STOPPING_S = 60.0  # after which a command that does not stop is killed, and so seen
_FINISHING_S = 10.0  # within which a command may end as if it had not been interrupted
_NOISE = ("Traceback", "Exception ignored", "Fatal Python error", "terminate called", "Warning: ")
_SOME_FRAMES = 6 * 2**20  # bytes, of which one frame has 2 MB at most: then its pauses are known
_LOST_S = 1.0  # of a recording, and the longest pause between two of its frames: on a busy machine
Words = tuple[object, ...]  # of a command


class Wrong(Exception):
    """What is not as it must be."""


def require(good: bool, what: str) -> str:
    if not good:
        raise Wrong(what)
    return what


@dataclass(frozen=True)
class Place:
    """An empty folder, and the one with case, model and scenes (``base_in``)."""

    base: Path
    folder: Path
    times: int  # to be killed
    rng: np.random.Generator

    def locate(self, out: Path) -> Words:
        cloud = self.base / "scenes" / "0000" / "cloud.ply"
        return ("locate", self.base / "model", cloud, out, "--device", "cpu")

    def train(self, name: str, steps: int = 12) -> Words:
        options = ("--steps", steps, "--seed", 1, "--workers", 0, "--device", "cpu")
        return ("train", self.base / "case", self.folder / name, "--preset", "quick", *options)

    def track(self, *sinks: str, seconds: float = 10) -> Words:
        report = self.folder / f"report{time.time_ns()}.json"
        source = f"virtual:{self.base / 'case'}?fps=8"
        options = ("--device", "cpu", "--stale", 5, "--seconds", seconds, "--report", report)
        return ("track", self.base / "model", source, *sinks, *options)

    def only(self, *expected: str) -> None:
        """Nothing else stays in the folder."""
        strays = sorted(names_in(self.folder) - {*expected})
        require(not strays, f"left behind: {strays}")


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# Killed ---------------------------------------------------------------------------------------


def killed(words: Words, after_s: float) -> bool:
    """Run a command and kill it, and whatever it started, after so long; False: it had ended."""
    return Child(command(*words)).end(after_s).code < 0


def whole(words: Words) -> float:
    """A command to its end: seconds."""
    ending = Child(command(*words)).end()
    require(ending.code in (0, 4), f"exit {ending.code}: {ending.line}")  # 4: located, and poor
    return ending.seconds


def training(place: Place) -> str:
    """A training killed again and again until it ended, and the next likewise"""
    from tumortrack.core.store import sha256_of

    takes_s = whole(place.train("undisturbed", 100))
    kills, names = 0, list[str]()
    while kills < place.times:
        names.append(f"killed{len(names)}")
        words = place.train(names[-1], 100)
        while kills < place.times and killed(words, place.rng.uniform(0.2, 0.5 * takes_s)):
            kills += 1
        if not (place.folder / names[-1] / "manifest.json").exists():
            whole(words)
        weights = (place.folder / n / "weights.safetensors" for n in (names[-1], "undisturbed"))
        require(len(set(map(sha256_of, weights))) == 1, f"other weights after {kills} kills")
    place.only("undisturbed", *names)
    return "the weights of one that was never killed"


def making(place: Place) -> str:
    """The first command that needs a case's model, killed while it makes it"""
    case = place.folder / "case"
    shutil.copytree(place.base / "case", case, ignore=shutil.ignore_patterns("model"))
    files = names_in(case) | {"model"}
    takes_s = whole(("compile", case))
    for _ in range(place.times):
        shutil.rmtree(case / "model")
        killed(("compile", case), place.rng.uniform(0.3, 1.1) * takes_s)
        read_manifest(case, "case")  # whole
        if (case / "model").exists():
            read_manifest(case / "model", "model")
        whole(("compile", case))
    place.only("case")
    require(names_in(case) <= files, f"left behind: {sorted(names_in(case) - files)}")
    return "the case is whole, and gets its model by the same command"


def locating(place: Place) -> str:
    """`locate` onto an older run, killed"""
    run = place.folder / "run"
    words = (*place.locate(run), "--overwrite")
    takes_s = whole(words)
    for _ in range(place.times):
        killed(words, place.rng.uniform(0.5, 1.1) * takes_s)
        require(run.exists(), "the run is gone")
        read_manifest(run, "run")  # whole
        whole(words)
    place.only("run")
    return "the old run or the new one, never a part; the same command works"


def recording(place: Place) -> str:
    """A recording, killed"""
    for _ in range(place.times):
        tape = place.folder / "tape"
        child = Child(command(*place.track(f"recording:{tape}", seconds=600)))

        def on_disk(child: Child = child, tape: Path = tape) -> bool:
            sizes = [path.stat().st_size for path in tape.rglob("*.mcap")]
            return sum(sizes) > _SOME_FRAMES or not child.running()

        try:
            until(on_disk, "a tape", 5 * PATIENCE_S)
            time.sleep(place.rng.uniform(0, 6))
            killed_ns = time.time_ns()
            require(child.running(), "it ended by itself")
        finally:
            child.kill()
            child.end()
        *pauses_s, lost_s = np.diff([*stamps_of(tape), killed_ns]) * 1e-9
        what = f"{len(pauses_s)} frames are played, the last {lost_s:.1f} s are lost"
        require(lost_s <= _LOST_S + max(pauses_s, default=0.0), what)
        shutil.rmtree(tape)
    return "can be read to its last second"


def stamps_of(tape: Path) -> list[int]:
    """The stamps (ns) of the frames that can be played."""
    from tumortrack.live.spec import SOURCES
    from tumortrack.live.values import SourceEnded

    stamps, source = [], SOURCES.parse(f"recording:{tape}?rate=0").open()
    try:
        while (frame := source.read(1.0)) is not None:
            stamps.append(frame.stamp_ns)
    except SourceEnded:
        pass
    finally:
        source.close()
    return stamps


# Interrupted ----------------------------------------------------------------------------------


def long_commands(place: Place) -> tuple[Words, ...]:
    case, out, scenes = place.base / "case", place.folder / "out", place.base / "scenes"
    world = f"virtual:{case}?breathing=false&instrument=false&camera_motion=false&fps=10"
    budget = ("--accept-poor", "--accept-budget")
    return (
        ("prepare", case / "labels.nii.gz", out),
        ("simulate", case, out, "--scenes", 8),
        ("train", case, out),
        ("locate", place.base / "model", scenes / "0000" / "cloud.ply", out),
        ("evaluate", place.base / "model", scenes, out),
        ("track", case, world, "viewer:0", "openigtlink:0", f"recording:{out}", "--seconds", 8),
        ("export", case, out),
        ("plan", place.base / "run", out, *budget),
        ("resect", place.base / "plan", "--film", f"{out}.gif"),
        ("resect", place.base / "plan", "--live", case, world, "--speed", 10),
        ("demo", "--out", out, "--scenes", 1),
        ("phantom-kit", case, out),
        ("twin", case, out),
    )


def interrupting(place: Place) -> str:
    """Every long command, interrupted (Ctrl-C) at a random moment"""
    outcomes, faults = dict[str, dict[str, int]](), list[str]()
    for words in long_commands(place):
        name = f"{words[0]} {str(words[2]).strip('-')}" if words[0] == "resect" else str(words[0])
        mine = outcomes.setdefault(name, {})
        for _ in range(place.times):
            after_s = place.rng.uniform(0.05, _LONG_S)
            child = Child(new_command(*words), place.folder)
            time.sleep(after_s)
            running = child.running()
            child.interrupt()
            ending = child.end(after_s + _STOPPING_S)
            what, wrong = _interrupted(ending, running, place.folder)
            if ending.code == 0 and ending.seconds > after_s + _FINISHING_S and name != "track":
                wrong += "not stopped"
            mine[what] = mine.get(what, 0) + 1
            said = f"{name} after {after_s:.2f} s: exit {ending.code}: {ending.output[-600:]}"
            faults += [f"{wrong}: {said}"] if wrong else []
            shutil.rmtree(place.folder)
            place.folder.mkdir()
    counts = "; ".join(
        f"{name}: " + ", ".join(f"{count} {what}" for what, count in sorted(mine.items()))
        for name, mine in outcomes.items()
    )
    return require(not faults, " / ".join([*faults, counts])) and counts


def _interrupted(ending: Ending, running: bool, folder: Path) -> tuple[str, str]:
    """How a command ended after Ctrl-C, and what is wrong with that, if anything."""
    wrong = [noise for noise in _NOISE if noise in ending.output]
    if ending.code not in (0, 4, 130, -signal.SIGINT):
        wrong.append(f"exit {ending.code}")
    if ending.code == 130 and ending.refusals != [ending.line]:
        wrong.append(f"{len(ending.refusals)} lines, or not the last")
    strays = names_in(folder) - {"out", "out.gif", "runs"}
    strays |= {str(path.relative_to(folder)) for path in folder.rglob(".*")}
    if strays:
        wrong.append(f"left behind: {strays}")
    for manifest in folder.rglob("manifest.json"):
        try:
            read_manifest(manifest.parent, read_json(manifest)["kind"])
        except TumortrackError as error:
            wrong.append(str(error))
    if (
        ending.code == -signal.SIGINT
    ):  # a Python that has hardly begun, or is ending: 130 to a shell
        return "by the signal", "; ".join(wrong)
    if not running:
        return "had ended", "; ".join(wrong)
    return f"with {ending.code}", "; ".join(wrong)


# Short of something ---------------------------------------------------------------------------


def ended(words: Words, limits: Mapping[int, int] = {}, environ: Mapping[str, str] = {}) -> Ending:
    """How a Python started anew ends; 0 or one clear line."""
    return judged(Child(new_command(*words, environ=environ), limits=limits))


def judged(child: Child) -> Ending:
    ending = child.end()
    require("Traceback" not in ending.output, f"exit {ending.code}: {ending.output}")
    return ending


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


def _refused(words: Words, disk: Path) -> str:
    ending, left = ended(words), names_in(disk)
    what = f"exit {ending.code}: {ending.line}; left behind: {left or 'nothing'}"
    return require(ending.code == 2 and not left, what)


def full_disk_locate(place: Place) -> str:
    """`locate` onto a disk of 100 kB"""
    with small_disk(place.folder / "disk", "size=100k") as disk:
        return _refused(place.locate(disk / "run"), disk)


def full_disk_train(place: Place) -> str:
    """`train` onto a disk of 2 MB"""
    with small_disk(place.folder / "disk", "size=2m") as disk:
        return _refused(("train", place.base / "case", disk / "model"), disk)


def full_disk_record(place: Place) -> str:
    """`track` with a recording onto a disk of 20 MB"""
    with small_disk(place.folder / "disk", "size=20m") as disk:
        tape = f"recording:{disk / 'tape'}"
        ending = ended(place.track(tape))
        frames = len(stamps_of(disk / "tape"))
    report = json.loads(next(place.folder.glob("report*.json")).read_text())
    results = report["estimates"]["good"] + report["estimates"]["poor"]
    error = report["sinks"][tape]["last_error"]
    return require(
        ending.code == 0 and frames > 10 and results > 2 * frames and "No space left" in error,
        f"exit {ending.code}: {results} estimates went on, {frames} frames are played; "
        f"the sink: {error}",
    )


def read_only_home(place: Place) -> str:
    """`locate` with home and caches read-only"""
    with small_disk(place.folder / "home", "size=1m,ro") as home:
        environ = {"HOME": str(home), "XDG_CACHE_HOME": str(home / "c"), "MPLCONFIGDIR": ""}
        environ |= {"XDG_CONFIG_HOME": str(home)}
        ending = ended(place.locate(place.folder / "run"), environ=environ)
    return require(ending.code in (0, 4), f"exit {ending.code}: {ending.line}")


def clock_set_back(place: Place) -> str:
    """The clock is set back by an hour during `track`"""
    words = place.track(seconds=25)

    def work() -> int:
        right, end = time.time_ns, time.monotonic() + 25
        time.time_ns = lambda: right() - (3600 * 10**9 if time.monotonic() > end else 0)
        return command(*words)()

    ending = judged(Child(work))
    report = json.loads(next(place.folder.glob("report*.json")).read_text())
    return require(
        ending.code == 0 and report["clock_jumps"] == 1 and not report["defects"],
        f"exit {ending.code}: {report['clock_jumps']} jump noticed, "
        f"{report['estimates']['good']} good, "
        f"{report['no_estimate']} none ({'; '.join(report['reasons'])})",
    )


def memory_of_3_gb(place: Place) -> str:
    """`train`, `locate` and `track` with 3 GB of memory (RLIMIT_DATA)"""
    return _all_of(place, {resource.RLIMIT_DATA: 3 * 2**30})


def handles_64(place: Place) -> str:
    """`train`, `locate`, and `track` with viewer, OpenIGTLink and a recording, 64 open files"""
    return _all_of(place, {resource.RLIMIT_NOFILE: 64})


def _all_of(place: Place, limits: Mapping[int, int]) -> str:
    tape = place.folder / "tape"
    endings = [
        ended(words, limits)
        for words in (
            place.train("model"),
            place.locate(place.folder / "run"),
            place.track("viewer:0", "openigtlink:0", f"recording:{tape}"),
        )
    ]
    good = all(ending.code in (0, 4) for ending in endings) and len(stamps_of(tape)) > 10
    return require(good, "; ".join(f"exit {each.code}: {each.line}" for each in endings))


# Two at once ----------------------------------------------------------------------------------


def two_trainings(place: Place) -> str:
    """Two trainings into one folder"""
    return _one_of_two(new_command(*place.train("model")), place, "model")


def two_locates(place: Place) -> str:
    """Two `locate` into one folder"""
    return _one_of_two(new_command(*place.locate(place.folder / "run")), place, "run")


def two_recordings(place: Place) -> str:
    """Two recordings into one folder"""
    tape = place.folder / "tape"
    what = _one_of_two(new_command(*place.track(f"recording:{tape}")), place, "tape")
    frames = len(stamps_of(tape))
    return require(frames > 10, f"{what}; {frames} frames are played")


def _one_of_two(work: Work, place: Place, expected: str) -> str:
    one, other = sorted(map(judged, (Child(work), Child(work))), key=lambda ending: ending.code)
    for report in place.folder.glob("report*.json"):
        report.unlink()
    place.only(expected)
    what = f"one: exit {one.code}; the other: exit {other.code}: {other.line}"
    return require((one.code, other.code) == (0, 2), what)


KILLS = {each.__name__: each for each in (training, making, locating, recording, interrupting)}
CIRCUMSTANCES = KILLS | {
    each.__name__: each
    for each in (
        *(full_disk_locate, full_disk_train, full_disk_record, read_only_home, clock_set_back),
        *(memory_of_3_gb, handles_64, two_trainings, two_locates, two_recordings),
    )
}


def main() -> int:
    parser = argparse.ArgumentParser(description="commands killed, or short of something")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=CIRCUMSTANCES, default=list(CIRCUMSTANCES))
    parser.add_argument("--slim", action="store_true", help="cases' models are made in seconds")
    given = parser.parse_args()
    base, faults = base_in(given.folder), 0
    if given.slim:  # in forks of this process
        from tumortrack.tracking import model_files
        from warp_objects import slim_clinic

        model_files.clinic = lambda *_: slim_clinic()  # type: ignore[attr-defined]
    print("| what was done | what happened | |\n|---|---|---|")
    for name in given.only:
        circumstance, folder = CIRCUMSTANCES[name], given.folder.resolve() / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        times = f", {given.times} times" if name in KILLS else ""
        rng = np.random.default_rng(given.seed)
        try:
            what, verdict = circumstance(Place(base, folder, given.times, rng)), "as it must be"
        except PermissionError as error:
            what, verdict = f"not tried: {error}", "-"
        except Wrong as wrong:
            what, verdict = str(wrong), "WRONG"
        faults += verdict == "WRONG"
        what = what.replace(str(folder) + os.sep, "").replace(str(folder), ".")
        print(f"| {circumstance.__doc__}{times} | {what} | {verdict} |", flush=True)
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
