"""From a tumor that tumortrack located to a resection that two arms carry out: the commands
`plan` and `resect`. Millimetres; the table's frame has z up."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tumortrack_resection.planning import begin_plan as begin_plan
    from tumortrack_resection.planning import plan_resection as plan_resection
    from tumortrack_resection.session import begin_resection as begin_resection

_MODULES = {"begin_plan": "planning", "begin_resection": "session", "plan_resection": "planning"}
__all__ = ["begin_plan", "begin_resection", "plan_resection"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
