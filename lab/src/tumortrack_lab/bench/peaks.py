"""What this machine reaches at best: matrix products and memory, measured as everything else."""

from __future__ import annotations

from collections.abc import Callable

from tumortrack_lab.bench.row import Peaks
from tumortrack_lab.bench.turns import in_turns

_SIZE = 1024  # of the square matrices
_LONG = 2**24  # floats in each of the triad's three arrays (64 MB: far more than any cache)


def measure_peaks(threads: int, budget_s: float) -> Peaks:
    """The best rates of torch's own products of square matrices, and of ``a = b + s c`` (STREAM's
    triad, McCalpin 1995: three arrays' bytes, as it counts them)."""
    import torch

    with torch.inference_mode():
        products = _products()
        a, b, c = (torch.zeros(_LONG) for _ in range(3))
        calls = [*products.values(), lambda: torch.add(b, c, alpha=0.5, out=a)]
        *timings, triad = in_turns(*calls, budget_s=budget_s)
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
        try:
            call()
        except RuntimeError:  # not made for this processor
            continue
        offered[name] = call
    return offered
