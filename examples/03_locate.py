"""Locate the organ and its tumors in what a depth camera sees. Nothing has to be trained.

Run after 01: python examples/03_locate.py [FOLDER] [STEPS]
The paper's method (tumortrack-occupancy: `make setup`) is trained for STEPS steps instead; a few
show that it works, and some thousands give a model worth using.
"""

import sys
from pathlib import Path

import tumortrack as tt


def main(out: Path, steps: int) -> None:
    case = tt.load_case(out / "case")
    (scene,) = tt.simulate_scenes(case, seed=1)
    tell(tt.Tracker(case).locate(scene.cloud, grid=48))
    if steps:
        network = tt.train(
            out / "case",
            out / f"paper_{steps}",
            # A preset is a value: change what you want with ``msgspec.structs.replace``.
            config=tt.presets.paper(case.anatomy),
            # Begun before? Then this goes on where it stopped, and ends with the same weights.
            steps=steps,
            workers=1,  # processes that make scenes, beside the one that learns
            on_status=lambda status: print(f"step {status.step}: loss {status.loss:.3f}"),
        )
        tell(tt.Tracker(network).locate(scene.cloud, grid=48))


def tell(estimate: tt.Estimate) -> None:
    print(f"{estimate.quality}: {estimate.reason or 'no check failed; its place is not verified'}")
    for name, part in estimate.report.parts.items():
        if part.center_mm is not None:
            x, y, z = part.center_mm
            print(f"{name}: {part.volume_ml:.1f} ml at ({x:.1f}, {y:.1f}, {z:.1f}) mm")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 0,
    )
