"""One deformed scene before the depth camera, and how far the undeformed organ is from it.

Any function from a cloud to an estimate can be measured like this. The one here cheats: it takes
the true pose and ignores the deformation, so it shows what the deformation alone costs.

Run after 01: python examples/02_simulate_and_compare.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import tumortrack as tt


def main(out: Path) -> None:
    case = tt.load_case(out / "case")
    (scene,) = tt.simulate_scenes(case, seed=3, elastic=False)
    if not (out / "scenes" / "dragged").exists():
        scene.write(out / "scenes" / "dragged")
    camera_from_ct = np.array(scene.meta["camera_from_ct"])

    def undeformed(cloud: tt.SensorCloud) -> tt.Estimate:
        surfaces = {}
        for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
            moved = part.vertices_mm @ camera_from_ct[:3, :3].T + camera_from_ct[:3, 3]
            surfaces[name] = part.with_vertices(moved)
        return tt.estimate_from_surfaces(surfaces, grid=96)

    (errors,) = tt.evaluate(undeformed, out / "scenes", out / "compared").scenes
    for name, part in errors.parts.items():
        print(f"{name}: Hausdorff {part.hausdorff_mm:.1f} mm, centre {part.center_mm:.1f} mm")
    print(f"mIoU {errors.miou:.2f}; open {out / 'compared' / 'index.html'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
