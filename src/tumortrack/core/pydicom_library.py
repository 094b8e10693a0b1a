"""pydicom, imported so that nothing of a user's is taken for a part of it."""

from __future__ import annotations

import sys
from typing import Any


def load_pydicom() -> None:
    """Import pydicom, before anything else does. It loads GDCM, which asks for Python 2's module
    ``dl`` and would take a module or folder of that name on the user's path for it."""
    if "pydicom" in sys.modules:
        return
    modules: dict[str, Any] = sys.modules
    absent = object()
    theirs = modules.get("dl", absent)
    modules["dl"] = None
    try:
        import pydicom  # noqa: F401
    finally:
        del modules["dl"]
        if theirs is not absent:
            modules["dl"] = theirs
