"""The protocol, its summary and its page, on balls."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from browser import Browser, of_first_tumor
from clock import until
from refused import refused
from report_objects import anatomy, ball, estimate_of, scene
from tumortrack.cli.console import say_table
from tumortrack.core.colours import TUMORS, css
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.mesh_query import thinned
from tumortrack.report.protocol import check_place, evaluate_scenes, failure
from tumortrack.report.summary import (
    conclusions,
    error_table,
    headlines,
    part_table,
    side_by_side,
    summarise,
)


def answering(*answers):
    """Answers one prepared estimate or error after another."""
    answers = iter(answers)

    def locate(cloud):
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    return locate


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Four scenes: shifted by 3 mm, by 1 mm, without the tumor, nothing at all."""
    folder, seen = tmp_path_factory.mktemp("evaluate"), []
    for n in range(4):
        scene().write(folder / "scenes" / f"scene_{n}")
    locate = answering(
        estimate_of(anatomy((3, 0, 0))),
        estimate_of(anatomy((0, 0, 1))),
        estimate_of(anatomy(), without=("tumor_1",)),
        NoEstimate("no <organ> in view"),
    )
    out = folder / "report"
    report = evaluate_scenes(locate, folder / "scenes", out, lambda: seen.append(1))
    assert len(seen) == 4
    assert json.loads((out / "report.json").read_text(), parse_constant=pytest.fail) == report
    assert [entry["name"] for entry in report["scenes"]] == [f"scene_{n}" for n in range(4)]
    return out, report


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
    # Of those found the worst is no median.
    assert summary["kidney"]["worst"]["center_mm"] == {"mm": None, "scene": "scene_3"}
    found = summarise(evaluated[1]["scenes"][:3])["kidney"]
    assert found["worst"]["center_mm"] == {"mm": pytest.approx(3, abs=1e-3), "scene": "scene_0"}
    assert found["p95"]["center_mm"] == pytest.approx(3, abs=1e-3)


def test_a_part_that_is_missed_never_helps(evaluated):
    """Errors of 1 and 3 mm; dropping the scene without the tumor would leave a median of 2."""
    near, far, missed = (evaluated[1]["scenes"][n] for n in (1, 0, 2))
    for entries, median in (
        ([near, far, far], 3.0), ([near, far, missed], 3.0), ([near, missed, missed], None)
    ):  # fmt: skip
        named = [{**entry, "name": f"scene {n}"} for n, entry in enumerate(entries)]
        tumor = summarise(named)["tumor_1"]
        assert tumor["center_mm"] == (median and pytest.approx(median, abs=0.05))
    assert tumor["iou"] == 0.0


def test_an_answer_that_is_far_off_has_failed_however_it_is_called(tmp_path):
    """5 mm of the tumor's centre are the limit; the kidney's own centre does not count."""
    shifts_mm = {"far": 5.1, "near": 4.9, "poor": 30.0}
    answers = []
    for name, x in shifts_mm.items():
        scene().write(tmp_path / "scenes" / name)
        answers.append(estimate_of(anatomy((x, 0, 0))))
        if name != "poor":
            answers[-1] = answers[-1].assessed(finding=None)
    report = evaluate_scenes(answering(*answers), tmp_path / "scenes", tmp_path / "out")
    failed = {entry["name"]: entry["failed"] for entry in report["scenes"]}
    assert failed["near"] is None
    assert "5.1 mm" in failed["far"]
    assert "30.0 mm" in failed["poor"]
    counts = {"scenes": 3, "good": 2, "poor": 1, "failed": 2, "far": 2, "far_good": 1}
    assert {name: report["summary"][name] for name in counts} == counts
    good, poor = headlines(report["summary"])  # never mixed
    assert "5.1 mm (tumor 1 of far)" in good
    assert "30.0 mm (tumor 1 of poor)" in poor
    counted, *lines = conclusions(report["scenes"])
    assert re.findall(r"\d+", counted) == ["3", "1", "5", "1", "0", "1", "0"]
    assert [line.split(":")[0] for line in lines] == ["far", "poor"]
    kidney = {"kidney": {"found": True, "center_mm": 5.1}}
    assert failure(kidney) is not None
    assert failure(kidney | {"tumor_1": {"found": True, "center_mm": 4.0}}) is None


