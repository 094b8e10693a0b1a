"""One deformed scene before the depth camera, and how far the undeformed organ is from it.

Any function from a cloud to an Estimate can be measured like this. The one here cheats: it takes
the true pose and ignores the deformation, so it shows what the deformation alone costs.

Run after 01: python examples/02_simulate_and_compare.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, CameraLabels, OccupancyCloud, SensorCloud
from tumortrack.imaging.case import load_case
from tumortrack.models.report import grid_over
from tumortrack.report.metrics import label_grid
from tumortrack.report.pictures import scene_picture
from tumortrack.report.protocol import evaluate_scene
from tumortrack.sense.noise import D405_NOISE
from tumortrack.simulate.deform.drag import CONFIGURATIONS, DragConfig
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator
from tumortrack.simulate.scene_folder import Scene, write_scene


def main(out: Path) -> None:
    case = load_case(out / "case")
    drags = DragConfig(steps=CONFIGURATIONS[2])  # of the paper's six; 3 is milder
    config = SceneConfig(noise=D405_NOISE, deform=(drags,))
    simulator = Simulator(case.anatomy, case.up_lps, config)
    stage = simulator.stage(SceneRecipe(seed=3, stream="test", index=0))
    scene = Scene(stage.cloud, simulator.reference(stage), stage.frame)
    if not (out / "scene").exists():
        write_scene(out / "scene", scene)

    def undeformed(cloud: SensorCloud) -> Estimate:
        organ_and_tumors = Anatomy(
            tuple(
                part.moved(transform_points(stage.camera_from_ct, part.vertices_mm))
                for part in case.anatomy.parts
            )
        )
        camera_from_index, shape = grid_over(organ_and_tumors.organ.vertices_mm, grid=96)
        labels = label_grid(organ_and_tumors, camera_from_index, shape)
        index = np.argwhere(labels > 0)
        points = transform_points(camera_from_index, index.astype(float))
        sure = np.ones(len(points), np.float32)
        inside = OccupancyCloud(points, labels[labels > 0], sure, cloud.stamp_ns)
        meshes = dict(zip(organ_and_tumors.names, organ_and_tumors.parts, strict=True))
        return Estimate(inside, CameraLabels(labels, camera_from_index), meshes, report={})

    entry, estimate = evaluate_scene(undeformed, scene, "undeformed organ, true pose")
    for name, part in entry["parts"].items():
        print(f"{name}: Hausdorff {part['hausdorff_mm']:.1f} mm, centre {part['center_mm']:.1f} mm")
    scene_picture(scene, estimate, entry, out / "scene.png")
    print(f"mIoU {entry['miou']:.2f}; look at {out / 'scene.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
