"""Deformations that a configuration may name: our own and those that installed packages add.

A package adds one by an entry point of the group ``tumortrack.deformations``:

    [project.entry-points."tumortrack.deformations"]
    twist = "my_package.twist:TwistConfig"

``TwistConfig`` is a ``core.config.Config`` whose ``tag`` is the entry point's name, with
``sample(view, rng) -> Deformation`` (``base``). A field ``body: BodyConfig`` asks for the organ's
elastic body in the view. Such packages are imported when a configuration is first read. A broken
one is refused, with the reason, only if a configuration names it.
"""

from functools import reduce
from importlib.metadata import EntryPoint, entry_points
from operator import or_
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from tumortrack.core.config import Config
from tumortrack.core.errors import PackageError
from tumortrack.simulation.deform.drag import DragConfig
from tumortrack.simulation.deform.elastic import ElasticConfig
from tumortrack.simulation.deform.stretch import StretchConfig

GROUP = "tumortrack.deformations"
_OURS: dict[str, Any] = {"drag": DragConfig, "stretch": StretchConfig, "elastic": ElasticConfig}

if TYPE_CHECKING:
    LinkConfig = DragConfig | StretchConfig | ElasticConfig
else:

    def __getattr__(name: str) -> Any:
        """``LinkConfig``: the deformations that may stand in a chain."""
        if name != "LinkConfig":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        known = {extension.name: extension.config for extension in extensions()} | _OURS
        globals()[name] = union = reduce(or_, known.values())
        return union


class Extension(NamedTuple):
    """A deformation of another package; ``fault``: why it cannot be used, empty if it can."""

    name: str
    package: str
    fault: str
    config: type[msgspec.Struct]


def extensions() -> list[Extension]:
    """The deformations of installed packages, which are imported."""
    points = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    names = [point.name for point in points]
    return [_loaded(point, names.count(point.name) > 1) for point in points]


def _loaded(point: EntryPoint, twice: bool) -> Extension:
    package = point.dist.name if point.dist else "an installed package"
    try:
        config = point.load()
        if point.name in (*_OURS, "chain"):
            raise TypeError(f"{point.name!r} is built in, and cannot be replaced")
        if twice:
            raise TypeError(f"two packages offer {point.name!r}")
        if not (isinstance(config, type) and issubclass(config, Config)):
            raise TypeError("it is not a tumortrack.core.config.Config")
        if (tag := config.__struct_config__.tag) != point.name:
            raise TypeError(f"its tag is {tag!r}; it must be {point.name!r}, as its entry point")
        if not callable(getattr(config, "sample", None)):
            raise TypeError("it has no method sample(view, rng)")
        return Extension(point.name, package, "", config)
    except Exception as error:  # another package's code may raise anything
        fault = f"{type(error).__name__}: {error}"

    def refuse(self: object) -> None:
        raise PackageError(
            f"the deformation {point.name!r} of {package} ({point.value}) cannot be used: {fault}. "
            f"Update {package} or uninstall it."
        )

    refused = msgspec.defstruct(
        "Refused", [], tag=point.name, frozen=True, namespace={"__post_init__": refuse}
    )
    return Extension(point.name, package, fault, refused)
