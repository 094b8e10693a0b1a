"""A small theatre: an ellipsoid with a tumor, on a coarse lattice, built once a process."""

from __future__ import annotations

from functools import cache
from typing import Any

from elastic_objects import UP, organ
from tumortrack.organ.body import BodyConfig
from tumortrack_devices.player import ScenePlayer, ScenePlayerConfig

COARSE = BodyConfig(cells=300, modes=24, responses=100, patches=250)


@cache
def small_theatre(seed: int = 3, **changes: Any) -> ScenePlayer:
    """Of the default configuration, but for ``changes`` and a coarse body."""
    return ScenePlayer(organ(), UP, ScenePlayerConfig(body=COARSE, **changes), seed)
