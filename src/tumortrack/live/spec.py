"""``kind:target?key=value&key=value`` -> the configuration of a source, sink, pose or tool.

A kind is a configuration class that an installed package, such as tumortrack-devices, offers by an
entry point in ``tumortrack.sources``, ``.sinks``, ``.poses`` or ``.tools``, named as the class's
``tag``. Only the requested kind is imported, so a broken package affects no other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.core.report import Point
from tumortrack.live.poses import PosesConfig
from tumortrack.live.tools import ToolConfig
from tumortrack.live.values import SinkConfig, SourceConfig

C = TypeVar("C", bound=Config)


class Extension(NamedTuple):
    """A kind of another package; ``fault``: why it cannot be used, empty if it can."""

    what: str
    kind: str
    package: str
    fault: str


@dataclass(frozen=True)
class Registry(Generic[C]):
    """The kinds of one ``what``: those of the entry points' ``group``, of the class ``base``, and
    ``built_in`` ones (``module:class`` by kind). ``packages``: what to install for the kinds of our
    other distributions."""

    what: str
    group: str
    base: Any
    packages: Mapping[str, str] = field(default_factory=dict)
    built_in: Mapping[str, str] = field(default_factory=dict)

    def parse(self, text: str) -> C:
        """The configuration that ``text`` describes. Raises InputError for an unknown kind, key or
        value (listing what is allowed), and if a package is broken."""
        head, _, options = text.partition("?")
        kind, _, target = head.partition(":")
        where = f"{self.what} {text!r}"
        return _filled(self.config(kind, where), target, options, where)

    def extensions(self) -> Iterator[Extension]:
        """The kinds of other packages; each class is imported."""
        entries = self._entry_points()
        for entry in entries:
            fault = ""
            try:
                self.config(entry.name, f"{self.what} {entry.name!r}", entries)
                if entry.name in self.built_in:
                    fault = f"{entry.name!r} is built in, and cannot be replaced"
            except InputError as error:
                fault = str(error)
            yield Extension(self.what, entry.name, _package_of(entry), fault)

    def config(self, kind: str, where: str, entries: Sequence[EntryPoint] | None = None) -> type[C]:
        """The configuration class of a kind, among ``entries`` (None: all that are installed).
        Raises InputError, which begins with ``where``."""
        if kind in self.built_in:
            return EntryPoint(kind, self.built_in[kind], self.group).load()
        entries = self._entry_points() if entries is None else entries
        matches = [entry for entry in entries if entry.name == kind]
        if not matches and kind in self.packages:
            raise InputError(
                f"{where}: {kind!r} is not installed here: {to_install(self.packages[kind])}."
            )
        if not matches:
            allowed = sorted({*self.built_in, *self.packages, *(entry.name for entry in entries)})
            raise InputError(f"{where}: there is no kind {kind!r}. Allowed: {', '.join(allowed)}.")
        if len(matches) > 1:
            packages = " and ".join(sorted(map(_package_of, matches)))
            raise InputError(f"{where}: {packages} both offer {kind!r}. Uninstall one of them.")
        cause: Exception | None = None
        try:
            config: type[C] = matches[0].load()
            fault = f"offers {matches[0].value}, which is no {self.base.__name__} of tumortrack"
            if isinstance(config, type) and issubclass(config, self.base):
                if (tag := config.__struct_config__.tag) == kind:
                    return config
                fault = f"names its entry point {kind!r}, and its class {tag!r}: not the same"
        except Exception as error:  # a foreign package raises anything
            cause = error
            fault = f"offers {kind!r}, but it cannot be imported ({type(error).__name__}: {error})"
        raise InputError(
            f"{where}: the package {_package_of(matches[0])} {fault}. Repair or uninstall it."
        ) from cause

    def _entry_points(self) -> list[EntryPoint]:
        return sorted(entry_points(group=self.group), key=lambda entry: entry.name)


def _devices(*kinds: str, **others: str) -> dict[str, str]:
    return dict.fromkeys(kinds, "tumortrack-devices") | others


SOURCES = Registry[SourceConfig](
    "source",
    "tumortrack.sources",
    SourceConfig,
    _devices(
        *("virtual", "recording", "ros2"),
        realsense="tumortrack-devices[realsense]",
        stereo="tumortrack-devices[stereo]",
        rehearsal="tumortrack-lab",
    ),
)
SINKS = Registry[SinkConfig](
    "sink",
    "tumortrack.sinks",
    SinkConfig,
    _devices(
        *("viewer", "recording", "ros2", "moveit", "openigtlink"), ur="tumortrack-resection[ur]"
    ),
)
POSES = Registry[PosesConfig](
    "camera's pose",
    "tumortrack.poses",
    PosesConfig,
    _devices("ros2", "ur"),
    {"file": "tumortrack.live.poses:PosesFileConfig"},
)
TOOLS = Registry[ToolConfig](
    "tool", "tumortrack.tools", ToolConfig, _devices("file", "ros2", "openigtlink", "ur")
)


def extensions() -> list[Extension]:
    """All kinds that installed packages add."""
    return [each for kinds in (SOURCES, SINKS, POSES, TOOLS) for each in kinds.extensions()]


def _package_of(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.value


def _filled(config: type[C], target: str, options: str, where: str) -> C:
    def refused(what: str) -> InputError:
        return InputError(f"{where}{what}. {usage(config)}")

    given: dict[str, str] = {}
    for option in filter(None, options.split("&")):
        key, _, value = option.partition("=")  # not unquoted: paths may contain + and %
        if key in given:
            raise refused(f": {key!r} is given twice")
        given[key] = value
    fields = {field.name: field for field in msgspec.structs.fields(config)}
    target_name = getattr(config, "target", "")
    if target and (not target_name or target_name in given):
        raise refused(f": {target!r} has no place there")
    if target:
        given[target_name] = target
    if unknown := [key for key in given if key not in fields]:
        raise refused(f": {unknown[0]!r} is no option")
    if missing := [n for n, f in fields.items() if f.required and n not in given]:
        raise refused(f" lacks its {missing[0]}")
    try:
        return config(**{key: _value(key, fields[key].type, text) for key, text in given.items()})
    except (TypeError, ValueError) as error:  # also of a foreign class's own check
        raise refused(f": {error}") from error


def _value(key: str, kind: Any, text: str) -> Any:
    words = text.split(",") if kind in (Point, Point | None) else text
    try:
        return msgspec.convert(words, kind, strict=False, dec_hook=_path)
    except msgspec.ValidationError as error:
        literals = getattr(msgspec.inspect.type_info(kind), "values", ())
        allowed = f"allowed: {', '.join(map(str, literals))}" if literals else error
        raise ValueError(f"{key} is {text!r}; {allowed}") from error


def _path(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"{kind.__name__} is not read from text")


def usage(config: type[Config]) -> str:
    """How to write a kind, with the defaults of its options."""
    kind, target = str(config.__struct_config__.tag), getattr(config, "target", "")
    fields = {field.name: field for field in msgspec.structs.fields(config)}
    first = fields.pop(target, None)
    options = "&".join(f"{name}={_text(field.default)}" for name, field in fields.items())
    place = "" if first is None else (f":{target.upper()}" if first.required else f"[:{target}]")
    return f"Write {kind}{place}" + (f"[?{options}]" if options else "") + "."


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ",".join(f"{number:g}" for number in value)
    return "" if value is None or value is msgspec.NODEFAULT else str(value)
