"""A description of the machine that figures were measured on."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from tumortrack.core.process import available_cores

_CPU_INFO = Path("/proc/cpuinfo")
_LIBRARIES = ("tumortrack", "numpy", "scipy")


def describe_machine() -> dict[str, str]:
    """Processor, cores, caches, memory, versions, date, in the order in which they are shown."""
    info = _cpu_info()
    model = f" (family {info['cpu family']}, model {info.get('model')})"
    return {
        "processor": cpu_name() + (model if "cpu family" in info else ""),
        "cores": f"{available_cores()}",
        "caches": _caches(),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "libraries": ", ".join(f"{name} {version(name)}" for name in _LIBRARIES),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "load before": f"{os.getloadavg()[0]:.1f}",
    }


def cpu_name() -> str:
    """The processor as the system names it."""
    return _cpu_info().get("model name") or platform.processor() or platform.machine()


def _cpu_info() -> dict[str, str]:
    """The first core's entries of /proc/cpuinfo; empty on other systems than Linux."""
    text = _CPU_INFO.read_text(encoding="utf-8") if _CPU_INFO.exists() else ""
    lines = (line.partition(":") for line in text.partition("\n\n")[0].splitlines())
    return {key.strip(): value.strip() for key, _, value in lines}


def _caches() -> str:
    """Level and size of the first core's caches, from Linux's /sys."""
    folders = sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*"))
    caches = [
        [(folder / name).read_text(encoding="utf-8").strip() for name in ("level", "type", "size")]
        for folder in folders
    ]
    data = ", ".join(f"L{level} {size}" for level, kind, size in caches if kind != "Instruction")
    return data or "not known"
