"""Locate in clouds that another program made: patients' label maps, seen by Open3D's ray caster.

Nothing of what makes the cloud and the truth is tumortrack's: nibabel reads the label map,
scikit-image marches it, Open3D casts the camera's rays. Open3D (400 MB) lives in an environment
of its own:

    python -m venv o3d && o3d/bin/pip install open3d nibabel scikit-image scipy
    o3d/bin/python lab/scripts/open3d_check.py --tumortrack .venv/bin/tumortrack \
        LABELS.nii.gz MODEL [LABELS.nii.gz MODEL ...] [--seeds 5]

MODEL was trained on the case that `tumortrack prepare LABELS.nii.gz CASE` made. The organ is
rigid, its anterior side faces the camera with tilts up to 12 degrees and any turn.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel
import numpy as np
import open3d as o3d
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage import measure

ORGAN_FROM_LPS = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # anterior (-y) to the camera (-z)
WIDTH, HEIGHT, FOCAL_PX = 848, 480, 447.0  # a D405
NEAREST_MM = 125.0


def surface_mm(mask: np.ndarray, lps_from_index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (LPS, mm) and faces of a mask's smooth surface."""
    box = tuple(slice(max(s.start - 4, 0), s.stop + 4) for s in ndimage.find_objects(mask * 1)[0])
    field = ndimage.gaussian_filter(mask[box].astype(np.float32), 1.0)
    vertices, faces, _, _ = measure.marching_cubes(field, 0.5)
    vertices = vertices + [s.start for s in box]
    return vertices @ lps_from_index[:3, :3].T + lps_from_index[:3, 3], faces


def read_patient(path: Path) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """The tumor-bearing kidney's surface (labels 1 and 2) and its tumor's vertices, LPS mm."""
    image = nibabel.load(path)
    labels = np.asarray(image.dataobj).astype(np.uint8)
    lps_from_index = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine
    pieces, _ = ndimage.label(labels > 0)
    kidney = pieces == np.bincount(pieces[labels == 2]).argmax()
    tumor, _ = surface_mm(kidney & (labels == 2), lps_from_index)
    return surface_mm(kidney, lps_from_index), tumor


def camera_from_lps(kidney_lps: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """A random pose before the camera: rotation and translation (mm)."""
    angles = [*rng.uniform(-12, 12, 2), rng.uniform(0, 360)]
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ ORGAN_FROM_LPS
    turned = kidney_lps @ rotation.T
    translation = np.array([*rng.uniform(-8, 8, 2), 0]) - (turned.min(0) + turned.max(0)) / 2
    translation[2] = NEAREST_MM - turned[:, 2].min()
    return rotation, translation


def cast_cloud(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The points where the camera's rays first meet the mesh (camera frame, mm)."""
    scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - WIDTH / 2) / FOCAL_PX, (v - HEIGHT / 2) / FOCAL_PX, np.ones(u.shape)], -1)
    rays = rays.reshape(-1, 3).astype(np.float32)
    depth = scene.cast_rays(tensor(np.concatenate([0 * rays, rays], 1)))["t_hit"].numpy()
    seen = np.isfinite(depth)
    return rays[seen] * depth[seen][:, None]


def locate(tumortrack: str, model: Path, points_mm: np.ndarray) -> dict:
    """The parts of tumortrack's report on a cloud that Open3D wrote."""
    with tempfile.TemporaryDirectory() as folder:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_mm))
        o3d.io.write_point_cloud(f"{folder}/cloud.ply", cloud)
        command = [tumortrack, "locate", str(model), f"{folder}/cloud.ply", f"{folder}/out"]
        if subprocess.run(command, stdout=subprocess.DEVNULL).returncode:
            sys.exit(f"{model} could not locate; the line above says why")
        return json.loads(Path(folder, "out", "report.json").read_text())["parts"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs", nargs="+", type=Path, metavar="LABELS MODEL")
    parser.add_argument("--tumortrack", default="tumortrack", help="the command, in its own place")
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    if len(options.pairs) % 2:
        parser.error("give a MODEL with each LABELS file")
    print("| model | seed | points | kidney's centre off, mm | tumor's, mm | tumor, ml |")
    print("|---|---|---|---|---|---|")
    for path, model in zip(options.pairs[::2], options.pairs[1::2], strict=True):
        (kidney, faces), tumor = read_patient(path)
        for seed in range(options.seeds):
            rotation, translation = camera_from_lps(kidney, np.random.default_rng(seed))
            kidney_camera, tumor_camera = (x @ rotation.T + translation for x in (kidney, tumor))
            points = cast_cloud(kidney_camera, faces)
            parts = locate(options.tumortrack, model, points)
            truths = {"kidney": kidney_camera, "tumor_1": tumor_camera}
            errors = []  # between the centres of the two boxes
            for name, truth in truths.items():
                middle = (truth.min(0) + truth.max(0)) / 2
                off = np.array(parts[name].get("center_mm", np.nan)) - middle
                errors.append(f"{np.linalg.norm(off):.1f}" if parts[name]["found"] else "not found")
            ml = f"{parts['tumor_1'].get('volume_ml', float('nan')):.1f}"
            row = map(str, (model, seed, len(points), *errors, ml))
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
