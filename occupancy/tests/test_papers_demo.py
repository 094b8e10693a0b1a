"""The demo of the paper's method, with hardly any training."""

import nibabel
import pytest

from stories import succeeded, tumortrack
from tumortrack.core import store
from tumortrack.registration.method import method_of_preset
from tumortrack.report.inspection import describe

pytestmark = pytest.mark.slow


def test_the_papers_chain_runs_beside_it(tmp_path):
    out = tmp_path / "demo"
    options = ("--preset", "quick", "--minutes", 0.2, "--scenes", 2)
    said = succeeded(tumortrack("demo", "--out", out, *options))
    assert said.index("default method:") < said.index("the paper's, quick:")
    digest = store.sha256_of(out / "model" / store.MANIFEST)
    report, run = (store.read_json(out / "paper" / x) for x in ("report.json", "run/report.json"))
    assert report["model_sha256"] == digest
    names = [entry["name"] for entry in report["scenes"]]
    assert names == [entry["name"] for entry in store.read_json(out / "report.json")["scenes"]]
    assert (out / "paper" / "index.html").stat().st_size > 10_000
    if run.get("quality", {}).get("verdict") != "none":  # as so short a training may end
        assert run["model_sha256"] == digest
        assert max(nibabel.load(out / "paper" / "run" / "labels.nii.gz").shape) == 400
    planned = (out / "paper" / "plan" / "plan.json").is_file()
    assert planned != ("no plan: " in said)  # as so short a training may end
    assert any("it labels points" in line for line in describe(out / "model"))
    assert any("trained for " in line for line in describe(out / "model"))


def test_without_minutes_it_takes_the_weights_that_come_with_the_package(tmp_path):
    said = succeeded(tumortrack("demo", "--out", tmp_path, "--preset", "quick", "--scenes", 1))
    shipped = method_of_preset("quick").phantom_model("quick")
    digest = store.sha256_of(shipped / store.MANIFEST)
    assert store.read_json(tmp_path / "paper" / "report.json")["model_sha256"] == digest
    assert said.index("default method:") < said.index("the paper's, quick:")
