"""ONNX Runtime answers as PyTorch does."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch

from tumortrack.occupancy.config import MlpDecoderConfig, NetworkConfig
from tumortrack.occupancy.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack.occupancy.model import onnx_bytes
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.occupancy.normalisation import Aligned
from tumortrack.tracking.model_files import load_model


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
