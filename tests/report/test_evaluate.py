"""The protocol, its pictures and its page, on synthetic ellipsoids."""

import itertools
import json
import multiprocessing
import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from browser import Browser, of_first_tumor
from clock import until
from tumortrack.api import write_scenes
from tumortrack.core.colours import TUMORS, css, part_colour
from tumortrack.core.errors import ArtifactError, InputError, NoEstimate, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.report import FitReport
from tumortrack.core.types import (
    Anatomy,
    CameraLabels,
    LabelVolume,
    Mesh,
    OccupancyCloud,
    SensorCloud,
    Volume,
)
from tumortrack.report import protocol
from tumortrack.report.drawing import section, section_mask
from tumortrack.report.metrics import label_grid
from tumortrack.report.page import thinned
from tumortrack.report.pictures import (
    FROM_CAMERA,
    FROM_SIDE,
    PLANES,
    border_letters,
    in_voxels,
    qc_picture,
    slice_volume,
)
from tumortrack.report.place import check_place
from tumortrack.report.protocol import Asked, evaluate_model, evaluate_scenes, failure
from tumortrack.report.renderer import Body, Frame, ParallelView, rgb
from tumortrack.report.summary import conclusions, headlines, summarise, summary_tables
from tumortrack.simulate.scene_folder import Scene


def ball(radius_mm, center_mm=(0.0, 0.0, 0.0), subdivisions=3):
    solid = trimesh.creation.icosphere(subdivisions, radius_mm)
    return Mesh(solid.vertices + np.array(center_mm), solid.faces)


def anatomy(shift_mm=(0.0, 0.0, 0.0)):
    middle = np.array(shift_mm) + np.array([0, 0, 130])
    return Anatomy((ball(22, middle), ball(7, middle + np.array([6, 3, -2]))))


def scene():
    points = anatomy().organ.vertices_mm
    return Scene(SensorCloud(points[points[:, 2] < 130]), anatomy())


def estimate_of(parts, without=()):
    camera_from_index = np.eye(4)
    camera_from_index[:3, 3] = parts.organ.box_mm[0] - 2.5
    labels = label_grid(parts, camera_from_index, (50, 50, 50))
    for name in without:
        labels[labels == parts.names.index(name) + 1] = 1
    points = np.argwhere(labels) + camera_from_index[:3, 3]
    return Estimate(
        OccupancyCloud(points, labels[labels > 0], np.ones(len(points))),
        CameraLabels(labels, camera_from_index),
        {n: m for n, m in zip(parts.names, parts.parts, strict=True) if n not in without},
        FitReport(timings={"search": 0.002}),
    )


