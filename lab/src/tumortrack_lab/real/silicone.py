"""Bent silicone, scanned: one part is given, the rest is predicted.

A kidney on its plate, bent over a stand and scanned by CT, and a slab, bent and laser-scanned.
vu-arma-dev/cpd-registration states no licence: the files stay with the user.
Of six casts of one mould there is the bent top surface (STL, mm), cut out of a CT; of the
mould the flat top surface (PLY, mm; flat down to z = -7, the kidney up to z = -19). How thick the
plate is is not said; ``kidney_and_base.stl`` has 10 mm. Spheres and arteries inside some casts have
no known place in the flat state, and the fiducials are the stand's: no point is known twice.

The slab has four shapes on it. There are point clouds (mm) of its top, flat and bent, and the
points of a curve on it that was traced in both states.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.spatial import Delaunay, cKDTree

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Points, transform_points, triangles_of
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.models.report import Frame
from tumortrack.registration.looks import Looks
from tumortrack.registration.model import RegistrationModel
from tumortrack.report.metrics import distance_to_surface
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth
from tumortrack.sense.noise import D405_NOISE, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene import PoseConfig, sample_pose
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.peers.pose_search import PoseSearch, RigidConfig
from tumortrack_lab.real.judging import CAMERA

REST = "psm_data/PLY/kidney_and_base_2mm_aligned.ply"
BENT = {
    cast: f"userstudy_data/STL/Kidney{name}.stl"
    for cast, name in {
        "10": "10_top",
        **{letter: f"{letter}_TopOnly_Reduced" for letter in "BCEF"},
        "D": "D_TopOnly_reduced",
    }.items()
}
SLAB = {
    f"{state} {what}": f"cartesian_data/PointCloudData/{file}{name}.mat"
    for state, file in {"flat": "NonDeformed", "bent": "Deformed"}.items()
    for what, name in {"scan": "PointCloud", "curve": "TargetCurve"}.items()
}
THICK_MM = 10.0  # the slab under its shapes; not said, so that of kidney_and_base.stl
GRID_MM = 1.0  # of the slab's surfaces; its scans have 15 points a mm2
HOLE_MM = 3.0  # wider ones in the bent scan stay open
UNDERSIDE_MM = 3.0  # z, of kidney_and_base.stl
UP = (0.0, 0.0, -1.0)  # out of the plate, where the kidney sticks out
SHARES = (1.0, 0.7, 0.5)  # of the scanned surface that the camera is given
POINTS = 2000  # of a whole scan, for the best rigid pose
WHERE = "https://github.com/vu-arma-dev/cpd-registration"


def file(data: Path, name: str) -> Path:
    """The user's copy. Raises InputError: it is missing."""
    path = data / "silicone" / name
    if not path.is_file():
        raise InputError(f"{path} is missing: put a copy of {WHERE} at {data / 'silicone'}.")
    return path


def read_slab(data: Path, what: str) -> Points:
    """One of ``SLAB``, turned so that ``UP`` holds (the scanner's z points up)."""
    (points,) = (v for k, v in loadmat(file(data, SLAB[what])).items() if k.endswith("Data"))
    return points * [1.0, -1.0, -1.0]


def surface_over(points_mm: Points, hole_mm: float) -> Mesh:
    """The surface through a cloud that was scanned along ``UP``: the mean in each square of the
    grid, and triangles between them with sides of at most ``hole_mm`` in the plane."""
    squares = np.floor(points_mm[:, :2] / GRID_MM).astype(int)
    _, where, count = np.unique(squares, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(where.reshape(-1), column) for column in points_mm.T]
    vertices = np.stack(sums, 1) / count[:, None]
    faces = Delaunay(vertices[:, :2]).simplices[:, ::-1]  # SciPy turns them to +z
    corners = vertices[faces][:, :, :2]
    sides_mm = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return Mesh(vertices, faces[sides_mm.max(1) <= hole_mm])


def closed(top: Mesh, bottom_z_mm: float) -> Mesh:
    """The solid between an open surface and the plane z = ``bottom_z_mm``."""
    vertices, faces = top.vertices_mm, top.faces
    below = vertices * [1, 1, 0] + [0, 0, bottom_z_mm]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, where, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    a, b = edges[count[where.reshape(-1)] == 1].T  # along the rim
    n = len(vertices)
    walls = np.concatenate([np.stack([b, a, a + n], 1), np.stack([b, a + n, b + n], 1)])
    return Mesh(
        np.concatenate([vertices, below]), np.concatenate([faces, faces[:, ::-1] + n, walls])
    )


