"""The fleet's store and engine: what lies there is whole or not there; nothing is done twice."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from clock import Clock
from fleet_objects import chain, executions, patients, results, user_file
from tumortrack.core.packages import to_install
from tumortrack_lab.cli.fleet import progress_words
from tumortrack_lab.fleet import engine
from tumortrack_lab.fleet.engine import Outcome, Status, run
from tumortrack_lab.fleet.executors import Serial
from tumortrack_lab.fleet.store import DamagedError, Store
from tumortrack_lab.fleet.task import Task
from tumortrack_lab.fleet.worker import Job, Report

pytest.importorskip("fsspec", reason="the extra `fleet` is not installed")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where tasks are logged; no pauses between attempts."""
    monkeypatch.setenv("FLEET_FOLDER", str(tmp_path))
    monkeypatch.setattr(engine, "_FIRST_PAUSE_S", 0.0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "faults.json").write_text("{}")
    return tmp_path


@pytest.fixture(params=["folder", "memory"])
def store(request, tmp_path, monkeypatch) -> Store:
    """A plain folder, and a storage without folders and renaming."""
    plain = request.param == "folder"
    store = Store(f"{'' if plain else 'memory://'}{tmp_path}/store", tmp_path / "cache")
    monkeypatch.setattr("tumortrack_lab.fleet.worker._store", lambda url: store)
    return store


def states(tasks: list[Task], store: Store, **options: object) -> dict[str, Outcome]:
    return {one.task.patient: one for one in run(tasks, store, Serial(), **options)}


def before(task: Task, steps: int = 1) -> Task:
    for _ in range(steps):
        task = task.inputs["before"]
    return task


def test_what_is_there_is_not_done_again(store, folder):
    first = states(patients(3), store)
    assert [one.state for one in first.values()] == ["done", "cannot", "done"]
    assert first["P1"].step == "step1"
    assert first["P1"].reason == "NoEstimate: nothing can be said of before"  # no paths
    assert len(executions(folder)) == 3 + 2 + 3

    again = states(patients(4), store)
    assert [one.state for one in again.values()] == ["there", "cannot", "there", "done"]
    assert len(executions(folder)) == 8 + 3

    store.remove(before(chain(0), 2).key)  # nobody needs it: what is wanted of P0 is there
    assert states([chain(0)], store)["P0"].state == "there"
    assert states(patients(2), store, again=True)["P1"].state == "cannot"
    assert executions(folder)[11:] == ["P1-1"]
    cost = store.cost(chain(0).key)
    assert cost["task"] == "P0 step2"
    assert cost["bytes"] == 32 + len("P0-2") + 66
    assert cost["peak_mb"] > 10


def test_all_storages_hold_the_same_bits(folder):
    plain, other = Store(str(folder / "store")), Store(f"memory://{folder}/o", folder / "cache")
    states(patients(3), plain)
    states(patients(3), other)
    files = {
        path.removeprefix(f"{other.root}/"): other._files.cat_file(path)
        for path in other._files.find(other.root)
    }
    assert results(folder / "store") == {
        path: content for path, content in files.items() if not path.startswith("costs/")
    }
    assert (plain.get(chain(2).key) / "value").read_bytes() == (
        other.get(chain(2).key) / "value"
    ).read_bytes()


def test_a_damaged_result_is_noticed_and_made_again(store, folder):
    states([chain(0)], store)
    whole = (store.get(chain(0).key) / "value").read_bytes()
    middle = before(chain(0)).key
    path = f"{store.root}/{middle[:2]}/{middle}/files/value"
    store.remove(chain(0).key)
    store._files.pipe_file(path, b"something else")
    shutil.rmtree(folder / "cache", ignore_errors=True)
    with pytest.raises(DamagedError, match=r"value was changed \(sha256 differs\)"):
        store.get(middle)
    assert states([chain(0)], store)["P0"].state == "done"
    assert executions(folder)[3:] == ["P0-1", "P0-2"]
    assert (store.get(chain(0).key) / "value").read_bytes() == whole
    store._files.rm_file(path)
    shutil.rmtree(folder / "cache", ignore_errors=True)
    with pytest.raises(DamagedError, match="it lacks value"):
        store.get(middle)


def test_half_of_a_result_is_none(store, folder):
    """As after kill -9 while it was written: files without a manifest, or half of one."""
    key = chain(0).key
    place = f"{store.root}/{key[:2]}/{key}"
    store._files.makedirs(f"{place}/files")
    store._files.pipe_file(f"{place}/files/value", b"half")
    assert not store.has(key)
    store._files.pipe_file(f"{place}/manifest.json", b'{"key": "')
    assert not store.has(key)
    with pytest.raises(DamagedError, match="no manifest"):
        store.get(key)
    assert states([chain(0)], store)["P0"].state == "done"
    assert (store.get(key) / "value").read_bytes() != b"half"
    for name in ("../../escaped", "/etc/escaped"):
        manifest = {"key": key, "failure": None, "files": {name: "0" * 64}}
        store._files.pipe_file(f"{place}/manifest.json", json.dumps(manifest).encode())
        assert not store.has(key)


