"""`doctor`: what works here, and the command that installs what does not."""

import os
import re
import sys
import tomllib
from importlib import import_module
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


@pytest.mark.parametrize("folder", [".", "devices", "occupancy", "experiment", "lab"])
def test_it_knows_what_every_extra_is_for(folder):
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
    needs = project.get("optional-dependencies", {})
    other = {name for name, (first, *_) in needs.items() if first.startswith("tumortrack-")}
    extras = {*needs, ""} - {"dev", "docs"} - other  # these are told as distributions
    assert {extra for name, extra in PURPOSES if name == project["name"]} == extras


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
    command = f"{sys.executable} -m pip install 'acme[far]'"
    assert line("acme", "far", "") == (
        f"absent   acme[far]: ; no-such-package is not installed; {command}"
    )
    assert re.search(r"BROKEN .* numpy 2\S+ is installed, but <2 is sup", line("acme", "old", ""))
    assert "shattered 0.1: libacme.so is not there" in line("acme", "wrong", "")
    assert line("nothing", "", "").endswith("-m pip install 'nothing'")


def without(monkeypatch, package, error):
    def find(name):
        if name == package:
            raise ImportError(error)
        return import_module(name)

    monkeypatch.setattr("tumortrack.cli.doctor.import_module", find)


def test_a_library_that_is_missing_costs_only_the_part_that_needs_it(monkeypatch, capsys):
    missing = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
    without(monkeypatch, "pyrealsense2", missing)
    Doctor().run()  # what is absent is no fault
    said = capsys.readouterr().out
    assert re.search(r"^ok       tumortrack-devices: .*; .*viser ", said, re.M)
    assert "tumortrack-devices[realsense]:" not in said
    assert re.search(
        rf"^absent   RealSense cameras: pyrealsense2 \S+: {missing}; apt-get install libusb-1.0-0$",
        said,
        re.M,
    )


def test_what_is_installed_and_does_not_work_is_told_by_the_exit_status(monkeypatch, capsys):
    without(monkeypatch, "viser", "undefined symbol: PyObject_Vast")
    assert run(["doctor"]) == 1
    said = capsys.readouterr()
    assert re.search(r"^BROKEN   the web viewer: viser \S+: undefined symbol", said.out, re.M)
    assert "1 of what is installed does not work" in said.err
