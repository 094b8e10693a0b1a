"""Sources and sinks that other packages add by entry points."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from depth_files import write_depth_png, write_intrinsics
from extension_objects import distribution, installed_example
from live_objects import small_frame, small_setting, small_update
from refused import refused
from stories import COMMAND, environment
from track_objects import World, ended_when, estimates, start
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.packages import to_install
from tumortrack.live.session import named_sinks, open_sinks
from tumortrack.live.spec import POSES, SINKS, SOURCES, TOOLS, extensions
from tumortrack.live.values import Sink, Source
from tumortrack.report.inspection import describe


@pytest.fixture
def example(tmp_path, monkeypatch):
    folders = installed_example(tmp_path / "site")
    for folder in folders:
        monkeypatch.syspath_prepend(str(folder))
    yield folders
    for name in [name for name in sys.modules if name.startswith("tumortrack_example")]:
        del sys.modules[name]


def finding(folders: list[Path]) -> dict[str, str]:
    paths = [*map(str, folders), os.environ.get("PYTHONPATH", "")]
    return {**environment(), "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def test_an_installed_package_adds_a_source(example, tmp_path):
    frame = small_frame()
    write_depth_png(tmp_path / "depth.png", frame)
    write_intrinsics(tmp_path / "intrinsics.json", frame.intrinsics)
    source = SOURCES.parse(f"image:{tmp_path}?fps=100").open()
    assert isinstance(source, Source)
    first, second = source.read(1.0), source.read(1.0)
    source.close()
    assert first.stamp_ns < second.stamp_ns
    held = np.isfinite(frame.depth_mm)
    np.testing.assert_allclose(first.content.depth_mm[held], frame.depth_mm[held], atol=0.051)


def test_an_installed_package_adds_a_sink(example, tmp_path):
    sink = SINKS.parse(f"csv:{tmp_path}/centres.csv?digits=1").open(small_setting())
    assert isinstance(sink, Sink)
    sink.publish(small_update())
    sink.close()
    header, kidney, tumor, *_ = (tmp_path / "centres.csv").read_text().splitlines()
    assert header == "stamp_ns,quality,part,x_mm,y_mm,z_mm"
    assert kidney.split(",")[1:3] == ["good", "kidney"]
    x, y, z = map(float, tumor.split(",")[3:])
    np.testing.assert_allclose([x, y, z], small_update().center_mm("tumor_1"), atol=0.051)


def test_a_sink_that_cannot_open_its_file_is_a_clear_line(example, tmp_path):
    named = named_sinks([f"csv:{tmp_path}/missing/centres.csv"])
    with refused(StorageError, "missing/centres"), open_sinks(named, small_setting()):
        pass
    with pytest.raises(InputError):
        named_sinks(["csv:a.csv", "csv:a.csv"])


def test_track_uses_it_by_its_text(phantom_case, elastic_model, tmp_path):
    folders = installed_example(tmp_path / "site")
    table = tmp_path / "centres.csv"
    report = tmp_path / "report.json"
    arguments = (f"virtual:{phantom_case}?fps=10", f"csv:{table}", "--report", report)
    world = World(phantom_case, elastic_model)
    ended_when(start(world, *arguments, env=finding(folders)), lambda: estimates(report) > 1)
    rows = [line.split(",") for line in table.read_text().splitlines()[1:]]
    assert {row[2] for row in rows} >= {"kidney", "tumor_1"}
    assert len({row[0] for row in rows}) > 1  # several frames, however slow the machine


def test_a_broken_package_breaks_its_own_kind_alone(example, tmp_path, monkeypatch):
    broken = {
        "tumortrack.sinks": {
            "lost": "no_such_module:Sink",
            "number": "math:pi",
            "renamed": "tumortrack_example.csv:CsvSinkConfig",
        },
        "tumortrack.poses": {"file": "tumortrack_example.image:ImageSourceConfig"},
    }
    monkeypatch.syspath_prepend(str(distribution(tmp_path / "other", "acme-sinks", broken)))
    assert POSES.parse("file:poses.csv").path == Path("poses.csv")
    assert SINKS.parse(f"csv:{tmp_path}/a.csv").digits == 2
    for kind in ("lost", "number", "renamed"):
        with refused(InputError, "acme-sinks"):
            SINKS.parse(kind)
    with refused(InputError, "csv", "lost", "number", "viewer"):
        SINKS.parse("screen")
    faults = {(one.package, one.name): one.fault for one in extensions()}
    assert faults["tumortrack-example", "csv"] == faults["tumortrack-example", "image"] == ""
    assert all(fault for (package, _), fault in faults.items() if package == "acme-sinks")


def test_a_kind_of_ours_that_is_not_installed_is_named_with_its_package(monkeypatch, tmp_path):
    monkeypatch.setattr("tumortrack.core.plugins.entry_points", lambda group: [])
    for registry, kind, package in (
        (SOURCES, "realsense", "tumortrack-devices[realsense]"),
        (SINKS, "ur", "tumortrack-resection[ur]"),
        (POSES, "ur", "tumortrack-devices"),
        (TOOLS, "openigtlink", "tumortrack-devices"),
    ):
        with refused(InputError, to_install(package)):
            registry.parse(f"{kind}:x")
    (tmp_path / "a.mcap").touch()
    for path in (tmp_path, tmp_path / "a.mcap"):
        with refused(InputError, "pip install"):
            describe(path)


def test_two_packages_with_one_kind_are_both_named(example, tmp_path, monkeypatch):
    twice = {"tumortrack.sinks": {"csv": "tumortrack_example.csv:CsvSinkConfig"}}
    monkeypatch.syspath_prepend(str(distribution(tmp_path / "other", "acme-sinks", twice)))
    with refused(InputError, "acme-sinks", "tumortrack-example"):
        SINKS.parse(f"csv:{tmp_path}/a.csv")


@pytest.mark.slow
def test_doctor_names_what_other_packages_add(tmp_path):
    broken = {"tumortrack.sources": {"lost": "no_such_module:Source"}}
    folders = [
        *installed_example(tmp_path / "site"),
        distribution(tmp_path / "other", "acme-sources", broken),
    ]
    done = subprocess.run(
        [*COMMAND, "doctor"], capture_output=True, text=True, timeout=600, env=finding(folders)
    )
    assert done.returncode == 1  # something that is installed does not work
    ok, broken = "ok       {} of the package tumortrack-example", "BROKEN   source lost of the"
    for said in (ok.format("deformation twist"), ok.format("sink csv"), broken, "no_such_module"):
        assert said in done.stdout


def test_the_examples_deformation_turns_one_end_against_the_other(example):
    from tumortrack_example.twist import TwistConfig

    from tumortrack.core.types import Anatomy
    from tumortrack.simulation.deform.base import View

    view = View(Anatomy((small_box(),)), visible=lambda points: np.ones(len(points), bool))
    twist = TwistConfig(most_degrees=30).sample(view, np.random.default_rng(0))
    ends = np.array([[10.0, 0, -20], [10.0, 0, 20]])
    moved = twist.apply(ends)
    first, second = np.degrees(np.arctan2(moved[:, 1], moved[:, 0]))
    assert second - first == pytest.approx(np.degrees(40 * twist.radians_per_mm), abs=1e-3)
    assert 0.5 < abs(second - first) <= 30
    np.testing.assert_allclose(
        np.linalg.norm(moved, axis=1), np.linalg.norm(ends, axis=1), rtol=1e-6
    )


def small_box():
    import trimesh

    from tumortrack.core.types import Mesh

    box = trimesh.creation.box((20, 20, 40))
    return Mesh(box.vertices, box.faces)
