"""Commands as processes of their own that need not import PyTorch each: forked by one that has.

As a script: that one. It takes orders (JSON lines) and answers each with its exit code.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NoReturn

PRELOADED = (
    "torch",
    "scipy.optimize",
    "scipy.spatial.transform",
    "skimage.measure",
    "tumortrack.cli.main",
    "tumortrack.tracking.presets",
    "tumortrack.registration.model",
    "tumortrack.report.protocol",
    "tumortrack.io.case",
    "tumortrack_occupancy.training.train",
    "tumortrack.simulation.scene",
    "tumortrack.tracking.tracker",
)


@cache
def _server() -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, __file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "GOMP_SPINCOUNT": "1000", "OPENBLAS_NUM_THREADS": "1"},  # as ``main``
    )


class Done(subprocess.CompletedProcess[str]):
    """``megabytes``: beyond what the process began with; ``cpu_s``: of all its cores."""

    cpu_s = megabytes = 0.0


def run(arguments: list[str], environment: dict[str, str], seconds: int = 0) -> Done:
    """``tumortrack ARGUMENTS`` to its end; after so many ``seconds`` (0: never) it is killed."""
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    with (
        tempfile.NamedTemporaryFile("r", errors="replace") as out,
        tempfile.NamedTemporaryFile("r", errors="replace") as errors,
    ):
        order = [arguments, environment, os.getcwd(), out.name, errors.name, seconds]
        print(json.dumps(order), file=server.stdin, flush=True)
        code, cpu_s, megabytes = json.loads(server.stdout.readline())
        done = Done(arguments, code, out.read(), errors.read())
        done.cpu_s, done.megabytes = cpu_s, megabytes
        return done


def preload() -> None:
    """Import what commands need, for forks of this process."""
    for name in PRELOADED:
        importlib.import_module(name)
    gc.freeze()  # nothing of it is looked through, and copied, in a fork


def _serve() -> Callable[[], None]:
    """Fork for every order; returns what a fork has to do."""
    preload()
    while line := sys.stdin.readline():
        if not (pid := os.fork()):
            arguments, environment, folder, out, errors, seconds = json.loads(line)
            signal.alarm(seconds)
            if seconds:
                resource.setrlimit(resource.RLIMIT_DATA, (6 * 2**30,) * 2)
            os.environ.clear()
            os.environ.update(environment)
            os.chdir(folder)
            for name, number in ((os.devnull, 0), (out, 1), (errors, 2)):
                os.dup2(os.open(name, os.O_RDWR | os.O_APPEND), number)
            return lambda: become_command(arguments)
        began_kb = int(Path("/proc/self/statm").read_text().split()[1]) * 4
        _, status, used = os.wait4(pid, 0)
        megabytes = (used.ru_maxrss - began_kb) / 1024
        cpu_s = used.ru_utime + used.ru_stime
        print(json.dumps([os.waitstatus_to_exitcode(status), cpu_s, megabytes]), flush=True)
    return sys.exit


def become_command(arguments: list[str]) -> NoReturn:
    """The command, and out at once: to take apart all that was imported takes seconds."""
    sys.argv = ["tumortrack", *arguments]
    try:
        importlib.import_module("tumortrack.cli.main").main()
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    _serve()()
