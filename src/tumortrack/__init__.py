"""tumortrack: kidney and tumors, located from one depth image of one side.

    import tumortrack as tt
    estimate = tt.Tracker(tt.load_model("MODEL")).locate(tt.read_cloud("cloud.ply"))

Millimetres everywhere; a transform is named ``b_from_a``. See docs/conventions.md. Each name is
loaded when it is first used: importing this package imports neither torch nor any other heavy
library.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tumortrack.api import (
        Case,
        DepthFrame,
        Estimate,
        Intrinsics,
        SensorCloud,
        estimate_from_surfaces,
        evaluate,
        find_organ,
        load_case,
        load_model,
        plan_resection,
        prepare,
        read_cloud,
        save_estimate,
        scan_phantom,
        simulate_scenes,
        track,
        train,
    )
    from tumortrack.core import errors
    from tumortrack.tracking.tracker import Tracker
    from tumortrack.training import presets

__version__ = "0.2.0"
__all__ = [
    "Case",
    "DepthFrame",
    "Estimate",
    "Intrinsics",
    "SensorCloud",
    "Tracker",
    "errors",
    "estimate_from_surfaces",
    "evaluate",
    "find_organ",
    "load_case",
    "load_model",
    "plan_resection",
    "prepare",
    "presets",
    "read_cloud",
    "save_estimate",
    "scan_phantom",
    "simulate_scenes",
    "track",
    "train",
]

_ELSEWHERE = {
    "Tracker": "tumortrack.tracking.tracker",
    "errors": "tumortrack.core",
    "presets": "tumortrack.training",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _ELSEWHERE.get(name, "tumortrack.api")
    if home in ("tumortrack.core", "tumortrack.training"):
        return import_module(f"{home}.{name}")
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted(__all__)
