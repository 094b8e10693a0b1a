"""Frozen typed configuration: JSON round trip, unknown keys refused."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from tumortrack.core.errors import InputError


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every configuration value.

    Subclasses that take part in a typed union (one kind, one file) add ``tag=...``.
    """


C = TypeVar("C", bound=msgspec.Struct)


def to_builtins(config: msgspec.Struct) -> dict:
    """The configuration as what JSON would give back, every key written out."""
    return msgspec.json.decode(msgspec.json.encode(config))


def from_builtins(data: object, kind: type[C], where: str) -> C:
    """Rebuild a configuration; ``where`` names its origin in the error.

    Raises:
        InputError: unknown key, wrong type or missing value.
    """
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: not a valid {kind.__name__}: {error}.") from error