def test_the_registrations_share_stands_beside_the_error(tmp_path):
    """Of scenes whose truth is a second CT: rms over them, by part."""
    stated = {"registration": {"tre_mm": {"kidney": 0.2, "tumor_1": 0.3}}}
    replace(scene(), meta=stated).write(tmp_path / "scenes" / "one")
    locate = answering(estimate_of(anatomy((3, 0, 0))))
    report = evaluate_scenes(locate, tmp_path / "scenes", tmp_path / "out")
    other = {**report["scenes"][0], "registration_mm": {"kidney": 0.2, "tumor_1": 0.4}}
    rows = part_table(summarise([report["scenes"][0], other])).rows
    assert [row[-1] for row in rows] == ["0.20", "0.35"]


def test_tables_show_every_part_and_cut_no_word(evaluated, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    summary = evaluated[1]["summary"]
    rows = {row[0]: row for row in part_table(summary).rows}
    assert rows["kidney"][1] == "3/4"
    assert rows["tumor_1"][1] == "2/4"
    for table in (error_table(summary), part_table(summary)):
        say_table(table)
    assert "…" not in capsys.readouterr().out


def test_only_a_report_is_replaced(evaluated, tmp_path):
    """A user's own page stays, whatever is asked for."""
    mine, out = tmp_path / "mine", tmp_path / "report"
    mine.mkdir()
    check_place(mine, overwrite=True)
    (mine / "index.html").write_text("my page")
    for overwrite in (False, True):
        with pytest.raises(InputError):
            check_place(mine, overwrite)
    shutil.copytree(evaluated[0], out)
    check_place(out, overwrite=True)
    (out / "scenes" / "holiday.png").touch()
    with refused(InputError, "holiday.png"):
        check_place(out, overwrite=True)


@pytest.mark.parametrize("error", [ZeroDivisionError(), KeyboardInterrupt()])
def test_what_breaks_off_leaves_no_report(tmp_path, error):
    for name in "ab":
        scene().write(tmp_path / "scenes" / name)

    def locate(cloud):
        if (tmp_path / "out" / "scenes" / "a.png").exists():
            raise error
        return estimate_of(anatomy())

    with pytest.raises(type(error)):
        evaluate_scenes(locate, tmp_path / "scenes", tmp_path / "out")
    assert not (tmp_path / "out").exists()  # so that the next command can start
    with pytest.raises(InputError):  # no scenes
        evaluate_scenes(locate, tmp_path / "scenes" / "a", tmp_path / "out")


def test_every_scene_has_a_readable_picture(evaluated):
    for n in range(4):
        with Image.open(evaluated[0] / "scenes" / f"scene_{n}.png") as picture:
            flat = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
        tumor = (np.abs(flat - TUMORS[0]).max(1) < 13).sum()  # a banner is as near as 20
        truth = (np.abs(flat - [0, 90, 160]).max(1) < 13).sum()
        assert truth > 1000  # in every scene
        assert (tumor > 1000) == (n < 2)  # estimated tumors only where there are some


def test_page_is_whole_and_fetches_nothing(evaluated):
    page = (evaluated[0] / "index.html").read_text()
    assert len(page) < 15e6
    assert "research use only" in page
    assert not re.search(r"<(script|img|link|iframe)[^>]*\s(src|href)\s*=\s*[\"'](?!data:)", page)
    assert "connect-src 'none'" in page
    assert not re.search("@[A-Z]+@", page)
    start = page.index('<script id="data" type="application/json">') + 42
    data = json.loads(page[start : page.index("</script>", start)])
    assert "no <organ>" not in page[: start - 42]
    scenes = data["scenes"]
    assert [s["name"] for s in scenes] == [f"scene_{n}" for n in range(4)]
    assert [s["verdict"] for s in scenes] == ["poor", "poor", "poor", "none"]
    assert scenes[3]["reason"] == "no <organ> in view."  # shown as text, never as HTML
    assert "no &lt;organ&gt; in view" in page
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


def test_methods_stand_side_by_side(evaluated):
    entries = evaluated[1]["scenes"]
    lost = {"name": "lost", "quality": "none", "parts": {"tumor_1": {"found": False, "iou": 0.0}}}
    rows = side_by_side({"one": [*entries, lost], "two": [*entries[::-1], lost]}).rows
    assert [row[0] for row in rows] == [entry["name"] for entry in (*entries, lost)]
    assert [row[1:5] for row in rows[:-1]] == [row[5:] for row in rows[-2::-1]]
    assert rows[-1][1:] == ["none", "-", "-", "-"] * 2


def test_thinned_meshes_keep_shape():
    fine = ball(20, subdivisions=5)
    coarse = thinned(fine, 2.5)
    assert len(coarse.faces) < len(fine.faces) / 4
    assert coarse.volume_mm3 == pytest.approx(fine.volume_mm3, rel=0.02)
