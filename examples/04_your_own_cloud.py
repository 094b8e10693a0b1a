"""Kidney and tumors in a cloud from any program: camera frame (x right, y down, z forward), mm.

Run after 02: python examples/04_your_own_cloud.py [FOLDER] [CASE] [CLOUD]
"""

import sys
from pathlib import Path

import tumortrack as tt


def main(out: Path, case_folder: Path, cloud_file: Path) -> None:
    cloud = tt.read_cloud(cloud_file, unit="mm")  # .ply, .pcd or .npz; "m" converts
    print(f"{len(cloud.points_mm)} points")
    # The cloud must show the organ alone; ``tt.find_organ`` frees it of table and instruments.

    tracker = tt.Tracker(tt.load_case(case_folder))  # once; then one call per cloud
    try:
        estimate = tracker.locate(cloud, grid=48, seed=0)
    except tt.errors.NoEstimate as error:  # said aloud, never a made-up answer
        sys.exit(f"none: {error}")
    print(f"{estimate.quality}: {estimate.reason or 'no check failed; its place is not verified'}")
    for name, mesh in estimate.meshes.items():
        x, y, z = mesh.box_mm.mean(0)
        print(f"{name}: {mesh.volume_mm3 / 1000:.1f} ml at ({x:.1f}, {y:.1f}, {z:.1f}) mm")
    estimate.save(out / "located", overwrite=True)
    print(f"surfaces, labelled volume and report are in {out / 'located'}")


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    folder = given[0] if given else Path("runs/examples")
    main(
        folder,
        given[1] if len(given) > 1 else folder / "case",
        given[2] if len(given) > 2 else folder / "scenes" / "dragged" / "cloud.ply",
    )
