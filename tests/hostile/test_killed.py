"""Commands that are killed (kill -9) or interrupted (Ctrl-C) at random moments, run short of
something, or meet another of their kind: each ends in one clear line, and loses nothing.

`make attack` runs all; what needs no attack option is a small share of it.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock import PATIENCE_S, until
from recording_objects import play
from stories import COMMAND, environment, tumortrack
from tumortrack.core.store import read_json, read_manifest, sha256_of
from tumortrack.live.values import Observation

pytestmark = pytest.mark.slow
LONG_S = 12.0  # within which commands are interrupted
FINISHING_S = 10.0  # within which a command may end as if it had not been interrupted
NOISE = ("Traceback", "Exception ignored", "Fatal Python error", "terminate called", "Warning: ")
SOME_FRAMES = 6 * 2**20  # bytes, of which one frame has 2 MB at most: then its pauses are known
LOST_S = 1.0  # of a recording, and the longest pause between two of its frames: on a busy machine
Words = tuple[object, ...]  # of a command


class Started:
    """A command in a process group of its own."""

    def __init__(self, words: Words, folder: Path, **more: Any) -> None:
        self.began = time.monotonic()
        self.process = subprocess.Popen(
            [*COMMAND, *map(str, words)],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            env=environment() | more.pop("environ", {}),
            **more,
        )

    def end(self, after_s: float | None = None, by: int = signal.SIGKILL) -> str:
        """What it said; it gets a signal after so long, if it still runs."""
        try:
            return self.process.communicate(timeout=after_s or 600)[0]
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, by)
            return self.process.communicate(timeout=PATIENCE_S)[0]

    @property
    def code(self) -> int:
        return self.process.returncode


@dataclass(frozen=True)
class Place:
    base: Path
    folder: Path
    times: int  # to be killed
    rng: np.random.Generator

    def locate(self, out: Path) -> Words:
        cloud = self.base / "scenes" / "0000" / "cloud.ply"
        return ("locate", self.base / "model", cloud, "--out", out, "--device", "cpu")

    def train(self, name: str, steps: int = 12) -> Words:
        options = ("--steps", steps, "--seed", 1, "--workers", 0, "--device", "cpu")
        return ("train", self.base / "case", self.folder / name, "--preset", "quick", *options)

    def track(self, *sinks: str, seconds: float = 10) -> Words:
        report = self.folder / f"report{time.time_ns()}.json"
        source = f"virtual:{self.base / 'case'}?fps=8"
        options = ("--device", "cpu", "--stale", 5, "--seconds", seconds, "--report", report)
        return ("track", self.base / "model", source, *sinks, *options)

    def whole(self, words: Words) -> float:
        """A command to its end: seconds."""
        began = time.monotonic()
        done = tumortrack(*words)
        assert done.returncode in (0, 4), done.stderr  # 4: located, and poor
        return time.monotonic() - began

    def killed(self, words: Words, after_s: float) -> bool:
        """Run a command and kill it after so long; False: it had ended."""
        started = Started(words, self.folder)
        started.end(after_s)
        return started.code < 0

    def only(self, *expected: str) -> None:
        assert names_in(self.folder) <= {*expected}  # nothing else stays in the folder


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def place(tmp_path, attack_base, request) -> Place:
    times = request.config.getoption("--attack")
    seed = None if times else 3
    return Place(attack_base, tmp_path, times or 2, np.random.default_rng(seed))


@pytest.mark.attack
def test_a_training_killed_again_and_again_has_the_weights_of_one_that_was_not(place):
    takes_s = place.whole(place.train("undisturbed", 100))
    names, kills = ["undisturbed"], 0
    while kills < place.times:
        names.append(f"killed{len(names)}")
        words = place.train(names[-1], 100)
        while kills < place.times and place.killed(words, place.rng.uniform(0.5, takes_s)):
            kills += 1
        if not (place.folder / names[-1] / "manifest.json").exists():
            place.whole(words)
    weights = {sha256_of(place.folder / name / "weights.safetensors") for name in names}
    assert len(weights) == 1
    place.only(*names)


@pytest.mark.attack
def test_a_case_whose_model_is_being_made_stays_whole(place):
    case = place.folder / "case"
    shutil.copytree(place.base / "case", case)
    files = names_in(case)
    shutil.rmtree(case / "model")
    takes_s = place.whole(("compile", case))
    for _ in range(place.times):
        shutil.rmtree(case / "model")
        place.killed(("compile", case), place.rng.uniform(0.3, 1.1) * takes_s)
        read_manifest(case, "case")  # whole
        if (case / "model").exists():
            read_manifest(case / "model", "model")
        place.whole(("compile", case))
    place.only("case")
    assert names_in(case) <= files


def test_locate_onto_an_older_run_leaves_one_of_both(place):
    run = place.folder / "run"
    words = (*place.locate(run), "--overwrite")
    place.whole(words)
    started = Started(words, place.folder)
    started.end()
    takes_s = time.monotonic() - started.began
    for _ in range(place.times):
        place.killed(words, place.rng.uniform(0.5, 1.1) * takes_s)
        read_manifest(run, "run")  # whole
        place.whole(words)
    place.only("run")


def test_a_recording_can_be_read_to_its_last_second(place):
    for _ in range(place.times):
        tape = place.folder / "tape"
        started = Started(place.track(f"recording:{tape}", seconds=600), place.folder)

        def on_disk(started: Started = started, tape: Path = tape) -> bool:
            sizes = [path.stat().st_size for path in tape.rglob("*.mcap")]
            return sum(sizes) > SOME_FRAMES or started.process.poll() is not None

        try:
            until(on_disk, "a tape", 5 * PATIENCE_S)
            time.sleep(place.rng.uniform(0, 6))
            killed_ns = time.time_ns()
            assert started.process.poll() is None
        finally:
            started.end(0.001)
        *pauses_s, lost_s = np.diff([*stamps_of(tape), killed_ns]) * 1e-9
        assert lost_s <= LOST_S + max(pauses_s, default=0.0)
        shutil.rmtree(tape)


def stamps_of(tape: Path) -> list[int]:
    """The stamps (ns) of the frames that can be played."""
    return [seen.stamp_ns for seen in play(tape) if isinstance(seen, Observation)]


WORLD = "virtual:{base}/case?breathing=false&instrument=false&camera_motion=false&fps=10"
LONG_COMMANDS = [
    "prepare {base}/case/labels.nii.gz --out {out}",
    "simulate {base}/case {out} --scenes 8",
    "train {base}/case {out}",
    "locate {base}/model {base}/scenes/0000/cloud.ply --out {out}",
    "evaluate {base}/model {base}/scenes {out}",
    f"track {{base}}/case {WORLD} viewer:0 openigtlink:0 recording:{{out}} --seconds 8",
    "export {base}/case {out}",
    "plan {base}/run {out} --accept-poor --accept-budget",
    "resect {base}/plan --film {out}.gif",
    f"resect {{base}}/plan --live {{base}}/case {WORLD} --speed 10",
    "demo --out {out} --scenes 1",
    "phantom-kit {base}/case {out}",
    "twin {base}/case {out}",
]


@pytest.mark.attack
@pytest.mark.parametrize("line", LONG_COMMANDS, ids=lambda line: line.split(" {")[0])
def test_an_interrupted_command_stops_and_leaves_what_is_whole(place, line):
    words = tuple(line.format(base=place.base, out=place.folder / "out").split())
    for _ in range(place.times):
        after_s = place.rng.uniform(2.0, LONG_S)  # not before Python itself has begun
        started = Started(words, place.folder)
        said = started.end(after_s, signal.SIGINT)
        took_s = time.monotonic() - started.began
        _check_interrupted(started.code, said, place.folder)
        if started.code == 0 and words[0] != "track":
            assert took_s < after_s + FINISHING_S, "not stopped"
        for path in place.folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _check_interrupted(code: int, said: str, folder: Path) -> None:
    assert code in (0, 4, 130, -signal.SIGINT), said
    assert not [noise for noise in NOISE if noise in said], said
    if code == 130:
        lines = said.strip().splitlines()
        assert [line for line in lines if line.startswith("tumortrack: ")] == lines[-1:], said
    assert names_in(folder) <= {"out", "out.gif", "runs"}
    assert not list(folder.rglob(".*"))
    for manifest in folder.rglob("manifest.json"):
        read_manifest(manifest.parent, read_json(manifest)["kind"])


# Short of something ---------------------------------------------------------------------------


@contextmanager
def small_disk(folder: Path, options: str) -> Iterator[Path]:
    """A tmpfs; the test is skipped where none may be mounted."""
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]).returncode:
        pytest.skip("no tmpfs may be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def ended(words: Words, folder: Path, **more: Any) -> int:
    """How a new process ends; 0 or one clear line."""
    started = Started(words, folder, **more)
    said = started.end()
    assert "Traceback" not in said, said
    if started.code not in (0, 4):
        assert said.strip().splitlines()[-1].startswith("tumortrack: "), said
    return started.code


@pytest.mark.attack
@pytest.mark.parametrize(("command", "size"), [("locate", "100k"), ("train", "2m")])
def test_a_full_disk_is_refused_and_left_empty(place, command, size):
    with small_disk(place.folder / "disk", f"size={size}") as disk:
        train = ("train", place.base / "case", disk / "out")
        words = place.locate(disk / "out") if command == "locate" else train
        assert ended(words, place.folder) == 2
        assert not names_in(disk)


@pytest.mark.attack
def test_tracking_goes_on_where_its_recording_finds_the_disk_full(place):
    with small_disk(place.folder / "disk", "size=20m") as disk:
        tape = f"recording:{disk / 'tape'}"
        assert ended(place.track(tape), place.folder) == 0
        frames = len(stamps_of(disk / "tape"))
    report = json.loads(next(place.folder.glob("report*.json")).read_text())
    assert report["sinks"][tape]["errors"] > 0
    assert report["estimates"]["good"] + report["estimates"]["poor"] > 2 * frames > 20


@pytest.mark.attack
def test_home_and_caches_may_be_read_only(place):
    with small_disk(place.folder / "home", "size=1m,ro") as home:
        environ = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"), str(home))
        assert ended(place.locate(place.folder / "run"), place.folder, environ=environ) in (0, 4)


@pytest.mark.attack
@pytest.mark.parametrize(
    ("kind", "limit"), [(resource.RLIMIT_DATA, 3 * 2**30), (resource.RLIMIT_NOFILE, 64)]
)
def test_commands_work_with_3_gb_and_with_64_open_files(place, kind, limit):
    for words in (
        place.train("model"),
        place.locate(place.folder / "run"),
        place.track("viewer:0", "openigtlink:0", f"recording:{place.folder / 'tape'}"),
    ):
        limited = {"preexec_fn": lambda: resource.setrlimit(kind, (limit, limit))}
        assert ended(words, place.folder, **limited) in (0, 4)
    assert len(stamps_of(place.folder / "tape")) > 10


# Two at once ----------------------------------------------------------------------------------


@pytest.mark.attack
@pytest.mark.parametrize("command", ["train", "locate", "track"])
def test_of_two_commands_into_one_folder_one_is_refused(place, command):
    out = place.folder / "out"
    words = {
        "train": place.train("out"),
        "locate": place.locate(out),
        "track": place.track(f"recording:{out}"),
    }[command]
    both = [Started(words, place.folder) for _ in range(2)]
    said = [each.end() for each in both]
    assert sorted(each.code for each in both) in ([0, 2], [2, 4]), said
    assert "Traceback" not in "".join(said)
    assert {name for name in names_in(place.folder) if "report" not in name} == {"out"}
    if command == "track":
        assert len(stamps_of(out)) > 10
