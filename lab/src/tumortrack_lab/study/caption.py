"""What stands below a block: the command that makes it, and what it was measured on."""

from __future__ import annotations

from collections.abc import Iterable


def caption(cells: list[dict], command: str) -> str:
    """Command, scenes, models with their steps and training time, device, grid; from the cells."""
    specs = [cell["spec"] for cell in cells]
    scenes = len({(s["case"], s["scene"], s["fault"], s["fault_seed"]) for s in specs})
    grids = sorted({s["grid"] for s in specs})
    sentences = [
        f"`{command}`: {len(cells)} measurements, {scenes} scenes (views: "
        f"{_list(sorted({s['view'] for s in specs}))}), volumes of "
        f"{_list(f'{g}³' for g in grids)} voxels at most.",
        *_training(cells),
        f"Measured on {_list(sorted({_device(cell['provenance']) for cell in cells}))}, "
        f"{_load(cells)}.",
    ]
    return " ".join(sentences)


def _training(cells: list[dict]) -> list[str]:
    """One sentence about the models, if there are any."""
    models = {
        cell["spec"]["method"]["model_sha256"]: cell["method"]
        for cell in cells
        if cell["spec"]["method"]["kind"] == "network"
    }
    if not models:
        return []
    about = list(models.values())
    minutes = [one["training_s"] / 60 for one in about]
    steps = _list(sorted({f"{one['steps']:,}" for one in about}))
    seeds = _list(str(seed) for seed in sorted({one["seed"] for one in about}))
    on = _list(sorted({one["device"] for one in about}))
    return [
        f"Models: {len(about)} of {steps} steps, seed {seeds}, trained on {on} in "
        f"{min(minutes):.1f} to {max(minutes):.1f} minutes each."
    ]


def _device(about: dict) -> str:
    if about["device"] != "cpu":
        return f"{about['device']} beside {about['cpu']}"
    return f"{about['cpu']} ({about['cores']} cores, PyTorch on {about['threads']})"


def _load(cells: list[dict]) -> str:
    """How busy the machine was: seconds a frame mean little without it."""
    loads = [load for cell in cells if (load := cell["provenance"]["load"]) is not None]
    return f"load average {min(loads):.1f} to {max(loads):.1f}" if loads else "load not known"


def _list(items: Iterable[str]) -> str:
    return ", ".join(items)
