"""The public names: what there is, how it is called, and that importing it is light."""

import inspect
import subprocess
import sys

import numpy as np
import pytest

import tumortrack as tt
from live_objects import ball, small_estimate

# A name or a parameter that goes or changes its meaning breaks users' scripts: think twice.
SIGNATURES = {
    "advise": "estimate part reach=None",
    "describe": "path",
    "estimate_from_surfaces": "surfaces grid=160",
    "evaluate": "locate scenes report=None overwrite=False grid=160 seed=0 device='auto' "
    "progress=None",
    "export": "case folder options",
    "find_organ": "content model=None range_mm=None box_mm=None mask=None picked_mm=None "
    "picture=None taught=None seed=0",
    "load_case": "folder",
    "load_estimate": "folder",
    "load_model": "folder device='auto'",
    "locate": "model clouds options",
    "prepare": "source folder=None overwrite=False segment=None progress=None options",
    "read_cloud": "path unit='mm'",
    "read_depth": "path intrinsics unit_mm=None",
    "save_estimate": "estimate folder overwrite=False cloud=None seen=None",
    "scan_phantom": "folder seed=1 spacing_mm=(1.2, 1.2, 1.5)",
    "simulate_scenes": "case count=1 seed=0 elastic=True noise=True",
    "teach": "frame picture organ beside",
    "track": "tracker source sinks=() until=None seconds=0.0 range_mm=None options",
    "train": "case folder preset='clinic' config=None rotations=None sensor=None minutes=None "
    "steps=None seed=0 device='auto' workers=None checkpoint_every_s=30.0 report=None "
    "progress=None",
    "write_scenes": "case folder progress=None options",
}
OTHERS = {
    *("Case", "DepthFrame", "Estimate", "Free", "Held", "Intrinsics", "Landmark", "Look"),
    *("Outline", "SensorCloud", "Touch", "Tracker", "datasets", "errors", "presets"),
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


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, tumortrack; dir(tumortrack); print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "numpy", "scipy"} & set(said.stdout.split())


def test_unknown_names_and_options_are_refused(tmp_path, unchecked):
    with pytest.raises(AttributeError):
        tt.prepair  # noqa: B018
    with pytest.raises(tt.errors.InputError, match=r"kidney.*organ_hu"):
        tt.prepare(tmp_path, kidney=(1, 2))
    with pytest.raises(tt.errors.InputError, match=r"fast.*clinic"):
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


WRONG = """
import numpy as np
import tumortrack as tt
from tumortrack.core.errors import InputError

EVIDENCE = ({"kind": "touch"}, {}, "touches.csv", 5, [{"kind": "touch"}], [None])
cloud = tt.SensorCloud(np.ones((300, 3), np.float32))
unmade = object.__new__(tt.Tracker)  # it looks at the cloud before the model
for call in (
    lambda: tt.Tracker("MODEL"),
    lambda: unmade.locate([[0.0, 0.0, 100.0]]),
    lambda: tt.evaluate(print, []),
    lambda: tt.evaluate(7, [1]),
    lambda: tt.find_organ(cloud, model="CASE"),
    lambda: tt.simulate_scenes("CASE"),
    lambda: tt.locate(unmade, "cloud.ply"),
    *((lambda given=given: unmade.locate(cloud, evidence=given)) for given in EVIDENCE),
):
    try:
        call()
    except InputError as error:
        print(error)
"""


def test_other_types_are_refused_with_the_call_that_makes_the_right_ones():
    # In a process of its own, where no test's checks of types come first.
    done = subprocess.run(
        [sys.executable, "-c", WRONG], capture_output=True, text=True, check=False
    )
    tracker, locate, *others = done.stdout.splitlines()
    assert len(others) == 5 + 6, done.stderr
    assert "Tracker(load_case(FOLDER))" in tracker
    assert "read_cloud(FILE)" in locate


def test_an_echoed_estimate_is_a_few_lines():
    said = repr(small_estimate()).splitlines()
    assert len(said) < 12
    assert max(map(len, said)) < 300
    assert sum("center_mm=" in line for line in said) == len(small_estimate().report.parts)


def test_scenes_are_not_written_among_other_files(phantom_case, tmp_path):
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(tt.errors.InputError, match=r"thesis\.txt"):
        tt.write_scenes(phantom_case, tmp_path, scenes=1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