class Scripted:
    """Answers one prepared estimate or error after another."""

    def __init__(self, *answers):
        self.answers = list(answers)

    def __call__(self, cloud):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Four scenes: shifted by 3 mm, by 1 mm, without the tumor, nothing at all."""
    folder = tmp_path_factory.mktemp("evaluate")
    for n in range(4):
        scene().write(folder / "scenes" / f"scene_{n}")
    locate = Scripted(
        estimate_of(anatomy((3, 0, 0))),
        estimate_of(anatomy((0, 0, 1))),
        estimate_of(anatomy(), without=("tumor_1",)),
        NoEstimate("no <organ> in view"),
    )
    out, seen = folder / "report", []

    def judged():
        seen.append("judged")
        assert not (out / "report.json").exists()

    def drawn():
        seen.append("drawn")
        assert (out / "report.json").is_file()  # before the pictures

    return out, evaluate_scenes(locate, folder / "scenes", out, judged, drawn), seen


def test_report_has_the_promised_layout(evaluated):
    out, report, seen = evaluated
    text = (out / "report.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == report
    assert [s["name"] for s in report["scenes"]] == [f"scene_{n}" for n in range(4)]
    assert seen == ["judged"] * 4 + ["drawn"] * 4
    keys = {"hausdorff_mm", "hausdorff_one_sided_mm", "hausdorff_95_mm", "surface_mm",
            "center_mm", "iou"}  # fmt: skip
    assert keys <= report["summary"]["tumor_1"].keys()
    assert keys <= report["summary"]["kidney"].keys()


def test_the_registrations_share_stands_beside_the_error(tmp_path):
    """Of scenes whose truth is a second CT: rms over them, by part."""
    stated = {"registration": {"tre_mm": {"kidney": 0.2, "tumor_1": 0.3}}}
    replace(scene(), meta=stated).write(tmp_path / "scenes" / "one")
    locate = Scripted(estimate_of(anatomy((3, 0, 0))))
    report = evaluate_scenes(locate, tmp_path / "scenes", tmp_path / "out")
    assert (
        "<th>expected error of the truth itself, mm</th>"
        in (tmp_path / "out" / "index.html").read_text()
    )
    other = {**report["scenes"][0], "registration_mm": {"kidney": 0.2, "tumor_1": 0.4}}
    report["summary"] = summarise([report["scenes"][0], other])
    table = summary_tables(report)[-1]
    assert [str(cell) for cell in table.columns[-1].cells] == ["0.20", "0.35"]


def test_known_shifts_give_known_distances(evaluated):
    first, second = evaluated[1]["scenes"][:2]
    for part in ("kidney", "tumor_1"):
        assert first["parts"][part]["center_mm"] == pytest.approx(3, abs=1e-3)
        assert first["parts"][part]["hausdorff_mm"] == pytest.approx(3, abs=0.05)
        assert second["parts"][part]["hausdorff_mm"] == pytest.approx(1, abs=0.03)
    ious = [first["parts"][part]["iou"] for part in ("kidney", "tumor_1")]
    assert first["miou"] == pytest.approx(np.mean(ious))
    assert first["failed"] is None
    assert first["timings"] == {"search": 0.002}


def test_what_was_not_found_counts_as_failed(evaluated):
    _, _, partly, nothing = evaluated[1]["scenes"]
    assert partly["failed"] == "not found: tumor_1"
    assert partly["parts"]["tumor_1"] == {"found": False, "iou": 0.0}
    assert partly["parts"]["kidney"]["hausdorff_mm"] < 0.01
    assert 0.4 < partly["miou"] < 0.5
    assert nothing["failed"] == "no <organ> in view"
    assert nothing["miou"] == 0
    summary = evaluated[1]["summary"]
    assert (summary["failed"], summary["far"], summary["scenes"]) == (2, 0, 4)
    assert (summary["kidney"]["found"], summary["tumor_1"]["found"]) == (3, 2)
    # Sorted kidney distances: 0, 1, 3, infinite.
    assert summary["kidney"]["hausdorff_mm"] == pytest.approx(2, abs=0.05)
    # Tumor: 1, 3, infinite, infinite: half way to infinity is infinite.
    assert summary["tumor_1"]["hausdorff_mm"] is None


def test_a_part_that_is_missed_never_helps():
    numbers = itertools.count()

    def entry(hausdorff_mm):
        found = hausdorff_mm is not None
        part = {"found": found, "iou": 0.5 if found else 0.0}
        if found:
            part |= dict.fromkeys(
                ("hausdorff_mm", "hausdorff_one_sided_mm", "hausdorff_95_mm", "surface_mm",
                 "center_mm"), hausdorff_mm)  # fmt: skip
        return {"name": f"scene {next(numbers)}", "quality": "good", "parts": {"tumor_1": part},
                "miou": part["iou"],
                "failed": None if found else "not found: tumor_1"}  # fmt: skip

    full = summarise([entry(h) for h in (2.0, 4.0, 9.0)])
    assert full["tumor_1"]["hausdorff_mm"] == 4.0
    missed = summarise([entry(h) for h in (2.0, 4.0, None)])
    assert missed["tumor_1"]["hausdorff_mm"] == 4.0  # dropping the scene would give 3
    assert missed["failed"] == 1
    worse = summarise([entry(h) for h in (2.0, None, None)])
    assert worse["tumor_1"]["hausdorff_mm"] is None
    assert worse["tumor_1"]["iou"] == 0.0


def test_an_answer_that_is_far_off_has_failed_however_it_is_called(tmp_path):
    """5 mm of the tumor's centre are the limit; the kidney's own centre does not count."""
    shifts_mm = {"near": 4.9, "far": 5.1, "poor": 30.0}
    for name in shifts_mm:
        scene().write(tmp_path / "scenes" / name)
    answers = {name: estimate_of(anatomy((x, 0, 0))) for name, x in shifts_mm.items()}
    for name in ("near", "far"):
        answers[name] = answers[name].assessed(finding=None)
    locate = Scripted(*(answers[name] for name in sorted(answers)))
    report = evaluate_scenes(locate, tmp_path / "scenes", tmp_path / "out")
    failed = {entry["name"]: entry["failed"] for entry in report["scenes"]}
    assert failed == {
        "near": None,
        "far": "far off: the centre of tumor_1 by 5.1 mm",
        "poor": "far off: the centre of tumor_1 by 30.0 mm",
    }
    counts = {"scenes": 3, "good": 2, "poor": 1, "failed": 2, "far": 2, "far_good": 1}
    assert {name: report["summary"][name] for name in counts} == counts
    first, good, poor = headlines(report["summary"])
    assert first.startswith("3 scenes: 2 good, 1 poor, 0 none. 2 failed: 0 without an answer")
    assert "2 with a tumor's centre over 5 mm off (1 of them called good)" in first
    assert "worst 5.1 mm (tumor 1 of far)" in good  # never mixed with the poor ones
    assert "worst 30.0 mm (tumor 1 of poor)" in poor
    assert conclusions(report["scenes"]) == [
        "of 3: 1 good and right (every tumor within 5 mm), 1 called good and WRONG, 0 poor though "
        "right, 1 poor and wrong, 0 without an answer",
        "far: called good and WRONG: far off: the centre of tumor_1 by 5.1 mm; no check failed",
        "poor: poor: it was not judged; far off: the centre of tumor_1 by 30.0 mm",
    ]
    assert failure({"kidney": {"found": True, "center_mm": 5.1}}).endswith("kidney by 5.1 mm")
    exophytic = {"kidney": {"found": True, "center_mm": 6.0},
                 "tumor_1": {"found": True, "center_mm": 4.0}}  # fmt: skip
    assert failure(exophytic) is None


def test_table_shows_every_part(evaluated):
    from rich.console import Console

    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    for table in summary_tables(evaluated[1]):
        console.print(table)
    text = console.export_text()
    assert re.search(r"kidney\D+3/4\D+2\.0", text)
    assert re.search(r"tumor_1\D+2/4\s+│\s+not found", text)
    assert re.search(r"poor\s+│\s+estimate\s+│.*3\.0 / not found / not found", text)


def test_no_word_of_the_tables_is_cut_on_a_terminal_of_80_columns(evaluated):
    from rich.console import Console

    found = {**evaluated[1], "summary": summarise(evaluated[1]["scenes"][:1])}
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    for table in summary_tables(found):
        console.print(table)
    text = console.export_text()
    assert "worst HD" in text
    assert "tumor_1" in text
    assert "…" not in text


def test_the_worst_of_a_part_is_no_median(evaluated):
    """Kidneys 3, 1 and 0 mm off, one not found; of those found the worst is 3 mm."""
    kidney = evaluated[1]["summary"]["kidney"]
    assert kidney["worst"]["center_mm"] == {"mm": None, "scene": "scene_3"}
    found = summarise(evaluated[1]["scenes"][:3])["kidney"]
    assert found["worst"]["center_mm"] == {"mm": pytest.approx(3, abs=1e-3), "scene": "scene_0"}
    assert found["p95"]["center_mm"] == pytest.approx(3, abs=1e-3)


def test_only_a_report_is_replaced(evaluated, tmp_path):
    """A user's own page stays, whatever is asked for."""
    mine = tmp_path / "mine"
    mine.mkdir()
    check_place(mine, overwrite=True)
    (mine / "index.html").write_text("my page")
    with pytest.raises(InputError, match="exists already"):
        check_place(mine, overwrite=False)
    with pytest.raises(InputError, match="is not a report of `evaluate`"):
        check_place(mine, overwrite=True)
    out = tmp_path / "report"
    shutil.copytree(evaluated[0], out)
    check_place(out, overwrite=True)
    (out / "scenes" / "holiday.png").touch()
    with pytest.raises(InputError, match=r"also holds holiday\.png"):
        check_place(out, overwrite=True)


