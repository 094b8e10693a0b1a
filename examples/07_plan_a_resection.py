"""Where to cut a tumor out, how two arms do it, and what an estimate that is wrong would leave.

Run after 01: python examples/07_plan_a_resection.py [FOLDER]
From the command line: tumortrack plan RUN PLAN; tumortrack resect PLAN viewer
"""

import sys
from pathlib import Path

import numpy as np

from tumortrack.core.errors import NoPlan
from tumortrack.core.types import Anatomy
from tumortrack.imaging.case import load_case
from tumortrack.plan.arms.cell import ArmCell
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.procedure import plan_motions
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.located import STAND_MM
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located
from tumortrack.report.plan_pictures import draw_plan
from tumortrack.simulate.occupancy import labels_of
from tumortrack_lab.cut.resection import cut

TABLE_FROM_LPS = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # supine: the front is up


def on_the_table(anatomy: Anatomy) -> Anatomy:
    """The organ of the CT as it lies on its stand; table frame, mm, z up."""
    parts = [part.vertices_mm @ TABLE_FROM_LPS.T for part in anatomy.parts]
    low, high = parts[0].min(0), parts[0].max(0)
    lift = np.array([*-(low + high)[:2] / 2, STAND_MM - low[2]])
    pairs = zip(anatomy.parts, parts, strict=True)
    return Anatomy(tuple(part.moved(vertices + lift) for part, vertices in pairs))


def main(out: Path) -> None:
    truth = on_the_table(load_case(out / "case").anatomy)

    # What `locate` would say if it were right: points evenly in the organ, and the surfaces.
    points = np.random.default_rng(0).uniform(*truth.organ.box_mm, (40_000, 3))
    labels = labels_of(truth, points)
    inside = labels > 0
    seen = Located(points[inside], labels[inside], dict(zip(truth.names, truth.parts, strict=True)))

    try:  # a tumor that lies wholly inside has no contour to cut along
        plan_resection(seen, ResectionConfig(tumor="tumor_1"))
    except NoPlan as error:
        print("no plan:", error)

    for method in ("published", "margin"):
        plan = plan_resection(seen, ResectionConfig(method=method, margin_mm=5.0))
        length = sum(stroke.length_mm for stroke in plan.cuts)
        print(
            f"{method}: {plan.tumor}, {len(plan.cuts)} strokes in {plan.sweeps} sweeps, "
            f"{length:.0f} mm; {plan.volumes_ml['healthy']:.1f} ml of healthy tissue"
        )
        for off_mm in (0.0, 4.0):  # the tumor is deeper than was estimated
            deeper = [part.moved(part.vertices_mm - [0, 0, off_mm]) for part in truth.parts]
            done = cut(Anatomy(tuple(deeper)), plan)
            print(
                f"  truth {off_mm:g} mm deeper: {done.removed_share:.1%} of the tumor comes away, "
                f"margin {done.margin_mm:.1f} mm, {done.healthy_ml:.1f} ml healthy"
            )

    draw_plan(plan, seen, out / "plan.png")
    print(f"look at {out / 'plan.png'}")
    motions = plan_motions(plan, ArmCell(CellConfig(), truth.organ), truth.organ)
    print("arms: " + ", ".join(f"{stage.name} {stage.seconds:.1f} s" for stage in motions.stages))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
