"""Tables that come along as TOML files beside the modules that read them."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import TypeVar

import msgspec

T = TypeVar("T")


def read_table(package: str, name: str, kind: Callable[..., T]) -> T:
    """The content of a package's TOML file; it must be of the ``kind``."""
    return msgspec.toml.decode(files(package).joinpath(name).read_bytes(), type=kind)
