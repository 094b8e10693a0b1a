"""Commands killed (kill -9) at random moments, and what is left.

python tests/support/crashes.py FOLDER [--times 20] [--seed 0] [--only NAME]

A killed training goes on to the weights of one that was never killed. A killed recording can be
read to its last second. After a killed `locate` or `compile` there is the old artifact or the new
one, never a part, and the same command works. Nothing else stays in the folder.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from attacks import make_base
from stories import COMMAND, environment

Check = Callable[[], str]  # what is wrong, or nothing


def killed(arguments: list[object], after_s: float) -> bool:
    """Run a command and kill it, and whatever it started, after so long; False: it had ended."""
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment(),
        start_new_session=True,
    )
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
    return time.perf_counter() - start, done.stderr if done.returncode else ""


def strays(folder: Path, *expected: str) -> str:
    """Names in the folder that nobody asked for."""
    return ", ".join(sorted({path.name for path in folder.iterdir()} - {*expected}))


def training(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    """Killed ``times`` times, then left alone."""
    from tumortrack.core.store import sha256_of

    options = ["--preset", "clinic", "--steps", 300, "--seed", 1, "--workers", 0, "--device", "cpu"]
    takes_s, fault = whole(["train", base / "case", folder / "undisturbed", *options])
    if fault:
        return fault
    command = ["train", base / "case", folder / "killed", *options]
    for _ in range(times):
        if not killed(command, rng.uniform(0.2, 0.5 * takes_s)):
            break
    _, fault = whole(command) if not (folder / "killed" / "manifest.json").exists() else (0, "")
    if fault:
        return fault
    names = ("weights.safetensors", "shape.safetensors")
    same = all(
        sha256_of(folder / "killed" / name) == sha256_of(folder / "undisturbed" / name)
        for name in names
    )
    return strays(folder, "undisturbed", "killed") or ("" if same else "other weights")


def locating(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    cloud = base / "scenes" / "0000" / "cloud.ply"
    command: list[object] = ["locate", base / "model", cloud, folder / "run", "--device", "cpu"]
    return _writing(command, folder, "run", "run", times, rng)


def compiling(base: Path, folder: Path, times: int, rng: np.random.Generator) -> str:
    import shutil

    shutil.copytree(base / "quick", folder / "model")
    command: list[object] = ["compile", folder / "model"]
    takes_s, fault = whole(command)
    for _ in range(times):
        if fault:
            return fault
        (folder / "model" / "compiled.json").unlink(missing_ok=True)
        killed(command, rng.uniform(0.2, takes_s))
        _, fault = whole(["inspect", folder / "model"])
    _, fault = whole(command)
    return fault or strays(folder, "model")


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
    from tumortrack.core.errors import TumortrackError
    from tumortrack.live.spec import SOURCES
    from tumortrack.live.values import SourceEnded

    for number in range(times):
        place = folder / f"tape{number}"
        command: list[object] = ["track", base / "model", f"virtual:{base / 'case'}"]
        command += [f"recording:{place}", "--device", "cpu", "--report", folder / "report.json"]
        after_s = rng.uniform(6, 12)
        killed(command, after_s)
        tapes = [path for path in (place, *place.rglob("*.mcap")) if path.exists()]
        if not tapes:
            continue  # killed before it began to record
        read, source = 0, SOURCES.parse(f"recording:{place}?rate=0").open()
        try:
            while source.read(1.0) is not None:
                read += 1
        except SourceEnded:
            pass
        except TumortrackError as error:
            return f"after {after_s:.1f} s and {read} frames: {error}"
        finally:
            source.close()
    return ""


KINDS = {each.__name__: each for each in (training, locating, compiling, recording)}


def main() -> int:
    parser = argparse.ArgumentParser(description="commands killed at random moments")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    base = given.folder.resolve() / "base"
    if not base.exists():
        base.mkdir(parents=True)
        make_base(base)
    if not (base / "quick").exists():
        quick = ["--preset", "quick", "--steps", 20, "--workers", 0, "--device", "cpu"]
        whole(["train", base / "case", base / "quick", *quick])
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
