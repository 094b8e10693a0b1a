"""`margins` as a user meets it: calibrate, state, plan; what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from stories import answered, refusal, succeeded, tumortrack
from tumortrack.core import store
from tumortrack.core.evidence import evidence_json
from tumortrack.core.mesh_files import read_mesh
from tumortrack.report.metrics import outward_miss
from tumortrack.simulate.scene_folder import list_scenes, read_scene
from tumortrack.tracking.margins import read_margins
from tumortrack_lab.world.evidence import EXACT, EvidenceSource

COUNT = 56  # 7 tested states without a gross miss show 50 %; two fifths of good ones are tested


@pytest.fixture(scope="module")
def scenes(once, phantom_case):
    """Scenes, a state each, with targets."""

    def make(folder):
        succeeded(tumortrack("simulate", phantom_case, folder, "--scenes", COUNT, "--elastic"))
        for scene in list_scenes(folder):
            meta = {**store.read_json(scene / "meta.json"), "family": "bed", "visible_share": 0.9}
            store.write_json(scene / "meta.json", meta)

    return once("margin_scenes", make)


def test_margins_are_found_stated_and_planned_with(ready_case, scenes, tmp_path):
    """Of a case: they are kept beside its model."""
    case, model = tmp_path / "case", tmp_path / "case" / "model"
    shutil.copytree(ready_case, case)
    table = model / "margins.jsonl"
    cloud, run = list_scenes(scenes)[3] / "cloud.ply", tmp_path / "run"
    said = answered(tumortrack("locate", case, cloud, tmp_path / "before", "--device", "cpu"))
    assert "no margin: the model was not calibrated" in said
    assert "give folders of scenes" in refusal(tumortrack("margins", case))
    calibrate = ("margins", case, scenes, "--device", "cpu", "--confidence")
    assert "from 0.5 to 0.99" in refusal(tumortrack(*calibrate, 95))
    said = refusal(tumortrack(*calibrate, 0.95))
    assert f"{COUNT} scenes given, a state each; about 180 are needed" in said
    assert not table.exists()  # nothing was located in vain
    succeeded(tumortrack(*calibrate, 0.5))
    located = table.read_bytes()
    assert located.count(b"\n") == 1 + COUNT
    assert "touches6 is not allowed" in refusal(
        tumortrack(*calibrate, 0.5, "--evidence", "touches6")
    )
    said = succeeded(tumortrack(*calibrate, 0.5, 0.6, "--evidence", "touch6"))
    assert table.read_bytes() == located  # located once
    assert "60 % margin of a tumor's surface: " in said
    assert "50 % margin of mapped points: " in said
    assert "bed, over 2/3, " in said
    assert "with touch6 or more beside the cloud:" in said
    assert (model / "margins-touch6.jsonl").read_bytes().count(b"\n") == 1 + COUNT

    rows = [json.loads(line) for line in located.splitlines()[1:]]
    clouds = [Path(row["scene"]) / "cloud.ply" for row in rows if not row["doubt"]]
    for good in clouds:
        said = answered(tumortrack("locate", case, good, run, "--overwrite"))
        if store.read_json(run / "report.json")["margin"]["stated"]:
            break
    radii = store.read_json(run / "report.json")["margin"]["stated"]
    assert [one["confidence"] for one in radii] == [0.5, 0.6]
    radius = radii[1]["mm"]["tumor_1"]
    assert radii[0]["mm"]["tumor_1"] <= radius
    assert f"60 % margin {radius:.1f} mm" in said
    shell, tumor = (read_mesh(run / f"{name}.ply") for name in ("tumor_1_margin", "tumor_1"))
    assert outward_miss(tumor, shell) == pytest.approx(radius, abs=0.2)

    file = tmp_path / "evidence.json"
    for good in clouds:  # the first that is as good with seven touches
        source = EvidenceSource.of(read_scene(good.parent), [0], EXACT)
        pieces = [piece.evidence for piece in source.touches_at_random(7, None)]
        file.write_bytes(evidence_json(tuple(pieces)))
        touched = ("--evidence", file, "--device", "cpu", "--overwrite")
        answered(tumortrack("locate", case, good, tmp_path / "touched", *touched))
        report = store.read_json(tmp_path / "touched" / "report.json")
        if report["margin"]["stated"]:
            break
    group = read_margins(model).others[0]
    deviation = report["parts"]["tumor_1"]["surface_std_mm"]
    figures = {"rarity": report["motion"]["rarity"]}
    at = group.shells[1].radii["tumor"].at(deviation, figures)
    assert report["margin"]["stated"][1]["mm"]["tumor_1"] == pytest.approx(at)

    plan = ("plan", run, tmp_path / "plan", "--no-arms", "--confidence")
    assert "states no 95 % margin of tumor_2" in refusal(tumortrack(*plan, 0.95))
    beside = ("--margin", 1, "--keep-away", "tumor_1=0.5", "--accept-budget")  # there is no room
    said = succeeded(tumortrack(*plan, 0.6, *beside))
    budgets = store.read_json(tmp_path / "plan" / "plan.json")["budgets"]
    stated = {budget["part"]: budget for budget in budgets}
    radius = radii[1]["mm"]["tumor_2"]
    assert list(stated) == ["tumor_2", "tumor_1"]
    for part, budget in stated.items():
        assert budget["tracking_mm"] == radii[1]["mm"][part]
        assert budget["confidence"] == 0.6
    assert f"tracking {radius:5.1f}  60 % margin" in said
    assert f"within {radius:.1f} mm of its estimate in 60 of 100 such cases" in said

    meta = list_scenes(scenes)[0] / "meta.json"
    written = meta.read_bytes()
    try:
        meta.write_bytes(written + b" ")
        assert "was changed since it was located" in refusal(tumortrack(*calibrate, 0.5))
    finally:
        meta.write_bytes(written)
    manifest = store.read_json(model / store.MANIFEST)
    trust = {**manifest["trust"], "std_scale": 1.25}
    store.write_json(model / store.MANIFEST, {**manifest, "trust": trust})
    said = refusal(tumortrack("locate", case, cloud, tmp_path / "after"))
    assert "margins.json is of another model, or this one was changed" in said
    assert "begun with another model_sha256" in refusal(tumortrack(*calibrate, 0.5))
