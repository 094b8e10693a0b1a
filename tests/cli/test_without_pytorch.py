"""The tracker where neither the paper's method nor PyTorch is installed."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from stories import answered, cloud_by_rays, environment, looking_down, refusal, succeeded
from tumortrack.core import store
from tumortrack.core.packages import to_install
from tumortrack.io.case import load_case
from tumortrack.io.ply import write_cloud_ply

WITHOUT = """
import sys
from importlib.machinery import PathFinder

HIDDEN = {hidden}

class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, *place):
        return None if name in HIDDEN else super().find_spec(name, *place)

    @classmethod
    def find_distributions(cls, *context):
        for found in super().find_distributions(*context):
            if (found.name or "").replace("-", "_") not in HIDDEN:
                yield found

sys.meta_path[sys.meta_path.index(PathFinder)] = Without
"""
PAPERS = "torch", "tumortrack_occupancy"
COMMAND = "from tumortrack.cli.main import main; main()"
EVERYTHING = """
import pkgutil
import sys
from importlib import import_module
import tumortrack as tt

for name in tt.__all__:
    getattr(tt, name)
for module in pkgutil.walk_packages(tt.__path__, "tumortrack.", onerror=print):
    if not module.name.endswith("__main__"):
        import_module(module.name)
assert "torch" not in sys.modules
"""


def without_pytorch(
    program: str, *arguments: object, hidden: tuple[str, ...] = PAPERS
) -> subprocess.CompletedProcess[str]:
    code = WITHOUT.format(hidden=hidden) + program
    words = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=600, env=environment())


def test_every_module_can_be_imported():
    succeeded(without_pytorch(EVERYTHING))


@pytest.mark.parametrize("hidden", [PAPERS, PAPERS[:1], PAPERS[1:]])
def test_the_papers_method_names_its_package_in_one_line(hidden, phantom_case, tmp_path):
    out = tmp_path / "out"
    for command in (("train", phantom_case, out, "--preset", "paper"),
                    ("demo", "--out", out, "--preset", "quick")):  # fmt: skip
        line = refusal(without_pytorch(COMMAND, *command, hidden=hidden))
        assert to_install("tumortrack-occupancy") in line
    assert not out.exists()


def test_a_model_of_another_method_names_its_package(slim_model, tmp_path):
    manifest = store.read_json(slim_model / store.MANIFEST)
    del manifest["files"]["shape.safetensors"]
    shutil.copytree(slim_model, tmp_path / "model")
    store.write_json(tmp_path / "model" / store.MANIFEST, manifest)
    refused = refusal(without_pytorch(COMMAND, "compile", tmp_path / "model"))
    assert to_install("tumortrack-occupancy") in refused


@pytest.mark.slow
def test_a_phantom_is_prepared_and_located(phantom_case, tmp_path):
    known, file = load_case(phantom_case), tmp_path / "cloud.ply"
    write_cloud_ply(file, cloud_by_rays(known, looking_down(known), 0.02).astype("float32"))
    case, run = tmp_path / "case", tmp_path / "run"
    succeeded(without_pytorch(COMMAND, "prepare", phantom_case / "labels.nii.gz", "--out", case))
    said = answered(without_pytorch(COMMAND, "locate", case, file, "--out", run, "--grid", 48))
    assert "tumor_2: centre" in said
    assert (run / "index.html").exists()
