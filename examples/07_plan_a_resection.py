"""Where to cut a tumor out of an organ that lies on the table.

Run after 01: python examples/07_plan_a_resection.py [FOLDER]
Needs the package tumortrack-resection (`make setup`).
From the command line, with the motions of two arms: tumortrack plan RUN PLAN
"""

import sys
from pathlib import Path

import numpy as np

import tumortrack as tt
from tumortrack_resection import plan_resection

CAMERA_FROM_LPS = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # supine, seen from above


def main(out: Path) -> None:
    # What `locate` would say if it were right, and the camera looked straight down.
    anatomy = tt.load_case(out / "case").anatomy
    turned = [part.with_vertices(part.vertices_mm @ CAMERA_FROM_LPS.T) for part in anatomy.parts]
    seen = tt.estimate_from_surfaces(dict(zip(anatomy.names, turned, strict=True)))

    try:  # a tumor that lies wholly inside has no contour to cut along
        plan_resection(seen, tumor="tumor_1")
    except tt.errors.NoPlan as error:
        print("no plan:", error)

    try:  # nothing is known of this estimate's errors: 8 mm are assumed, and 5 don't cover them
        plan_resection(seen)
    except tt.errors.NoPlan as error:
        print("no plan:", error)

    for method in ("published", "margin"):
        picture = out / f"plan_{method}.png"
        plan = plan_resection(seen, method=method, picture=picture, accept_budget=True)
        length = sum(stroke.length_mm for stroke in plan.cuts)
        ml = plan.volumes_ml  # the published method does not know what its cuts burn
        lost_ml = ml["healthy"] + ml.get("kerf", 0.0)
        print(
            f"{method}: {plan.tumor}, {len(plan.cuts)} strokes in {plan.sweeps} sweeps, "
            f"{length:.0f} mm; {lost_ml:.1f} ml of healthy tissue are lost; look at {picture}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
