"""`margins`: the factor of known ratios, states and their table, and the command as used."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from refused import refused
from stories import answered, refusal, succeeded, tumortrack
from tumortrack.assessment.bound_factor import NAME, read_factor
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.io.scene_folder import list_scenes, read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks import margins
from tumortrack_benchmarks.margins import (
    LEAST,
    Locating,
    Row,
    factor_of,
    head_of,
    list_states,
    open_table,
)
from tumortrack_benchmarks.physics.scenes import simplified

FIRST, SECOND = Row("a", "1", ratio=0.5), Row("b", "2", doubt="poor")
COUNT = 12


@pytest.mark.parametrize(("count", "rank"), [(59, 57), (99, 95), (119, 114), (200, 191)])
def test_the_factor_is_the_known_order_statistic(count, rank):
    ratios = np.random.default_rng(0).permutation(np.arange(1, count + 1)) / 10
    rows = [Row(str(n), "", ratio=float(ratio)) for n, ratio in enumerate(ratios)]
    rows += [Row("poor", "", doubt="poor")] * 7
    assert factor_of(rows) == (rank / 10, count)


def test_a_factor_holds_for_as_many_as_it_says():
    rng, held = np.random.default_rng(1), []
    for _ in range(400):
        ratios = rng.exponential(size=LEAST + 100)
        found, _ = factor_of([Row("", "", ratio=float(ratio)) for ratio in ratios[:LEAST]])
        held.append((ratios[LEAST:] <= found).mean())
    assert np.mean(held) == pytest.approx(57 / 60, abs=0.006)  # four standard errors


def test_too_few_answers_are_refused_with_their_number():
    rows = [Row("", "", ratio=1.0)] * (LEAST - 1) + [Row("", "", doubt="poor")] * 100
    with refused(InputError, 58):
        factor_of(rows)


def test_a_table_goes_on_where_it_was_killed(tmp_path):
    path, head = tmp_path / "table.jsonl", head_of("abc", 0)
    with open_table(path, head) as (rows, add):
        assert rows == []
        add(FIRST)
        with pytest.raises(InputError), open_table(path, head):
            pass
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"scene": "un')  # killed while it wrote
    with open_table(path, head) as (rows, add):
        assert rows == [FIRST]
        add(SECOND)
    with open_table(path, head) as (rows, _):
        assert rows == [FIRST, SECOND]
    with (
        refused(InputError, "model_sha256", "seed"),
        open_table(path, head_of("other", 1)),
    ):
        pass
    path.write_bytes(whole[:10])  # the first line was cut short
    with open_table(path, head) as (rows, _):
        assert rows == []


def test_a_table_is_not_made_of_somebodys_notes(tmp_path):
    for text in ("first line\nno end of line", "[1]\n{}\n"):
        (tmp_path / "notes.txt").write_text(text)
        with (
            pytest.raises(InputError),
            open_table(tmp_path / "notes.txt", head_of("sha", 0)),
        ):
            pass
        assert (tmp_path / "notes.txt").read_text() == text


def test_one_scene_of_each_state_counts(tmp_path):
    for n in range(6):
        (tmp_path / f"{n}").mkdir()
        (tmp_path / f"{n}" / "cloud.ply").touch()
        store.write_json(tmp_path / f"{n}" / "meta.json", {"family": "bed", "state": f"s{n // 2}"})
    assert sorted(int(one.name) // 2 for one in list_states([tmp_path], 0)) == [0, 1, 2]
    picks = {tuple(one.name for one in list_states([tmp_path], seed)) for seed in range(20)}
    assert len(picks) > 4  # of 8
    store.write_json(tmp_path / "0" / "meta.json", {"state": "other", "model_organ": False})
    assert len(list_states([tmp_path], 0)) == 3


@pytest.fixture(scope="module")
def scenes(once, phantom_case):
    def make(folder):
        succeeded(tumortrack("simulate", phantom_case, folder, "--scenes", COUNT, "--elastic"))

    return once("margin_scenes", make)


def good_row(locating, scenes):
    rows = ((path, locating.row(read_scene(path), path)) for path in list_scenes(scenes))
    return next((path, row) for path, row in rows if row.ratio is not None)


def test_a_ratio_is_the_farthest_vertex_over_its_bound(ready_case, scenes):
    model = load_model(ready_case, "cpu")
    tracker = Tracker(replace(model, bound_factor=4.0))  # not counted: it would be found anew
    path, row = good_row(Locating(tracker, 0), scenes)
    scene = read_scene(path)
    found = Tracker(model).locate(scene.cloud, grid=8, full_view=scene.depth)
    ratios = []
    for rest, true, name in zip(
        tracker.anatomy_ct.tumors, scene.reference.tumors, model.parts[1:], strict=True
    ):
        moved, triangles = found.motion.forward(rest.vertices_mm), rest.faces.ravel()
        off_mm = np.linalg.norm(moved[triangles] - true.vertices_mm[true.faces.ravel()], axis=1)
        ratios.append(off_mm.max() / found.assessment.bounds[name].error_bound95_mm)
    assert row.ratio == pytest.approx(max(ratios), rel=1e-4)
    # A scene of the wider world has the triangles of the simplified case.
    few = simplified(tracker.anatomy_ct)
    wide = scene.reference.with_parts(
        p.with_vertices(found.motion.forward(p.vertices_mm)) for p in few.parts
    )
    exact = Locating(tracker, 0).row(replace(scene, reference=wide), path)
    assert exact.ratio == pytest.approx(0.0, abs=1e-6)


def test_a_factor_is_found_kept_and_applied(ready_case, scenes, tmp_path, monkeypatch):
    """Of a case: it is kept beside its model."""
    case, model = tmp_path / "case", tmp_path / "case" / "model"
    shutil.copytree(ready_case, case)
    table, calibrate = model / "margins.jsonl", ("margins", case, scenes, "--device", "cpu")
    assert refusal(tumortrack("margins", case))
    assert "59" in refusal(tumortrack(*calibrate))
    assert not table.exists()  # nothing was located in vain
    monkeypatch.setattr(margins, "LEAST", 2)
    monkeypatch.setattr(margins, "_CONFIDENCE", 0.5)
    from tumortrack_benchmarks.cli.margins import Margins

    command = Margins(model=case, scenes=(scenes,), device="cpu")
    command.run()
    located = table.read_bytes()
    assert located.count(b"\n") == 1 + COUNT
    command.run()
    assert table.read_bytes() == located  # located once
    rows = [json.loads(line) for line in located.splitlines()[1:]]
    ratios = sorted(row["ratio"] for row in rows if row["ratio"] is not None)
    found = read_factor(model)
    assert (found.factor, found.answers) == (ratios[len(ratios) // 2], len(ratios))
    assert load_model(case, "cpu").bound_factor == found.factor
    assert found.message in succeeded(tumortrack("inspect", case))

    run, bounds = tmp_path / "run", {}
    for name, given in (("with", case), ("without", ready_case)):
        cloud = list_scenes(scenes)[0] / "cloud.ply"
        answered(tumortrack("locate", given, cloud, "--out", run / name, "--device", "cpu"))
        bounds[name] = store.read_json(run / name / "report.json")["assessment"]
    assert bounds["with"]["factor"] == found.factor
    assert bounds["without"]["factor"] == 1.0
    assert found.factor * bounds["without"]["bounds"]["tumor_1"][
        "error_bound95_mm"
    ] == pytest.approx(bounds["with"]["bounds"]["tumor_1"]["error_bound95_mm"])

    meta = list_scenes(scenes)[0] / "meta.json"
    written = meta.read_bytes()
    try:
        meta.write_bytes(written + b" ")
        with pytest.raises(InputError):
            command.run()
    finally:
        meta.write_bytes(written)
    manifest = store.read_json(model / store.MANIFEST)
    trust = {**manifest["calibration"], "std_scale": 1.25}
    store.write_json(model / store.MANIFEST, {**manifest, "calibration": trust})
    said = refusal(tumortrack("locate", case, cloud, "--out", tmp_path / "after"))
    assert NAME in said
    with refused(InputError, "model_sha256"):
        command.run()
