"""Frozen typed configuration: JSON round trip, unknown keys refused."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from tumortrack.core.errors import InputError


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every configuration value. Subclasses that take part in a typed union (one kind, one
    file) add ``tag=...``."""

    def check_ranges(self, what: str, least: str = "0 (off)", **most: float) -> None:
        """Refuse each named field that is not in 0..most, by an InputError with this range, its
        lower end written as ``least``; ``what`` names the configuration."""
        for name, limit in most.items():
            value = getattr(self, name)
            if not 0 <= value <= limit:
                raise InputError(f"{what} {name} is {value}; allowed: {least} to {limit:g}.")

    def check_between(self, what: str, **allowed: tuple[float, float]) -> None:
        """The same for ranges with a lower end: each named field, or all numbers in it."""
        for name, (low, high) in allowed.items():
            value = getattr(self, name)
            if not all(low <= one <= high for one in (value if type(value) is tuple else (value,))):
                said = f"{value:g}" if isinstance(value, float) else value
                raise InputError(f"{what} {name} is {said}; allowed: {low:g} to {high:g}.")


_LARGEST_SEED = 2**32 - 1  # what the generators of all libraries take


def check_seed(seed: int) -> None:
    """InputError for a number that is not allowed as a seed of random numbers."""
    if not 0 <= seed <= _LARGEST_SEED:
        raise InputError(f"the seed is {seed}; allowed: whole numbers from 0 to {_LARGEST_SEED}.")


C = TypeVar("C", bound=msgspec.Struct)


def to_builtins(config: msgspec.Struct) -> dict[str, Any]:
    """The configuration as JSON would return it, every key written out."""
    return msgspec.json.decode(msgspec.json.encode(config))


def from_builtins(data: object, kind: type[C], where: str) -> C:
    """Rebuild a configuration. An unknown key, wrong type or missing value is an InputError, in
    which ``where`` names the origin."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: not a valid {kind.__name__}: {error}.") from error
