"""What the figures were measured on, in words."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from tumortrack.core.process import available_cores

_FEATURES = {
    "avx2": "AVX2",
    "avx512": "AVX-512",
    "avx512_vnni": "VNNI",
    "avx512_bf16": "bf16",
    "amx_bf16": "AMX bf16",
    "amx_int8": "AMX int8",
}
NO_GPU = "none at hand"
_CPU_INFO = Path("/proc/cpuinfo")
_LIBRARIES = ("tumortrack", "torch", "numba", "numpy", "scipy")


def describe_machine() -> dict[str, str]:
    """Processor, cores, caches, memory, GPU, versions, date: for people, in their order."""
    import torch

    info, has = _cpu_info(), torch.cpu.get_capabilities()
    model = f" (family {info['cpu family']}, model {info.get('model')})"
    return {
        "processor": cpu_name() + (model if "cpu family" in info else ""),
        "cores": f"{available_cores()}",
        "matrix products": ", ".join(name for key, name in _FEATURES.items() if has.get(key)),
        "caches": _caches(),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
        "GPU": torch.cuda.get_device_name() if torch.cuda.is_available() else NO_GPU,
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "libraries": ", ".join(f"{name} {version(name)}" for name in _LIBRARIES),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "load before": f"{os.getloadavg()[0]:.1f}",
    }


def cpu_name() -> str:
    """The processor as the system names it."""
    return _cpu_info().get("model name") or platform.processor() or platform.machine()


def _cpu_info() -> dict[str, str]:
    """Of the first core, as Linux tells it."""
    text = _CPU_INFO.read_text(encoding="utf-8") if _CPU_INFO.exists() else ""
    return _fields(text.partition("\n\n")[0])


def _fields(text: str) -> dict[str, str]:
    lines = (line.partition(":") for line in text.splitlines())
    return {key.strip(): value.strip() for key, _, value in lines}


def _caches() -> str:
    """Level and size of the first core's caches, as Linux tells them."""
    folders = sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*"))
    found = [
        [(folder / name).read_text(encoding="utf-8").strip() for name in ("level", "type", "size")]
        for folder in folders
    ]
    data = ", ".join(f"L{level} {size}" for level, kind, size in found if kind != "Instruction")
    return data or "not known"
