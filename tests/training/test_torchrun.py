"""One training by two processes: the same weights as by one, one error, the same resumption."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from torch import distributed

from stories import environment
from torchrun_peer import STEPS, UP, anatomy, small_run
from tumortrack.core.errors import InputError
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.simulate.occupancy import FixedPoints
from tumortrack.simulate.scene import SceneConfig, SceneStream
from tumortrack.training.distributed import ProcessGroup, ProcessLost, process_group
from tumortrack.training.presets import clinic_network
from tumortrack.training.state import TrainingState
from tumortrack.training.train import train

HERE = Path(__file__).parents[1] / "support"
CPU = torch.device("cpu")


def torchrun(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Two processes on this machine, to their end."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2"]
    command += ["--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0"]  # any free port
    command += [str(HERE / "torchrun_peer.py"), *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=600, env=environment(), cwd=HERE
    )


@pytest.mark.slow
def test_two_processes_end_with_the_weights_of_one(tmp_path, monkeypatch):
    """Rank 1 is killed on the way; the same command goes on."""
    folder = tmp_path / "two"
    killed = torchrun(folder, STEPS // 2)
    assert killed.returncode != 0
    said = [line for line in killed.stderr.splitlines() if line.startswith("peer: ")]
    assert len(said) == 1, killed.stderr
    assert "process 0 of 2 stops: another one of this training has ended" in said[0]
    assert not (folder / "manifest.json").exists()
    assert (folder / "training" / "checkpoint.safetensors").exists()

    resumed = torchrun(folder, -1)
    assert resumed.returncode == 0, resumed.stderr
    assert resumed.stdout.count(f"trained {STEPS}") == 2
    reporters = {line for line in resumed.stdout.splitlines() if line.startswith("reported")}
    assert len(reporters) == 1

    monkeypatch.setattr("tumortrack.training.state.has_fast_bfloat16", lambda _: False)
    train(small_run(), tmp_path / "one", lambda _: None)
    one = load_file(tmp_path / "one" / "weights.safetensors")
    two = load_file(folder / "weights.safetensors")
    start = train_start()
    assert one.keys() == two.keys()
    moved, apart = (
        np.concatenate([(one[name] - other[name]).ravel() for name in start])
        for other in (start, two)
    )
    assert np.abs(moved).max() > 1e-4
    # Adam divides a gradient by its own size: where a weight's gradient is no more than what a sum
    # in another order rounds it by, its step is a toss-up, and one of 200,000 always is. Of all
    # steps together, a share eta = 1.2e-7 * sqrt(10,000 summands) of the usual gradient leaves
    # sqrt(2 * eta) = 0.5 % open (measured: 0.04 %). A mean left out leaves more than half.
    assert np.linalg.norm(apart) < 0.01 * np.linalg.norm(moved)


def train_start() -> dict[str, np.ndarray]:
    """The weights before the first step."""
    network = TrainingState(small_run(), CPU).network
    return {name: value.detach().numpy() for name, value in network.named_parameters()}


def test_shares_are_the_batch():
    """Whatever their number, the processes see the scenes that one would, each once."""
    pool = FixedPoints(np.zeros((1, 3), np.float32))
    config = SceneConfig(width=106, height=60)

    def stream(size: int) -> SceneStream:
        return SceneStream(anatomy(), UP, config, pool, 3, "train", size)

    whole = stream(4).batch(5).camera_from_ct
    parts = []
    for rank in range(2):
        group = ProcessGroup(CPU, rank, 2)
        (number,) = group.local_batches(range(5, 6))
        parts.append(stream(group.local_size(4)).batch(number).camera_from_ct)
    assert np.array_equal(np.concatenate(parts), whole)
    assert ProcessGroup(CPU).local_batches(range(3, 9)) == range(3, 9)
    assert len(ProcessGroup(CPU, 1, 2).local_batches(range(3, 9))) == 6
    with pytest.raises(InputError, match="a batch of 4 cannot be shared by 3 processes"):
        ProcessGroup(CPU, 0, 3).local_size(4)


@pytest.mark.parametrize("lost_at", ["init_process_group", "all_reduce", "destroy_process_group"])
def test_a_lost_process_is_one_error_wherever_it_is_missed(monkeypatch, lost_at):
    def lost(*_: object, **__: object) -> None:
        raise distributed.DistBackendError("Connection closed by peer")

    where = {"RANK": 0, "LOCAL_RANK": 0, "WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2}
    for name, value in {**where, "TORCHELASTIC_RUN_ID": "test"}.items():
        monkeypatch.setenv(name, str(value))
    for name in ("init_process_group", "all_reduce", "destroy_process_group"):
        gone = lost if name == lost_at else lambda *_, **__: None
        monkeypatch.setattr(distributed, name, gone)
    monkeypatch.setattr(distributed, "get_rank", lambda: 0)
    with pytest.raises(ProcessLost, match="of this training"), process_group("cpu") as group:
        group.all_reduce(0.0, False)


@pytest.mark.parametrize("share", [1, 3, 6])
def test_equal_shares_of_any_size_have_the_whole_batchs_loss_and_gradient(share):
    """Which clouds are shown the wrong way round is the batch's matter, not a process's."""
    torch.manual_seed(0)
    network = RegistrationNetwork(clinic_network(modes=5, scale_mm=50.0))
    network.points.normal_(std=30.0)
    network.modes.normal_()
    points_mm = torch.randn(12, 300, 3) * torch.tensor([40.0, 20.0, 5.0])
    poses = torch.eye(4).repeat(12, 1, 1)
    poses[:, :3, :3] = torch.linalg.qr(torch.randn(12, 3, 3)).Q
    places = torch.randn(12, 96, 3) * 30

    def learnt(rows: slice) -> tuple[float, np.ndarray]:
        network.zero_grad()
        loss = network.loss(
            points_mm[rows], places[rows], torch.zeros(1), poses[rows], first=rows.start
        )
        loss.backward()
        gradients = [parameter.grad.flatten() for parameter in network.parameters()]
        return float(loss.detach()), torch.cat(gradients).numpy().copy()

    loss, gradient = learnt(slice(0, 12))
    parts = [learnt(slice(first, first + share)) for first in range(0, 12, share)]
    assert np.mean([part[0] for part in parts]) == pytest.approx(loss, rel=1e-5)
    apart = np.mean([part[1] for part in parts], axis=0) - gradient
    assert np.abs(apart).max() < 1e-4 * np.abs(gradient).max()


def test_the_package_is_a_command():
    command = [sys.executable, "-m", "tumortrack", "train", "no-case", "model", "--steps", "-1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert done.stderr == "tumortrack: --steps -1 must be 0 or more.\n"
