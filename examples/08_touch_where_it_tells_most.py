"""Half of the organ is hidden: the answer without touches and with them, and what to touch next.

Run after 01: python examples/08_touch_where_it_tells_most.py [FOLDER]
From the command line: tumortrack locate CASE CLOUD --out OUT --evidence touches.json
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

import tumortrack as tt

ERROR_MM = 1.0  # of the tip, one standard deviation along each axis


def main(out: Path) -> None:
    case = tt.load_case(out / "case")
    tracker, rng = tt.Tracker(case), np.random.default_rng(0)
    (scene,) = tt.simulate_scenes(case, seed=3, elastic=False)  # where touches tell much
    points_mm = scene.cloud.points_mm  # of which something hides the right half
    cloud = tt.SensorCloud(points_mm[points_mm[:, 0] < np.median(points_mm[:, 0])])
    vertices_mm = scene.reference.organ.vertices_mm  # of the true organ

    touches: list[tt.Touch] = []
    estimate = tracker.locate(cloud, grid=48)
    tell("no touch", estimate, scene.targets)
    for _ in range(2):
        bounds = estimate.assessment.bounds
        least_sure = max(estimate.report.tumors, key=lambda n: bounds[n].error_bound95_mm)
        advice = tt.advise(estimate, least_sure)  # estimate.assessment has what pays
        for advised in advice:  # camera frame, mm
            print(f"next, {advised.message}")
        for advised in advice:
            if advised.kind == "touch":  # the tip meets the true surface near there
                away_mm = np.linalg.norm(vertices_mm - advised.place_mm, axis=1)
                place_mm = vertices_mm[away_mm.argmin()] + rng.normal(0, ERROR_MM, 3)
                touches.append(tt.Touch(place_mm=tuple(place_mm), std_mm=ERROR_MM, tool="probe"))
        estimate = tracker.locate(cloud, grid=48, evidence=touches)
        tell(f"{len(touches)} touches", estimate, scene.targets)
    for each in estimate.report.evidence:
        print(
            f"{each.name}: {each.off_mm:.1f} mm from the answer, "
            f"{each.information_gain:.0%} of it new"
        )


def tell(known: str, estimate: tt.Estimate, targets: Any) -> None:
    """``targets``: points inside the parts, in the CT and where they truly are (mm)."""
    print(f"{known}: {estimate.quality}")
    assert estimate.motion is not None
    for name, bound in estimate.assessment.bounds.items():
        mine = targets.labels == estimate.report.parts[name].label
        now_mm = estimate.motion.forward(targets.points_ct[mine])
        off_mm = np.linalg.norm(now_mm.mean(0) - targets.points_mm[mine].mean(0))
        print(f"  {name}: its centre is {off_mm:.1f} mm off; stated: {bound.message}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
