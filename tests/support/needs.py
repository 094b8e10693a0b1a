"""What some tests need beyond Python packages of every machine: without it they are skipped, with
the reason; where everything is installed, as in CI, they fail instead."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any, NoReturn

import pytest

EVERYTHING = "TUMORTRACK_TEST_EVERYTHING"  # set: nothing may be missing


def missing(reason: str) -> NoReturn:
    """Skip the test, or the module that is being imported; fail where nothing may be missing."""
    if os.environ.get(EVERYTHING):
        pytest.fail(f"{reason}; {EVERYTHING} is set, so this test must run", pytrace=False)
    pytest.skip(reason, allow_module_level=True)


def module(name: str, how: str) -> Any:
    """The module; without it, or where it cannot be loaded, the test is skipped.

    how: what to do to get it.
    """
    try:
        return import_module(name)
    except ImportError as error:  # a library of the system's is missing as well
        missing(f"{error}: {how}")
