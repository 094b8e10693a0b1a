"""Commands killed (kill -9) at random moments, and what is left.

python tests/support/crashes.py FOLDER [--times 20] [--seed 0] [--only NAME]    (`make crash`)

A killed training goes on to the weights of one that was never killed. A case whose first model was
being made is whole, and gets its model by the same command. A killed recording can be
read to its last second. After a killed `locate` there is the old run or the new one,
never a part, and the same command works. Nothing else stays in the folder.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from attacks import make_base
from clock import PATIENCE_S, until
from stories import COMMAND, environment

_LOST_S = 1.0  # of a recording, and the longest pause between two of its frames: on a busy machine
Check = Callable[[], str]  # what is wrong, or nothing


def started(arguments: list[object]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment(),
        start_new_session=True,
    )


def killed(arguments: list[object], after_s: float) -> bool:
    """Run a command and kill it, and whatever it started, after so long; False: it had ended."""
    process = started(arguments)
    try:
        process.wait(after_s)
        return False
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True


def whole(arguments: list[object]) -> tuple[float, str]:
    """A command to its end: seconds, and what it said where it failed."""
    start = time.perf_counter()
    done = subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, env=environment()
    )
    return time.perf_counter() - start, done.stderr if done.returncode not in (0, 4) else ""


def strays(folder: Path, *expected: str) -> str:
    """Names in the folder that nobody asked for."""
    return ", ".join(sorted({path.name for path in folder.iterdir()} - {*expected}))


def training(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    """Killed again and again until it ended, the next likewise, ``times`` times in all."""
    from tumortrack.core.store import sha256_of

    options = ["--preset", "quick", "--steps", 100, "--seed", 1, "--workers", 0, "--device", "cpu"]
    takes_s, fault = whole(["train", base / "case", folder / "undisturbed", *options])
    if fault:
        return fault
    kills, names = 0, []
    while kills < times:
        names.append(f"killed{len(names)}")
        command = ["train", base / "case", folder / names[-1], *options]
        while kills < times and killed(command, rng.uniform(0.2, 0.5 * takes_s)):
            kills += 1
        if not (folder / names[-1] / "manifest.json").exists():
            _, fault = whole(command)
        if fault:
            return fault
        ours, theirs = (folder / n / "weights.safetensors" for n in (names[-1], "undisturbed"))
        if sha256_of(ours) != sha256_of(theirs):
            return f"other weights after {kills} kills"
    return strays(folder, "undisturbed", *names)


def making(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    """The first command that needs a case's model, killed while it makes it."""
    from tumortrack.core.store import read_manifest

    case = folder / "case"
    shutil.copytree(base / "case", case, ignore=shutil.ignore_patterns("model"))
    there = {path.name for path in case.iterdir()} | {"model"}
    takes_s, fault = whole(["compile", case])
    for _ in range(times):
        if fault:
            return fault
        shutil.rmtree(case / "model")
        killed(["compile", case], rng.uniform(0.3, 1.1) * takes_s)
        read_manifest(case, "case")  # whole
        if (case / "model").exists():
            read_manifest(case / "model", "model")
        _, fault = whole(["compile", case])
    return fault or strays(case, *there) or strays(folder, "case")


def locating(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    cloud = base / "scenes" / "0000" / "cloud.ply"
    command: list[object] = ["locate", base / "model", cloud, folder / "run", "--device", "cpu"]
    return _writing(command, folder, "run", "run", times, rng)


def _writing(
    command: list[object], folder: Path, name: str, kind: str, times: int, rng: np.random.Generator
) -> str:
    """A command that writes an artifact, new and over an old one."""
    from tumortrack.core.store import read_manifest

    takes_s, fault = whole(command)
    for _ in range(times):
        if fault:
            return fault
        killed([*command, "--overwrite"], rng.uniform(0.5, 1.1) * takes_s)
        if not (folder / name).exists():
            return f"{name} is gone"
        read_manifest(folder / name, kind)  # whole
        _, fault = whole([*command, "--overwrite"])
    return fault or strays(folder, name)


def recording(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    for number in range(times):
        place = folder / f"tape{number}"
        command: list[object] = ["track", base / "model", f"virtual:{base / 'case'}?fps=10"]
        command += [f"recording:{place}", "--device", "cpu", "--stale", 5]
        process = started([*command, "--report", folder / f"report{number}.json"])
        try:
            _wait_for_chunks(place, process)
            time.sleep(rng.uniform(0, 6))
            killed_ns = time.time_ns()
            if process.poll() is not None:
                return "it ended by itself"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        stamps = [*stamps_of(place), killed_ns]
        *pauses_s, lost_s = np.diff(stamps) * 1e-9
        if lost_s > _LOST_S + max(pauses_s, default=0.0):
            return f"{place.name} has {len(pauses_s)} frames and lacks the last {lost_s:.1f} s"
        shutil.rmtree(place)
    return ""


def _wait_for_chunks(place: Path, process: subprocess.Popen[bytes]) -> None:
    """Until the first are on the disk."""

    def there() -> bool:
        sizes = [path.stat().st_size for path in place.rglob("*.mcap")]
        return sum(sizes) > 2**20 or process.poll() is not None

    until(there, "a tape", 5 * PATIENCE_S)


def stamps_of(tape: Path) -> list[int]:
    """The stamps (ns) of the frames that can be played."""
    from tumortrack.live.spec import SOURCES
    from tumortrack.live.values import SourceEnded

    stamps, source = [], SOURCES.parse(f"recording:{tape}?rate=0").open()
    try:
        while (seen := source.read(1.0)) is not None:
            stamps.append(seen.stamp_ns)
    except SourceEnded:
        pass
    finally:
        source.close()
    return stamps


KINDS = {each.__name__: each for each in (training, making, locating, recording)}


def make_bases(folder: Path) -> Path:
    """A case, a model, a scene, a run and a plan, made once."""
    base = folder.resolve() / "base"
    if not base.exists():
        base.mkdir(parents=True)
        make_base(base)
    return base


def main() -> int:
    parser = argparse.ArgumentParser(description="commands killed at random moments")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    base = make_bases(given.folder)
    faults = 0
    for name, kind in KINDS.items():
        if given.only in ("", name):
            folder = given.folder.resolve() / f"{name}-{given.seed}-{time.time_ns()}"
            folder.mkdir()
            start = time.perf_counter()
            fault = kind(base, folder, given.times, np.random.default_rng(given.seed))
            faults += bool(fault)
            seconds = time.perf_counter() - start
            print(
                f"{fault or 'ok':20} {name}, killed {given.times} times, {seconds:.0f} s",
                flush=True,
            )
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
