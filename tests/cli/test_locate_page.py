"""`locate` on a raw depth image: table, drape and a hand in it; and the page that it writes."""

import io
import json
from contextlib import nullcontext, redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import tumortrack as tt
from depth_files import write_frame_folder
from live_objects import ball, small_estimate
from refused import refused
from region_objects import ORGAN, Props, make_scene
from reports import advised, reporting
from stories import answered, refusal, tumortrack
from tumortrack.cli.main import run
from tumortrack.core import colours
from tumortrack.core.camera import d405
from tumortrack.core.cloud import check_depth_unit
from tumortrack.core.report import Finding
from tumortrack.core.types import Intrinsics
from tumortrack.io.case import load_case
from tumortrack.io.depth_files import depth_png, intrinsics_json, read_mask
from tumortrack.report.page import write_run_page
from tumortrack.report.seen import PAGE, PICTURE, Seen

HAND = Props(tilt_degrees=20, waves_mm=3, hand=True, up=(0.0, -1.0, 0.0), distance_mm=(115, 135))


@cache
def scene(case_folder: Path):
    organ = load_case(case_folder).anatomy.organ
    return make_scene(organ, HAND, np.random.default_rng(3), d405(424, 240))


@pytest.fixture
def raw(tmp_path, phantom_case):
    """A folder with the image in steps of 0.1 mm, of 1 mm and in metres; what is the organ; and a
    camera's file that says nothing of a unit."""
    seen = scene(phantom_case)
    camera = intrinsics_json(seen.frame.intrinsics)
    del camera["depth_unit_mm"]
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "depth.png").write_bytes(depth_png(seen.frame))
    depth_mm = np.nan_to_num(seen.frame.depth_mm)
    Image.fromarray(np.rint(depth_mm).astype(np.uint16)).save(tmp_path / "mm.png")
    Image.fromarray((depth_mm / 1000).astype(np.float32)).save(tmp_path / "m.tif")
    Image.fromarray((seen.what == ORGAN).astype(np.uint8)).save(tmp_path / "mask.png")
    return tmp_path


@pytest.mark.parametrize("size", [(1024, 768), (1366, 768), (401, 301)])
def test_a_depth_image_of_any_size_has_its_page(size, elastic_model, phantom_case, tmp_path):
    organ = load_case(phantom_case).anatomy.organ
    camera = Intrinsics(*size, 0.7 * size[0], 0.7 * size[0], size[0] / 2, size[1] / 2)
    frame = make_scene(organ, HAND, np.random.default_rng(3), camera).frame
    write_frame_folder(tmp_path / "scene", frame)
    paths = {"intrinsics": (tmp_path / "scene" / "intrinsics.json",)}
    tt.locate_files(elastic_model, tmp_path / "scene" / "depth.png", grid=32, **paths).save(
        str(tmp_path / "run")
    )
    assert (tmp_path / "run" / PAGE).is_file()


