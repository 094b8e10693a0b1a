"""The default method where PyTorch is not installed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from stories import answered, cloud_by_rays, environment, looking_down, refusal, succeeded
from tumortrack.imaging.case import load_case
from tumortrack.sense.ply import write_cloud_ply

WITHOUT = """
import sys
from importlib.machinery import PathFinder

class WithoutTorch(PathFinder):
    @classmethod
    def find_spec(cls, name, *place):
        return None if name == "torch" else super().find_spec(name, *place)

sys.meta_path[sys.meta_path.index(PathFinder)] = WithoutTorch
"""
COMMAND = "from tumortrack.cli.main import main; main()"
EVERYTHING = """
import pkgutil
from importlib import import_module
import tumortrack as tt

for name in tt.__all__:
    getattr(tt, name)
for module in pkgutil.walk_packages(tt.__path__, "tumortrack.", onerror=print):
    if "occupancy" not in module.name and not module.name.endswith("__main__"):
        import_module(module.name)
"""


def without_pytorch(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", WITHOUT + program, *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=600, env=environment())


def test_everything_but_the_papers_method_can_be_imported():
    succeeded(without_pytorch(EVERYTHING))


def test_the_papers_method_names_its_extra_in_one_line(phantom_case, tmp_path):
    train = ("train", phantom_case, tmp_path / "model", "--preset", "quick")
    assert "pip install 'tumortrack[occupancy]'" in refusal(without_pytorch(COMMAND, *train))
    assert not (tmp_path / "model").exists()


@pytest.mark.slow
def test_a_phantom_is_prepared_and_located(phantom_case, tmp_path):
    known, file = load_case(phantom_case), tmp_path / "cloud.ply"
    write_cloud_ply(file, cloud_by_rays(known, looking_down(known), 0.02).astype("float32"))
    case, run = tmp_path / "case", tmp_path / "run"
    succeeded(without_pytorch(COMMAND, "prepare", phantom_case / "labels.nii.gz", case))
    said = answered(without_pytorch(COMMAND, "locate", case, file, run, "--grid", 48))
    assert "tumor_2: centre" in said
    assert (run / "index.html").exists()
