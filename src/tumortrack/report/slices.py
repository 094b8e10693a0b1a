"""Slices of the CT through the present scene: each pixel is mapped back into the CT."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from tumortrack.core.colours import Colour, label_colours
from tumortrack.core.geometry import plane_section, spacing_mm, transform_points
from tumortrack.core.organ import organ_name
from tumortrack.core.types import Mesh
from tumortrack.io.case import Case

# Directions of the image's columns and rows in the camera frame (x right, y down, z forward).
ORIENTATIONS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "facing the camera": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "horizontal, camera above": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "vertical, camera left": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
}
_SURE_MM, _UNSURE_MM = 5.0, 20.0  # outside the organ the motion is a guess: the CT fades out
_FAINT = 0.3
_FILL = 0.6  # brightness of a label: estimated outlines stand out from it
_SLICE_ROOM = 1.15  # side of a slice, relative to the organ's largest extent
_BAR_MM = 10
_FINER = 2


@dataclass(frozen=True, eq=False)
class SlicePlane:
    """A square in the camera frame: centre, unit directions of columns and rows, side; mm."""

    centre_mm: Float64[np.ndarray, " 3"]
    across: Float64[np.ndarray, " 3"]
    down: Float64[np.ndarray, " 3"]
    side_mm: float

    def points(self, pixels: int) -> Float64[np.ndarray, "n 3"]:
        """The centres of the pixels, row by row."""
        steps = ((np.arange(pixels) + 0.5) / pixels - 0.5) * self.side_mm
        rows = self.centre_mm + steps[:, None, None] * self.down
        return (rows + steps[None, :, None] * self.across).reshape(-1, 3)

    def section(self, mesh: Mesh) -> Float64[np.ndarray, "m 2 2"]:
        """Where a surface crosses the plane: segments of (column, row) in mm from the centre."""
        normal = np.cross(self.across, self.down)
        lines = plane_section(mesh.vertices_mm, mesh.faces, normal, self.centre_mm)
        return (lines - self.centre_mm) @ np.stack([self.across, self.down], axis=1)


class CarriedCt:
    """Samples a case's CT, or its labels if it has none; ``name``: which of the two."""

    def __init__(self, case: Case) -> None:
        from scipy.ndimage import distance_transform_edt

        labels, ct = case.labels, case.ct
        self.name = "Label map" if ct is None else "CT"
        self._labels = labels.labels
        self._label_index_from_lps = np.linalg.inv(labels.lps_from_index)
        self._hu = None if ct is None else ct.hu
        if ct is None:
            return
        organ = labels.labels > 0
        outside_mm = distance_transform_edt(~organ, sampling=spacing_mm(labels.lps_from_index))
        self._outside_mm = outside_mm.astype(np.float32)
        self._index_from_lps = np.linalg.inv(ct.lps_from_index)
        # Black and white: the organ's range (of each tenth voxel), widened by as much.
        inside = transform_points(labels.lps_from_index, np.argwhere(organ)[::10].astype(float))
        low, high = np.nanpercentile(_sample(ct.hu, self._index_from_lps, inside, 0), (1, 99))
        room = max(50.0, 0.5 * float(high - low))
        self._window = float(low) - room, float(high) + room

    def picture(self, points_ct: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
        """Grey values: 0 outside the CT, faint far outside the organ. Without a CT the parts'
        colours, black outside."""
        if self._hu is None:
            labels = _sample(self._labels, self._label_index_from_lps, points_ct, 0)
            labels = np.nan_to_num(labels).astype(np.uint8)
            return np.where(labels[:, None] > 0, _FILL * label_colours(labels), 0).astype(np.uint8)
        values = _sample(self._hu, self._index_from_lps, points_ct, 1)
        low, high = self._window
        share = np.clip((values - low) / (high - low), 0, 1)
        outside_mm = _sample(self._outside_mm, self._label_index_from_lps, points_ct, 1)
        fade = np.interp(outside_mm, (_SURE_MM, _UNSURE_MM), (1.0, _FAINT))
        grey = np.nan_to_num(255 * share * fade).astype(np.uint8)
        return np.repeat(grey[:, None], 3, axis=1)


def outlined(
    picture: UInt8[np.ndarray, "s s *rgb"],
    plane: SlicePlane,
    outlines: Iterable[tuple[Mesh, Colour, int]],
    pixels: int,
    note: str = "",
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of the plane, over it outlines of surfaces (camera frame) in their colour and width
    (pixels), a bar of 10 mm, and ``note`` in the corner."""
    from PIL import Image, ImageDraw

    fine = _FINER * pixels  # lines are drawn finer and then shrunk: smooth
    image = Image.fromarray(picture).resize((fine, fine), Image.Resampling.BILINEAR).convert("RGB")
    draw = ImageDraw.Draw(image)
    per_mm = fine / plane.side_mm
    for mesh, colour, width in outlines:
        for a, b in plane.section(mesh) * per_mm + fine / 2:
            draw.line((*a.tolist(), *b.tolist()), fill=colour, width=_FINER * width)
    edge, foot = fine / 32, fine - fine / 32
    draw.line((edge, foot, edge + _BAR_MM * per_mm, foot), fill="white", width=_FINER * 3)
    draw.text((edge, foot - 17 * _FINER), f"{_BAR_MM} mm", fill="white", font_size=12 * _FINER)
    draw.text((fine - edge, foot), note, fill="white", font_size=12 * _FINER, anchor="rb")
    return np.asarray(image.reduce(_FINER))


def _sample(
    values: np.ndarray, index_from_lps: np.ndarray, points_ct: np.ndarray, order: int
) -> Float32[np.ndarray, " n"]:
    """Values at points (order 0: nearest voxel, 1: trilinear), NaN outside the grid."""
    from scipy.ndimage import map_coordinates

    index = transform_points(index_from_lps, points_ct).T
    return map_coordinates(values, index, output=np.float32, order=order, cval=np.nan)


def plane_through(meshes: Mapping[str, Mesh], part: str, orientation: str) -> SlicePlane | None:
    """Through the centre of a part's present surface; centred on the organ, and as large."""
    if part not in meshes or (organ := organ_name(meshes)) is None:
        return None
    across, down = np.array(ORIENTATIONS[orientation])
    normal = np.cross(across, down)
    centre, middle = (meshes[name].box_mm.mean(0) for name in (organ, part))
    everything = np.concatenate([mesh.box_mm for mesh in meshes.values()])
    side = _SLICE_ROOM * float(np.ptp(everything, axis=0).max())
    return SlicePlane(centre + normal * (normal @ (middle - centre)), across, down, side)
