"""Frozen typed configuration: JSON round trip, unknown keys refused."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from tumortrack.core.errors import InputError, readable
from tumortrack.core.renamed import Renamed, of_unknown_key
from tumortrack.core.report import Finding


class Config(msgspec.Struct, Renamed, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every configuration. Members of a union (one kind, one file) add ``tag=...``."""

    def check_ranges(self, what: str, least: str = "0 (off)", **most: float) -> None:
        """InputError for a named field outside 0..most. The message calls the configuration
        ``what`` and the lower end ``least``."""
        for name, limit in most.items():
            value = getattr(self, name)
            if not 0 <= value <= limit:
                raise InputError(f"{what} {name} is {value}; allowed: {least} to {limit:g}.")

    def check_between(self, what: str, **allowed: tuple[float, float]) -> None:
        """The same for fields, or tuples of numbers, with a lower and an upper end."""
        for name, (low, high) in allowed.items():
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(low <= number <= high for number in numbers):
                text = f"{value:g}" if isinstance(value, float) else value
                raise InputError(f"{what} {name} is {text}; allowed: {low:g} to {high:g}.")


_LARGEST_SEED = 2**32 - 1  # that all random generators in use accept


def check_seed(seed: int) -> None:
    """InputError for a seed out of range."""
    if not 0 <= seed <= _LARGEST_SEED:
        raise InputError(f"the seed is {seed}; allowed: whole numbers from 0 to {_LARGEST_SEED}.")


C = TypeVar("C", bound=msgspec.Struct)


def to_builtins(config: msgspec.Struct) -> dict[str, Any]:
    """The configuration as JSON types, defaults included."""
    return msgspec.json.decode(msgspec.json.encode(config))


def from_builtins(data: object, kind: type[C], where: str) -> C:
    """The inverse. Raises InputError, which names ``where`` the data came from: an unknown key, a
    wrong type, a missing value, or one that is not allowed."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        said = of_unknown_key(kind, str(error))
        raise InputError(f"{where}: not a valid {kind.__name__}: {error}{said}.") from error
    except InputError as error:  # of its own checks
        if type(error) is not InputError:  # of a package: it says which
            raise
        raise InputError(f"{where}: {error}") from error


def findings_in(entries: object, where: str) -> tuple[Finding, ...]:
    """Likewise of findings; none: of a version that knew none."""
    with readable(where, "has findings that are none of this version"):
        found = msgspec.convert(entries or (), tuple[Finding, ...])
        _ = [finding.message for finding in found]  # their values are there
    return found