def test_errors_that_are_ours_are_not_hidden(tmp_path):
    scene().write(tmp_path / "scenes" / "a")
    with pytest.raises(ZeroDivisionError):
        evaluate_scenes(Scripted(ZeroDivisionError()), tmp_path / "scenes", tmp_path / "out")
    assert not (tmp_path / "out").exists()  # so that the next command can start
    with pytest.raises(InputError, match="holds no scenes"):
        evaluate_scenes(Scripted(), tmp_path / "scenes" / "a", tmp_path / "out")


def test_every_scene_has_a_readable_picture(evaluated):
    from matplotlib.image import imread

    for n in range(4):
        picture = imread(evaluated[0] / "scenes" / f"scene_{n}.png")
        assert picture.shape[0] > 600
        assert picture.shape[1] > 1000
        flat = picture[..., :3].reshape(-1, 3)
        green = (np.abs(flat - np.array(TUMORS[0]) / 255) < 0.1).all(1).sum()
        blue = (np.abs(flat - [0.0, 90 / 255, 160 / 255]) < 0.05).all(1).sum()
        assert blue > 1000  # truth in every scene
        assert (green > 1000) == (n < 2)  # estimated tumors only where there are some


def test_page_is_whole_and_fetches_nothing(evaluated):
    page = (evaluated[0] / "index.html").read_text()
    assert len(page) < 15e6
    assert "research use only" in page
    assert not re.search(r"<(script|img|link|iframe)[^>]*\s(src|href)\s*=\s*[\"'](?!data:)", page)
    assert "connect-src 'none'" in page
    assert "@" + "DATA@" not in page
    start = page.index('<script id="data" type="application/json">') + 42
    data = json.loads(page[start : page.index("</script>", start)])
    scenes = data["scenes"]
    assert [s["name"] for s in scenes] == [f"scene_{n}" for n in range(4)]
    assert [s["verdict"] for s in scenes] == ["poor", "poor", "poor", "none"]
    assert scenes[3]["reason"] == "no <organ> in view"  # shown as text, never as HTML
    assert "no &lt;organ&gt; in view" in page[:start]
    assert "no <organ>" not in page[:start]
    # Of the answers: off by 3 mm, by 1 mm, and without its tumor.
    assert (data["typical"], data["worst"]) == (0, 2)
    kinds = [[layer["kind"] for layer in s["layers"]] for s in scenes]
    assert kinds[0] == ["points", "surface", "surface", "outline", "outline"]
    assert kinds[3] == ["points", "outline", "outline"]
    assert scenes[0]["layers"][2]["color"] == css(TUMORS[0])


