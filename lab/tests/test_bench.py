"""The bench: figures that follow from their definitions, naive forms that give the same answers."""

import csv
import json
import sys
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from clock import Clock
from stories import tumortrack
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_lab.bench import rows as interleaving
from tumortrack_lab.bench import run as running
from tumortrack_lab.bench import subject as subject_module
from tumortrack_lab.bench.naive import NaiveOccupancy, flowed
from tumortrack_lab.bench.report import BLOCKS, GOALS, goals_of, write_bench
from tumortrack_lab.bench.rows import (
    BenchResult,
    BenchRow,
    InterleavedTiming,
    Uncounted,
    Workload,
    interleaved,
    timing_of,
)
from tumortrack_lab.bench.run import GROUPS, Task, TaskMessage, carry_out, tasks_of
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.study.document import closing, opening
from tumortrack_occupancy.config import MlpDecoderConfig, NetworkConfig
from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack_occupancy.network import OccupancyNetwork
from tumortrack_occupancy.normalisation import CloudBox
from tumortrack_occupancy.presets import quick_network


def timing(median_s: float) -> InterleavedTiming:
    return timing_of([0.9 * median_s, median_s, 1.2 * median_s])


def test_turns_are_fair_and_what_is_not_counted_is_left_out(monkeypatch) -> None:
    clock, order = Clock(), []
    monkeypatch.setattr(interleaving, "time", clock)

    def slow() -> None:
        order.append("slow")
        clock.sleep(0.02)

    def fast() -> Uncounted:
        order.append("fast")
        clock.sleep(0.015)
        return Uncounted(0.01)

    slow_s, fast_s = interleaved(slow, fast, budget_s=0.2)
    assert slow_s.median_s == pytest.approx(0.02)
    assert fast_s.median_s == pytest.approx(0.005)  # a hundredth is not counted
    assert order[4:8] == ["slow", "fast", "slow", "fast"]  # after two calls of each to warm up
    assert 3 <= slow_s.turns <= 6
    for one in (slow_s, fast_s):
        assert one.best_s <= one.low_s <= one.median_s <= one.high_s


def normed_network() -> NetworkConfig:
    levels = (
        SetAbstraction(ratio=0.5, radius=0.2, neighbours=16, widths=(8, 16)),
        SetAbstraction(ratio=0.25, radius=0.4, neighbours=8, widths=(16, 24)),
    )
    decoder = MlpDecoderConfig(
        n_classes=3, width=24, hidden_layers=4, skip_layer=3, norm_layers=(3, 4)
    )
    encoder = PointNet2Config(levels=levels, widths=(24, 32))
    return NetworkConfig(encoder=encoder, decoder=decoder, normalisation=CloudBox())


@pytest.mark.parametrize("config", [normed_network(), quick_network(4, 60.0)])
def test_the_naive_network_is_the_network(config: NetworkConfig) -> None:
    torch.manual_seed(1)
    network = OccupancyNetwork(config)
    clouds = 30 * torch.randn(2, 300, 3) + torch.tensor([0.0, 5.0, 150.0])
    queries = 40 * torch.randn(2, 50, 3) + torch.tensor([0.0, 5.0, 150.0])
    with torch.no_grad():
        for training in (True, False):  # the first settles the norms' statistics
            network.train(training)
            plain = NaiveOccupancy(network)
            if training:
                network(clouds, queries)
                continue
            expected = network(clouds, queries)
            found = plain.logits(plain.encode(clouds), queries)
    assert float(expected.std()) > 1e-3
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)


def test_the_naive_flow_is_the_flow() -> None:
    from tumortrack.simulate.elastic.body import ElasticBody

    rng = np.random.default_rng(0)
    waves = np.sin(np.linspace(0, 3, 7))[:, None, None, None, None] * rng.normal(
        size=(1, 7, 7, 3, 2)
    )
    smooth = (waves + np.roll(waves, 1, 1) + np.roll(waves, 1, 2)).astype(np.float32)
    states = rng.normal(size=(5, 2)).astype(np.float32)
    body = ElasticBody(np.zeros(3, np.float32), 20.0, np.full(3, 60.0), smooth, states)
    points = rng.uniform(25, 95, (200, 3)).astype(np.float32)
    moved = body.carry(states[0], points)
    assert np.linalg.norm(moved - points, axis=1).max() > 1.0
    np.testing.assert_allclose(flowed(body, states[0], points), moved, atol=0.1)


def some_bench() -> BenchResult:
    row = BenchRow(
        name="frame",
        what="paper",
        threads=2,
        item="frame",
        ours=timing(0.04),
        naive=timing(1.2),
        naive_is="plain",
        agreement=0.99941,
    )
    follow = BenchRow(
        name="tracking frame", what="clinic", threads=2, item="frame", ours=timing(0.006)
    )
    machine = {"processor": "a processor", "GPU": "none at hand", "date": "2026-01-02"}
    return BenchResult(machine=machine, command="the command", rows=(row, follow))


def test_goals_are_judged_by_what_was_measured() -> None:
    goals = {goal["figure"]: goal for goal in goals_of(some_bench())}
    assert len(goals) == len(GOALS)
    frame = goals["frame (1,000 points, 40,000 queries), paper, 2 CPU cores"]
    assert frame["measured here"] == "30.0 x (40.0 ms, naive 1.20 s), 99.941 % equal"
    assert frame["met"] == "yes"
    tracking = goals["tracking frame, clinic, 2 CPU cores"]
    assert (tracking["measured here"], tracking["met"]) == ("6.00 ms", "no")
    open_ones = [goal["measured here"] for goal in goals.values() if not goal["met"]]
    assert open_ones.count("no GPU was at hand") == 3
    assert open_ones.count("not measured in this run") == len(GOALS) - 5


