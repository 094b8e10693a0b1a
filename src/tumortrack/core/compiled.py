"""``njit`` for our kernels: numba's, with a cache that never runs outdated machine code.

numba keeps machine code beside the modules: for each function an index, and a code file for each
signature. Three gaps in that are closed here; what does not fit is compiled again.

- The files pickle our classes. After an update some of them are gone, and numba fails on unpickling
  before it compares versions. A file that cannot be read counts as outdated.
- A code file does not say what it holds. Two processes that compile a function for different
  signatures at once choose the same file name, and a process that is killed between index and code
  leaves an older file under a new index. Machine code for other types, or of older source, would
  then run: wrong numbers or a crash. So each code file states its source and signature.
- Code is outdated when its own module changes, but not when a compiled function or a constant from
  another module does. Here those count as well.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As ``numba.njit(cache=True, **options)``, with the cache described above."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        dispatcher._cache = _KernelCache(function)
        return dispatcher

    return compiled


class _KernelCache(FunctionCache):
    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp(), *sorted(set(_dependencies(function)))
        self._cache_file = _CacheFile(self._cache_path, self._impl.filename_base, stamp)


class _CacheFile(IndexDataCacheFile):
    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # unpickling raises anything
            return {}

    def load(self, key: Any) -> Any:
        try:
            stamp, signature, code = super().load(key)
        except Exception:  # likewise; or there is none
            return None
        return code if (stamp, signature) == (self._source_stamp, key) else None

    def save(self, key: Any, code: Any) -> None:
        super().save(key, (self._source_stamp, key, code))


def _dependencies(function: FunctionType) -> Iterator[str]:
    """What else becomes part of a function's machine code: constants, and the sources of the
    compiled functions that it calls, with their dependencies."""
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher) and value.py_func is not function:
            yield _sha256(value.py_func.__code__.co_filename)
            yield from _dependencies(value.py_func)
        elif isinstance(value, int | float | str | tuple):
            yield f"{name} = {value!r}"


@cache
def _sha256(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()