def test_a_disk_that_fills_up_while_a_result_is_put_away(store, folder, monkeypatch):
    """No space left in the middle of the files: nothing is there, and the next attempt succeeds."""
    put, copy, full = store._files.put_file, shutil.copyfile, [True]

    def fill_up(do, source, *others):
        if str(source).endswith("value") and full:
            full.pop()
            raise OSError(28, "No space left on device")
        return do(source, *others)

    monkeypatch.setattr(store._files, "put_file", lambda *names: fill_up(put, *names))
    monkeypatch.setattr(shutil, "copyfile", lambda *names: fill_up(copy, *names))
    assert states([chain(0)], store)["P0"].state == "done"
    first = before(chain(0), 2).key
    assert store.cost(first)["attempts"] == ["OSError: [Errno 28] No space left on device", ""]
    assert executions(folder)[:2] == ["P0-0", "P0-0"]


def test_a_users_file_is_read_as_it_was_listed(folder):
    store, path = Store(str(folder / "store")), folder / "ct.raw"
    path.write_bytes(b"a CT")
    listed = user_file(path)
    path.write_bytes(b"another")
    outcome = states([chain(0, source=listed)], store, tries=2)["P0"]
    assert (outcome.state, outcome.step) == ("failed", "step0")
    assert "changed after the list was read" in outcome.reason
    path.unlink()
    outcome = states([chain(0, source=listed)], store, tries=2)["P0"]
    assert "is not there (on this machine) (attempt 2 of 2)" in outcome.reason
    path.write_bytes(b"a CT")
    assert states([chain(0, source=listed)], store)["P0"].state == "done"


def test_patients_with_the_same_data_are_done_once(folder):
    one = chain(0)
    other = Task("Q", one.step, one.version, one.work, one.options, one.inputs)
    found = states([one, other, lambda: chain(2)], Store(str(folder / "store")))
    states_of = {name: outcome.state for name, outcome in found.items()}
    assert states_of == {"P0": "done", "Q": "there", "P2": "done"}
    assert len(executions(folder)) == 6


def test_memory_is_doubled_where_it_was_too_little(folder):
    asked = []

    class Small(Serial):
        """A machine on which a task that asks for less than 300 MB has too little."""

        async def do(self, job: Job) -> Report:
            asked.append(job.memory_mb)
            if job.memory_mb < 300:
                return Report("memory", "too little")
            return await super().do(job)

    store = Store(str(folder / "store"))
    [outcome] = run([before(chain(0), 2)], store, Small())
    assert outcome.state == "done"
    assert asked == [100, 200, 400]
    assert store.cost(outcome.task.key)["attempts"] == ["too little", "too little", ""]
    [outcome] = run([before(chain(2), 2)], store, Small(), tries=2)
    assert (outcome.state, outcome.reason) == ("failed", "too little (attempt 2 of 2)")


def test_without_the_extra_one_line_says_how_to_get_it():
    hide = (
        "import importlib.util as u, sys; find = u.find_spec;"
        "u.find_spec = lambda name: None if name == 'ray' else find(name);"
    )
    code = f"{hide} from tumortrack.cli.main import run; sys.exit(run({['fleet', 'L', 'O']!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"tumortrack: fleet needs ray: {to_install('tumortrack-lab[fleet]')}.\n"


def test_what_another_run_is_doing_is_left_to_it(store, folder, monkeypatch):
    monkeypatch.setattr(engine, "_ELSEWHERE_S", 0.0)
    key = chain(0).key
    assert store.claim(key, "other")
    assert store.claim(key, "other")  # renewed
    assert not store.claim(key, "mine")
    looks = []

    class Meanwhile(Serial):
        """At the third look the other run has given it up."""

        async def do(self, job: Job) -> Report:
            report = await super().do(job)
            looks.append(report.state)
            if looks.count("elsewhere") == 3:
                store.release(key)
            return report

    [outcome] = run([chain(0)], store, Meanwhile())
    assert outcome.state == "done"
    assert looks == ["done", "done", *["elsewhere"] * 3, "done"]
    assert store.claim(key, "mine")  # nothing is left of a claim when a task is over

    claim = json.loads(store._files.cat_file(f"{store.root}/claims/{key}.json"))
    for void in ({"process": 2**22 + 1}, {"host": "elsewhere", "time": claim["time"] - 61}):
        text = json.dumps({**claim, "run": "other", **void}).encode()
        store._files.pipe_file(f"{store.root}/claims/{key}.json", text)
        assert store.claim(key, "mine")


def test_no_rate_is_told_before_a_patient_is_through(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(engine, "time", clock)
    status = Status(total=3, wanted=1, there=1, started_s=clock.monotonic())
    clock.sleep(3600.0)
    words = progress_words(status)
    assert "time left unknown until the first patient is through" in words
    assert "an hour" not in words
    status.wanted = 2
    assert "1.0 an hour | 1:00:00 left" in progress_words(status)
