"""The laboratory's commands: `tumortrack` finds them by entry points."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def twin(
    case: Positional[Path],
    scenes: Positional[Path],
    /,
    *,
    seed: int = 0,
    states: tuple[
        Literal["D0", "D1", "D2", "D3", "Rot90", "Rot180", "Rot270", "G1", "P1"], ...
    ] = (),
    views: tuple[Literal["clean", "noise", "shaft", "clutter"], ...] = (),
) -> None:
    """Squeeze, turn, sink and poke a case by finite elements, and write the scenes with truth.

    Args:
        case: folder that `prepare` wrote.
        scenes: folder to write: what `evaluate` reads. The same command resumes.
        seed: of noise, instruments, background and target points.
        states: which of them; default: all.
        views: which of them; default: all.
    """
    from tumortrack_lab.cli.twin import write_twin

    write_twin(case, scenes, seed, states, views)


def bench(
    *,
    only: tuple[
        Literal[
            "generator", "elastic-generator", "encoder", "decoder", "frame", "tracking", "volume",
            "command", "planning", "gpu", "training", "whole-training",
        ],
        ...,
    ] = (),
    quick: bool = False,
    curves: bool = False,
    model: Path | None = None,
    cloud: Path | None = None,
    out: Path = Path("runs/bench.json"),
    document: Path | None = None,
) -> None:  # fmt: skip
    """Measure the speed of every part on this machine, each beside its naive form, in turns.

    Args:
        only: which parts; default: all.
        quick: shorter measurements, about a minute in all once there are models.
        curves: also how time and memory grow with queries, points, tumors, voxels and batch.
        model: folder that `train` wrote, to be measured instead of the one that the bench trains
            (kept in runs/bench).
        cloud: of that model's organ, freed of its background; .ply, .pcd or .npz in mm.
        out: JSON file to write; curves lie beside it.
        document: Markdown file whose marked blocks are to be filled, such as docs/performance.md.
    """
    from tumortrack_lab.cli.bench import BenchOptions
    from tumortrack_lab.cli.bench import bench as run

    run(BenchOptions(only, quick, curves, model, cloud, out, document))
