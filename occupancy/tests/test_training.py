"""Training: learns, survives kill -9 and a full disk, and refuses what it must not resume."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from clock import PATIENCE_S, Clock, until
from refused import refused
from stories import COMMAND, STEPS, environment, refusal, succeeded, train_command, tumortrack
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.process import available_cores
from tumortrack.core.types import Anatomy
from tumortrack.io.case import load_case
from tumortrack.tracking.model_files import load_model
from tumortrack_occupancy.config import TrainConfig
from tumortrack_occupancy.normalisation import CloudBox
from tumortrack_occupancy.presets import paper, quick
from tumortrack_occupancy.training import train as training_loop
from tumortrack_occupancy.training.state import (
    Diverged,
    TrainingProgress,
    TrainingState,
    fix_last_step,
    learning_rate,
)
from tumortrack_occupancy.training.train import (
    TrainingClock,
    TrainingRun,
    divide_cores,
    run_steps,
    train,
    work_folder,
)


@pytest.fixture
def case(phantom_case: Path) -> Path:
    return phantom_case


def kill_at_first_checkpoint(command: list[object], model: Path) -> None:
    with subprocess.Popen(
        [str(word) for word in command],
        stdout=subprocess.DEVNULL,
        env=environment(),
        cwd=Path(__file__).parents[2] / "tests" / "support",  # whose files import each other
    ) as process:
        checkpoint = model / "training" / "checkpoint.safetensors"
        until(checkpoint.exists, "a checkpoint", 5 * PATIENCE_S)
        process.send_signal(signal.SIGKILL)
    assert not (model / "manifest.json").exists(), "the run ended before it was killed"


def same_files(model: Path, other: Path, *names: str) -> bool:
    return all((model / name).read_bytes() == (other / name).read_bytes() for name in names)


@pytest.mark.slow
def test_a_killed_run_ends_with_the_weights_of_one_that_was_not(case, quick_model, tmp_path):
    model = tmp_path / "killed"
    command = train_command(case, model)
    kill_at_first_checkpoint([*COMMAND, *command, "--checkpoint-every", 0], model)
    assert "has not ended" in refusal(
        tumortrack("locate", model, "cloud.ply", "--out", model / "out")
    )
    succeeded(tumortrack(*command))
    assert same_files(model, quick_model, "weights.safetensors")
    assert not (model / "shape.safetensors").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_the_state_and_says_how_to_go_on(case, tmp_path):
    model = tmp_path / "stopped"
    options = ["--preset", "quick", "--steps", "100000"]
    command = [*COMMAND, "train", str(case), str(model), *options, "--workers", "1"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    ) as process:
        assert process.stdout is not None
        assert any("samples/s" in line for line in process.stdout)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "The same command goes on" in errors
    assert "Traceback" not in errors
    assert (model / "training" / "checkpoint.safetensors").exists()
    message = refusal(tumortrack("train", case, model, *options, "--seed", 1))
    assert "differs from this command in --seed (0 there, 1 here). Give" in message


@pytest.mark.slow
def test_ctrl_c_while_processes_start_ends_the_training(case, tmp_path):
    """A terminal sends it to all processes. It once ended one that was still starting, and the
    training waited forever to write to it."""
    options = ["--preset", "quick", "--steps", "100000", "--workers", "1"]
    command = [*COMMAND, "train", str(case), str(tmp_path / "stopped"), *options]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(),
        start_new_session=True,
    ) as process:  # fmt: skip
        try:
            until(lambda: "spawn_main" in _commands_below(process.pid), "a process for scenes")
            time.sleep(0.3)  # it imports
            os.killpg(process.pid, signal.SIGINT)
            _, errors = process.communicate(timeout=300)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert "Traceback" not in errors


def _commands_below(pid: int) -> str:
    """Command lines of a process's children."""
    found = []
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with contextlib.suppress(OSError):  # it has ended
            found.append(Path(f"/proc/{child}/cmdline").read_text())
    return " ".join(found)


