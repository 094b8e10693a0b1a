"""No word of a plan's picture, nor of a film, is lost; warnings first."""

# ruff: noqa: F811 (fixtures)

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from picture_objects import located, plan, published, workcells  # noqa: F401 (fixtures)
from picture_words import LONG, PATIENT, check
from tumortrack.core.colours import NONE, WHITE
from tumortrack.live.values import Workcell
from tumortrack_resection.film import Paragraph, film, words_strip
from tumortrack_resection.pictures import plan_figure
from tumortrack_resection.values import (
    OVER_BUDGET,
    POOR_ESTIMATE,
    UNGUARDED,
    Located,
    ResectionPlan,
)
from workcell_objects import stopped

WARNINGS = (
    f"{POOR_ESTIMATE}: only 12% of the organ's surface is seen, and 3 of 1000 points lie farther "
    "than 5 mm from it; another organ, or another patient's: take a view from which more of it can "
    "be seen, uncover fat and drape, and locate again. Also the tumor lies 4.1 mm elsewhere in "
    "another minimum that fits nearly as well.",
    f"{OVER_BUDGET}: 18.6 mm of error, most of it tracking (15.5), against a margin of 4.9 mm.",
    f"{UNGUARDED} {', '.join(f'segmental_artery_of_the_lower_pole_{n}' for n in range(8))}.",
)
SETS = [(), WARNINGS[1:2], WARNINGS, (*WARNINGS, f"{OVER_BUDGET} {LONG}")]


@pytest.mark.parametrize("warnings", SETS)
def test_a_plan(warnings: tuple[str, ...], plan: ResectionPlan, located: Located) -> None:
    notes = (*warnings, "tumor_2 comes away with tumor_1.", "a note that goes on " * 30)
    figure = plan_figure(replace(plan, notes=notes), replace(located, patient=PATIENT))
    check(figure, warnings)
    told = "".join("".join(text.get_text().split()) for text in figure.texts)
    for note in notes:
        assert "".join(note.split()) in told
    title = figure.texts[len(warnings)].get_text()
    assert not any(word in title for word in ("kept", "safe", "good"))


def test_a_plans_views_have_one_scale(plan: ResectionPlan, located: Located) -> None:
    figure = plan_figure(plan, located)
    figure.canvas.draw()  # type: ignore[attr-defined]
    scales = [np.ptp(axes.transData.transform([[0, 0], [10, 0]])[:, 0]) for axes in figure.axes]
    assert scales[0] == pytest.approx(scales[1], rel=1e-6)
    assert scales[2:] == pytest.approx([scales[2]] * len(plan.cuts), rel=1e-6)  # sections
    assert all(any("mm" in text.get_text() for text in axes.texts) for axes in figure.axes)


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
    workcells: list[Workcell],
    located: Located,
    plan: ResectionPlan,
    tmp_path: Path,
) -> None:
    cells = [*workcells[:2], replace(workcells[2], halt=stopped(WARNINGS[0]))]
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
