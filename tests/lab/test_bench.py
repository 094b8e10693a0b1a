"""The bench: figures that follow from their definitions, naive forms that give the same answers."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from clock import Clock
from stories import tumortrack
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.models.config import MlpDecoderConfig, NetworkConfig
from tumortrack.models.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack.models.normalisation import CloudBox
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.training.presets import quick_network
from tumortrack_lab.bench import rows as interleaving
from tumortrack_lab.bench import training
from tumortrack_lab.bench.groups import GROUPS
from tumortrack_lab.bench.machine import describe_machine
from tumortrack_lab.bench.naive import NaiveOccupancy
from tumortrack_lab.bench.report import BLOCKS, GOALS, goals_table, write_bench
from tumortrack_lab.bench.rows import (
    BenchResult,
    BenchRow,
    InterleavedTiming,
    Workload,
    interleaved,
    timing_of,
)
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.study.document import closing, opening


def timing(median_s: float) -> InterleavedTiming:
    return timing_of([0.9 * median_s, median_s, 1.2 * median_s])


def test_turns_are_fair(monkeypatch) -> None:
    clock, order = Clock(), []
    monkeypatch.setattr(interleaving, "time", clock)

    def slow() -> None:
        order.append("slow")
        clock.sleep(0.02)

    def fast() -> None:
        order.append("fast")
        clock.sleep(0.015)

    slow_s, fast_s = interleaved(slow, fast, budget_s=0.2)
    assert slow_s.median_s == pytest.approx(0.02)
    assert fast_s.median_s == pytest.approx(0.015)
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
    rows = (row, follow)
    return BenchResult(machine=machine, command="the command", rows=rows)


def test_goals_are_judged_by_what_was_measured() -> None:
    lines = goals_table(some_bench()).splitlines()
    assert len(lines) == len(GOALS) + 2
    (frame,) = [line for line in lines if "`paper`, 2 CPU" in line and "frame" in line]
    assert "30.0 x (40.0 ms, naive 1.20 s), 99.941 % equal | yes |" in frame
    (tracking,) = [line for line in lines if "tracking" in line]
    assert tracking.endswith("| 6.00 ms | no |")
    assert sum("no GPU was at hand |  |" in line for line in lines) == 3
    assert sum("not measured in this run |  |" in line for line in lines) == len(GOALS) - 5


def test_a_document_is_filled_and_the_rest_of_it_stays(tmp_path) -> None:
    document = tmp_path / "docs" / "performance.md"
    document.parent.mkdir()
    blocks = "\n".join(f"{opening(name)}\nold\n{closing(name)}" for name in BLOCKS)
    document.write_text(f"before\n{blocks}\nafter")
    written = write_bench(some_bench(), tmp_path / "bench.json", document)
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after")
    assert "old" not in text
    assert "| frame | paper | 2 | 40.0 ms a frame |" in text
    assert "| 25.0 | 1.20 s | 30.0 x | 99.941 % |" in text
    assert "- frame (paper, 2): naive: plain." in text
    assert [path.name for path in written] == ["bench.json", "performance.md"]
    assert len(json.loads((tmp_path / "bench.json").read_text())["rows"]) == 2


def small_subject(folder: Path) -> BenchSubject:
    """The bench's subject with a ball and a tumor in place of the phantom."""
    import trimesh

    def ball(radius_mm: float, x_mm: float) -> Mesh:
        sphere = trimesh.creation.icosphere(2, radius_mm)
        return Mesh(sphere.vertices + [x_mm, 0, 0], sphere.faces)

    subject = BenchSubject({}, folder)
    subject.__dict__["anatomy"] = Anatomy((ball(30.0, 0.0), ball(8.0, 10.0)))
    return subject


def test_a_workload_becomes_a_row(tmp_path) -> None:
    (workload,) = training.drags(small_subject(tmp_path), 0.1)
    row = workload.row(1, 0.1)
    ours = row.ours
    assert 1e-5 < ours.best_s <= ours.low_s <= ours.median_s <= ours.high_s
    assert row.per_s == 1 / ours.median_s
    assert (row.name, row.what, row.item, row.naive) == ("generator", "drags", "pair", None)
    assert int(describe_machine()["cores"]) >= 1


def test_the_command_says_and_writes_what_it_found(tmp_path, monkeypatch, capfd) -> None:
    def two(subject: BenchSubject, seconds: float) -> Iterator[Workload]:
        for name, naive in (("one", None), ("two", lambda: None)):
            yield Workload(name, "", "pair", lambda: None, naive)

    monkeypatch.setattr(training, "drags", two)
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None, raising=False)
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    out = tmp_path / "new" / "found.json"
    Bench(only=("generator",), quick=True, out=out).run()
    found = json.loads(out.read_text())
    assert [row["name"] for row in found["rows"]] == ["one", "two"]
    assert found["machine"]["processor"]
    assert found["command"] == "tumortrack bench --only generator --quick"
    shown = capfd.readouterr().out
    assert shown.index("  one") < shown.index("  two") < shown.index("written to")
    first, second = (line for line in shown.splitlines() if " a pair" in line)
    assert "naive" not in first
    assert second.endswith(" x")


def test_what_cannot_be_measured_is_refused(tmp_path) -> None:
    assert "nonsense" in tumortrack("bench", "--only", "nonsense").stderr
    with pytest.raises(InputError, match="cannot be read"):
        Bench(document=tmp_path / "none.md").run()
    (tmp_path / "bare.md").write_text("no markers")
    with pytest.raises(InputError, match="results:goals"):
        Bench(document=tmp_path / "bare.md").run()


def test_the_command_line_names_every_part() -> None:
    from typing import get_args, get_type_hints

    assert set(get_args(get_args(get_type_hints(Bench)["only"])[0])) == set(GROUPS)
