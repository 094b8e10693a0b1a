"""What installed packages add, by entry points of groups such as ``tumortrack.sinks``. Each is
imported when it is asked for, so a broken package affects no other."""

from __future__ import annotations

from collections.abc import Container, Iterator
from importlib.metadata import EntryPoint, entry_points
from typing import Any, NamedTuple

from tumortrack.core.errors import PackageError


class Plugin(NamedTuple):
    """``loaded``: what a package adds as a ``kind`` (sink, ...) of that ``name``; ``fault``: why it
    cannot be used, empty if it can."""

    kind: str
    name: str
    package: str
    fault: str
    loaded: Any

    @property
    def refusal(self) -> str:
        return (
            f"the {self.kind} {self.name!r} of the package {self.package} cannot be used: "
            f"{self.fault}. Repair or uninstall it."
        )


def names(group: str) -> list[str]:
    return sorted(point.name for point in entry_points(group=f"tumortrack.{group}"))


def plugins(
    group: str, base: Any = None, built_in: Container[str] = (), name: str | None = None
) -> Iterator[Plugin]:
    """Those of a group, by name; with a ``name`` that one alone. ``base``: of what is added, which
    then are configuration classes with their name as tag; ``built_in``: names that are taken."""
    offered: dict[str, list[EntryPoint]] = {}
    for point in sorted(entry_points(group=f"tumortrack.{group}"), key=lambda each: each.name):
        if name in (None, point.name):
            offered.setdefault(point.name, []).append(point)
    for known, points in offered.items():
        loaded, package = None, " and ".join(sorted(map(_package_of, points)))
        if known in built_in:
            fault = "it is built in, and cannot be replaced"
        elif len(points) > 1:
            fault = "both offer it"
        else:
            try:
                loaded = points[0].load()
                fault = _fault(loaded, known, base)
            except PackageError as error:  # it says what it lacks
                fault = str(error).rstrip(".")
            except Exception as error:  # a foreign package raises anything
                fault = f"it cannot be imported ({type(error).__name__}: {error})"
        yield Plugin(group.removesuffix("s"), known, package, fault, loaded)


def _fault(loaded: Any, name: str, base: Any) -> str:
    if base is None:
        return ""
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        return f"it is no {base.__name__} of tumortrack"
    tag = loaded.__struct_config__.tag  # type: ignore[attr-defined]
    return "" if tag == name else f"its class has the tag {tag!r}, not its name"


def _package_of(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
