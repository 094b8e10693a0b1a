"""Deformations that a configuration may name: ours and those that installed packages add.

A package adds one with an entry point of the group ``tumortrack.deformations``:

    [project.entry-points."tumortrack.deformations"]
    twist = "my_package.twist:TwistConfig"

``TwistConfig`` is a ``core.config.Config`` with a ``tag`` of its own and
``sample(view, rng) -> Deformation`` (``base``). A field ``body: BodyConfig`` asks for the organ's
elastic body in the view. Foreign packages are imported when a configuration is first read.
"""

from functools import reduce
from importlib.metadata import EntryPoint, entry_points
from operator import or_
from typing import TYPE_CHECKING, Any

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.simulate.deform.drag import DragConfig
from tumortrack.simulate.deform.elastic import ElasticConfig
from tumortrack.simulate.deform.stretch import StretchConfig

GROUP = "tumortrack.deformations"
_OURS = (DragConfig, StretchConfig, ElasticConfig)

if TYPE_CHECKING:
    LinkConfig = DragConfig | StretchConfig | ElasticConfig
else:

    def __getattr__(name: str) -> Any:
        """``LinkConfig``: the deformations that may stand in a chain."""
        if name != "LinkConfig":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        known: dict[str, Any] = {"chain": None}
        known |= {kind.__struct_config__.tag: kind for kind in _OURS}
        for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
            kind = _loaded(point)
            if known.setdefault(kind.__struct_config__.tag, kind) is not kind:
                raise _broken(point, f"its tag {kind.__struct_config__.tag!r} is taken")
        globals()[name] = union = reduce(or_, filter(None, known.values()))
        return union


def _loaded(point: EntryPoint) -> type[Config]:
    try:
        kind = point.load()
    except Exception as error:
        raise _broken(point, f"{type(error).__name__}: {error}") from error
    if not (isinstance(kind, type) and issubclass(kind, Config) and kind.__struct_config__.tag):
        raise _broken(point, "it is no tumortrack.core.config.Config with a tag")
    if not callable(getattr(kind, "sample", None)):
        raise _broken(point, "it has no method sample(view, rng)")
    return kind


def _broken(point: EntryPoint, why: str) -> InputError:
    package = point.dist.name if point.dist else "an installed package"
    return InputError(
        f"the deformation {point.name!r} of {package} ({point.value}) cannot be used: {why}. "
        f"Update {package} or uninstall it."
    )
