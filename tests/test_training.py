"""Training: learns, survives kill -9 and a full disk, and refuses what it must not resume."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from stories import COMMAND, environment, refusal, succeeded, tumortrack, write_phantom_case
from tumortrack.app.presets import paper, quick
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.learn.checkpoint import Progress
from tumortrack.learn.config import TrainConfig
from tumortrack.learn.model import load_model
from tumortrack.learn.network import CloudBox
from tumortrack.learn.schedule import learning_rate, settle_end


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training") / "case"
    write_phantom_case(folder)
    return folder


@pytest.fixture(scope="module")
def uninterrupted(case: Path) -> Path:
    model = case.parent / "uninterrupted"
    succeeded(tumortrack("train", case, model, "--steps", 40, "--workers", 1, "--device", "cpu"))
    return model


def test_a_killed_run_ends_with_the_weights_of_one_that_was_not(case, uninterrupted):
    model = case.parent / "killed"
    command = ["train", case, model, "--steps", 40, "--workers", 1, "--device", "cpu"]
    command += ["--checkpoint-every", 0.2]
    with subprocess.Popen(
        [*COMMAND, *map(str, command)], stdout=subprocess.DEVNULL, env=environment()
    ) as process:
        checkpoint = model / "training" / "checkpoint.safetensors"
        deadline = time.monotonic() + 120
        while not checkpoint.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.3)
        process.send_signal(signal.SIGKILL)
    assert checkpoint.exists()
    assert not (model / "manifest.json").exists(), "the run ended before it was killed"
    assert "has not ended" in refusal(tumortrack("locate", model, "cloud.ply", model / "out"))
    succeeded(tumortrack(*command))
    weights = (model / "weights.safetensors").read_bytes()
    assert weights == (uninterrupted / "weights.safetensors").read_bytes()


def test_ctrl_c_keeps_the_state_and_says_how_to_go_on(case):
    model = case.parent / "stopped"
    command = [*COMMAND, "train", str(case), str(model), "--steps", "100000", "--workers", "1"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    ) as process:
        assert process.stdout is not None
        assert "samples/s" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "The same command goes on" in errors
    assert "Traceback" not in errors
    assert (model / "training" / "checkpoint.safetensors").exists()
    message = refusal(tumortrack("train", case, model, "--steps", 100000, "--seed", 1))
    assert "another case, preset, seed or option" in message


def test_the_model_says_what_it_was_made_from(case, uninterrupted):
    about = load_model(uninterrupted).provenance
    assert about["steps"] == 40
    assert about["seed"] == 0
    lines = (uninterrupted / "training" / "history.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["step"] == 40
    assert list((uninterrupted / "training" / "tensorboard").iterdir())
    again = tumortrack("train", case, uninterrupted, "--steps", 40, "--device", "cpu")
    assert "trained already" in succeeded(again)
    refusal(tumortrack("train", case, uninterrupted, "--steps", 41))


def test_a_changed_weights_file_or_schema_is_refused(uninterrupted, tmp_path):
    import shutil

    model = tmp_path / "model"
    shutil.copytree(uninterrupted, model)
    manifest = json.loads((model / "manifest.json").read_text())
    (model / "manifest.json").write_text(json.dumps({**manifest, "schema": 999}))
    with pytest.raises(ArtifactError, match="schema 999"):
        load_model(model)
    (model / "manifest.json").write_text(json.dumps(manifest))
    weights = bytearray((model / "weights.safetensors").read_bytes())
    weights[-1] ^= 1
    (model / "weights.safetensors").write_bytes(weights)
    with pytest.raises(ArtifactError, match="changed after it was written"):
        load_model(model)


def test_a_full_disk_stops_training_and_spares_the_last_checkpoint(case):
    model = case.parent / "full"

    def small_disk() -> None:  # the checkpoint is larger than this, everything before is smaller
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    command = ["train", case, model, "--steps", 200, "--workers", 0, "--checkpoint-every", 0.1]
    message = refusal(tumortrack(*command, preexec_fn=small_disk))
    assert "cannot write" in message
    assert not list((model / "training").glob("*.part"))


def test_a_case_is_needed_to_train(tmp_path):
    assert "not a tumortrack case" in refusal(tumortrack("train", tmp_path, tmp_path / "m"))
    assert not (tmp_path / "m").exists()


def test_presets_survive_json_and_refuse_unknown_keys(case):
    from tumortrack.imaging.case import load_case

    anatomy = load_case(case).anatomy
    for preset in (paper, quick):
        config = preset(anatomy)
        data = to_builtins(config)
        assert from_builtins(data, TrainConfig, "here") == config
        with pytest.raises(InputError, match="unknown"):
            from_builtins({**data, "learning_rte": 1}, TrainConfig, "here")
    assert paper(anatomy).steps == 155_000
    assert paper(anatomy).scene.clutter.scenes == 0
    assert quick(anatomy).scene.clutter.scenes == 0.5
    assert isinstance(paper(anatomy).network.normalisation, CloudBox)
    assert paper(anatomy).scene.cloud.n_points == 1000


def test_the_learning_rate_warms_up_holds_and_falls_to_a_hundredth(case):
    from tumortrack.imaging.case import load_case

    config = quick(load_case(case).anatomy)
    peak = config.schedule.learning_rate

    def rate(step: int, end: int | None) -> float:
        return learning_rate(config, Progress(step=step, end=end))

    assert rate(0, 1000) == pytest.approx(peak / config.schedule.warmup_steps)
    assert rate(400, 1000) == pytest.approx(peak)
    assert rate(10**6, None) == pytest.approx(peak)
    assert rate(1000, 1000) == pytest.approx(peak / 100)
    rates = [rate(s, 1000) for s in range(500, 1001)]
    assert np.all(np.diff(rates) <= 0)


def test_minutes_fix_the_last_step_once(case):
    from tumortrack.imaging.case import load_case

    config = quick(load_case(case).anatomy)
    head = 1 - config.schedule.tail
    progress = Progress(step=300, elapsed_s=head * 60 - 1)
    assert not settle_end(config, progress, 1.0)
    progress.elapsed_s = head * 60 + 1
    assert settle_end(config, progress, 1.0)
    assert progress.end == round(300 / head)
    progress.elapsed_s = 1e6
    assert not settle_end(config, progress, 1.0)
