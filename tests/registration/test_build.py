"""A model of an organ: the same each time, sane, and kept in its case."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from elastic_objects import SMALL, UP
from refused import refused
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import SensorCloud
from tumortrack.io.case import Case, load_case, save_case
from tumortrack.io.model_folder import is_model_of, save_model
from tumortrack.registration.config import elastic
from tumortrack.registration.model import RegistrationModel, build_model
from tumortrack.simulation.deform import DragConfig, ElasticConfig
from tumortrack.simulation.noise import STEREO_NOISE
from tumortrack.tracking.model_files import case_model, load_model, make_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, slim_elastic


def test_the_same_arguments_give_the_same_model_and_it_is_sane(slim_model):
    kept, told = load_model(slim_model), []
    again = build_model(ANATOMY, UP, slim_elastic(), progress=lambda *done: told.append(done))
    assert again.calibration == kept.calibration
    assert again.in_distribution == kept.in_distribution
    arrays = kept.shape.to_arrays()
    for name, array in again.shape.to_arrays().items():
        np.testing.assert_array_equal(array, arrays[name], err_msg=name)
    other = build_model(ANATOMY, UP, slim_elastic(), seed=1)
    assert other.calibration != again.calibration
    for model in (again, other):
        assert 0.2 < model.calibration.std_scale < 5
        assert 1 < model.calibration.usual_cost < 300
        assert 0 < model.provenance["validation_tre_mm"] < 45  # the ellipsoid lies either way round
        assert model.provenance["validation_far"] < 0.5
    assert [done for done, _ in told] == [*range(1, told[0][1] + 1)]
    scene = msgspec.structs.replace(slim_elastic().scene, deform=(DragConfig(),))
    with pytest.raises(InputError):  # what is not elastic has no model
        build_model(ANATOMY, UP, msgspec.structs.replace(slim_elastic(), scene=scene))


def slim(case: Case) -> RegistrationModel:
    """A model of a case in seconds."""
    config = elastic(case.anatomy, case.rotations)
    deform = (ElasticConfig(body=SMALL),)
    scene = msgspec.structs.replace(config.scene, width=212, height=120, deform=deform)
    config = msgspec.structs.replace(config, scene=scene, scenes=6, searched=3)
    return make_model(case, config)


def test_a_case_keeps_its_model_until_it_changes(phantom_case: Path, tmp_path):
    folder = tmp_path / "case"
    shutil.copytree(phantom_case, folder, ignore=shutil.ignore_patterns(Case.MODEL))
    case = load_case(folder)
    first = slim(case)
    with store.new_folder(folder / "model") as aside:
        save_model(first, aside)
    assert first.provenance["case_sha256"] == case.sha256
    assert first.patient == case.patient
    kept = store.sha256_of(folder / "model")
    for again in (case_model(load_case(folder)), load_model(folder), Tracker(case).model):
        assert again.calibration == first.calibration
    assert store.sha256_of(folder / "model") == kept
    (folder / "model" / "shape.safetensors").rename(folder / "aside")
    with refused(ArtifactError, "shape.safetensors"):
        load_model(folder)
    (folder / "aside").rename(folder / "model" / "shape.safetensors")
    assert is_model_of(folder / "model", folder)
    save_case(replace(case, rotations="full", sensor="stereo"), folder)
    assert not is_model_of(folder / "model", folder)  # another is made in its place


@pytest.mark.slow
def test_a_case_that_lies_nowhere_has_a_model_all_the_same(phantom_case):
    seen_anyhow = replace(load_case(phantom_case), rotations="full", sensor="stereo")
    tracker = Tracker(replace(seen_anyhow, folder=None))
    assert tracker.model.registration.prior.unconstrained
    assert tracker.model.config.scene.noise == STEREO_NOISE
    organ = tracker.anatomy_ct.organ
    places = (organ.vertices_mm - organ.box_mm.mean(0))[:, [0, 2, 1]] * [1, -1, 1] + [0, 0, 160]
    near = places[places[:, 2] < np.median(places[:, 2])]
    found = tracker.locate(SensorCloud(near.astype(np.float32)), grid=16)
    rigid = found.motion.forward(organ.vertices_mm)
    assert np.linalg.norm(rigid - places, axis=1).mean() < 3