@pytest.mark.slow
def test_a_script_need_not_guard_its_main_part(case, tmp_path):
    """Worker processes once ran the script again and failed, and it waited forever."""
    script = tmp_path / "mine.py"
    given = f"{str(case)!r}, {str(tmp_path / 'model')!r}, preset='quick', steps=2, workers=1"
    script.write_text(f"import tumortrack as tt\ntt.train({given})\nprint(__file__)")
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=300, env=environment()
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(script)]
    assert load_model(tmp_path / "model").provenance["steps"] == 2


@pytest.mark.slow
def test_the_model_says_what_it_was_made_from(case, quick_model):
    about = load_model(quick_model).provenance
    assert about["steps"] == STEPS
    assert about["seed"] == 0
    lines = (quick_model / "training" / "history.jsonl").read_text().splitlines()
    last = json.loads(lines[-1])
    assert last["step"] == STEPS
    assert last["samples_per_s"] > 0
    assert 0 < last["validation_loss"] < np.log(4)  # of four classes, by chance
    assert 0 < last["learning_rate"] < 1e-3  # the schedule has nearly ended
    assert list((quick_model / "training" / "tensorboard").iterdir())
    again = tumortrack(*train_command(case, quick_model))
    assert "trained already" in succeeded(again)
    more = [*train_command(case, quick_model), "--seed", 1]
    message = refusal(tumortrack(*more))
    assert "(seed 0), whose command differs" in message
    assert "from this one in --seed (0 there, 1 here). A finished" in message
    other = [*train_command(case, quick_model), "--rotations", "full"]
    assert "in --preset, --rotations, --sensor or the version. A" in refusal(tumortrack(*other))


def test_a_changed_weights_file_or_schema_is_refused(quick_model, tmp_path):
    import shutil

    model = tmp_path / "model"
    shutil.copytree(quick_model, model)
    manifest = json.loads((model / "manifest.json").read_text())
    (model / "manifest.json").write_text(json.dumps({**manifest, "schema": 999}))
    with refused(ArtifactError, 999):
        load_model(model)
    (model / "manifest.json").write_text(json.dumps(manifest))
    weights = bytearray((model / "weights.safetensors").read_bytes())
    weights[-1] ^= 1
    (model / "weights.safetensors").write_bytes(weights)
    with refused(ArtifactError, "weights.safetensors"):
        load_model(model)


@pytest.mark.slow
def test_a_full_disk_stops_training_and_spares_the_last_checkpoint(case, tmp_path):
    model = tmp_path / "full"

    def small_disk() -> None:  # the checkpoint is larger than this, everything before is smaller
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    command = ["train", case, model, "--preset", "quick", "--steps", 200, "--workers", 0]
    command += ["--checkpoint-every", 0.1]
    message = refusal(tumortrack(*command, preexec_fn=small_disk))
    assert "cannot write" in message
    assert not list((model / "training").glob("*.part"))


HISTORY_ON_A_FULL_DISK = """
import resource, sys
from pathlib import Path
from tumortrack.core.errors import InputError, StorageError
from tumortrack_occupancy.training.state import TrainingProgress
from tumortrack_occupancy.training.train import history

folder, mode = Path(sys.argv[1]), sys.argv[2]
import torch.utils.tensorboard  # its own caches are not the point
resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
numbers = 1.0, 0.9, 0.5, 100.0, 1e-3, 0.0
progress = TrainingProgress()
try:
    with history(folder, progress) as write:
        if mode == "other":
            write(*numbers)
            raise InputError("the first error")
        for progress.step in range(200):
            write(*numbers)
except StorageError as error:
    print("storage:", error)
except InputError as error:
    print("input:", error)
"""