def test_the_organ_is_found_in_a_raw_depth_image(raw, elastic_model, phantom_case):
    def locate(image, *options):
        command = (
            "locate",
            elastic_model,
            raw / image,
            "--out",
            raw / "run",
            "--grid",
            32,
            "--overwrite",
        )
        return tumortrack(*command, "--intrinsics", raw / "camera.json", *options)

    said = answered(done := locate("depth.png"))
    report = json.loads((raw / "run" / "report.json").read_text())
    assert said.startswith(f"{report['quality']['verdict']}: ")
    assert done.returncode == {"good": 0, "poor": 4}[report["quality"]["verdict"]]
    (view,) = report["input"]
    there = int((scene(phantom_case).what == ORGAN).sum())
    assert there > 5000
    assert abs(view["organ"] - there) < 0.1 * there
    assert view["of"] > 4 * there
    assert view["pixels"]["plane"] > there
    assert f"{view['organ']} of {view['of']} pixels" in said
    assert "0.1 mm" in said
    assert str(raw / "run" / PAGE) in said.splitlines()[-1]
    page = (raw / "run" / PAGE).read_text()
    assert "://" not in page
    assert f"<h1>{report['quality']['verdict'].upper()}</h1>" in page
    assert report["quality"]["verdict"] == "good"  # a poor one's bound would not be shown
    assert f"{report['assessment']['bounds']['tumor_1']['error_bound95_mm']:.1f} mm" in page
    with Image.open(raw / "run" / PICTURE) as picture:
        assert picture.width == 2200

    printed = json.loads(answered(locate("depth.png", "--json")))
    written = json.loads((raw / "run" / "report.json").read_text())
    assert printed == written
    assert printed["parts"]["kidney"]["center_mm"] == report["parts"]["kidney"]["center_mm"]

    assert "--depth-unit 1" in refusal(done := locate("mm.png"))
    assert done.returncode == 2
    answered(locate("m.tif"))
    by_mask = answered(locate("mm.png", "--depth-unit", 1, "--mask", raw / "mask.png"))
    assert "by --mask" in by_mask
    again = tt.load_estimate(raw / "run")
    assert again.meshes["kidney"].volume_mm3 > 1e5
    assert again.volume.labels.max() == 3


def test_without_an_estimate_there_is_a_page_that_says_why(raw, elastic_model):
    command = ("locate", elastic_model, raw / "depth.png", "--out", raw / "run", "--grid", 32)
    command = (*command, "--intrinsics", raw / "camera.json")
    line = refusal(done := tumortrack(*command, "--at", 5, 5))
    assert done.returncode == 3
    assert "--box" in line
    assert "NONE" in (raw / "run" / PAGE).read_text()
    report = json.loads((raw / "run" / "report.json").read_text())
    assert report["quality"]["reason"] in line
    assert report["assessment"]["finding"]["kind"] == "pick_missed"
    assert report["assessment"]["finding"]["values"]["reach_mm"] > 0
    assert {path.name for path in (raw / "run").iterdir()} == {
        *(PAGE, PICTURE, "manifest.json", "report.json")
    }
    for reader in (("plan", raw / "run"), ("export", raw / "run")):
        refusal(tumortrack(*reader, raw / "new"))
    answered(tumortrack(*command))  # takes its place
    assert (raw / "run" / "kidney.ply").exists()
    refusal(tumortrack(*command))  # it exists
    assert "424" in refusal(tumortrack(*command, "--overwrite", "--at", 424, 0))


def test_the_verdict_is_said_before_anything_is_written(raw, elastic_model):
    out, said = raw / "run", []

    class Watched(io.StringIO):
        def write(self, text):
            said.append((text, out.exists()))
            return len(text)

    command = (
        "locate",
        elastic_model,
        raw / "depth.png",
        "--out",
        out,
        "--intrinsics",
        raw / "camera.json",
    )
    with redirect_stdout(Watched()):
        assert run([str(part) for part in command]) == 0
    before = "".join(text for text, written in said if not written)
    assert before.startswith("good: ")
    assert "tumor_1" in before
    assert str(out) not in before.replace("\n", "")
    assert out.exists()


@pytest.mark.parametrize(
    ("depth_mm", "unit_mm", "better"),
    [(130.0, 0.1, ""), (130.0, 1.0, ""), (700.0, 0.1, ""), (13.0, 0.1, "--depth-unit 1"),
     (1300.0, 1.0, "--depth-unit 0.1"), (130_000.0, 1000.0, "--depth-unit 1"),
     (1.0, 0.1, "--depth-unit")],
)  # fmt: skip
def test_a_unit_is_questioned_only_where_it_cannot_be_right(depth_mm, unit_mm, better):
    """700 mm is far away, and no unit would bring it near."""
    camera = tt.Intrinsics(40, 30, 40.0, 40.0, 20.0, 15.0)
    frame = tt.DepthFrame(np.full((30, 40), depth_mm, np.float32), camera)
    outcome = refused(tt.errors.InputError, better) if better else nullcontext()
    with outcome:
        check_depth_unit(frame, unit_mm, 110.0, 150.0)


