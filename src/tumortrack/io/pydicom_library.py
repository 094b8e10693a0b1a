"""A safe import of pydicom."""

from __future__ import annotations

import sys
from typing import Any


def load_pydicom() -> None:
    """Import pydicom; to be called before any other import of it. It loads GDCM, which imports
    Python 2's module ``dl`` and would execute a module of that name on the user's path."""
    if "pydicom" in sys.modules:
        return
    modules: dict[str, Any] = sys.modules
    absent = object()
    users = modules.get("dl", absent)
    modules["dl"] = None
    try:
        import pydicom  # noqa: F401
    finally:
        del modules["dl"]
        if users is not absent:
            modules["dl"] = users