def seen_tumor(browser):
    """How many pixels of the page's 3-D view show the first tumor, and how far right they are."""
    script = "document.getElementById('view').scrollIntoView()"
    browser.call("Runtime.evaluate", expression=script)
    left, top, width, height = (round(side) for side in browser.box("#view canvas"))
    _, columns = np.nonzero(of_first_tumor(browser.picture()[top : top + height, left:][:, :width]))
    return len(columns), columns.mean() if len(columns) else 0.0


def chosen(browser):
    script = "document.getElementById('scene')?.value"
    return browser.call("Runtime.evaluate", expression=script)["result"].get("value")


def test_page_draws_each_part_that_its_legend_shows(evaluated):
    with Browser(1280, 800) as browser:
        browser.open((evaluated[0] / "index.html").as_uri())
        until(lambda: chosen(browser) == "0", "the page")
        until(lambda: seen_tumor(browser)[0] > 5000, "the tumor in the 3-D view")
        whole, place = seen_tumor(browser)
        left, top, width, height = browser.box("#view canvas")
        middle = {"x": left + width / 2, "y": top + height / 2}
        mouse = {**middle, "type": "mouseWheel", "deltaX": 0, "deltaY": 400}
        browser.call("Input.dispatchMouseEvent", **mouse)
        until(lambda: seen_tumor(browser)[0] < 0.6 * whole, "the view to get smaller")
        for kind, x in (("mousePressed", 0), ("mouseMoved", 150), ("mouseReleased", 150)):
            at = {**middle, "x": middle["x"] + x, "type": kind, "button": "left", "buttons": 1}
            browser.call("Input.dispatchMouseEvent", **at, clickCount=1)
        until(lambda: abs(seen_tumor(browser)[1] - place) > 5, "the view to turn")
        reset = "document.querySelector('canvas').dispatchEvent(new MouseEvent('dblclick'))"
        browser.call("Runtime.evaluate", expression=reset)
        until(lambda: seen_tumor(browser) == (whole, place), "the view as it was")
        browser.click_text("next")
        until(lambda: chosen(browser) == "1", "the next scene")
        until(lambda: seen_tumor(browser)[0] > 0.9 * whole, "its tumor, at once")
        browser.click_text("tumor 1, estimated")
        until(lambda: seen_tumor(browser)[0] < 0.1 * whole, "the tumor to be hidden")
        browser.click_text("previous")  # who hides a part does not see it in other scenes
        until(lambda: chosen(browser) == "0", "the scene before")
        assert seen_tumor(browser)[0] < 0.1 * whole
        browser.click_text("tumor 1, estimated")
        until(lambda: seen_tumor(browser)[0] > 0.9 * whole, "the tumor again")


