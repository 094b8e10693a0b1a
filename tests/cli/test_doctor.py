"""`doctor`: what works here, and the command that installs what does not."""

import os
import re
import sys
import tomllib
from pathlib import Path

import pytest

from extension_objects import distribution
from tumortrack.cli.doctor import PURPOSES, Doctor, part
from tumortrack.cli.main import run

ROOT = Path(__file__).parents[2]


def test_it_finds_everything_on_one_screen_also_where_the_system_tells_no_affinity(
    monkeypatch, capsys
):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # as on macOS
    Doctor().run()
    said = capsys.readouterr().out
    assert int(re.search(r"cores: (\d+)", said).group(1)) >= 1
    assert "BROKEN" not in said
    assert len(said.splitlines()) <= 24


@pytest.fixture
def acme(tmp_path, monkeypatch):
    """A distribution that needs what is not here, too old, or broken."""
    distribution(tmp_path, "acme", {})
    distribution(tmp_path, "shattered", {})
    (tmp_path / "shattered.py").write_text("raise ImportError('libacme.so is not there')")
    with (tmp_path / "acme-0.1.dist-info" / "METADATA").open("a") as metadata:
        metadata.write(
            "Requires-Dist: numpy>=2\n"
            "Requires-Dist: no-such-package>=1; extra == 'far'\n"
            "Requires-Dist: numpy<2; extra == 'old'\n"
            "Requires-Dist: shattered; extra == 'wrong'\n"
        )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("acme")
def test_it_says_what_is_missing_unsupported_or_broken_and_what_to_type():
    def line(*about):
        ((state, text),) = part(*about)
        return f"{state:8} {text}"

    assert line("acme", "", "all").startswith("ok       acme: all; numpy ")
    far = line("acme", "far", "")
    assert far.startswith("absent ")
    assert "no-such-package" in far
    assert far.endswith(f"{sys.executable} -m pip install 'acme[far]'")
    old, wrong = line("acme", "old", ""), line("acme", "wrong", "")
    assert old.startswith("BROKEN ")
    assert "<2" in old
    assert "libacme.so" in wrong
    assert line("nothing", "", "").endswith("-m pip install 'nothing'")


@pytest.fixture
def breaking(monkeypatch, tmp_path):
    """Makes the import of an installed package fail."""

    def broken(package, error):
        (tmp_path / f"{package}.py").write_text(f"raise ImportError({error!r})")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, package, raising=False)

    return broken


def test_a_library_that_is_missing_costs_only_the_part_that_needs_it(breaking, capsys):
    missing = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
    breaking("pyrealsense2", missing)
    Doctor().run()  # what is absent is no fault
    (line,) = [line for line in capsys.readouterr().out.splitlines() if missing in line]
    assert line.startswith("absent ")
    assert "apt-get install libusb-1.0-0" in line


def test_what_is_installed_and_does_not_work_is_told_by_the_exit_status(breaking, capsys):
    breaking("viser", "undefined symbol: PyObject_Vast")
    assert run(["doctor"]) == 1
    (line,) = [x for x in capsys.readouterr().out.splitlines() if "PyObject_Vast" in x]
    assert line.startswith("BROKEN ")


@pytest.mark.parametrize("folder", [".", "devices", "occupancy", "experiment", "benchmarks"])
def test_it_knows_what_every_extra_is_for(folder):
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
    needs = project.get("optional-dependencies", {})
    other = {name for name, (first, *_) in needs.items() if first.startswith("tumortrack-")}
    extras = {*needs, ""} - {"dev", "docs"} - other  # these are told as distributions
    assert {extra for name, extra in PURPOSES if name == project["name"]} == extras
