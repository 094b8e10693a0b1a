"""A ROS 1 graph for tests: a real roscore, and nodes of Debian's Python with ROS's own classes."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import pytest

from clock import PATIENCE_S
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.ros.rospy_node import Master, rospy_module

PEER = Path(__file__).with_name("ros1_peer.py")
PYTHON = "/usr/bin/python3"
HERE = {"ROS_IP": "127.0.0.1"}  # of other nodes: ours are on this machine alone unasked
T = TypeVar("T")


def eventually(ask: Callable[[], T], what: str, every_s: float = 0.02) -> T:
    """The first answer that is true; errors of ours count as not yet."""
    until_s, last = time.monotonic() + PATIENCE_S, ""
    while time.monotonic() < until_s:
        try:
            if answer := ask():
                return answer
        except TumortrackError as error:
            last = str(error)
        time.sleep(every_s)
    raise AssertionError(f"waited {PATIENCE_S:g} s for {what}. {last}")


def refusal_of(ask: Callable[[], object], kind: type[TumortrackError], words: str = "") -> str:
    """What it says when it refuses at last, with these words."""

    def error() -> str:
        try:
            ask()
        except kind as refused:
            return str(refused) if words in str(refused) else ""
        return ""

    return eventually(error, f"a {kind.__name__}")


def end(process: subprocess.Popen) -> None:
    """Kill a process and all that it started, in whatever group: roscore gives each its own."""
    for pid in [process.pid, *_offspring(process.pid)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()


def _offspring(pid: int) -> list[int]:
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


class Graph:
    """A roscore on a free port; this process and those it starts are told of it."""

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="ros1_"))
        with socket.socket() as some:
            some.bind(("127.0.0.1", 0))
            self.port = some.getsockname()[1]
        self.master = Master(f"http://127.0.0.1:{self.port}")
        os.environ |= {
            "ROS_MASTER_URI": self.master.uri,
            "ROS_HOME": str(self._folder),
            "ROS_LOG_DIR": str(self._folder),
        }
        self._core: subprocess.Popen | None = None
        atexit.register(self._remove)

    def start(self) -> None:
        """Start roscore, unless it runs."""
        if self._core is None:
            self._core = subprocess.Popen(
                ["roscore", "-p", str(self.port)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                env=os.environ | HERE,
            )
            eventually(lambda: self.master.call("getPid"), "roscore")

    def kill(self) -> None:
        """End roscore and its master, without a word to its nodes."""
        if self._core is not None:
            end(self._core)
            self._core = None

    def _remove(self) -> None:
        self.kill()
        shutil.rmtree(self._folder, ignore_errors=True)


@cache
def _only_graph() -> Graph:
    return Graph()


def ros1_graph() -> Graph:
    """This process's graph, running: rospy knows one master a process. Skips without ROS 1."""
    if shutil.which("roscore") is None:
        pytest.skip("ROS 1 (roscore) is not installed: `make debian`")
    try:
        rospy_module()
    except InputError as error:
        pytest.skip(f"ROS 1's Python is not installed: `make debian` ({error})")
    graph = _only_graph()
    graph.start()
    return graph


@contextlib.contextmanager
def publisher(topics: dict[str, str], hz: float = 20.0, **more: Any) -> Iterator[None]:
    """A node that publishes ``depth``, ``info``, ``mask`` or ``cloud`` on topics: see
    ``ros1_peer``."""
    process = _peer("publish", {"topics": topics, "hz": hz, **more}, stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        end(process)


class Listener:
    """A node that writes down what it hears under a namespace."""

    def __init__(self, process: subprocess.Popen, heard: Path) -> None:
        self._process, self._heard = process, heard

    def messages(self, topic: str) -> list[dict]:
        """What came on a topic so far, oldest first."""
        text = self._heard.read_text()
        lines = text[: text.rfind("\n") + 1].splitlines()
        return [one for one in map(json.loads, lines) if one["topic"] == topic]


@contextlib.contextmanager
def listener(namespace: str, folder: Path, name: str = "heard") -> Iterator[Listener]:
    heard = folder / f"{name}.jsonl"
    with heard.open("w") as stream:
        process = _peer("listen", {"namespace": namespace}, stdout=stream)
    try:
        yield Listener(process, heard)
    finally:
        end(process)


def _peer(command: str, given: dict, stdout: Any) -> subprocess.Popen:
    return subprocess.Popen(
        [PYTHON, str(PEER), command, json.dumps(given)],
        stdout=stdout,
        start_new_session=True,
        env=os.environ | HERE,
    )
