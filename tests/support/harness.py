"""Work in a process of its own, within limits, and how it ended: for hostile files (attacks.py),
damaged input (fuzz.py), and kills and shortages (crashes.py)."""

from __future__ import annotations

import math
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import warm
from stories import COMMAND, environment

Work = Callable[[], int]  # returns an exit code


@dataclass(frozen=True)
class Ending:
    """``code``: -9 where it was killed. ``cpu_s``: of all its cores, which no other program's load
    lengthens by much. ``megabytes``: beyond what the process began with."""

    code: int
    output: str
    seconds: float
    cpu_s: float
    megabytes: float

    @property
    def refusals(self) -> list[str]:
        """The command line's own messages."""
        return [line for line in self.output.splitlines() if line.startswith("tumortrack: ")]

    @property
    def line(self) -> str:
        return ([*self.output.strip().splitlines(), *self.refusals] or [""])[-1]

    @property
    def fault(self) -> str:
        """What no command may do, whatever happens to it; empty where it did not."""
        if self.code < 0:
            return f"killed ({signal.Signals(-self.code).name})"
        if "Traceback" in self.output:
            return "traceback"
        return "warning" if "Warning: " in self.output else ""  # Python's, as NumPy gives


class Child:
    """Work in a fork of this process, within ``limits`` (of ``resource``)."""

    def __init__(self, work: Work, folder: Path = Path(), limits: Mapping[int, int] = {}) -> None:
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  closed by ``end``
        self._started = time.perf_counter()
        self._pid = os.fork()
        if not self._pid:
            _become(work, folder, limits, self._output.fileno())
        with suppress(OSError):  # it did so itself
            os.setpgid(self._pid, self._pid)

    def kill(self) -> None:
        """And whatever it started."""
        with suppress(ProcessLookupError):
            os.killpg(self._pid, signal.SIGKILL)

    def interrupt(self) -> None:
        """As Ctrl-C does."""
        with suppress(ProcessLookupError):
            os.killpg(self._pid, signal.SIGINT)

    def running(self) -> bool:
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        return os.waitid(os.P_PID, self._pid, options) is None

    def end(
        self,
        seconds: float = 600.0,
        megabytes: float = math.inf,
        progress: Callable[[], int] = lambda: 0,
    ) -> Ending:
        """Wait for it; kill it at so much memory, or so long after its progress last changed."""
        before_mb, most_mb = _resident_mb(self._pid), 0.0
        last, since = progress(), self._started
        while self.running():
            most_mb = max(most_mb, _resident_mb(self._pid) - before_mb)
            if (now := progress()) != last:
                last, since = now, time.perf_counter()
            if time.perf_counter() - since > seconds or most_mb > megabytes:
                self.kill()
            time.sleep(0.005)
        took_s = time.perf_counter() - self._started
        _, status, used = os.wait4(self._pid, 0)
        with self._output as stream:
            stream.seek(0)
            output = stream.read().decode(errors="replace")
        cpu_s = used.ru_utime + used.ru_stime
        return Ending(os.waitstatus_to_exitcode(status), output, took_s, cpu_s, most_mb)


def _become(work: Work, folder: Path, limits: Mapping[int, int], output: int) -> None:
    code = 70
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        os.dup2(output, 1)
        os.dup2(output, 2)
        # What a shell starts in the background ignores Ctrl-C, and so would all that it starts.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for kind, limit in {resource.RLIMIT_CORE: 0, **limits}.items():
            resource.setrlimit(kind, (limit, limit))
        code = work()
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


def command(*arguments: object) -> Work:
    """``tumortrack ARGUMENTS``, with what this process has imported."""
    words = [os.fspath(word) if isinstance(word, Path) else str(word) for word in arguments]
    return lambda: warm.become_command(words)


def new_command(*arguments: object, environ: Mapping[str, str] = {}) -> Work:
    """``tumortrack ARGUMENTS`` in a Python started anew."""
    words = [*COMMAND, *map(str, arguments)]
    return lambda: os.execve(words[0], words, {**environment(), **environ})


def base_in(folder: Path) -> Path:
    """What attacks, damage and kills start from, made once in ``folder/base``: a case of the
    phantom, both kinds of model, scenes, a run and a plan of it."""
    from stories import train_command, write_phantom_case

    warm.preload()
    base = folder.resolve() / "base"
    if base.exists():
        return base
    base.mkdir(parents=True)
    write_phantom_case(base / "case")
    for arguments in (
        ("train", base / "case", base / "model"),
        train_command(base / "case", base / "network"),
        ("simulate", base / "case", base / "scenes", "--scenes", 1),
        ("locate", base / "model", base / "scenes/0000/cloud.ply", base / "run"),
        ("plan", base / "run", base / "plan", "--accept-poor", "--accept-budget"),
    ):
        ending = Child(command(*arguments), base).end()
        if ending.code and (arguments[0], ending.code) != ("locate", 4):  # poor
            raise SystemExit(f"{arguments[0]}: {ending.output}")
    return base
