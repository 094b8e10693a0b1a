"""The method's version, by what it answers: nobody raises it by hand."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.resources import files

_ANSWERS = "answers.json"


@cache
def fingerprint() -> str:
    """Of the answers that come with this version: places of 30 scenes, and figures of the
    fit. ``make fingerprint`` records them again once a place is more than 0.05 mm from what is
    recorded, or a figure by 2 %. What was measured with another fingerprint is of another method.
    """
    content = files("tumortrack.assessment").joinpath(_ANSWERS).read_bytes()
    return hashlib.sha256(content).hexdigest()[:12]
