"""Peak memory of this process, as Linux counts it."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # Documentation/filesystems/proc: resets VmHWM to what is resident now


def forget_peak() -> int | None:
    """Give freed memory back and begin to count anew; bytes resident now, None where the system
    does not say."""
    gc.collect()
    if not _CLEAR.exists():
        return None
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    try:
        _CLEAR.write_text(_RESET_PEAK, encoding="ascii")
    except PermissionError:  # a container may forbid it
        return None
    return _of("VmRSS")


def peak_bytes() -> int | None:
    """The most that was resident since ``forget_peak``."""
    return _of("VmHWM") if _STATUS.exists() else None


def _of(name: str) -> int:
    for line in _STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"{_STATUS} does not tell {name}.")
