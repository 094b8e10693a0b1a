"""Deformations that a configuration may name: our own and those that installed packages add.

A package adds one by an entry point of the group ``tumortrack.deformations``:

    [project.entry-points."tumortrack.deformations"]
    twist = "my_package.twist:TwistConfig"

``TwistConfig`` is a ``core.config.Config`` whose ``tag`` is the entry point's name, with
``sample(view, rng) -> Deformation`` (``base``). A field ``body: BodyConfig`` asks for the organ's
elastic body in the view. Such packages are imported when a configuration is first read. A broken
one is refused, with the reason, only if a configuration names it.
"""

from collections.abc import Iterator
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Any

import msgspec

from tumortrack.core.config import Config
from tumortrack.core.errors import PackageError
from tumortrack.core.plugins import Plugin, plugins
from tumortrack.simulation.deform.drag import DragConfig
from tumortrack.simulation.deform.elastic import ElasticConfig
from tumortrack.simulation.deform.stretch import StretchConfig

_OURS: dict[str, Any] = {"drag": DragConfig, "stretch": StretchConfig, "elastic": ElasticConfig}

if TYPE_CHECKING:
    LinkConfig = DragConfig | StretchConfig | ElasticConfig
else:

    def __getattr__(name: str) -> Any:
        """``LinkConfig``: the deformations that may stand in a chain."""
        if name != "LinkConfig":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        others = {each.name: _config(each) for each in extensions() if each.name != "chain"}
        globals()[name] = union = reduce(or_, (others | _OURS).values())
        return union


def extensions() -> Iterator[Plugin]:
    """The deformations of installed packages, which are imported."""
    for each in plugins("deformations", Config, (*_OURS, "chain")):
        unable = not each.fault and not callable(getattr(each.loaded, "sample", None))
        yield each._replace(fault="it has no method sample(view, rng)") if unable else each


def _config(each: Plugin) -> type[msgspec.Struct]:
    """Its class; of one that cannot be used, a class that says so when it is made."""

    def refuse(self: object) -> None:
        raise PackageError(each.refusal)

    if not each.fault:
        return each.loaded
    namespace = {"__post_init__": refuse}
    return msgspec.defstruct("Refused", [], tag=each.name, frozen=True, namespace=namespace)