def facing_pose(scan: Mesh, rng: np.random.Generator) -> np.ndarray:
    """``camera_from_scan`` with the scan's outer side towards the camera."""
    x, y, z = triangles_of(scan.vertices_mm, scan.faces)[1].sum(0)
    return sample_pose(PoseConfig(), scan, (x, y, z), PoseConfig().nearest_mm, rng)


def measured(
    tracker: Tracker,
    case: Anatomy,
    top: Mesh,
    scan: Mesh,
    rng: np.random.Generator,
    curves: tuple[np.ndarray, np.ndarray] | None = None,
) -> list[dict[str, Any]]:
    """A row for each share of the scan that the camera is given (one side of a line in the image):
    verdict, and distances of the estimated and the best rigid top surface to the scan, where the
    camera saw and where not (median, 95 %, worst; mm).

    ``curves``: the points of one, at rest (the longer) and in a scan that lacks parts of the
    surface. Distances are then from the scan, and from its curve to the other carried there, and
    the latter's ratio to the stated deviation is given. Else they are to the scan: the casts' rims
    reach farther than the mould. The rigid pose is the best for the whole scan. Where the tracker
    refuses, the errors are those of the fit that it refused.
    """
    camera_from_scan = facing_pose(scan, rng)
    there = scan.moved(transform_points(camera_from_scan, scan.vertices_mm))
    frame = add_noise(render_depth(there.vertices_mm, there.faces, CAMERA), D405_NOISE, rng)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    row, column = np.indices(frame.depth_mm.shape)
    rays = np.stack([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy], -1) @ along
    whole = surface_samples(there, 3.0)[0]
    whole = whole[:: len(whole) // POINTS + 1]
    pose = PoseSearch(case, UP, RigidConfig()).poses(SensorCloud(whole))[0].camera_from_ct
    rows = []
    for share in SHARES:
        limit = np.quantile(_places(whole, along), share)
        visible = frame.with_depth(np.where(rays <= limit, frame.depth_mm, np.float32("nan")))
        cloud = cloud_from_depth(visible, CloudConfig(near_mm=1.0, far_mm=1e4), rng)
        verdict, motion = located(tracker, cloud)
        std_mm = float(np.median(motion.std_mm(top.vertices_mm)))
        result = {"share": share, **verdict, "std_mm": std_mm}
        for name, carry in {"": motion.carry, "rigid_": partial(transform_points, pose)}.items():
            mesh = top.moved(carry(top.vertices_mm))
            points_mm, onto = surface_samples(mesh, 3.0)[0], there
            if curves is not None:
                points_mm, onto = whole, mesh
            off = {name: (points_mm, distance_to_surface(points_mm, onto))}
            if curves is not None:
                true = transform_points(camera_from_scan, curves[1])
                off_mm, nearest = cKDTree(carry(curves[0])).query(true)
                off[f"{name}curve_"] = true, off_mm
                if not name:
                    off["ratio_"] = true, off_mm / motion.std_mm(curves[0])[nearest]
            for what, (places_mm, size) in off.items():
                hidden = (share < 1) & (_places(places_mm, along) > limit)
                for part, which in {"seen": ~hidden, "unseen": hidden}.items():
                    if which.any():
                        spread = np.percentile(size[which], [50, 95, 100])
                        result[f"{what}{part}_mm"] = spread.tolist()
        rows.append(result)
    return rows


def _places(points_mm: Points, along: np.ndarray) -> np.ndarray:
    """Coordinates along a direction of the image."""
    return points_mm[:, :2] / points_mm[:, 2:] @ along


def located(tracker: Tracker, cloud: SensorCloud) -> tuple[dict[str, Any], Any]:
    """Verdict, reason and cost, and the motion, even if the estimate is refused."""
    try:
        estimate = tracker.follow(cloud)
    except NoEstimate as error:
        model = tracker.model
        assert isinstance(model, RegistrationModel)
        frame = Frame(model, cloud, 0, np.random.default_rng(0))
        usual = model.calibration.usual_cost
        looks = Looks.of([frame.points_mm])
        fit = model.registration.register(looks, None, frame.stage)
        words = {"verdict": "refused", "reason": str(error), "cost": fit.cost / usual}
        return words, model.registration.bend(fit).motion
    costs = estimate.report.fit_cost
    assert costs is not None  # of the default method
    cost = costs.now / costs.usual
    return {"verdict": estimate.quality, "reason": estimate.reason, "cost": cost}, estimate.motion