@pytest.mark.parametrize(
    ("mode", "words"),
    [("full", "storage: cannot write the history"), ("other", "input: the first")],
)
def test_a_history_that_cannot_be_written_is_one_clear_error(tmp_path, mode, words):
    done = subprocess.run(
        [sys.executable, "-c", HISTORY_ON_A_FULL_DISK, str(tmp_path), mode],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(words), done.stdout + done.stderr


def a_run(case: Path, **changes: object) -> TrainingRun:
    loaded = load_case(case)
    config = quick(loaded.anatomy)
    run = TrainingRun(loaded.anatomy, loaded.up_lps, "no digest", config, steps=2, workers=0)
    return replace(run, **changes)


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"seed": -1}, "seed"),
        ({"checkpoint_every_s": float("nan")}, "checkpoint_every_s"),
        ({"checkpoint_every_s": -1}, "checkpoint_every_s"),
        ({"minutes": float("nan")}, "minutes"),
        ({"workers": -1}, "workers"),
        ({"steps": 0}, "steps"),
    ],
)
def test_impossible_runs_are_refused(case, changes, option):
    with refused(InputError, option, *changes.values()):
        a_run(case, **changes)


def test_a_refused_run_leaves_nothing_behind(case, tmp_path):
    message = refusal(tumortrack("train", case, tmp_path / "model", "--seed", -1))
    assert "seed is -1" in message
    run = a_run(case)
    needle = run.anatomy_ct.organ.vertices_mm.mean(0) + run.anatomy_ct.tumors[0].vertices_mm * 1e-4
    needle[:, 0] *= 1e-3
    thin = Anatomy((run.anatomy_ct.organ, run.anatomy_ct.tumors[0].with_vertices(needle)))
    with pytest.raises(InputError):
        train(replace(run, anatomy_ct=thin), tmp_path / "model", lambda _: None)
    assert not (tmp_path / "model").exists()


def test_two_trainings_in_one_folder_are_refused_and_a_dead_ones_lock_is_not(tmp_path):
    model = tmp_path / "model"
    with work_folder(model) as work:
        (work / "something").touch()
        with refused(InputError, model), work_folder(model):
            pass
    assert (work / "something").exists()
    hold = (
        "import sys, os, signal; from pathlib import Path;"
        "from tumortrack_occupancy.training.train import work_folder\n"
        "with work_folder(Path(sys.argv[1])): os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", hold, str(model)]).returncode == -signal.SIGKILL
    assert (work / ".lock").exists()
    with work_folder(model):
        pass


def test_a_diverged_run_stops_and_keeps_the_checkpoint_before(case, tmp_path):
    state = TrainingState(a_run(case), torch.device("cpu"))
    batch = (torch.randn(2, 300, 3) * 30, torch.randn(2, 50, 3) * 30, torch.zeros(2, 50))
    assert state.step(batch) > 0
    state.save(tmp_path)
    before = (tmp_path / "checkpoint.safetensors").read_bytes()
    clouds, points, labels = batch
    with refused(Diverged, "step 1"):
        state.step((clouds, points * float("inf"), labels))
    with torch.no_grad():
        next(iter(state.network.parameters())).fill_(float("nan"))
    with pytest.raises(Diverged):
        state.save(tmp_path)
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == before


def test_dropped_points_are_a_share_of_what_the_encoder_takes(case):
    state = TrainingState(a_run(case), torch.device("cpu"))
    kept = []
    for state.progress.step in range(300):
        kept.append(state.points_kept(1000))
    assert 200 < min(kept) < 225
    assert 490 < max(kept) <= 512
    assert np.mean(kept) == pytest.approx((512 + 205) / 2, abs=15)


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "50000 100000"}, 1),
        ({"cpu.max": "max 100000"}, None),
        ({"cpu/cpu.cfs_quota_us": "100000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 1),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, None),
        ({}, None),
    ],
)
def test_a_containers_quota_of_cores_counts(tmp_path, monkeypatch, files, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(6), raising=False)
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert available_cores(tmp_path) == (cores or 6)
    monkeypatch.delattr(os, "sched_getaffinity")  # as on macOS
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert available_cores(tmp_path) == (cores or 3)


