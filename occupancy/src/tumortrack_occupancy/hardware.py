"""Devices for networks and their arithmetic."""

from __future__ import annotations

import torch

from tumortrack.core.errors import InputError


def choose_device(device: str) -> torch.device:
    """``auto`` takes CUDA if available. InputError: ``cuda`` without a GPU."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch sees no CUDA GPU here. Use --device cpu or auto.")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(device)


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for bf16 matrix products."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capability = torch.cpu.get_capabilities()
    return bool(capability.get("avx512_bf16") or capability.get("amx_bf16"))
