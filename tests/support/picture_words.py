"""Is every word of a picture there: whole, within its borders, none over another?"""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from tumortrack.core.colours import NONE
from tumortrack.core.patient import Patient
from tumortrack.report.drawing import SIGN

LONG = "W" * 300  # a word that is wider than any picture
PATIENT = Patient("W" * 64, "left")


def texts(figure: Figure) -> list[Text]:
    """Everything that is written, but for the words within axes."""
    legends = [text for legend in figure.legends for text in legend.get_texts()]
    titles = [title for axes in figure.axes for title in (axes.title, axes.yaxis.label)]
    every = [*figure.texts, *legends, *titles]
    assert not figure.get_suptitle()  # it knows of no borders
    return [text for text in every if text.get_text()]


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
