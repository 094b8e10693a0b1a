"""A training of seconds, to see the parts work. For a model worth using see `tumortrack train`.

After the default 60 steps of 16 scenes the network only knows roughly where the organ lies; most
of the answer is the refinement's, which lays the organ of the CT on the points.

Run after 01: python examples/03_train_and_locate.py [FOLDER] [STEPS]
"""

import sys
from pathlib import Path

import msgspec

import tumortrack as tt


def main(out: Path, steps: int) -> None:
    case = tt.load_case(out / "case")
    # A preset is a value: change what you want to change, unknown names are refused.
    config = msgspec.structs.replace(
        tt.presets.clinic(case.anatomy), batch_size=16, validation_pairs=8, validation_points=512
    )
    # Begun before? Then this goes on where it stopped, and ends with the same weights.
    model = tt.train(
        out / "case",
        out / f"model_{steps}",
        config=config,
        steps=steps,
        workers=1,  # processes that make scenes, beside the one that learns
        report=lambda status: print(
            f"step {status.step}: loss {status.loss:.3f}, validation mIoU {status.miou}"
        ),
    )

    (scene,) = tt.simulate_scenes(case, seed=1)
    estimate = tt.Tracker(model).locate(scene.cloud, grid=48)
    print(f"{estimate.quality}: {estimate.reason or 'no check failed; its place is not verified'}")
    for name, part in estimate.report["parts"].items():
        x, y, z = part["center_mm"]
        print(f"{name}: {part['volume_ml']:.1f} ml at ({x:.1f}, {y:.1f}, {z:.1f}) mm")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 60,
    )
