"""Points of the CT, such as a vessel or a planned cut, and where they are before the camera now.

Run after 01 to 03: python examples/05_where_is_this_point_now.py [FOLDER] [MODEL] [SCENE]
From the command line: tumortrack locate MODEL CLOUD OUT --map points.csv
"""

import sys
from pathlib import Path

import numpy as np

from tumortrack.imaging.case import load_case
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model


def place(point_mm: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in point_mm) + ")"


def main(out: Path, model_folder: Path, scene_folder: Path) -> None:
    case, scene = load_case(out / "case"), read_scene(scene_folder)
    estimate = Tracker(load_model(model_folder)).locate(scene.cloud, grid=48, seed=0)
    motion = estimate.motion
    if motion is None:  # models of the presets quick and paper know no correspondence
        sys.exit(f"{model_folder} says what is where, but not which point of the CT lies there.")

    # LPS in, camera frame out, mm. ``std_mm``: one standard deviation along any axis.
    for part, truth in zip(case.anatomy.parts, scene.reference.parts, strict=True):
        points_ct = part.vertices_mm[part.faces[::50]].mean(1)  # middles of triangles
        now, std = motion.carry(points_ct), motion.std_mm(points_ct)
        # The scene's true surfaces have the case's triangles, so each one's true place is known.
        true_mm = truth.vertices_mm[truth.faces[::50]].mean(1)
        off = np.linalg.norm(now - true_mm, axis=1)
        if std is not None:
            print(
                f"CT {place(points_ct[0])} is now at {place(now[0])} +- {std[0]:.1f} mm; "
                f"{len(off)} points of this part are off by {off.mean():.1f} mm on average"
            )

    # And back: what is it in the CT that the camera sees here?
    seen = scene.cloud.points_mm[:1]
    print(f"the camera's point {place(seen[0])} is {place(motion.back(seen)[0])} in the CT")


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    folder = given[0] if given else Path("runs/examples")
    main(
        folder,
        given[1] if len(given) > 1 else folder / "model_60",
        given[2] if len(given) > 2 else folder / "scene",
    )
