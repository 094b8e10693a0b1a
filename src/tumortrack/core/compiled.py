"""numba, for modules that compile: ``from tumortrack.core.compiled import numba``.

It keeps machine code beside the modules, in files that name our classes. After an update some of
these classes are gone, and numba fails on its own file before it sees that the file is outdated.
Whatever cannot be read is taken for outdated here, and compiled again.
"""

from __future__ import annotations

from typing import Any

import numba as numba
from numba.core.caching import IndexDataCacheFile

_load_index, _load = IndexDataCacheFile._load_index, IndexDataCacheFile.load


def _index_or_none(self: Any) -> Any:
    try:
        return _load_index(self)
    except Exception:  # unpickling raises anything
        return {}


def _kept_or_none(self: Any, key: Any) -> Any:
    try:
        return _load(self, key)
    except Exception:  # likewise
        return None


setattr(IndexDataCacheFile, "_load_index", _index_or_none)  # noqa: B010  as mypy wants it
setattr(IndexDataCacheFile, "load", _kept_or_none)  # noqa: B010
