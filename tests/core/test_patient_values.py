"""Whose organ: what counts as the same, and what as somebody else's."""

from __future__ import annotations

import pytest

from refused import refused
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.patient import NOBODY, Patient, patient_in

A, B = Patient("A", "left"), Patient("B", "left")


def test_it_comes_back_from_a_file_and_one_that_says_nothing_knows_nobody():
    assert patient_in(to_builtins(A), "here") == A
    assert patient_in(None, "here") == NOBODY
    for nonsense in ({"id": "A", "side": "up"}, {"id": "A", "name": "Doe"}, "A"):
        with refused(InputError, "here"):
            patient_in(nonsense, "here")


def test_only_what_both_know_can_differ():
    assert A.differs(B)
    assert A.differs(Patient("A", "right"))
    assert not any(A.differs(other) for other in (A, NOBODY, Patient("A"), Patient(side="left")))
    assert [p.known for p in (A, NOBODY, Patient("A"), Patient(side="left"))] == [True] + 3 * [
        False
    ]


def test_whoever_is_stated_must_be_known_to_be_meant():
    for stated in (NOBODY, Patient("A"), Patient(side="left"), A):
        A.check_is(stated, "MODEL")
    for stated in (B, Patient("B"), Patient("A", "right"), Patient(side="right")):
        with refused(InputError, "MODEL", "A", "left"):
            A.check_is(stated, "MODEL")
    for found in (NOBODY, Patient("A"), Patient(side="left")):
        with refused(InputError, "MODEL", "unknown"):
            found.check_is(A, "MODEL")


@pytest.mark.parametrize("wrong", ["", " A", "A\n", "A\x1b[2J", "x" * 65])
def test_what_is_no_identifier_is_refused(wrong):
    with pytest.raises(InputError):
        Patient(wrong)
