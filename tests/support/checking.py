"""Beartype as jaxtyping's import hook calls it: what annotations say of arrays is executed."""

from __future__ import annotations

from functools import wraps
from typing import Any

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype

# mypy checks numbers; NumPy's and whole ones may stand for Python's here as they do there.
_NUMBERS = FrozenDict({int: int | np.integer, float: float | int | np.number})
_checked = beartype(conf=BeartypeConf(hint_overrides=_NUMBERS))


def check_annotations(function: Any) -> Any:
    """The typechecker that the hook is given. Each function's check is made when it is first
    called: a worker imports all modules and calls some of their functions."""
    checked = None

    @wraps(function)
    def first_made(*arguments: Any, **named: Any) -> Any:
        nonlocal checked
        checked = checked or _checked(function)
        return checked(*arguments, **named)

    return first_made
