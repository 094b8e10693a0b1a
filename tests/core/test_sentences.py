"""Sentences are made of kinds and values: each kind has one, filled by its values; equal kinds are
the same whatever their numbers."""

from __future__ import annotations

import string
import tomllib
from importlib.resources import files
from typing import get_args

import pytest

from tumortrack.assessment.causes import words
from tumortrack.core.report import Cause, Finding, Kind, Likely
from tumortrack.core.units import Unit

FINDINGS = tomllib.loads(files("tumortrack.core").joinpath("findings.toml").read_text("utf-8"))
OF_FINDINGS = {
    kind: said if isinstance(said, str) else said[1]
    for part in FINDINGS.values()
    for kind, said in part.items()
}


def values_of(sentence: str) -> dict[str, float | str]:
    """A value for each placeholder: a number where it is written with digits."""
    found: dict[str, float | str] = {}
    for _, name, form, _ in string.Formatter().parse(sentence):
        if name:
            found[name] = 7.0 if form and form[-1] in "fge%" else f"<{name}>"
            inner = [each for _, each, _, _ in string.Formatter().parse(form or "") if each]
            found |= dict.fromkeys(inner, "2")
    return found


def test_every_kind_has_one_sentence():
    assert sorted(OF_FINDINGS) == sorted(get_args(Kind))


@pytest.mark.parametrize(("kind", "sentence"), OF_FINDINGS.items())
def test_a_sentence_says_each_of_its_values(kind, sentence):
    values = values_of(sentence)
    said = Finding(kind, values)
    assert not {"{", "}"} & set(said.message)
    for value in values.values():
        assert value == "2" or str(value).removesuffix(".0") in said.message
    assert "7" not in said.words_without_numbers
    other = {name: 3.0 if value == 7.0 else value for name, value in values.items()}
    assert said.same_as == Finding(kind, other).same_as


@pytest.mark.parametrize("cause", list(Cause))
def test_each_cause_has_words(cause):
    one = Likely(cause, Unit.INCH.value if cause is Cause.UNIT else 0.4)
    said = words((one, Likely(Cause.VIEW)), "look from the left")
    assert said
    assert "{" not in said
