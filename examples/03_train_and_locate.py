"""A training of seconds, to see the parts work. For a model worth using see `tumortrack train`.

After the default 60 steps the kidney is a blob and the tumors are guesses.

Run after 01: python examples/03_train_and_locate.py [FOLDER] [STEPS]
"""

import sys
from pathlib import Path

import msgspec

from tumortrack.app.presets import quick
from tumortrack.core.store import MANIFEST, sha256_of
from tumortrack.imaging.case import load_case
from tumortrack.learn.train import Run, Status, train
from tumortrack.simulate.occupancy import OccupancyConfig
from tumortrack.simulate.scene import SceneRecipe, Simulator
from tumortrack.track.tracker import Tracker


def show(status: Status) -> None:
    print(f"step {status.step}: loss {status.loss:.3f}, validation mIoU {status.miou}")


def main(out: Path, steps: int) -> None:
    case = load_case(out / "case")
    # A preset is a value: change what you want to change, unknown names are refused.
    preset = quick(case.anatomy)
    scene = msgspec.structs.replace(
        preset.scene, occupancy=OccupancyConfig(per_side=64, pool=20_000)
    )
    config = msgspec.structs.replace(
        preset, scene=scene, batch_size=4, validation_pairs=4, validation_points=512
    )
    run = Run(
        anatomy_ct=case.anatomy,
        up_lps=case.up_lps,
        case_sha256=sha256_of(out / "case" / MANIFEST),
        config=config,
        seed=0,
        steps=steps,
        workers=1,  # processes that make scenes, beside the one that learns
    )
    # Begun before? Then this goes on where it stopped, and ends with the same weights.
    model = train(run, out / f"model_{steps}", show)

    simulator = Simulator(case.anatomy, case.up_lps, config.scene)
    stage = simulator.stage(SceneRecipe(seed=1, stream="test", index=0))
    estimate = Tracker(model).locate(stage.cloud, grid=48)
    for name, part in estimate.report["parts"].items():
        print(f"{name}: {part['volume_ml']:.1f} ml" if part["found"] else f"{name}: not found")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 60,
    )
