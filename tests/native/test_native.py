"""Calls into the compiled kernels: what is refused before anything native runs; and their build."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tumortrack import native
from tumortrack.native import F32, F64, I32, kernel

ROOT = Path(__file__).parents[2]

# of registration.estimate: margins, one over each standard deviation, which of them, chances
CHANCES = kernel("probabilities", F32["n"], F64["s"], I32["n"], F32["n"].out, result=int)


def given(n=5):
    return [np.ones(n, np.float32), np.ones(3), np.zeros(n, np.int32), np.empty(n, np.float32)]


def test_a_call_fills_what_it_is_given():
    arrays = given()
    assert CHANCES(*arrays) == 0
    np.testing.assert_allclose(arrays[3], 0.841345, atol=1e-6)


@pytest.mark.parametrize(
    ("which", "wrong"),
    [
        (0, np.ones(5)),  # another type
        (0, np.ones((5, 1), np.float32)),  # another number of axes
        (0, np.ones(4, np.float32)),  # not as many as there are places for
        (0, np.ones(10, np.float32)[::2]),  # not one after the other
        (2, [0] * 5),
        (3, np.empty(6, np.float32)),
        (3, np.frombuffer(bytes(20), np.float32)),  # cannot be written
    ],
)
def test_arrays_that_are_not_as_declared_are_refused(which, wrong):
    arrays = given()
    arrays[3][:] = -1
    as_before, arrays[which] = arrays[3], wrong
    with pytest.raises(TypeError):
        CHANCES(*arrays)
    assert (as_before == -1).all()  # nothing native ran


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_where_they_are_not_declared(value):
    arrays = given()
    arrays[0][2] = value
    arrays[3][:] = -1
    with pytest.raises(ValueError):  # noqa: PT011 - of ours there is no other
        CHANCES(*arrays)
    assert (arrays[3] == -1).all()
    as_it_is = kernel("probabilities", F32["n"].any_value, F64["s"], I32["n"], F32["n"].out)
    as_it_is(*arrays)  # and numbers whose squares are not finite are
    arrays[0][2] = 1e30
    CHANCES(*arrays)
    assert arrays[3][2] == 1


def test_a_wrong_number_of_arguments_and_a_wrong_declaration_are_refused():
    with pytest.raises(ValueError):  # noqa: PT011
        CHANCES(*given()[:3])
    with pytest.raises(ImportError):
        kernel("probabilities", F32["n"], F64["s"], I32["n"])(*given()[:3])
    with pytest.raises(AttributeError):
        kernel("no_such_kernel", int)(1)


def test_arrays_that_cannot_be_written_and_empty_ones_are_read():
    arrays = given()
    for array in arrays[:3]:
        array.flags.writeable = False
    assert CHANCES(*arrays) == CHANCES(*given(0)) == 0


@pytest.mark.parametrize("folder", [native.LIBRARIES, ROOT / "docs"])
def test_without_a_library_for_this_processor_there_is_one_error(folder):
    with pytest.raises(ImportError):
        native.library_in(folder, frozenset())


def build(*arguments, **environment):
    command = [sys.executable, ROOT / "tools" / "build_backend.py", *arguments]
    environ = {**os.environ, **environment}
    return subprocess.run(command, env=environ, capture_output=True, text=True, check=False)


def test_a_compiler_that_is_not_there_ends_the_build_in_one_line():
    said = build(CC="no-such-compiler")
    assert said.returncode == 1
    assert "no-such-compiler" in said.stderr.splitlines()[0]
    assert len(said.stderr.splitlines()) == 1
    assert build("--compiler", CC="some cc").stdout == "some cc\n"


def test_pip_and_make_build_with_the_same_ziglang():
    locked = (ROOT / "requirements" / "compiler.txt").read_text().split()[0]
    assert f'"{locked}"' in (ROOT / "tools" / "build_backend.py").read_text()
