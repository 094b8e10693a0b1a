"""The public names: what there is, how it is called, and that importing it is light."""

import inspect
import shutil
import subprocess
import sys
from dataclasses import FrozenInstanceError
from html import escape
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlparse

import msgspec
import numpy as np
import pytest

import tumortrack as tt
from camera_objects import Notes
from live_objects import ball, small_estimate
from refused import refused
from tumortrack.core.estimate import LocatedPart
from tumortrack.live.meter import RunStatistics
from tumortrack.live.workers import SinkWorker
from tumortrack.report.results import PartErrors, Percentiles, track_summary

# A name or a parameter that goes or changes its meaning breaks users' scripts: think twice.
SIGNATURES = {
    "advise": "estimate part reach=None",
    "describe": "path",
    "estimate_from_surfaces": "surfaces grid=160",
    "evaluate": "locate scenes folder=None overwrite=False grid=160 seed=0 device='auto' "
    "progress=None",
    "export": "case folder options",
    "find_organ": "content model=None range_mm=None box_mm=None mask=None picked_mm=None "
    "picture=None tissue_classifier=None seed=0",
    "load_case": "folder",
    "load_estimate": "folder",
    "load_model": "folder device='auto'",
    "locate": "case points views=() evidence=() full_view=None grid=160 seed=0 frame='camera' "
    "device='auto'",
    "locate_files": "model clouds options",
    "prepare": "source folder=None overwrite=False segment=None progress=None options",
    "read_cloud": "path unit='mm'",
    "read_depth": "path intrinsics unit_mm=None",
    "read_ultrasound": "path parts=('kidney', 'tumor_1') options",
    "scan_phantom": "folder seed=1 spacing_mm=(1.2, 1.2, 1.5)",
    "simulate_scenes": "case count=1 seed=0 elastic=True noise=True",
    "train_tissue_classifier": "frame picture organ beside",
    "track": "tracker source sinks=() until=None seconds=0.0 range_mm=None options",
    "train": "case folder preset='elastic' config=None rotations=None sensor=None minutes=None "
    "steps=None seed=0 device='auto' workers=None checkpoint_every_s=30.0 on_status=None "
    "progress=None",
    "write_scenes": "case folder progress=None options",
}
OTHERS = {
    *(
        "Case",
        "DepthFrame",
        "Estimate",
        "Evaluation",
        "Cut",
        "FreeSpace",
        "Grasp",
        "Intrinsics",
        "Landmark",
    ),
    *("View", "Outline", "ProbeRecording", "SensorCloud", "Touch", "TrackSummary", "Tracker"),
    *("datasets", "errors", "presets"),
}


def test_the_public_names_and_their_parameters():
    assert set(tt.__all__) == set(SIGNATURES) | OTHERS
    for name, wanted in SIGNATURES.items():
        given = [
            parameter.name
            + ("" if parameter.default is parameter.empty else f"={parameter.default!r}")
            for parameter in inspect.signature(getattr(tt, name)).parameters.values()
        ]
        assert " ".join(given) == wanted, name


def test_unknown_names_and_options_are_refused(tmp_path, unchecked):
    with pytest.raises(AttributeError):
        tt.prepair  # noqa: B018
    with refused(tt.errors.InputError, "kidney", "organ_hu"):
        tt.prepare(tmp_path, kidney=(1, 2))
    with refused(tt.errors.InputError, "fast", "elastic"):
        tt.train(tmp_path, tmp_path, preset="fast")


def test_surfaces_become_an_estimate_that_compares_as_equal():
    organ = ball((0.0, 0.0, 150.0), 30.0)
    tumor = ball((20.0, 0.0, 150.0), 8.0)
    made = tt.estimate_from_surfaces({"kidney": organ, "tumor_1": tumor}, grid=80)
    assert made.report.parts["kidney"].volume_ml == pytest.approx(organ.volume_mm3 / 1000)
    voxel_ml = made.report.voxel_mm**3 / 1000
    counted = np.bincount(made.volume.labels.reshape(-1))[1:] * voxel_ml
    assert counted.sum() == pytest.approx(organ.volume_mm3 / 1000, rel=0.02)
    assert counted[1] == pytest.approx(tumor.volume_mm3 / 1000, rel=0.05)