@pytest.mark.parametrize(
    ("granted", "workers", "threads"),
    [("", 1, 5), ("2", 1, 2), ("", 5, 3), ("9", 0, 6), ("", None, 6)],
)
def test_the_network_gets_the_cores_that_workers_and_openmp_leave(
    monkeypatch, granted, workers, threads
):
    before = torch.get_num_threads()
    monkeypatch.setenv("OMP_NUM_THREADS", granted)
    monkeypatch.setattr("tumortrack_occupancy.training.train.available_cores", lambda: 6)
    assert divide_cores(torch.device("cpu"), workers) == (6 if workers is None else workers)
    try:
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_a_case_is_needed_to_train(tmp_path):
    assert "not a tumortrack case" in refusal(tumortrack("train", tmp_path, tmp_path / "m"))
    assert not (tmp_path / "m").exists()


def test_presets_survive_json_and_refuse_unknown_keys(case):
    anatomy = load_case(case).anatomy
    for preset in (paper, quick):
        config = preset(anatomy)
        data = to_builtins(config)
        assert from_builtins(data, TrainConfig, "here") == config
        assert config.scene.occlusion.scenes == config.scene.calibration.scale == 0
        with refused(InputError, "learning_rte"):
            from_builtins({**data, "learning_rte": 1}, TrainConfig, "here")
    assert paper(anatomy).steps == 155_000
    assert paper(anatomy).scene.clutter.scenes == 0
    assert quick(anatomy).scene.clutter.scenes == 0.5
    assert isinstance(paper(anatomy).network.normalisation, CloudBox)
    assert paper(anatomy).scene.cloud.n_points == 1000


def test_the_learning_rate_warms_up_holds_and_falls_to_a_hundredth(case):
    config = quick(load_case(case).anatomy)
    peak = config.schedule.learning_rate

    def rate(step: int, end: int | None) -> float:
        return learning_rate(config, TrainingProgress(step=step, end=end))

    assert rate(0, 1000) == pytest.approx(peak / config.schedule.warmup_steps)
    assert rate(400, 1000) == pytest.approx(peak)
    assert rate(10**6, None) == pytest.approx(peak)
    assert rate(1000, 1000) == pytest.approx(peak / 100)
    rates = [rate(s, 1000) for s in range(500, 1001)]
    assert np.all(np.diff(rates) <= 0)


def test_minutes_fix_the_last_step_once(case):
    config = quick(load_case(case).anatomy)
    head = 1 - config.schedule.tail
    progress = TrainingProgress(step=300, elapsed_s=head * 60 - 1)
    assert not fix_last_step(config, progress, 1.0)
    progress.elapsed_s = head * 60 + 1
    assert fix_last_step(config, progress, 1.0)
    assert progress.end == round(300 / head)
    progress.elapsed_s = 1e6
    assert not fix_last_step(config, progress, 1.0)


@pytest.mark.parametrize("compiling_s", [1.0, 300.0])
def test_minutes_are_of_training_whatever_its_start_takes(case, tmp_path, monkeypatch, compiling_s):
    clock = Clock()
    monkeypatch.setattr(training_loop, "time", clock)
    anatomy, config = load_case(case).anatomy, quick(load_case(case).anatomy)
    run = TrainingRun(anatomy, (0.0, -1.0, 0.0), "none", config, minutes=0.5)
    state, statuses = TrainingState(run, torch.device("cpu")), []

    def step(_):
        clock.sleep(0.1 if state.progress.step else compiling_s)
        state.progress.step += 1
        return 1.0

    monkeypatch.setattr(state, "step", step)
    run_steps(state, (() for _ in range(10_000)), tmp_path, statuses.append)
    assert state.progress.step == pytest.approx(300, abs=3)
    assert state.progress.elapsed_s == pytest.approx(30, abs=0.3)
    assert statuses[0].samples_per_s == pytest.approx(10 * config.batch_size, rel=0.1)
    assert statuses[0].seconds_left == pytest.approx(25, abs=0.5)


def test_one_step_has_a_pace_and_takes_no_time_of_its_own(monkeypatch):
    clock, progress = Clock(), TrainingProgress(elapsed_s=7.0)
    monkeypatch.setattr(training_loop, "time", clock)
    own = TrainingClock(progress)
    clock.sleep(4.0)
    progress.step = 1
    own.count_step()
    assert (own.elapsed(), own.rate()) == pytest.approx((7.0, 0.25))
