"""Methods that installed packages bring: found where they are asked for, named where they fail."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import tumortrack as tt
from extension_objects import distribution
from refused import refused
from tumortrack.cli.doctor import Doctor
from tumortrack.core.errors import InputError, PackageError, TumortrackError
from tumortrack.registration.base_model import ModelConfig
from tumortrack.registration.method import method_of_config, method_of_preset
from tumortrack.simulation.scene import SceneConfig

METHOD = """
from dataclasses import replace
from tumortrack.registration.base_model import ModelConfig
from tumortrack.simulation.scene import SceneConfig

class GuessConfig(ModelConfig, frozen=True):
    scene: SceneConfig = SceneConfig()

class Guess:
    presets = {"guess": lambda anatomy, rotations: GuessConfig()}
    def has_config(self, config):
        return isinstance(config, GuessConfig)
    def has_model(self, manifest):
        return "guess" in manifest["config"]
    def train(self, case, folder, config, options, report):
        return replace(self.model, provenance={"of": (case.sha256, folder, config, options)})
    def load(self, folder, manifest, device, **known):
        raise NotImplementedError
    def locator(self, model):
        return self
    anatomy_ct = None
    def locate(self, looks, grid, seed):
        raise NotImplementedError
    follow = warm = locate
    def hardware(self):
        return ["abacus: 12 beads"]

METHOD = Guess()
"""


class Unknown(ModelConfig, frozen=True):
    scene: SceneConfig = SceneConfig()


@pytest.fixture
def guess(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The module of an installed method."""
    distribution(tmp_path, "guessing", {"tumortrack.methods": {"guess": "guessing:METHOD"}})
    (tmp_path / "guessing.py").write_text(METHOD)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield __import__("guessing")
    del sys.modules["guessing"]


def test_a_package_brings_a_method(guess, slim_model, phantom_case, tmp_path, capsys):
    assert method_of_preset("guess") is guess.METHOD
    config, folder = guess.GuessConfig(), tmp_path / "model"
    guess.METHOD.model = tt.load_model(slim_model)
    made = tt.train(phantom_case, folder, config=config, steps=7, seed=3)
    sha256, where, given, options = made.provenance["of"]
    assert (sha256, where, given) == (tt.load_case(phantom_case).sha256, folder, config)
    assert (options.steps, options.seed, options.minutes) == (7, 3, None)
    assert method_of_config(config).locator(made) is guess.METHOD
    Doctor().run()
    assert "abacus: 12 beads" in capsys.readouterr().out


@pytest.mark.usefixtures("guess")
def test_a_configuration_of_no_method_is_refused(phantom_case, tmp_path):
    with refused(InputError, "guess"):
        tt.train(phantom_case, tmp_path / "model", config=Unknown())
    with pytest.raises(InputError):
        tt.train(phantom_case, tmp_path / "model", config=Unknown(), sensor="stereo")


def test_a_broken_method_is_named_and_stops_no_other(tmp_path, monkeypatch, capsys):
    distribution(tmp_path, "aaa", {"tumortrack.methods": {"aaa": "no_such_module:METHOD"}})
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "quick" in method_of_preset("quick").presets
    with refused(PackageError, "aaa"):
        method_of_config(Unknown())
    with pytest.raises(TumortrackError):
        Doctor().run()
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("BROKEN ") and "aaa" in line]