CLOUD = tt.SensorCloud(np.ones((300, 3), np.float32))
UNMADE = object.__new__(tt.Tracker)  # it looks at what it is given before the model


@pytest.mark.parametrize(
    ("call", "named"),  # what makes the right type
    [
        (lambda: tt.Tracker("MODEL"), "load_case"),
        (lambda: UNMADE.locate([[0.0, 0.0, 100.0]]), ""),
        (lambda: tt.locate("CASE", "cloud.ply"), "read_cloud"),
        (lambda: tt.locate("CASE", np.ones((300, 2))), "300"),
        (lambda: tt.locate("CASE", np.ones((3, 300))), "300"),
        (lambda: tt.locate("CASE", np.full((300, 3), "x")), ""),
        (lambda: tt.locate("CASE", np.full((300, 3), np.nan)), ""),
        (lambda: tt.locate("ABSENT", CLOUD), "ABSENT"),
        (lambda: tt.locate(None, CLOUD), ""),
        (lambda: UNMADE.locate(CLOUD, views=[tt.Touch(place_mm=(0, 0, 100))]), "evidence="),
        (lambda: UNMADE.locate(CLOUD, evidence=[tt.View(CLOUD, CLOUD, np.eye(4))]), "views="),
        (lambda: tt.evaluate(print, []), ""),
        (lambda: tt.evaluate(7, [1]), ""),
        (lambda: tt.find_organ(CLOUD, model="CASE"), ""),
        (lambda: tt.simulate_scenes("CASE"), ""),
        (lambda: tt.locate_files(UNMADE, "cloud.ply"), ""),
        *(
            (lambda given=given: UNMADE.locate(CLOUD, evidence=given), "")
            for given in ({"kind": "touch"}, {}, "touches.csv", 5, [{"kind": "touch"}], [None])
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_other_types_are_refused_with_the_call_that_makes_the_right_ones(call, named):
    with refused(tt.errors.InputError, named):
        call()


def test_an_echoed_estimate_is_ten_lines_at_most():
    estimate = small_estimate()
    first, *parts, frame = repr(estimate).splitlines()
    assert estimate.quality in first
    assert [line.partition(":")[0] for line in parts] == list(estimate.report.parts)
    for line, part in zip(parts, estimate.report.parts.values(), strict=True):
        assert all(f"{value:.1f}" in line for value in part.center_mm)
    assert estimate.frame in frame
    many = {f"tumor_{n}": estimate.report.parts["tumor_1"] for n in range(1, 41)}
    said = repr(estimate.reporting(parts={**estimate.report.parts, **many})).splitlines()
    assert len(said) == 10
    assert max(map(len, said)) < 300


def test_a_result_is_a_value_that_names_its_parts():
    estimate = small_estimate()
    with pytest.raises(FrozenInstanceError):
        estimate.report = None
    with refused(ValueError):
        estimate.cloud.points_mm[0] = 0
    assert isinstance(estimate.tumors["tumor_1"], LocatedPart)
    assert estimate.tumors.get("tumor_9") is None
    with refused(tt.errors.InputError, "'tumor_9'", "tumor_1, tumor_2"):
        estimate.tumors["tumor_9"]
    with pytest.raises(KeyError):
        estimate.parts["liver"]


@pytest.fixture
def located():
    surfaces = {"kidney": ball((0.0, 0.0, 150.0), 30.0), "tumor_1": ball((20.0, 0.0, 150.0), 8.0)}
    return tt.estimate_from_surfaces(surfaces, grid=24)


def test_a_saved_estimate_is_read_again(located, tmp_path):
    located.save(tmp_path / "run")
    assert (tmp_path / "run" / "index.html").is_file()
    again = tt.load_estimate(tmp_path / "run")
    assert again.frame == located.frame
    assert list(again.parts) == ["kidney", "tumor_1"]
    np.testing.assert_allclose(again.tumors["tumor_1"].center_mm, [20, 0, 150], atol=0.5)
    with pytest.raises(tt.errors.InputError):
        located.save(tmp_path / "run")
    located.save(str(tmp_path / "run"), overwrite=True)


@pytest.mark.parametrize("display", ["", ":0"])
def test_an_estimate_is_shown_in_the_browser_or_said_where(located, display, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("BROWSER", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", display)
    located.show()
    said = capsys.readouterr().out
    page = Path(unquote(urlparse(opened[0]).path) if display else said.split()[-1])
    assert bool(opened) == bool(display) != bool(said)
    assert page.read_text().startswith("<!DOCTYPE html>")
    shutil.rmtree(page.parent)


def test_a_notebook_shows_the_page_within_itself(located, monkeypatch, capsys):
    shell = SimpleNamespace(kernel=None)
    shown = []
    monkeypatch.setattr("IPython.get_ipython", lambda: shell)
    monkeypatch.setattr("IPython.display.display", shown.append)
    located.show()
    (frame,) = shown
    assert escape("<!DOCTYPE html>") in frame.data
    assert capsys.readouterr().out == ""


def test_an_evaluation_is_of_frozen_figures(phantom_case):
    (scene,) = tt.simulate_scenes(phantom_case, noise=False)
    true = dict(zip(scene.reference.names, scene.reference.parts, strict=True))
    answers = [tt.estimate_from_surfaces(true, grid=32), None]

    def locate(cloud):
        if (answer := answers.pop(0)) is None:
            raise tt.errors.NoEstimate("nothing is there")
        return answer

    found = tt.evaluate(locate, [scene, scene])
    assert isinstance(found, tt.Evaluation)
    assert (found.good, found.poor, found.none, found.failed) == (1, 0, 1, 1)
    right, wrong = found.scenes
    assert right.parts["kidney"].found
    assert right.parts["kidney"].hausdorff_mm == pytest.approx(0, abs=1e-3)
    assert right.parts["kidney"].iou == pytest.approx(1)
    assert right.failed is None
    assert wrong.failed == wrong.reason
    assert wrong.parts["kidney"] == PartErrors(found=False, iou=0.0)
    assert found.errors["good"].estimate.center_mm.worst_mm == pytest.approx(0, abs=1e-3)
    assert list(found.parts) == list(scene.reference.names)
    assert found.parts["tumor_1"].center_mm is None  # the median of 0 and infinity
    assert len(repr(found)) < 1000
    with pytest.raises(AttributeError):
        found.good = 2


def test_the_figures_of_a_run_are_frozen():
    statistics, sink = RunStatistics(), SinkWorker("mine", Notes(), 1)
    statistics.latency.add(12.0)
    sink.close()
    more = {"dropped": 3, "opened": 1, "latency_from": "frame", "defects": []}
    figures = statistics.summary() | {"sinks": {"mine": sink.summary()}} | more
    summary = track_summary(figures)
    assert isinstance(summary, tt.TrackSummary)
    assert summary.latency_ms.p50 == figures["latency_ms"]["p50"] == pytest.approx(12, rel=0.05)
    assert summary.latency_ms.p999 == figures["latency_ms"]["p99.9"]
    assert summary.sinks["mine"].latency_ms == Percentiles(count=0)
    assert (summary.dropped, summary.no_estimate) == (3, 0)
    assert msgspec.to_builtins(summary).keys() >= figures.keys()
    with pytest.raises(AttributeError):
        summary.dropped = 0


def test_scenes_are_not_written_among_other_files(phantom_case, tmp_path):
    (tmp_path / "thesis.txt").touch()
    with refused(tt.errors.InputError, "thesis.txt"):
        tt.write_scenes(phantom_case, tmp_path, scenes=1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, tumortrack; dir(tumortrack); print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "numpy", "scipy"} & set(said.stdout.split())
