"""The demo from its first line to its page."""

from __future__ import annotations

import json

import pytest

from stories import succeeded, tumortrack
from tumortrack.core import store
from tumortrack.io.case import load_case
from tumortrack.io.scene_folder import list_scenes, read_scene
from tumortrack.simulation import datasets

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The folder, and what was printed."""
    out = tmp_path_factory.mktemp("demo") / "demo"
    return out, succeeded(tumortrack("demo", "--out", out, "--scenes", 2))


def test_the_demo_tells_the_whole_story(demo):
    out, said = demo
    assert [f"{n}/3" in said for n in range(1, 4)] == [True] * 3
    case = load_case(out / "case")
    assert case.ct is not None
    assert len(case.anatomy.tumors) == 2
    report = json.loads((out / "report.json").read_text())
    names = [folder.name for folder in list_scenes(out / "dataset")]
    shown = datasets.phantom_scenes(2)
    assert names == [entry["name"] for entry in report["scenes"]] == list(shown)
    assert report["model_sha256"] == store.sha256_of(out / "case" / "model" / store.MANIFEST)
    assert report["patient"] == {"id": "PHANTOM", "side": "right"}  # of the scanner's DICOM tags
    assert "PHANTOM" in (out / "index.html").read_text()
    assert report["model"]["case_sha256"] == store.sha256_of(out / "case" / store.MANIFEST)
    assert report["summary"]["tre_mm"]["scenes"] == 2  # the default preset knows correspondences
    for name, entry in zip(names, report["scenes"], strict=True):
        scene = read_scene(out / "dataset" / name)
        # True surfaces have the case's triangles, on any machine.
        assert entry["baselines"]["best_rigid_pose"]["by"] == "triangles"
        assert entry["message"] == scene.meta["words"] == shown[name].meta["words"]
        assert len(scene.reference.tumors) == 2
        assert (out / "scenes" / f"{name}.png").stat().st_size > 10_000
    assert (out / "index.html").stat().st_size > 100_000  # self-contained, with its viewer
    closing = said[said.index("rigid fit") :]
    assert all(name in closing for name in names)
    assert str(out / "index.html") in said.replace("\n", "")
