"""A training of seconds, to see the parts work. For a model worth using see `tumortrack train`.

After the default 60 steps of 8 scenes the network only knows roughly where the organ lies; most of
the answer is the refinement's, which lays the organ of the CT on the points.

Run after 01: python examples/03_train_and_locate.py [FOLDER] [STEPS]
"""

import sys
from pathlib import Path

import msgspec

from tumortrack.core.store import MANIFEST, sha256_of
from tumortrack.imaging.case import load_case
from tumortrack.simulate.scene import SceneRecipe, Simulator, body_for
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.presets import clinic
from tumortrack.training.train import TrainingRun, TrainingStatus, train


def show(status: TrainingStatus) -> None:
    print(f"step {status.step}: loss {status.loss:.3f}, validation mIoU {status.miou}")


def main(out: Path, steps: int) -> None:
    case = load_case(out / "case")
    # A preset is a value: change what you want to change, unknown names are refused.
    config = msgspec.structs.replace(
        clinic(case.anatomy), batch_size=16, validation_pairs=8, validation_points=512
    )
    run = TrainingRun(
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

    # Another seed: other states of the organ's elastic body than those that training drew.
    body = body_for(case.anatomy, case.up_lps, config.scene, seed=1)
    simulator = Simulator(case.anatomy, case.up_lps, config.scene, body)
    stage = simulator.render(SceneRecipe(seed=1, stream="test", index=0))
    estimate = Tracker(model).locate(stage.cloud, grid=48)
    for name, part in estimate.report["parts"].items():
        x, y, z = part["center_mm"]
        print(f"{name}: {part['volume_ml']:.1f} ml at ({x:.1f}, {y:.1f}, {z:.1f}) mm")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 60,
    )