def test_without_webgl_the_page_says_so_and_does_all_else(evaluated):
    with Browser(600, 800) as browser:
        without = "HTMLCanvasElement.prototype.getContext = () => null"
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=without)
        browser.open((evaluated[0] / "index.html").as_uri())
        until(lambda: "offers no WebGL 2" in browser.text(), "the sentence")
        until(lambda: chosen(browser) == "0", "the page")
        browser.click_text("worst")
        until(lambda: chosen(browser) == "2", "the worst scene")


def test_thinned_meshes_keep_shape():
    fine = ball(20, subdivisions=5)
    coarse = thinned(fine, 2.5)
    assert len(coarse.faces) < len(fine.faces) / 4
    assert coarse.volume_mm3 == pytest.approx(fine.volume_mm3, rel=0.02)


def test_sections_of_a_ball_are_circles_of_the_right_size():
    mesh = ball(10, (3, 4, 120), subdivisions=5)
    through = np.array([0.0, 0.0, 126.0])
    for view, center, radius in (
        (FROM_CAMERA, (3, 4), 8.0),
        (FROM_SIDE, (3, 120), np.sqrt(100 - 16)),
    ):
        outline = section(mesh, view, through)
        away = np.linalg.norm(outline.reshape(-1, 2) - center, axis=1)
        np.testing.assert_allclose(away, radius, atol=0.03)
        length = np.linalg.norm(outline[:, 1] - outline[:, 0], axis=1).sum()
        assert length == pytest.approx(2 * np.pi * radius, rel=1e-3)  # closed, nothing doubled
        frame = Frame(center[0] - 12.0, center[0] + 12.0, center[1] - 12.0, center[1] + 12.0)
        mask = section_mask(mesh, view, frame, through)
        assert mask.sum() * 0.25**2 == pytest.approx(np.pi * radius**2, rel=0.01)


