"""The examples are documentation: each runs, in order, each on what the ones before it left."""

import contextlib
import io
import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from tumortrack.core.mesh_query import surface_distance
from tumortrack.io.case import load_case
from tumortrack.io.mesh_files import read_mesh
from tumortrack.io.scene_folder import read_scene

pytestmark = pytest.mark.slow

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("[0-9]*.py"))


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """The folder that all examples wrote into, and what each of them said."""
    out = tmp_path_factory.mktemp("examples")
    said = {}
    for file in EXAMPLES:  # as `python FILE FOLDER`, without loading the package eight times
        with (
            pytest.MonkeyPatch.context() as patch,
            contextlib.chdir(out),
            contextlib.redirect_stdout(io.StringIO()) as told,
        ):
            patch.setattr(sys, "argv", [str(file), str(out)])
            runpy.run_path(str(file), run_name="__main__")
        said[file.name[:2]] = told.getvalue()
    return out, said


def test_a_resection_is_planned(story):
    out, said = story
    assert "tumor_1" in said["07"]
    assert said["07"].count("no plan: ") == 2
    lost = [float(x) for x in re.findall(r"([0-9.]+) ml of healthy tissue", said["07"])]
    assert len(lost) == 2
    assert 1 < lost[0] < lost[1] < 60  # ours keeps a margin all round, with plane facets
    for method in ("published", "margin"):
        assert (out / f"plan_{method}.png").stat().st_size > 50_000


def test_nothing_has_to_be_trained(story):
    """The verdict, then the three parts, in the third."""
    _, said = story
    assert re.fullmatch(r"(good|poor): .+\n(\w+: [\d.]+ ml at \(.+\) mm\n){3}", said["03"])


def test_touches_bring_a_hidden_half_nearer(story):
    _, said = story
    off = [float(mm) for mm in re.findall(r"tumor_\d: its centre is ([\d.]+) mm off", said["08"])]
    assert len(off) == 6  # two tumors: without, with three, with six
    assert 0 < sum(off[4:]) < sum(off[:2])
    gains = re.findall(r"next, .+: tumor_\d .+ ([\d.]+) mm instead of ([\d.]+)", said["08"])
    assert len(gains) >= 8  # twice three touches, an outline, a view
    assert all(float(then) <= float(now) for then, now in gains)
    assert said["08"].count("of it new") == 6


def test_the_scene_is_deformed_and_pictured(story):
    out, said = story
    scene, case = read_scene(out / "scenes" / "dragged"), load_case(out / "case")
    assert len(scene.cloud.points_mm) == 1000
    before, after = case.anatomy.organ.vertices_mm, scene.reference.organ.vertices_mm
    lengths = [np.linalg.norm(v[1:] - v[:-1], axis=1) for v in (before, after)]
    assert np.abs(lengths[0] - lengths[1]).max() > 0.05  # no rigid motion
    assert "mIoU 0." in said["02"]
    assert (out / "compared" / "scenes" / "dragged.png").stat().st_size > 10_000


def test_the_cloud_gives_surfaces_in_its_own_frame(story):
    out, _ = story
    report = json.loads((out / "located" / "report.json").read_text())
    assert report["frame"] == "camera"
    assert report["parts"]["kidney"]["found"]
    kidney = read_mesh(out / "located" / "kidney.ply")
    assert kidney.volume_mm3 / 1000 == pytest.approx(
        report["parts"]["kidney"]["volume_ml"], rel=1e-3
    )
    # The organ lies on its cloud, with the volume that it has in the CT.
    cloud = read_scene(out / "scenes" / "dragged").cloud.points_mm
    assert np.median(surface_distance(kidney, cloud)) < 1
    true_mm3 = load_case(out / "case").anatomy.organ.volume_mm3
    assert kidney.volume_mm3 == pytest.approx(true_mm3, rel=0.04)


def test_points_of_the_ct_have_a_place_now_and_back(story):
    out, said = story
    numbers = [
        [float(number) for number in re.findall(r"-?\d+\.\d+", line)]
        for line in said["05"].splitlines()[1:]  # the verdict comes first
    ]
    *parts, seen = numbers
    organ = load_case(out / "case").anatomy.organ
    assert len(parts) == 3
    for line in parts:
        assert line[6] > 0  # the standard deviation
        assert line[-1] < 5  # mm off; the deformations are none of an elastic body
    # The organ's first triangle, by carrying it and as example 04 wrote the surface.
    written = read_mesh(out / "located" / "kidney.ply")
    for place, mesh in ((parts[0][:3], organ), (parts[0][3:6], written)):
        assert place == pytest.approx(mesh.vertices_mm[mesh.faces[0]].mean(0), abs=0.1)
    # What the camera sees is the organ's surface.
    assert surface_distance(organ, np.array([seen[3:6]], np.float32))[0] < 5
