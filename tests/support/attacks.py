"""Hostile files and calls: each must end in one clear line, in bounded time and memory.

python tests/support/attacks.py FOLDER [NAME ...]    make them in FOLDER, run them, print a table

The attacks are in attack_*.py, by kind of input. What the command may do is in ``Outcome``.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

import attack_artifacts  # noqa: F401  each adds its attacks
import attack_clouds  # noqa: F401
import attack_series  # noqa: F401
import attack_volumes  # noqa: F401
from attack_registry import ATTACKS, FINISH, MUST_FINISH

SECONDS, MEGABYTES = 20.0, 1024
WITHOUT_BASE = (  # how the names of attacks begin that need nothing but their own folder
    *("nifti_", "gzip_", "labels_", "nrrd_", "mha_", "volume_", "name_", "target_"),
    *("dicom_", "mesh_"),
)


@dataclass(frozen=True)
class Outcome:
    """What became of an attack. ``fault``: empty where all is as it must be."""

    name: str
    code: int
    seconds: float
    megabytes: float
    line: str
    fault: str


def make_base(folder: Path) -> None:
    """What attacks start from: a case of the phantom, both kinds of model, scenes, a run and a plan
    of it."""
    from stories import write_phantom_case

    write_phantom_case(folder / "case")
    here = {"case": folder / "case", "model": folder / "model", "scenes": folder / "scenes"}
    quick = ("--preset", "quick", "--steps", 12, "--workers", 0, "--device", "cpu")
    for arguments in (
        ("train", here["case"], here["model"]),
        ("train", here["case"], folder / "network", *quick),
        ("simulate", here["case"], here["scenes"], "--scenes", 1),
        ("locate", here["model"], here["scenes"] / "0000" / "cloud.ply", folder / "run"),
        ("plan", folder / "run", folder / "plan", "--accept-poor", "--accept-budget"),
    ):
        code, output, *_ = run([str(argument) for argument in arguments], folder, 300)
        if code and (arguments[0], code) != ("locate", 4):  # poor
            raise SystemExit(f"{arguments[0]}: {output}")


def run(arguments: list[str], folder: Path, seconds: float) -> tuple[int, str, float, float]:
    """A command in a fork of this process: exit code (-9: it ran too long or took too much
    memory), what it said, seconds, and megabytes beyond what the fork began with."""
    with tempfile.TemporaryFile() as said:
        started = time.perf_counter()
        child = os.fork()
        if not child:
            _become(arguments, folder, said.fileno())
        before_mb, most_mb = _resident_mb(child), 0.0
        while True:
            done, status, _ = os.wait4(child, os.WNOHANG)
            took_s = time.perf_counter() - started
            if done:
                break
            most_mb = max(most_mb, _resident_mb(child) - before_mb)
            if took_s > seconds or most_mb > 4 * MEGABYTES:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.005)
        said.seek(0)
        output = said.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(status), output, took_s, most_mb


def _become(arguments: list[str], folder: Path, output: int) -> None:
    code = 70
    try:
        from tumortrack.cli.main import run as command

        os.chdir(folder)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = command(arguments)
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 1
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _resident_mb(process: int) -> float:
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * 4096 / 2**20
    except (OSError, IndexError):  # it has just ended
        return 0.0


def outcome(name: str, folder: Path, base: Path) -> Outcome:
    """Make one attack in an empty folder, and run it."""
    folder.mkdir(parents=True)
    arguments = [
        os.fspath(one) if isinstance(one, Path) else str(one) for one in ATTACKS[name](folder, base)
    ]
    before = set(_below(folder))
    # What may end well does the whole work: it compiles, beside whatever else the machine does.
    allowed_s = (6 if name in FINISH else 1) * SECONDS
    code, output, seconds, megabytes = run(arguments, folder, allowed_s)
    lines = [line for line in output.strip().splitlines() if line.startswith("tumortrack: ")]
    line = lines[-1] if lines else (output.strip().splitlines() or [""])[-1]
    left = [path for path in _below(folder) if path not in before]
    return Outcome(
        name,
        code,
        seconds,
        megabytes,
        line,
        _fault(name, code, output, lines, left, seconds > allowed_s / 2, megabytes),
    )


def _below(folder: Path) -> list[str]:
    return [os.path.join(at, name) for at, _, names in os.walk(folder) for name in names]


def _fault(
    name: str,
    code: int,
    output: str,
    lines: list[str],
    left: list[str],
    slow: bool,
    megabytes: float,
) -> str:
    if code < 0:
        return f"killed ({signal.Signals(-code).name})"
    if "Traceback" in output:
        return "traceback"
    if "Warning: " in output:  # Python's, as NumPy gives
        return "warning"
    if slow:
        return "slow"
    if megabytes > MEGABYTES:
        return "memory"
    if code == 0 or "\nwritten to" in output:  # `locate` ends with 4 where an estimate is poor
        return "" if name in FINISH else "accepted"
    if name in MUST_FINISH:
        return "refused"
    if len(lines) != 1 or code == 1:
        return "no clear line"
    page = any(path.endswith("index.html") for path in left)  # why there is no estimate
    whole = {"report.json", *(("index.html", "picture.png", "manifest.json") if page else ())}
    strays = [path for path in left if os.path.basename(path) not in whole]
    return f"left {strays[0]}" if strays else ""


def main(folder: Path, names: list[str]) -> int:
    import warm

    for module in warm.PRELOADED:
        __import__(module)
    base, names = folder / "base", names or list(ATTACKS)
    if not base.exists() and not all(name.startswith(WITHOUT_BASE) for name in names):
        base.mkdir(parents=True)
        make_base(base)
    faults = 0
    with tempfile.TemporaryDirectory(dir=folder) as work:
        for name in names:
            done = outcome(name, Path(work, name), base)
            faults += bool(done.fault)
            print(
                f"{done.fault or 'ok':14} {name:40} {done.code:4} {done.seconds:6.2f} s "
                f"{done.megabytes:6.0f} MB  {done.line[:150]}",
                flush=True,
            )
    print(f"{len(names)} attacks, {faults} faults")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), sys.argv[2:]))
