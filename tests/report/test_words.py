"""No word of a picture is lost: whole, within the borders, none over another; warnings first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from test_evaluate import anatomy, estimate_of, scene

from picture_words import LONG, PATIENT, check
from tumortrack.core.types import LabelVolume
from tumortrack.report import drawing
from tumortrack.report.metrics import label_grid
from tumortrack.report.pictures import qc_picture, scene_picture
from tumortrack.report.wrapping import wrapped

WARNINGS = (
    "POOR: only 12% of the organ's surface is seen, and 3 of 1000 points lie farther "
    "than 5 mm from it; another organ, or another patient's: take a view from which more of it can "
    "be seen, uncover fat and drape, and locate again. Also the tumor lies 4.1 mm elsewhere in "
    "another minimum that fits nearly as well.",
    "OVER BUDGET: 18.6 mm of error, most of it tracking (15.5), against a margin of 4.9 mm.",
    f"NOT GUARDED {', '.join(f'segmental_artery_of_the_lower_pole_{n}' for n in range(8))}.",
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that would be saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(drawing, "save", lambda figure, _: figures.append(figure))
    return figures


@pytest.mark.parametrize("failed", [WARNINGS[0], LONG])
def test_a_scene(failed: str, drawn: list[Figure], tmp_path: Path) -> None:
    part = {"found": True, "hausdorff_mm": 123.4, "center_mm": 123.4, "iou": 0.05}
    entry = {
        "name": "a-scene-of-the-laboratory-" * 8, "miou": 0.5, "parts": {"tumor_1": part},
        "failed": failed, "quality": "poor", "reason": WARNINGS[0],
    }  # fmt: skip
    scene_picture(scene(), estimate_of(anatomy()).meshes, entry, tmp_path / "scene.png")
    check(drawn[0], (f"FAILED: {failed}", f"POOR: {WARNINGS[0]}"))


def test_a_prepared_case(drawn: list[Figure], tmp_path: Path) -> None:
    parts, lps_from_index = anatomy(), np.eye(4)
    lps_from_index[:3, 3] = (-30, -30, 100)
    labels = LabelVolume(label_grid(parts, lps_from_index, (60, 60, 60)), lps_from_index)
    qc_picture(labels, None, parts, tmp_path / "qc.png", str(PATIENT), WARNINGS)
    check(drawn[0], WARNINGS)


def test_wrapping_loses_nothing() -> None:
    text = "one two three " + "x" * 25 + " four\nfive"
    for width in (1, 3, 8, 100):
        lines = wrapped(text, width, len)
        assert "".join(lines).replace(" ", "") == "".join(text.split())
        assert max(map(len, lines)) <= width
    assert wrapped("a bc def", 4, len) == ["a bc", "def"]
