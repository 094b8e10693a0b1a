"""What the figures were measured on."""

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
_LIBRARIES = ("tumortrack", "torch", "numba", "numpy", "scipy")


def describe_machine() -> dict[str, str]:
    """Processor, cores, caches, memory, GPU, versions, date: for people, in their order."""
    import torch

    capabilities = torch.cpu.get_capabilities()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else NO_GPU
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return {
        "processor": _processor(),
        "cores": f"{available_cores()}",
        "matrix products": ", ".join(
            name for key, name in _FEATURES.items() if capabilities.get(key)
        ),
        "caches": _caches(),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
        "GPU": gpu,
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "libraries": libraries,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "load before": f"{os.getloadavg()[0]:.1f}",
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if not info.exists():
        return platform.processor() or platform.machine()
    wanted: dict[str, str] = {}
    for line in info.read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        wanted.setdefault(key.strip(), value.strip())
    name = wanted.get("model name", platform.machine())
    family = wanted.get("cpu family")
    return name if family is None else f"{name} (family {family}, model {wanted.get('model')})"


def _caches() -> str:
    """Level and size of the first core's caches, as Linux tells them."""
    found = []
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, kind, size = (
            (folder / name).read_text(encoding="utf-8").strip()
            for name in ("level", "type", "size")
        )
        if kind != "Instruction":
            found.append(f"L{level} {size}")
    return ", ".join(found) or "not known"
