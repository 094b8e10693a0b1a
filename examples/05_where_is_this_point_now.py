"""Points of the CT, such as a vessel or a planned cut, and where they are before the camera now.

Run after 01: python examples/05_where_is_this_point_now.py [FOLDER]
From the command line: tumortrack locate CASE CLOUD --out OUT --map points.csv
"""

import sys
from pathlib import Path

import numpy as np

import tumortrack as tt


def place(point_mm: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in point_mm) + ")"


def main(out: Path) -> None:
    case = tt.load_case(out / "case")
    (scene,) = tt.simulate_scenes(case, seed=3, elastic=False)
    estimate = tt.Tracker(case).locate(scene.cloud, grid=48, seed=0)
    motion = estimate.motion
    assert motion is not None  # only the paper's networks know none
    print(f"{estimate.quality}: {estimate.reason or 'no check failed; its place is not verified'}")

    # LPS in, camera frame out, mm. ``std_mm``: one standard deviation along any axis.
    for part, truth in zip(case.anatomy.parts, scene.reference.parts, strict=True):
        points_ct = part.vertices_mm[part.faces[::50]].mean(1)  # middles of triangles
        now, std = motion.forward(points_ct), motion.std_mm(points_ct)
        # The scene's true surfaces have the case's triangles, so each one's true place is known.
        true_mm = truth.vertices_mm[truth.faces[::50]].mean(1)
        off = np.linalg.norm(now - true_mm, axis=1)
        if std is not None:
            print(
                f"CT {place(points_ct[0])} is now at {place(now[0])} mm, standard deviation "
                f"{std[0]:.1f} mm along each axis; {len(off)} points of this part are off by "
                f"{off.mean():.1f} mm on average"
            )

    # And back: what is it in the CT that the camera sees here?
    seen = scene.cloud.points_mm[:1]
    print(f"the camera's point {place(seen[0])} is {place(estimate.inverse(seen)[0])} in the CT")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
