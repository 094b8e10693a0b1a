"""What the figures were measured on: the machine in words, its best rates, a process's memory."""

from __future__ import annotations

import ctypes
import gc
import os
import platform
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from tumortrack.core.process import available_cores
from tumortrack_lab.bench.rows import Peaks, interleaved

_FEATURES = {
    "avx2": "AVX2",
    "avx512": "AVX-512",
    "avx512_vnni": "VNNI",
    "avx512_bf16": "bf16",
    "amx_bf16": "AMX bf16",
    "amx_int8": "AMX int8",
}
NO_GPU = "none at hand"
_SIZE = 1024  # of the square matrices
_LONG = 2**24  # floats in each of the triad's three arrays (64 MB: far more than any cache)
_CPU_INFO, _CLEAR = Path("/proc/cpuinfo"), Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # Documentation/filesystems/proc: resets VmHWM to what is resident now
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


def measure_peaks(threads: int, budget_s: float) -> Peaks:
    """The best rates of torch's own products of square matrices, and of ``a = b + s c`` (STREAM's
    triad, McCalpin 1995: three arrays' bytes, as it counts them)."""
    import torch

    with torch.inference_mode():
        products = _products()
        a, b, c = (torch.zeros(_LONG) for _ in range(3))
        calls = [*products.values(), lambda: torch.add(b, c, alpha=0.5, out=a)]
        *timings, triad = interleaved(*calls, budget_s=budget_s)
    flops = 2.0 * _SIZE**3
    gemm = {name: flops / timing.best_s for name, timing in zip(products, timings, strict=True)}
    return Peaks(threads=threads, gemm=gemm, triad=3 * 4 * _LONG / triad.best_s)


def _products() -> dict[str, Callable[[], object]]:
    """Products by precision; those that this PyTorch refuses here are left out."""
    import torch

    torch.manual_seed(0)
    single = torch.randn(_SIZE, _SIZE), torch.randn(_SIZE, _SIZE)
    half = tuple(matrix.bfloat16() for matrix in single)
    whole = tuple(torch.randint(-99, 99, (_SIZE, _SIZE), dtype=torch.int8) for _ in range(2))
    calls: dict[str, Callable[[], object]] = {
        "fp32": lambda: torch.mm(*single),
        "bf16": lambda: torch.mm(*half),
        "int8": lambda: torch._int_mm(*whole),
    }
    offered = {}
    for name, call in calls.items():
        with suppress(RuntimeError):  # not made for this processor
            call()
            offered[name] = call
    return offered


def forget_peak() -> int | None:
    """Give freed memory back and restart the count; bytes resident now, None where the system
    does not say."""
    gc.collect()
    if not _CLEAR.exists():
        return None
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    try:
        _CLEAR.write_text(_RESET_PEAK, encoding="ascii")
    except PermissionError:  # a container may forbid it
        return None
    return _status_bytes("VmRSS")


def peak_bytes() -> int:
    """The most that was resident since ``forget_peak``."""
    return _status_bytes("VmHWM")


def _status_bytes(name: str) -> int:
    found = _fields(Path("/proc/self/status").read_text(encoding="ascii"))
    return int(found[name].split()[0]) * 1024
