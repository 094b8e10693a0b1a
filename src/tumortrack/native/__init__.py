"""The compiled kernels, C called through ctypes: what a kernel takes, and the checks before a call.

Sources are ``exact`` (each operation rounded as written: alike on every machine) and ``fast`` (sums
in the order that the compiler likes). ``tools/build_backend.py`` makes one library of them at
installation. A kernel is declared where it is used::

    follow = kernel("follow", FIELD, F32["n", 3], int, F32["n", 3].out)

and gets a pointer to a C struct with these members in this order: an array is its address and its
sizes (``f32_2`` in ``native.h``), a float is a double, an int an int64_t, and a tuple (for a
NamedTuple; ``FIELD = (F32["i", "j", "k", 3], F32[3], float)``) a struct of its own. Python's lock
is released during the call.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np

# kernels.elf; in wheels another for newer processors. As .so Python took them for its own modules.
LIBRARIES = Path(__file__).parent
_CODES = {float: "d", int: "q"}
_AGAIN = (
    "In a checkout `make setup` builds them; elsewhere install the package again: "
    "`pip install --force-reinstall` and its wheel."
)
_RESULTS = {None: None, float: ctypes.c_double, int: ctypes.c_int64}


class Array:
    """A C-contiguous array: ``F32["n", 3]`` has n rows of three; sizes of one name are equal within
    a call. Floats must be finite, but where ``any_value`` says that the kernel can do with the rest
    or that they were checked before; ``out`` is what the kernel writes, whatever is in it."""

    def __init__(
        self,
        dtype: type,
        shape: tuple[int | str, ...] = (),
        finite: bool = True,
        written: bool = False,
    ) -> None:
        self.dtype, self.shape, self.written = np.dtype(dtype), shape, written
        self.finite = finite and self.dtype.kind == "f"

    def __getitem__(self, shape: int | str | tuple[int | str, ...]) -> Self:
        return type(self)(self.dtype.type, shape if isinstance(shape, tuple) else (shape,))

    @property
    def any_value(self) -> Self:
        """The same without the check."""
        return type(self)(self.dtype.type, self.shape, finite=False)

    @property
    def out(self) -> Self:
        """The same, to write into."""
        return type(self)(self.dtype.type, self.shape, finite=False, written=True)

    def __repr__(self) -> str:
        return f"{self.dtype.name} ({', '.join(map(str, self.shape))})"

    def slots(self, value: Any, sizes: dict[int | str, int]) -> tuple[int, ...]:
        """Address and sizes. Raises TypeError: no such array; ValueError: not finite."""
        if not isinstance(value, np.ndarray) or value.dtype != self.dtype:
            self._refuse(value)
        flags, shape = value.flags, value.shape
        if not flags.c_contiguous or len(shape) != len(self.shape):
            self._refuse(value)
        for size, wanted in zip(shape, self.shape, strict=True):
            if sizes.setdefault(wanted, size) != size:
                self._refuse(value, f", where {wanted} is {sizes[wanted]}")
        if self.finite and not _is_finite(value):
            raise ValueError(f"{self!r} holds values that are not finite")
        if flags.writeable:  # the address in a fifth of the time
            return ctypes.addressof(_Nothing.from_buffer(value)), *shape
        if self.written:
            self._refuse(value, ", to write into")
        return value.__array_interface__["data"][0], *shape

    def _refuse(self, value: Any, more: str = "") -> None:
        given = type(value).__name__
        if isinstance(value, np.ndarray):
            kind = "" if value.flags.c_contiguous else "strided "
            given = f"{kind}{value.dtype.name} {value.shape}" + (
                "" if value.flags.writeable else ", read only"
            )
        raise TypeError(f"C-contiguous {self!r}{more}, is wanted, not {given}")


_Nothing = ctypes.c_char * 0
_FEW = 4096  # numbers: BLAS then does not wake threads


def _is_finite(value: np.ndarray) -> bool:
    # The sum of squares is much quicker, and not finite where one of them is not; or is too large
    if value.size < _FEW and math.isfinite(np.vdot(value, value)):
        return True
    return bool(np.isfinite(value).all())


F32, F64 = Array(np.float32), Array(np.float64)
I32, I64, U8, BOOL = (Array(dtype) for dtype in (np.int32, np.int64, np.uint8, np.bool_))

# What a kernel takes: an array, a float, an int, or a tuple of these.
Argument = Array | type[float] | type[int] | tuple["Argument", ...]


def kernel(
    name: str,
    *arguments: Argument,
    result: type[float] | type[int] | None = None,
    within: ctypes.CDLL | None = None,
) -> Any:
    """The function ``name`` of the library, or of another. Calling it raises TypeError or
    ValueError for what is not declared so, before anything native runs."""
    layout = struct.Struct("=" + "".join(map(_code, arguments)))
    fixed: dict[int | str, int] = {n: n for n in _sizes(arguments) if isinstance(n, int)}

    @cache
    def function() -> Callable[[bytes], Any]:
        kernels = within or library()
        found = kernels[name]  # an object of this declaration alone
        found.argtypes, found.restype = [ctypes.c_char_p], _RESULTS[result]
        takes = ctypes.c_int64.in_dll(kernels, f"{name}_bytes").value
        if takes != layout.size:
            raise ImportError(f"kernel {name}: {layout.size} bytes declared, of {takes}. {_AGAIN}")
        return found

    def call(*values: Any) -> Any:
        slots: list[Any] = []
        try:
            _fill(slots, arguments, values, dict(fixed))
        except (TypeError, ValueError) as error:
            raise type(error)(f"{name}: {error}") from None
        return function()(layout.pack(*slots))

    call.__name__ = call.__qualname__ = name
    return call


def _fill(
    slots: list[Any], arguments: Sequence[Any], values: Sequence[Any], sizes: dict[int | str, int]
) -> None:
    for argument, value in zip(arguments, values, strict=True):
        if isinstance(argument, Array):
            slots += argument.slots(value, sizes)
        elif isinstance(argument, tuple):
            _fill(slots, argument, value, sizes)
        else:
            slots.append(argument(value))


def _code(argument: Any) -> str:
    if isinstance(argument, tuple):
        return "".join(map(_code, argument))
    return "q" * (1 + len(argument.shape)) if isinstance(argument, Array) else _CODES[argument]


def _sizes(arguments: Sequence[Any]) -> Iterator[int | str]:
    for argument in arguments:
        if isinstance(argument, Array | tuple):
            yield from argument.shape if isinstance(argument, Array) else _sizes(argument)


@cache
def library() -> ctypes.CDLL:
    """The kernels for this processor. Raises ImportError: there are none."""
    return library_in(LIBRARIES, processor_features())


def library_in(folder: Path, features: frozenset[str]) -> ctypes.CDLL:
    """The kernels in a folder for a processor with these features. Raises ImportError: none."""
    names = sorted(path.name for path in folder.glob("kernels*.elf"))
    for name in reversed(names):  # the one for newer processors last
        found = ctypes.CDLL(str(folder / name))
        needed = ctypes.c_char_p.in_dll(found, "processor_features").value or b""
        if set(needed.decode().split()) <= features:
            return found
    what = "were built for another processor; remove them" if names else "are not built"
    raise ImportError(f"tumortrack's kernels, {folder / 'kernels.elf'}, {what}. {_AGAIN}")


@cache
def processor_features() -> frozenset[str]:
    """Of this processor, as Linux names them."""
    with open("/proc/cpuinfo") as lines:  # beside many processors the first ones tell
        for line in lines:
            name, _, values = line.partition(":")
            if name.strip() in ("flags", "Features"):
                return frozenset(values.split())
    return frozenset()
