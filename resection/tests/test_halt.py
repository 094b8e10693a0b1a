"""Halts of arms are compared by kind, whatever their numbers; every kind has a sentence."""

import tomllib
from importlib.resources import files
from typing import get_args

from tumortrack.core.report import Finding
from tumortrack_resection.halt import Halt, HaltKind


def test_halts_that_differ_in_numbers_alone_are_the_same():
    first, second = (Halt("moved", {"part": "tumor_1", "off_mm": mm}) for mm in (2.04, 13.0))
    assert first.message == "tumor_1 has moved by 2.0 mm"
    assert first != second
    assert first.same_as == second.same_as
    assert first.words_without_numbers == second.words_without_numbers
    for other in (Halt("moved", {"part": "kidney", "off_mm": 2.04}), Halt("planning")):
        assert other.same_as != first.same_as
    once, again = (
        Halt("no_estimate", {"message": finding.message}, finding)
        for finding in (Finding("no_frame", {"seconds": s}) for s in (0.6, 1.9))
    )
    assert once.same_as == again.same_as
    assert once.message == "no estimate: no frame for 0.6 s"


def test_every_kind_has_one_sentence():
    halts = tomllib.loads(files("tumortrack_resection").joinpath("halts.toml").read_text("utf-8"))
    assert set(halts) == set(get_args(HaltKind))
