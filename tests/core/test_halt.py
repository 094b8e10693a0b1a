"""Halts of arms: compared by kind, whatever their numbers. Every kind has a sentence."""

from typing import get_args

from tumortrack.core import halt, report
from tumortrack.core.halt import CUT_NOTE, Halt
from tumortrack.core.report import Finding


def moved(part, off_mm, cut=False):
    return Halt("moved", {"part": part, "off_mm": off_mm}, cut=cut)


def without_frame(seconds):
    finding = Finding("no_frame", {"seconds": seconds})
    return Halt("no_estimate", {"words": finding.words}, finding)


def test_halts_that_differ_in_numbers_alone_are_the_same():
    first, second = moved("tumor_1", 2.04), moved("tumor_1", 13.0)
    assert first.words == "tumor_1 has moved by 2.0 mm"
    assert first != second
    assert first.same_as == second.same_as
    assert first.words_without_numbers == second.words_without_numbers
    for other in (moved("kidney", 2.04), moved("tumor_1", 2.04, cut=True), Halt("planning")):
        assert other.same_as != first.same_as
    assert CUT_NOTE in moved("tumor_1", 2.04, cut=True).words
    assert without_frame(0.6).same_as == without_frame(1.9).same_as
    assert without_frame(0.6).words == "no estimate: no frame for 0.6 s"


def test_every_kind_has_one_sentence():
    assert {*halt._SENTENCES} == {*get_args(halt.HaltKind)}
    assert sorted([*report._SAID.poor, *report._SAID.none, *report._SAID.case]) == sorted(
        get_args(report.Kind)
    )