@pytest.mark.parametrize("mode", ["L", "1", "RGB", "RGBA", "P"])
def test_a_mask_is_what_is_not_zero(tmp_path, mode):
    grey = np.zeros((6, 8), np.uint8)
    grey[2:4, 3:5] = 255
    Image.fromarray(grey).convert(mode).save(tmp_path / "mask.png")
    assert (read_mask(tmp_path / "mask.png", (8, 6)) == (grey > 0)).all()
    with refused(tt.errors.InputError, "8 x 6", "9 x 6"):
        read_mask(tmp_path / "mask.png", (9, 6))


def test_a_reason_is_text_and_no_part_of_the_page(tmp_path):
    report = {"quality": {"verdict": "none", "reason": f"{'x' * 400} <b> @BODY@"}}
    write_run_page(tmp_path, report, None, Seen())
    page = (tmp_path / PAGE).read_text()
    assert f"{'x' * 400} &lt;b&gt; @BODY@" in page.replace("X", "x")


def test_structures_are_drawn_and_named(tmp_path):
    vein, colour = ball((0.0, 0.0, 100.0), 8.0), colours.structure_colour(0)
    found = small_estimate()
    for estimate in (found, replace(found, structures={"vein": vein})):
        write_run_page(tmp_path, {}, estimate, Seen())
        with Image.open(tmp_path / PICTURE) as image:
            reds = (np.asarray(image.convert("RGB")).astype(int) - colour).astype(int)
        drawn = int((np.abs(reds).max(2) < 40).sum())
        named = f"{colours.css(colour)}" in (tmp_path / PAGE).read_text()
        assert (drawn > 100, named) == (estimate is not found,) * 2


@pytest.mark.parametrize("placed", [True, False])
def test_the_page_shows_evidence_and_what_to_learn_next_where_the_organ_surely_lies(
    tmp_path, placed
):
    place_mm = [4.0, -3.0, 104.0]
    foreseen = [  # each touch after those before it
        ("touch", 5.26, 3.12), ("touch", 3.12, 2.5), ("touch", 2.5, 2.2), ("view", 5.26, 4.01)
    ]  # fmt: skip
    known = [
        {
            "name": "touch",
            "tool": "probe",
            "off_mm": 0.44,
            "information_gain": 0.312,
            "rejected": False,
        },
        {"name": "outline", "off_mm": 24.0, "information_gain": 0.0, "rejected": True},
    ]
    known = [{**each, "places_mm": [[30.0, 20.0, 110.0 + n]]} for n, each in enumerate(known)]
    advice = [
        {
            "kind": kind, "part": "tumor_1", "place_mm": place_mm,
            "direction": [0.0, 0.0, -1.0], "std_mm": 1.33, "then_std_mm": 0.9,
            "bound_mm": bound_mm, "then_bound_mm": then_mm,
        }
        for kind, bound_mm, then_mm in foreseen
    ]  # fmt: skip
    estimate = advised(reporting(small_estimate(), evidence=known), advice)
    elsewhere = Finding("alternative", {"part": "tumor_1", "distance_mm": 9.0})
    estimate = estimate.assessed(finding=None if placed else elsewhere)
    write_run_page(tmp_path, {}, estimate, Seen())
    page = (tmp_path / PAGE).read_text()
    for cell in (">touch 1</th>", ">0.4 mm</td>", ">31 %</td>", ">outline 2</th>", ">24.0 mm</td>"):
        assert cell in page
    assert ("would be off by at most 3.1 mm instead of 5.3 (95 %)" in page) == placed
    assert page.count("Next, ") == placed  # of three touches and a look the best alone
    with Image.open(tmp_path / PICTURE) as image:
        picture = np.asarray(image.convert("RGB"))
    counts = [(picture == colour).all(2).sum() for colour in (colours.TO_CUT, colours.NONE)]
    assert counts[1] > 30
    assert (counts[0] > 30) == placed
