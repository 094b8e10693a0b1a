"""Fast arithmetic against the network in single precision, and what `tumortrack compile` keeps."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from tumortrack.cli.inspection import describe
from tumortrack.cli.models import Compile
from tumortrack.core.config import to_builtins
from tumortrack.models.config import MlpDecoderConfig, NetworkConfig
from tumortrack.models.normalisation import CloudBox
from tumortrack.occupancy.inference import Arithmetic, Inference, can_pack, possible, usual
from tumortrack.occupancy.locator import OccupancyLocator
from tumortrack.occupancy.model import (
    Compiled,
    find,
    like_an_organ,
    measured,
    place_of,
    read,
    save,
    this_machine,
)
from tumortrack.occupancy.model import describe as describe_compiled
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.training.model import load_model
from tumortrack.training.presets import quick_network

CPU = torch.device("cpu")
QUERIES = 6000  # enough for 8 bits, and no whole number of chunks
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
    """A network that knows one cloud's organ, and what to ask it."""

    network: OccupancyNetwork
    cloud: np.ndarray
    queries: np.ndarray


def learnt(config: NetworkConfig) -> Learnt:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    cloud = like_an_organ(50.0, rng)
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
@pytest.mark.parametrize("numbers", possible(CPU))
def test_fast_arithmetic_gives_the_labels_of_single_precision(numbers, known):
    inference = Inference(known.network, Arithmetic(numbers=numbers, chunk=1024))
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


@pytest.mark.skipif(not can_pack(CPU), reason="oneDNN's layers do not exist here")
def test_folding_and_splitting_change_nothing_but_rounding(known):
    inference = Inference(known.network, Arithmetic(numbers="float32", chunk=1000))
    with torch.inference_mode():
        cloud, queries = (torch.from_numpy(v)[None] for v in (known.cloud, known.queries))
        whole = known.network(cloud, queries)[0]
        latent = inference.network.encode(cloud)
    torch.testing.assert_close(inference.logits(latent, known.queries), whole, atol=1e-3, rtol=1e-4)


def test_usual_arithmetic_is_one_that_the_processor_has():
    assert usual(CPU).numbers == possible(CPU)[-1]


def test_compiled_is_found_again_and_not_where_anything_differs(learnt_model, tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    arithmetic, notice = find(folder, "weights")
    assert arithmetic is None
    assert "tumortrack compile" in notice
    compiled = measured_once(learnt_model)
    assert {timing.arithmetic.numbers for timing in compiled.timings} == set(possible(CPU))
    # bfloat16 keeps 8 bits: some 1 % of the logits' spread is lost, and labels differ where two
    # classes are nearer than that. A model that has learnt has few such places.
    assert all(timing.labels_equal > 0.99 for timing in compiled.timings)
    path = save(folder, compiled)
    assert read(path) == compiled
    assert find(folder, "weights") == (compiled.arithmetic, None)
    for change in ("weights", "machine", "threads", "damaged", "chunk", "schema"):
        arithmetic, notice = find(changed(folder, tmp_path / change, change), "weights")
        assert arithmetic is None
        assert "tumortrack compile" in notice


def measured_once(folder: Path) -> Compiled:
    model = load_model(folder, "cpu")
    half_mm = model.in_distribution.spread_mm[1]
    return measured(model.network, model.query_box_mm, half_mm, "weights", rounds=1)


def changed(folder: Path, copy: Path, what: str) -> Path:
    """A copy of the folder whose compiled file is not for here, or not whole."""
    (copy / "compiled").mkdir(parents=True)
    place = this_machine(), torch.get_num_threads()
    path = place_of(copy, *place)
    content = json.loads(place_of(folder, *place).read_text())
    if what == "weights":
        content["weights_sha256"] = "others"
    elif what == "machine":
        content["machine"]["torch"] = "1.0"
    elif what == "threads":
        content["threads"] += 1
    elif what == "chunk":
        content["arithmetic"]["chunk"] = 10**9
    elif what == "schema":
        content["schema"] = 0
    path.write_text("{" if what == "damaged" else json.dumps(content))
    return copy


def test_each_number_of_threads_has_its_own_choice(learnt_model, tmp_path, monkeypatch):
    """What is fastest on one core need not be on two."""
    alone = measured_once(learnt_model)
    many = msgspec.structs.replace(
        alone, threads=alone.threads + 1, arithmetic=other_than(alone.arithmetic)
    )
    save(tmp_path, many)
    arithmetic, notice = find(tmp_path, "weights")
    assert arithmetic is None
    assert f"threads ({alone.threads} here); the usual arithmetic is used" in notice
    save(tmp_path, alone)
    assert find(tmp_path, "weights") == (alone.arithmetic, None)
    lines = describe_compiled(tmp_path)
    assert len(lines) == 2
    for one in (alone, many):
        (line,) = [line for line in lines if f"for {one.threads} thread" in line]
        assert f": {one.arithmetic.numbers}, {one.arithmetic.chunk} queries" in line
        assert line.endswith("(this machine)")
    monkeypatch.setattr(torch, "get_num_threads", lambda: many.threads)
    assert find(tmp_path, "weights") == (many.arithmetic, None)


def other_than(arithmetic: Arithmetic) -> Arithmetic:
    return Arithmetic(numbers=arithmetic.numbers, chunk=arithmetic.chunk // 2)


def test_arithmetic_is_read_as_written():
    one = Arithmetic(numbers="bfloat16", chunk=2048)
    assert to_builtins(one) == {"numbers": "bfloat16", "chunk": 2048}


def test_compile_is_used_by_the_next_load_and_named_by_inspect(learnt_model, tmp_path, capsys):
    folder = shutil.copytree(learnt_model, tmp_path / "model")
    before = load_model(folder, "cpu")
    assert before.arithmetic is None
    assert "tumortrack compile" in before.notes[0]
    Compile(model=folder, device="cpu").run()
    said = capsys.readouterr().out
    assert all(numbers in said for numbers in possible(CPU))
    after = load_model(folder, "cpu")
    assert after.notes == ()
    assert after.arithmetic is not None
    assert after.arithmetic.numbers in said
    assert any("this machine" in line for line in describe(folder))
    assert OccupancyLocator(after).inference.arithmetic == after.arithmetic


def test_there_is_nothing_to_choose_for_a_model_that_places_the_organ(clinic_model, capsys):
    Compile(model=clinic_model, device="cpu").run()
    assert "nothing to choose" in capsys.readouterr().out
    assert not (clinic_model / "compiled").exists()
    assert load_model(clinic_model, "cpu").notes == ()
