"""The paper's table: medians, the worst, and verdicts."""

from __future__ import annotations

import pandas as pd
import paper

from tumortrack_benchmarks.physics.twin import TURNED, USUAL, VARIANTS


def row(method, scene, part, kind, mm, quality="good", miou=0.8):
    return {
        "method": method, "scene": scene, "part": part, "kind": kind, "quality": quality,
        "miou": miou, "variant": "D3", "hausdorff_mm": mm + 1, "hausdorff_one_sided_mm": mm,
        "center_mm": mm / 2, "labels_s": 0.02,
    }  # fmt: skip


ROWS = pd.DataFrame([
    row("limited", "a", "kidney", None, 90.0, miou=0.7),
    row("limited", "a", "tumor_1", "endophytic", 4.0, miou=0.7),
    row("limited", "b", "tumor_1", "endophytic", 12.0, miou=0.9),
    row("full", "a", "tumor_1", "endophytic", 3.0),
    row("full", "b", "tumor_1", "endophytic", 11.0, "poor"),
])  # fmt: skip


def test_a_line_has_medians_and_the_worst_beside_what_the_paper_says():
    (line,) = paper.table(ROWS).to_dict("records")
    assert (line["variant"], line["tumor"], line["scenes"]) == ("D3", "endophytic", 2)
    assert line["M_lim HD"] == "8.0 (12.0)"
    assert line["M_lim both ways"] == "9.0 (13.0)"
    assert line["M_lim centre"] == "4.0 (6.0)"
    assert (line["M_lim in the paper"], line["M_full in the paper"]) == ("12.9", "18.5")


def test_only_good_answers_can_be_good_and_wrong():
    (line,) = paper.overlap(ROWS).to_dict("records")
    assert (line["M_lim good"], line["M_lim good and over 5 mm off"]) == ("2 of 2", 1)
    assert (line["M_full good"], line["M_full good and over 5 mm off"]) == ("1 of 2", 0)
    assert line["M_lim labels, ms"] == "20"
    assert line["M_lim mIoU"] == "0.800"  # of scenes, not of parts


def test_pressed_states_are_seen_in_all_turns_when_asked_for():
    turns = {(one.state, one.turn_degrees) for one in TURNED.values()}
    assert turns == {(f"D{n}", turn) for n in (1, 2, 3) for turn in (90, 180, 270)}
    assert not set(TURNED) & set(USUAL)
    assert tuple(VARIANTS) == (*USUAL, *TURNED)  # the usual ones keep their random numbers
