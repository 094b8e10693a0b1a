"""The weights of the built-in phantom that come with the package."""

import numpy as np
import pytest

import tumortrack as tt
from tumortrack.core import store
from tumortrack.registration.method import method_of_preset
from tumortrack.report.protocol import evaluate_scene


@pytest.fixture(scope="module")
def folder():
    found = method_of_preset("quick").phantom_model("quick")
    assert found is not None
    return found


def test_they_are_small_and_say_how_they_were_made(folder):
    assert sum(path.stat().st_size for path in folder.iterdir()) < 5e6
    about = store.read_manifest(folder, "model")  # checks the hash of the weights
    assert about["provenance"]["decided_by"]["--seed"] == 0
    assert about["provenance"]["steps"] > 1000
    assert method_of_preset("paper").phantom_model("paper") is None


def test_they_find_the_phantoms_tumors_at_rest(folder):
    tracker = tt.Tracker(tt.load_model(folder, "cpu"))
    ((name, scene),) = tt.datasets.phantom_scenes(1).items()
    entry, _ = evaluate_scene(lambda cloud: tracker.locate(cloud, grid=64), scene, name)
    far_mm = [part["center_mm"] for part in entry["parts"].values()]
    assert len(far_mm) == 3
    assert np.max(far_mm) < 5
