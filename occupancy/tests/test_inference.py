"""Fast arithmetic against the network in single precision, and `tumortrack compile`."""

import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tumortrack.cli.doctor import Compile
from tumortrack_occupancy.config import MlpDecoderConfig, NetworkConfig
from tumortrack_occupancy.inference import Inference
from tumortrack_occupancy.network import OccupancyNetwork
from tumortrack_occupancy.normalisation import CloudBox
from tumortrack_occupancy.presets import quick_network

QUERIES = 6000  # no whole number of chunks
STEPS = 150


def wide() -> NetworkConfig:
    """The paper's kind, smaller: skip, norms, raw coordinates."""
    decoder = MlpDecoderConfig(
        n_classes=3, width=128, hidden_layers=5, skip_layer=3, norm_layers=(3, 5)
    )
    slim = quick_network(3, 50.0)
    return NetworkConfig(encoder=slim.encoder, decoder=decoder, normalisation=CloudBox())


def label_of(points: Tensor) -> Tensor:
    """An ellipsoid with a ball in it, camera frame, mm."""
    axes = torch.tensor([50.0, 30.0, 25.0])
    middle = torch.tensor([0.0, 0.0, 130.0])
    organ = ((points - middle) / axes).norm(dim=-1) < 1
    tumor = (points - middle - torch.tensor([20.0, 5.0, 0.0])).norm(dim=-1) < 18
    return torch.where(tumor, 2, organ.long())


@dataclass(frozen=True, eq=False)
class Learnt:
    """A network trained on one cloud's organ, and queries."""

    network: OccupancyNetwork
    cloud: np.ndarray
    queries: np.ndarray


def learnt(config: NetworkConfig) -> Learnt:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = -np.abs(directions[:, 2])  # the upper side of an organ
    cloud = (directions * [50.0, 30, 22.5] + [0, 0, 130]).astype(np.float32)
    lower, upper = cloud.min(0) - 10, cloud.max(0) + 40
    queries = rng.uniform(lower, upper, (QUERIES, 3)).astype(np.float32)
    out = OccupancyNetwork(config).eval()
    with torch.no_grad():
        latent = out.encode(torch.from_numpy(cloud)[None])
    out.decoder.train()
    optimizer = torch.optim.Adam(out.decoder.parameters(), 1e-3)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = 2e-3 * (1 - step / STEPS)  # norms settle
        points = torch.from_numpy(rng.uniform(lower, upper, (1, 512, 3)).astype(np.float32))
        terms = out.decoder.prepare(latent.vector)
        logits = out.query(replace(latent, terms=terms), points)
        optimizer.zero_grad()
        torch.nn.functional.cross_entropy(logits[0], label_of(points[0])).backward()
        optimizer.step()
    return Learnt(out.eval(), cloud, queries)


@pytest.fixture(scope="module", params=["wide", "quick"])
def known(request) -> Learnt:
    return learnt(wide() if request.param == "wide" else quick_network(3, 50.0))


@pytest.mark.slow
def test_bfloat16_gives_the_labels_of_single_precision(known):
    inference = Inference(known.network, bfloat16=True)
    latent = inference.encode(known.cloud)
    with torch.inference_mode():
        queries = torch.from_numpy(known.queries)[None]
        right = known.network.folded().query(latent, queries)[0]
    assert right.argmax(1).bincount()[:2].min() > 50
    answer = inference.logits(latent, known.queries)
    assert answer.dtype == torch.float32
    equal = (answer.argmax(1) == right.argmax(1)).double().mean()
    assert equal >= 0.99
    near = 0.08 * float(right.std())
    assert (answer - right).square().mean().sqrt() < near
    few = inference.logits(latent, known.queries[:7])
    torch.testing.assert_close(few, right[:7], atol=3 * near, rtol=0)


def test_folding_and_splitting_change_nothing_but_rounding(known):
    inference = Inference(known.network, bfloat16=False)
    with torch.inference_mode():
        cloud, queries = (torch.from_numpy(v)[None] for v in (known.cloud, known.queries))
        whole = known.network(cloud, queries)[0]
        latent = inference.network.encode(cloud)
    torch.testing.assert_close(inference.logits(latent, known.queries), whole, atol=1e-3, rtol=1e-4)


def test_compile_leaves_the_model_as_it_is_and_what_older_versions_kept_there(
    learnt_model, tmp_path, capsys
):
    folder = shutil.copytree(learnt_model, tmp_path / "model")
    (folder / "compiled").mkdir()
    (folder / "compiled" / "0123456789abcdef.json").write_text("{")  # of a version that chose
    before = sorted(folder.rglob("*"))
    Compile(model=folder, device="cpu").run()
    assert "nothing to compile" in capsys.readouterr().out
    assert sorted(folder.rglob("*")) == before