def test_shading_hides_what_lies_behind():
    red, green = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    near, far = Body(ball(5, (0, 0, 100)), red), Body(ball(8, (0, 0, 130)), green)
    frame = FROM_CAMERA.frame_around(far.mesh.vertices_mm)
    for bodies in ([near, far], [far, near]):
        picture = FROM_CAMERA.draw(bodies, frame).astype(int)
        x, y = frame.pixel_centres(0.3)
        middle = picture[np.abs(y).argmin(), np.abs(x).argmin()]
        rim = picture[np.abs(y).argmin(), np.abs(x - 6.5).argmin()]
        assert middle[0] > 2 * middle[1]
        assert rim[1] > 2 * rim[0]
        np.testing.assert_array_equal(picture[0, 0], 255)
    back = ParallelView("from behind", (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    behind = back.draw([near, far], Frame(-13.0, 13.0, -13.0, 13.0)).astype(int)
    assert behind[43, 43, 1] > 2 * behind[43, 43, 0]  # from behind the far one covers the near


@pytest.mark.parametrize("view", [FROM_CAMERA, FROM_SIDE, PLANES[1], PLANES[2]])
def test_depths_and_outlines_are_those_of_the_mesh(view):
    middle = np.array([30.0, -40.0, 150.0])
    mesh = ball(10, middle, subdivisions=5)
    right, down, depth = view.project(middle[None])[0]
    frame = view.frame_around(mesh.vertices_mm).widened(1.5)
    found = view.depth_of(mesh, frame)
    x, y = np.meshgrid(*frame.pixel_centres())
    away = np.hypot(x - right, y - down)
    np.testing.assert_array_equal(view.silhouette(mesh, frame)[np.abs(away - 10) > 0.3],
                                  (away < 10)[np.abs(away - 10) > 0.3])  # fmt: skip
    inner = away < 9
    expected = depth - np.sqrt(100 - away[inner] ** 2)
    np.testing.assert_allclose(found[inner], expected, atol=0.06)


# A marker on each side of the patient must appear at its own letter.
MARKS = {"L": (30, 0, 0), "R": (-30, 0, 0), "P": (0, 30, 0), "A": (0, -30, 0), "S": (0, 0, 30),
         "I": (0, 0, -30)}  # fmt: skip
ORIENTATIONS = {
    "LPS": np.eye(3),
    "flipped": np.diag([-1.0, -1.0, 1.0]),
    "slices first": np.eye(3)[[2, 1, 0]] * [1, -1, 1],
    "oblique": trimesh.transformations.rotation_matrix(0.4, (1, 2, 3))[:3, :3],
}


@pytest.mark.parametrize("name", ORIENTATIONS)
@pytest.mark.parametrize("view", PLANES, ids=lambda view: view.name)
def test_letters_stand_where_the_patients_sides_are(view, name):
    turn, size, step = ORIENTATIONS[name], 64, 1.5
    lps_from_index = np.eye(4)
    lps_from_index[:3, :3] = turn * step
    center = np.array([100.0, -50.0, 700.0])
    lps_from_index[:3, 3] = center - lps_from_index[:3, :3] @ np.full(3, (size - 1) / 2)
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1)
    lps = index @ lps_from_index[:3, :3].T + lps_from_index[:3, 3] - center
    frame = Frame(*(center @ view.right + [-45, 45]), *(center @ view.down + [-45, 45]))
    x, y = frame.pixel_centres()
    edges = {"left": x < x.mean(), "right": x > x.mean()}
    rows = {"top": y < y.mean(), "bottom": y > y.mean()}
    for border, letter in border_letters(view).items():
        mark = (np.linalg.norm(lps - MARKS[letter], axis=-1) < 8).astype(np.uint8)
        picture = slice_volume(mark, lps_from_index, view, frame, center) == 1
        side = picture[:, edges[border]] if border in edges else picture[rows[border]]
        assert picture.sum() > 1000
        assert side.sum() == picture.sum()
    hidden = set("LRAPSI") - set(border_letters(view).values())
    assert len(hidden) == 2


def test_radiological_convention():
    axial, coronal, sagittal = (border_letters(view) for view in PLANES)
    assert axial == {"left": "R", "right": "L", "top": "A", "bottom": "P"}
    assert coronal == {"left": "R", "right": "L", "top": "S", "bottom": "I"}
    assert sagittal == {"left": "A", "right": "P", "top": "S", "bottom": "I"}


@pytest.mark.parametrize("with_ct", [True, False])
def test_qc_picture_shows_outlines(tmp_path, with_ct):
    from matplotlib.image import imread

    parts = anatomy()
    lps_from_index = np.eye(4)
    lps_from_index[:3, 3] = (-30, -30, 100)
    labels = label_grid(parts, lps_from_index, (60, 60, 60))
    ct = Volume(np.where(labels, 50.0 * labels, -80.0), lps_from_index) if with_ct else None
    whose = r"patient $\frac$, left side"  # no formula
    qc_picture(LabelVolume(labels, lps_from_index), ct, parts, tmp_path / "qc.png", whose)
    flat = imread(tmp_path / "qc.png")[..., :3].reshape(-1, 3)
    for color in (rgb(part_colour(1)), rgb(part_colour(2))):
        assert (np.abs(flat - color) < 0.03).all(1).sum() > 300
    assert list(tmp_path.iterdir()) == [tmp_path / "qc.png"]


def test_qc_picture_cuts_through_every_tumor(tmp_path):
    """Tumors in opposite corners share no slice: each has its outline in its own row."""
    from matplotlib.image import imread

    corners = [ball(5, (-20, -20, -20)), ball(7, (20, 20, 20))]
    parts = Anatomy((ball(48, (0, 0, 0)), *corners))
    lps_from_index = np.diag([2.0, 2.0, 2.0, 1.0])
    lps_from_index[:3, 3] = -60
    labels = label_grid(parts, lps_from_index, (60, 60, 60))
    qc_picture(LabelVolume(labels, lps_from_index), None, parts, tmp_path / "qc.png")
    picture = imread(tmp_path / "qc.png")[..., :3]
    top, left = picture.shape[0] // 10, int(0.74 * picture.shape[1])  # no legend, no 3-D view
    rows = np.array_split(picture[top:, :left], 2)
    for row, color in zip(rows, (rgb(part_colour(2)), rgb(part_colour(3))), strict=True):
        drawn = (np.abs(row - color) < 0.03).all(2)
        assert all(part.sum() > 50 for part in np.array_split(drawn, 3, axis=1))


def test_slice_and_outline_of_coarse_voxels_belong_together():
    """A bar that leans by 45 degrees, in voxels of 3 mm; the plane asked for lies between two
    layers of voxels, so that the nearest one's slice is 1.5 mm beside the bar's own section."""
    step, n = 3.0, 31
    lps_from_index = np.diag([step, step, step, 1.0])
    i, j, k = np.indices((n, n, n))
    bar = ((np.abs(i - k) <= 2) & (np.abs(j - 15) <= 2)).astype(np.uint8)
    corners = step * np.array(
        [[k + x, 15 + y, k] for k in (5, 25) for x in (-2.5, 2.5) for y in (-2.5, 2.5)]
    )
    solid = trimesh.Trimesh(corners, trimesh.convex.convex_hull(corners).faces, process=False)
    mesh = Mesh(trimesh.convex.convex_hull(solid).vertices, trimesh.convex.convex_hull(solid).faces)
    view, between_mm = PLANES[0], step * np.array([15.0, 15.0, 15.5])
    frame = Frame(0.0, 90.0, 0.0, 90.0)

    def apart_mm(through_mm):
        picture = slice_volume(bar, lps_from_index, view, frame, through_mm)
        middle = frame.pixel_centres()[0][(picture == 1).any(0)].mean()
        return abs(middle - section(mesh, view, through_mm)[..., 0].mean(axis=(0, 1)))

    through_mm = in_voxels(between_mm, lps_from_index)
    assert np.abs(through_mm - between_mm).max() == pytest.approx(step / 2)
    assert apart_mm(between_mm) == pytest.approx(step / 2, abs=0.3)
    assert apart_mm(through_mm) < 0.3
    turned = trimesh.transformations.rotation_matrix(0.4, (1, 2, 3)) @ lps_from_index
    index = np.linalg.inv(turned) @ [*in_voxels(np.array([20.0, 31.0, 7.0]), turned), 1.0]
    np.testing.assert_allclose(index, np.rint(index), atol=1e-9)


@pytest.mark.slow
def test_two_processes_say_what_one_says(ready_case, tmp_path, monkeypatch):
    """But how long it took."""
    monkeypatch.setattr(protocol, "_SCENES", 1)
    write_scenes(ready_case, tmp_path / "scenes", scenes=3, seed=4)
    reports = []
    for processes in (1, 2):
        out, seen = tmp_path / f"report_{processes}", []
        asked = Asked(processes=processes)
        report = evaluate_model(
            ready_case, tmp_path / "scenes", out, asked, partial(seen.append, 1)
        )
        assert len(seen) == 3
        assert {path.stem for path in (out / "scenes").iterdir()} == {"0000", "0001", "0002"}
        assert json.loads((out / "report.json").read_text()) == report
        for scene in report["scenes"]:
            assert scene.pop("seconds") > 0
            assert scene.pop("timings")
            scene["rivals"].pop("seconds", None)
        report["summary"].pop("seconds", None)
        reports.append(report)
    assert reports[0]["scenes"] == reports[1]["scenes"]
    assert reports[0]["summary"].keys() == reports[1]["summary"].keys()


@pytest.mark.slow
def test_a_scene_that_cannot_be_read_leaves_no_report_of_two_processes(
    ready_case, tmp_path, monkeypatch
):
    monkeypatch.setattr(protocol, "_SCENES", 1)
    write_scenes(ready_case, tmp_path / "scenes", scenes=2, seed=4)
    (cloud,) = (tmp_path / "scenes" / "0001").glob("cloud*")
    cloud.write_text("nothing")
    with pytest.raises((InputError, ArtifactError), match="0001"):
        evaluate_model(ready_case, tmp_path / "scenes", tmp_path / "out", Asked(processes=2))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_process_that_dies_is_said_in_one_line(ready_case, tmp_path, monkeypatch):
    """As the system ends one when memory runs out."""
    monkeypatch.setattr(protocol, "_SCENES", 1)
    write_scenes(ready_case, tmp_path / "scenes", scenes=3, seed=4)

    def kill_one():
        multiprocessing.active_children()[0].kill()

    asked = Asked(processes=2)
    for calls in ((kill_one, lambda: None), (lambda: None, kill_one)):  # judging, drawing
        with pytest.raises(TumortrackError, match=r"ended from outside.*memory") as caught:
            evaluate_model(ready_case, tmp_path / "scenes", tmp_path / "out", asked, *calls)
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "out").exists()
        assert not multiprocessing.active_children()
