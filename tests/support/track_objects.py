"""`tumortrack track` as a user runs it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from clock import PATIENCE_S, until
from stories import COMMAND, environment

PATIENT = ("--stale", 30)  # with a loaded machine: its answers may be late


class World(NamedTuple):
    case: Path
    model: Path


def start(world, *arguments, env=None):
    return subprocess.Popen(
        [*COMMAND, "track", str(world.model), *map(str, (*arguments, *PATIENT))],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=env or environment(),
    )


def ended_when(process, met):
    """What a run said that Ctrl-C ends once it has done enough, however long that takes."""

    def enough():
        time.sleep(0.3)
        assert process.poll() is None, process.communicate()[0]
        return met()

    try:
        until(enough, "enough of the run", 5 * PATIENCE_S)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=5 * PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0, said
    return said


def estimates(report):
    """How many a run has had, by its report, which it writes every ten seconds."""
    return sum(told(report)["estimates"].values()) if report.exists() else 0


def virtual(world, **options):
    text = "&".join(f"{key}={value}" for key, value in options.items())
    return f"virtual:{world.case}" + (f"?{text}" if text else "")


def told(path):
    return json.loads(path.read_text())


def wait_for(process, words, seconds=300):
    """Read the output until one of the words stands in it."""
    until = time.monotonic() + seconds
    os.set_blocking(process.stdout.fileno(), True)
    while time.monotonic() < until:
        line = process.stdout.readline()
        if any(word in line for word in words.split("|")):
            return
        assert process.poll() is None, line
    raise AssertionError(f"{words!r} was never said")
