"""numba, for modules that compile: ``from tumortrack.core.compiled import numba``.

It keeps machine code beside the modules: an index names a file for each function's types of
arguments. Three things about it are mended here, each of which costs a compilation and no more.

- The files name our classes. After an update some of these are gone, and numba fails on its own
  file before it sees that the file is outdated. Whatever cannot be read is taken for outdated.
- A file does not say what it holds. Two processes that compile the same function for other types
  at once choose the same name, and a process that is killed between index and file leaves an older
  file under a new index. Machine code for other types, or of older source, would then run: it
  gives wrong numbers or crashes. So each file says for which source and types it is, and what is
  for others is not taken.
- Code is outdated when its own module has changed, but not when a function of another module has
  that is part of it, or a number that it takes from one. Here those count as well.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba as numba
from numba.core.caching import Cache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

_begin = Cache.__init__
_load_index, _load, _save = (
    IndexDataCacheFile._load_index,
    IndexDataCacheFile.load,
    IndexDataCacheFile.save,
)


def _begin_with_parts(self: Any, function: FunctionType) -> None:
    _begin(self, function)
    self._cache_file._source_stamp = (
        self._cache_file._source_stamp,
        *sorted(set(_parts(function))),
    )


def _parts(function: FunctionType) -> Iterator[str]:
    """What becomes part of a function's machine code: the sources of compiled ones that it calls,
    theirs in turn, and constants."""
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher) and value.py_func is not function:
            yield _sha256(value.py_func.__code__.co_filename)
            yield from _parts(value.py_func)
        elif isinstance(value, int | float | str | tuple):
            yield f"{name} = {value!r}"


@cache
def _sha256(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def _index_or_none(self: Any) -> Any:
    try:
        return _load_index(self)
    except Exception:  # unpickling raises anything
        return {}


def _code_or_none(self: Any, key: Any) -> Any:
    try:
        stamp, types, code = _load(self, key)
    except Exception:  # likewise; or there is none
        return None
    return code if (stamp, types) == (self._source_stamp, key) else None


def _save_with_key(self: Any, key: Any, code: Any) -> None:
    _save(self, key, (self._source_stamp, key, code))


setattr(Cache, "__init__", _begin_with_parts)  # noqa: B010
setattr(IndexDataCacheFile, "_load_index", _index_or_none)  # noqa: B010  as mypy wants it
setattr(IndexDataCacheFile, "load", _code_or_none)  # noqa: B010
setattr(IndexDataCacheFile, "save", _save_with_key)  # noqa: B010