def test_a_document_is_filled_and_the_rest_of_it_stays(tmp_path) -> None:
    document = tmp_path / "docs" / "performance.md"
    document.parent.mkdir()
    blocks = "\n".join(f"{opening(name)}\nold\n{closing(name)}" for name in BLOCKS)
    document.write_text(f"before\n{blocks}\nafter")
    data = document.parent / "data"
    written = write_bench(some_bench(), tmp_path / "bench.json", document)
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after")
    assert "old" not in text
    assert "| frame | paper | 40.0 ms a frame | 1.20 s | 30.0 x | 99.941 % |" in text
    assert "\n\n[Every row: 2 rows](data/speed.csv)\n\n" in text
    head, frame, _ = csv.reader((data / "speed.csv").read_text().splitlines())
    values = dict(zip(head, frame, strict=True))
    assert (values["ms"], values["naive ms"], values["times faster"]) == ("40.0", "1200", "30.0")
    assert values["labels equal %"] == "99.941"
    tables = [data / f"speed{name}.csv" for name in ("", "_goals", "_machine")]
    assert written == [tmp_path / "bench.json", document, *tables]


def test_a_large_network_to_measure_is_saved_and_read_again(tmp_path, monkeypatch):
    for name, small in (("_SETTLED", 1), ("_PER_SIDE", 8), ("_STEPS", 1)):
        monkeypatch.setattr(subject_module, name, small)
    subject = BenchSubject(tmp_path)
    subject.make("paper", lambda *_: None)
    assert subject.has("paper")
    assert subject.model("paper").provenance["steps"] == 1


def test_a_process_measures_a_part(tmp_path, monkeypatch) -> None:
    def workloads(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
        yield Workload("part", "", "sum", lambda: sum(range(99)), lambda: sum(range(9999)))

    monkeypatch.setattr(running, "resolve_name", lambda name: workloads)
    task = Task(threads=1, folder="", parts=(("machine",), ("group", "planning")), quick=True)
    messages: list[TaskMessage] = []
    carry_out(task, BenchSubject(tmp_path), messages.append)
    (row,) = [one.row for one in messages if one.row is not None]
    ours, naive = row.ours, row.naive
    assert naive is not None
    assert ours.best_s <= ours.low_s <= ours.median_s <= ours.high_s < naive.median_s
    assert row.ratio == naive.median_s / ours.median_s
    assert row.per_s == 1 / ours.median_s
    (machine,) = [one.machine for one in messages if one.machine is not None]
    assert int(machine["cores"]) >= 1
    assert [one.begins for one in messages if one.begins] == ["planning, one core"]


WORKER = """
import json, os, sys
task = json.loads(sys.argv[-1])
assert os.environ["OMP_NUM_THREADS"] == str(task["threads"])
print("a library's chatter")
print(json.dumps({"begins": "something"}))
parts = [tuple(part) for part in task["parts"]]
if ("machine",) in parts:
    print(json.dumps({"machine": {"date": "today"}}))
for group in (name for kind, *names in parts for name in names):
    time = dict(best_s=1.0, median_s=2.0, low_s=1.5, high_s=3.0, turns=3)
    row = dict(name=group, what="", threads=1, item="pair", ours=time)
    if group == "planning":
        row["naive"] = {**time, "median_s": 4.0}
    print(json.dumps({"row": row}))
if ("group", "tracking") in parts:
    sys.exit("tracking is broken")
"""


def test_the_command_gathers_what_processes_find(tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.setattr(running, "WORKER", [sys.executable, "-c", WORKER])
    out = tmp_path / "new" / "found.json"
    Bench(only=("training", "planning"), quick=True, out=out).run()
    found = json.loads(out.read_text())
    assert [row["name"] for row in found["rows"]] == ["planning", "training"]
    assert found["machine"] == {"date": "today"}
    assert found["command"] == "tumortrack bench --only training planning --quick"
    shown = capfd.readouterr().out
    assert "something; about" in shown  # and so many seconds left
    assert shown.index("  planning") < shown.index("  training") < shown.index("written to")
    first, second = (line for line in shown.splitlines() if "2.00 s a pair" in line)
    assert "; naive 4.00 s, 2.00 x; about " in first  # each as soon as it was measured
    assert "naive" not in second
    assert second.endswith(" left")
    with pytest.raises(TumortrackError, match="tracking is broken"):
        Bench(only=("tracking",), out=tmp_path / "none.json").run()
    assert not (tmp_path / "none.json").exists()


def test_each_process_has_its_own_threads_and_only_needed_models_are_made(tmp_path) -> None:
    common = Task(threads=1, folder=str(tmp_path))
    groups = ("planning", "frame", "tracking")
    first, one, two = tasks_of(common, groups, cores=4)
    made = ("make", "clinic"), ("make", "paper")
    assert (first.threads, first.parts) == (2, (("machine",), *made))
    assert (one.threads, one.parts) == (1, tuple(("group", name) for name in groups))
    assert (two.threads, two.parts) == (2, tuple(("group", name) for name in groups[1:]))
    (alone,) = tasks_of(common, ("planning",), cores=1)
    assert alone.parts == (("machine",), ("group", "planning"))


def test_what_cannot_be_measured_is_refused(tmp_path) -> None:
    assert "nonsense" in tumortrack("bench", "--only", "nonsense").stderr
    with pytest.raises(InputError, match="cannot be read"):
        Bench(document=tmp_path / "none.md").run()
    (tmp_path / "bare.md").write_text("no markers")
    with pytest.raises(InputError, match="results:speed"):
        Bench(document=tmp_path / "bare.md").run()


def test_the_command_line_names_every_part() -> None:
    from typing import get_args, get_type_hints

    assert set(get_args(get_args(get_type_hints(Bench)["only"])[0])) == set(GROUPS)
