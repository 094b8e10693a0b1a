"""Deformations of other packages: found by entry points, named in a configuration's JSON."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

MODULE = """
from dataclasses import dataclass

import numpy as np

from tumortrack.core.config import Config
from tumortrack.simulation.deform.base import View
from tumortrack.simulation.scene import SceneConfig  # the configuration that will hold it


@dataclass(frozen=True)
class Shift:
    way_mm: np.ndarray

    def apply(self, points_ct):
        return (points_ct + self.way_mm).astype(np.float32)

    def record(self):
        return {"kind": "shift", "way_mm": self.way_mm.tolist()}


class ShiftConfig(Config, frozen=True, tag="shift"):
    most_mm: float = 5.0

    def sample(self, view: View, rng: np.random.Generator) -> Shift:
        return Shift(rng.uniform(-self.most_mm, self.most_mm, 3))


class TakenConfig(Config, frozen=True, tag="drag"):
    def sample(self, view, rng): ...


class Unsampled(Config, frozen=True, tag="shift"):
    pass


nothing = 7
"""

USE = """
import sys
import json, pickle
import numpy as np
import tumortrack.simulation.deform
assert "shifting" not in sys.modules  # imported when a configuration is read
from render_objects import anatomy
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.simulation.scene import SceneConfig, SceneRecipe, Simulator, body_for

text = '''{"deform": [{"type": "shift", "most_mm": 9}, {"type": "chain", "links":
    [{"type": "drag"}, {"type": "shift"}]}], "occupancy": {"per_side": 16, "pool": 2000}}'''
config = from_builtins(json.loads(text), SceneConfig, "scene.json")
assert from_builtins(to_builtins(config), SceneConfig, "again") == config
assert pickle.loads(pickle.dumps(config)) == config
organ, up = anatomy(), (0.0, -1.0, 0.0)
assert body_for(organ, up, config, 0) is None
simulator = Simulator(organ, up, config)
records = []
for index in range(16):
    scene = simulator.render(SceneRecipe(0, "test", index))
    records.append(scene.deformation.record())
    if records[-1]["kind"] == "shift":
        moved = scene.deformation.apply(organ.organ.vertices_mm) - organ.organ.vertices_mm
        np.testing.assert_allclose(moved.mean(0), records[-1]["way_mm"], atol=1e-4)
        assert np.abs(moved).max() <= 9.001
kinds = {record["kind"] for record in records}
assert kinds == {"shift", "chain"}, kinds
print("used")
"""

READ = """
from tumortrack.core.config import from_builtins
from tumortrack.simulation.scene import SceneConfig
read = [{"type": "drag"}, {"type": "chain", "links": [{"type": "stretch"}]}]
from_builtins({"deform": read}, SceneConfig, "scene.json")
print("read")
"""
NAME = """
from_builtins({"deform": [{"type": "shift", "most_mm": 9}]}, SceneConfig, "scene.json")
"""


def run(folder: Path, value: str, code: str) -> subprocess.CompletedProcess[str]:
    """Python beside a distribution whose entry point is ``value``."""
    (folder / "shifting.py").write_text(MODULE)
    about = folder / "shifting_organs-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: shifting-organs\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[tumortrack.deformations]\nshift = {value}\n")
    paths = [str(folder), str(Path(__file__).parents[1] / "support")]
    begin = f"import sys; sys.path[:0] = {paths}\n"
    command = [sys.executable, "-c", begin + code]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_scene_takes_an_installed_deformation_from_json(tmp_path):
    done = run(tmp_path, "shifting:ShiftConfig", USE)
    assert done.stdout == "used\n", done.stderr


def test_the_foreign_module_may_be_imported_first(tmp_path):
    done = run(tmp_path, "shifting:ShiftConfig", f"import shifting\n{READ}")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("value", ["Absent", "nothing", "Unsampled", "TakenConfig"])
def test_a_broken_one_is_refused_with_its_package_where_it_is_named_alone(tmp_path, value):
    done = run(tmp_path, f"shifting:{value}", READ + NAME)
    assert done.stdout == "read\n", done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert "PackageError" in last
    assert "shifting-organs" in last
