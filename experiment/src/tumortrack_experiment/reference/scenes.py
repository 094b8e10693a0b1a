"""What the camera saw of a state, with the second CT's surfaces as its truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from tumortrack.core.camera import deproject, project
from tumortrack.core.cloud import CloudConfig, cloud_from_depth
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points, transform_points
from tumortrack.core.mesh_query import labels_of
from tumortrack.core.render import render_depth
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud
from tumortrack.io.case import Case
from tumortrack.io.scene_folder import Targets
from tumortrack_experiment.register.beads import fit_rigid

_PART_MM = 2.0  # a pixel so near to a part of the kit shows that
_BEAD_RIM_MM = 2.0
_OVER_PLATE_MM = 1.5
_RANGE = CloudConfig(near_mm=60.0, far_mm=450.0)
_EDGE_PX = 4  # of the organ's outline: depth flies there
_LEAST_PIXELS = 300
_RIM_PX, _CRUMB = 2, 0.02  # of the pixels that are not the kit's: less is none of the organ
_OFF_MM = 1.5  # 95 % of the surface seen: of the right state 0.7, of its neighbours 2.0 and more
_BESIDE = 0.2
_FAR_MM = 25.0  # something else before or behind the organ
_LARGEST_STRETCH_MM = 12.0  # of a bead in the organ beside the others' rigid motion


def kit_pixels(
    frame: DepthFrame,
    camera_from_base: Float64[np.ndarray, "4 4"],
    parts: list[Mesh],
    beads: tuple[Points, float],
) -> Bool[np.ndarray, "h w"]:
    """Which pixels show the base or what stands on it: ``parts``, base frame, and ``beads``, their
    middles before the camera and their diameter."""
    seen = np.isfinite(frame.depth_mm)
    points = deproject(frame).astype(np.float64)
    known = transform_points(np.linalg.inv(camera_from_base), points)[:, 2] < _OVER_PLATE_MM
    for bead in beads[0]:
        known |= ((points - bead) ** 2).sum(1) < (beads[1] / 2 + _BEAD_RIM_MM) ** 2
    pixels = np.zeros(seen.shape, bool)
    pixels[seen] = known
    for part in parts:
        corners = transform_points(camera_from_base, part.vertices_mm)
        there_mm = render_depth(corners, part.faces, frame.intrinsics).depth_mm
        pixels |= frame.depth_mm > there_mm - _PART_MM
    return pixels


def organ_cloud(frame: DepthFrame, others: Bool[np.ndarray, "h w"]) -> SensorCloud:
    """All points that are not the kit's, but for crumbs and thin rims: a stand may part them, and
    an exophytic tumor stands out, which a search for the organ's one piece would lose. Raises
    NoEstimate: none are left."""
    left = ndimage.binary_opening(np.isfinite(frame.depth_mm) & ~others, iterations=_RIM_PX)
    pieces, _ = ndimage.label(left)
    sizes = np.bincount(pieces.ravel())
    organ = left & (sizes >= _CRUMB * left.sum())[pieces]
    seen_mm = np.where(organ, frame.depth_mm, np.float32("nan"))
    return cloud_from_depth(frame.with_depth(seen_mm), _RANGE, np.random.default_rng(0))


def check_surface(
    frame: DepthFrame, others: Bool[np.ndarray, "h w"], organ: Mesh, cloud: SensorCloud
) -> dict[str, float]:
    """How far the depths seen lie from the second CT's organ, all in the camera frame: ``median``
    (a common offset: the camera's, or the registration's) and ``p95``, mm; ``beside``: the share of
    the cloud that does not lie before the organ.

    Raises:
        InputError: little of the organ is seen, or what is seen has another shape or place.
    """
    true_mm = render_depth(organ.vertices_mm, organ.faces, frame.intrinsics).depth_mm
    inner = ndimage.binary_erosion(np.isfinite(true_mm), iterations=_EDGE_PX)
    off_mm = (frame.depth_mm - true_mm)[inner & ~others]
    off_mm = off_mm[np.abs(off_mm) < _FAR_MM]
    column, row = np.rint(project(cloud.points_mm, frame.intrinsics)[0]).astype(int).T
    found = {
        "median_mm": float(np.median(off_mm)) if len(off_mm) else np.inf,
        "p95_mm": float(np.quantile(np.abs(off_mm), 0.95)) if len(off_mm) else np.inf,
        "beside": float(np.isnan(true_mm[row, column]).mean()),
    }
    if len(off_mm) < _LEAST_PIXELS or found["p95_mm"] > _OFF_MM or found["beside"] > _BESIDE:
        raise InputError(
            f"the organ that the camera saw is not the CT's: 95 % of {len(off_mm)} pixels lie "
            f"within {found['p95_mm']:.1f} mm of its surface ({_LEAST_PIXELS} within "
            f"{_OFF_MM:g} mm are needed), {found['beside']:.0%} of its points beside it (at most "
            f"{_BESIDE:.0%}). They show different states, or the organ moved in between: check "
            "--state."
        )
    return found


def match_targets(
    rest_ct: Points, found_mm: Points, expected_mm: Points, case: Case
) -> tuple[Targets, str]:
    """Beads inside the organ, known at rest (CT of the case), to those found in the second CT;
    ``expected_mm``: where they would be had the organ not been deformed. All in one frame but the
    first.

    Raises:
        InputError: other numbers of them, or a bead that could be two.
    """
    if len(rest_ct) != len(found_mm):
        raise InputError(
            f"{len(rest_ct)} targets are known at rest, and {len(found_mm)} bright balls lie in "
            "the organ of the second CT; they must be as many."
        )
    guess = expected_mm
    for _ in range(5):
        rows, columns = linear_sum_assignment(cdist(guess, found_mm) ** 2)
        if len(rows) < 3:
            break
        guess = transform_points(fit_rigid(expected_mm, found_mm[columns])[0], expected_mm)
    stretch_mm = np.linalg.norm(guess - found_mm[columns], axis=1)
    if stretch_mm.max() > _LARGEST_STRETCH_MM:
        raise InputError(
            f"a target lies {stretch_mm.max():.1f} mm from where the others would have it; "
            f"{_LARGEST_STRETCH_MM:g} mm are allowed. Check --targets and --target-mm."
        )
    labels = np.maximum(labels_of(case.anatomy, rest_ct), 1).astype(np.uint8)
    note = f"{len(rest_ct)} targets, up to {stretch_mm.max():.1f} mm beside a rigid motion"
    return Targets(rest_ct, found_mm[columns], labels), note
