"""No word of a picture is lost: whole, within the borders, none over another; warnings first."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image
from test_evaluate import anatomy, estimate_of, scene
from test_plan_pictures import located, plan, workcells  # noqa: F401 (fixtures)

from tumortrack.core.colours import NONE, WHITE
from tumortrack.core.patient import Patient
from tumortrack.core.types import LabelVolume
from tumortrack.live.values import Workcell
from tumortrack.plan.values import OVER_BUDGET, POOR_ESTIMATE, UNGUARDED, Located, ResectionPlan
from tumortrack.report import drawing
from tumortrack.report.drawing import SIGN
from tumortrack.report.film import Paragraph, film, words_strip
from tumortrack.report.metrics import label_grid
from tumortrack.report.pictures import qc_picture, scene_picture
from tumortrack.report.plan_pictures import plan_figure
from tumortrack.report.wrapping import wrapped

WARNINGS = (
    f"{POOR_ESTIMATE}: only 12% of the organ's surface is seen, and 3 of 1000 points lie farther "
    "than 5 mm from it; another organ, or another patient's: take a view from which more of it can "
    "be seen, uncover fat and drape, and locate again. Also the tumor lies 4.1 mm elsewhere in "
    "another minimum that fits nearly as well.",
    f"{OVER_BUDGET}: 18.6 mm of error, most of it tracking (15.5), against a margin of 4.9 mm.",
    f"{UNGUARDED} {', '.join(f'segmental_artery_of_the_lower_pole_{n}' for n in range(8))}.",
)
LONG = "W" * 300  # a word that is wider than any picture
PATIENT = Patient("W" * 64, "left")


def texts(figure: Figure) -> list[Text]:
    """Everything that is written, but for the words within axes."""
    legends = [text for legend in figure.legends for text in legend.get_texts()]
    titles = [title for axes in figure.axes for title in (axes.title, axes.yaxis.label)]
    found = [*figure.texts, *legends, *titles]
    assert figure._suptitle is None  # it knows of no borders
    return [text for text in found if text.get_text()]


def check(figure: Figure, warnings: tuple[str, ...]) -> None:
    figure.canvas.draw()  # type: ignore[attr-defined]
    boxes: list[tuple[str, Bbox]] = []
    for text in texts(figure):
        box = text.get_window_extent()
        if (patch := text.get_bbox_patch()) is not None:
            box = Bbox.union([box, patch.get_window_extent()])
        boxes.append((text.get_text(), box))
    for words, box in boxes:
        assert min(box.x0, box.y0) >= 0, words
        assert box.x1 <= figure.bbox.x1, words
        assert box.y1 <= figure.bbox.y1, words
    for (one, first), (other, second) in itertools.combinations(boxes, 2):
        assert Bbox.intersection(first, second) is None, f"{one!r} lies over {other!r}"
    for axes in figure.axes:
        for words, box in boxes[: len(figure.texts)]:
            assert Bbox.intersection(axes.bbox, box) is None, f"{words!r} lies over a picture"
    flat = ["".join(text.get_text().split()) for text in figure.texts]
    for n, warning in enumerate(warnings):  # first, and whole
        assert flat[n] == "".join(f"{SIGN}WARNING:{warning}".split())
        text = figure.texts[n]
        assert text.get_fontsize() >= 12
        paper = text.get_bbox_patch()
        assert paper is not None
        assert np.allclose(paper.get_facecolor()[:3], np.array(NONE) / 255)
    heights = [text.get_window_extent().y0 for text in figure.texts[: len(warnings) + 1]]
    assert heights == sorted(heights, reverse=True)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that would be saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(drawing, "save", lambda figure, _: figures.append(figure))
    return figures


SETS = [(), WARNINGS[1:2], WARNINGS, (*WARNINGS, f"{OVER_BUDGET} {LONG}")]


@pytest.mark.parametrize("warnings", SETS)
def test_a_plan(warnings: tuple[str, ...], plan: ResectionPlan, located: Located) -> None:  # noqa: F811
    notes = (*warnings, "tumor_2 comes away with tumor_1.", "a note that goes on " * 30)
    figure = plan_figure(replace(plan, notes=notes), replace(located, patient=PATIENT))
    check(figure, warnings)
    told = "".join("".join(text.get_text().split()) for text in figure.texts)
    for note in notes:
        assert "".join(note.split()) in told
    title = figure.texts[len(warnings)].get_text()
    assert not any(word in title for word in ("kept", "safe", "good"))


def test_a_plans_views_have_one_scale(plan: ResectionPlan, located: Located) -> None:  # noqa: F811
    figure = plan_figure(plan, located)
    figure.canvas.draw()  # type: ignore[attr-defined]
    scales = [np.ptp(axes.transData.transform([[0, 0], [10, 0]])[:, 0]) for axes in figure.axes]
    assert scales[0] == pytest.approx(scales[1], rel=1e-6)
    assert all(any("mm" in text.get_text() for text in axes.texts) for axes in figure.axes)


@pytest.mark.parametrize("failed", [WARNINGS[0], LONG])
def test_a_scene(failed: str, drawn: list[Figure], tmp_path: Path) -> None:
    part = {"found": True, "hausdorff_mm": 123.4, "center_mm": 123.4, "iou": 0.05}
    entry = {
        "name": "a-scene-of-the-laboratory-" * 8, "miou": 0.5, "parts": {"tumor_1": part},
        "failed": failed, "quality": "poor", "reason": WARNINGS[0],
    }  # fmt: skip
    scene_picture(scene(), estimate_of(anatomy()), entry, tmp_path / "scene.png")
    check(drawn[0], (f"FAILED: {failed}", f"POOR: {WARNINGS[0]}"))


def test_a_prepared_case(drawn: list[Figure], tmp_path: Path) -> None:
    parts, lps_from_index = anatomy(), np.eye(4)
    lps_from_index[:3, 3] = (-30, -30, 100)
    labels = LabelVolume(label_grid(parts, lps_from_index, (60, 60, 60)), lps_from_index)
    qc_picture(labels, None, parts, tmp_path / "qc.png", str(PATIENT), WARNINGS)
    check(drawn[0], WARNINGS)


@pytest.mark.parametrize("size", [(640, 480), (200, 160)])
def test_the_strip_of_a_films_frame(size: tuple[int, int]) -> None:
    paragraphs = [Paragraph(text, WHITE, NONE) for text in (*WARNINGS, LONG)]
    strip, boxes = words_strip(paragraphs, size)
    assert strip.width == size[0]
    for left, top, right, bottom in boxes:
        assert min(left, top) >= 0
        assert right <= strip.width
        assert bottom <= strip.height
    assert all(above[3] <= below[1] for above, below in itertools.pairwise(boxes))
    longer, more = words_strip([*paragraphs, Paragraph("and this", WHITE, NONE)], size)
    assert len(more) == len(boxes) + 1
    assert longer.height > strip.height


def test_every_frame_of_a_film_has_its_words(
    workcells: list[Workcell],  # noqa: F811
    located: Located,  # noqa: F811
    plan: ResectionPlan,  # noqa: F811
    tmp_path: Path,
) -> None:
    cells = [*workcells[:2], replace(workcells[2], halted=WARNINGS[0])]
    film(cells, located, tmp_path / "film.gif", (320, 240), plan=replace(plan, notes=WARNINGS))
    film(cells, located, tmp_path / "none.gif", (320, 240), plan=plan)
    with Image.open(tmp_path / "film.gif") as gif, Image.open(tmp_path / "none.gif") as bare:
        assert gif.height > bare.height > 240
        for n in range(3):
            gif.seek(n)
            bare.seek(n)
            warned, plain = (
                np.asarray(each.convert("RGB")).astype(int)[:-240] for each in (gif, bare)
            )
            red, none = ((np.abs(part - NONE).max(2) < 40).sum() for part in (warned, plain))
            assert red > 0.15 * warned[..., 0].size
            assert none < red / 20


def test_wrapping_loses_nothing() -> None:
    text = "one two three " + "x" * 25 + " four\nfive"
    for width in (1, 3, 8, 100):
        lines = wrapped(text, width, len)
        assert "".join(lines).replace(" ", "") == "".join(text.split())
        assert max(map(len, lines)) <= width
    assert wrapped("a bc def", 4, len) == ["a bc", "def"]
