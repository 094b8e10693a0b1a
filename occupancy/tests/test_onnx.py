"""`onnx`: ONNX Runtime gives the same logits as PyTorch; wrong arguments fail at once."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch

from stories import with_imports
from tumortrack.core.packages import to_install
from tumortrack.tracking.model_files import load_model
from tumortrack_occupancy.config import MlpDecoderConfig, NetworkConfig
from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack_occupancy.model import onnx_bytes
from tumortrack_occupancy.network import OccupancyNetwork
from tumortrack_occupancy.normalisation import Aligned


def answers(content: bytes, **inputs: np.ndarray) -> list[np.ndarray]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return session.run(None, inputs)


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = -np.abs(directions[:, 2])
    return (directions * [50, 30, 22] + [5, -3, 140]).astype(np.float32)[None]


@pytest.fixture(scope="module")
def occupancy(quick_model):
    """The presets' kind, small: farthest points, balls, a skip, norms, octaves, alignment."""
    torch.manual_seed(0)
    config = NetworkConfig(
        encoder=PointNet2Config(
            levels=(SetAbstraction(ratio=0.25, radius=0.5, neighbours=16, widths=(16, 32)),),
            widths=(64,),
            n_points=64,
        ),
        decoder=MlpDecoderConfig(
            n_classes=3,
            width=32,
            hidden_layers=3,
            skip_layer=2,
            norm_layers=(2,),
            octaves=(0,),
        ),
        normalisation=Aligned(scale_mm=50.0, reach=1.35),
    )
    network = OccupancyNetwork(config)
    model = replace(load_model(quick_model, "cpu"), network=network.eval())
    return network, onnx_bytes(model)


@pytest.mark.parametrize("count", [1, 2000])
def test_an_occupancy_network_gives_the_same_logits(occupancy, cloud, count):
    network, content = occupancy
    rng = np.random.default_rng(1)
    queries = rng.uniform(cloud.min(1) - 20, cloud.max(1) + 40, (1, count, 3)).astype(np.float32)
    (logits,) = answers(content, cloud_mm=cloud, queries_mm=queries)
    with torch.inference_mode():
        right = network(torch.from_numpy(cloud), torch.from_numpy(queries)).numpy()
    assert right.std() > 0.01
    np.testing.assert_allclose(logits, right, atol=1e-3)
    assert (logits.argmax(2) == right.argmax(2)).mean() >= 0.999


@pytest.mark.parametrize(
    ("command", "wrong"),
    [
        ("onnx NONE OUT.onnx", "NONE is not a tumortrack model"),
        ("onnx MODEL OUT.onnx", "MODEL has no network"),
        ("onnx CASE OUT.onnx", "CASE has no network"),
    ],
)
def test_what_is_wrong_is_said_before_pytorch_is_loaded(
    command, wrong, slim_model, phantom_case, tmp_path
):
    places = {"NONE": tmp_path / "none", "MODEL": slim_model, "CASE": phantom_case}
    for name, place in {**places, "OUT": tmp_path / "out"}.items():
        command, wrong = (text.replace(name, str(place)) for text in (command, wrong))
    done, imported = with_imports(*command.split())
    assert done.returncode == 2, done.stderr
    assert wrong in done.stderr
    assert "torch" not in imported
    assert not (tmp_path / "out.onnx").exists()


def test_a_missing_package_is_told_before_pytorch_is_loaded(quick_model, tmp_path):
    without = "import sys; sys.modules['onnx'] = None; from tumortrack.cli.main import main; main()"
    done, imported = with_imports("onnx", quick_model, tmp_path / "out.onnx", run=["-c", without])
    assert done.returncode == 2, done.stderr
    assert to_install("tumortrack-occupancy[onnx]") in done.stderr
    assert "torch" not in imported
