"""Split the image into connected pieces at depth jumps, creases and narrow places.

A pixel is an edge where a neighbour is missing, lies at another depth, or, if that is asked for,
where the surface folds into a valley. Pixels farther than ``opening_mm`` from every edge are the
cores of pieces. Cores grow by little more than what the opening took away, and never across a
jump.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tumortrack.native import BOOL, F32, I32, U8, kernel
from tumortrack.segmentation.working_image import DEPTH, FLYING, ORGAN, RegionConfig, WorkingImage
from tumortrack.simulation.noise import REFERENCE_MM

_CREASE_REACH_MM = 4.0
_JUMP = float, float
_TAKEN = U8["height", "width"]

# Depths, states, jump; which pixels have few neighbours at their depth.
find_isolated = kernel("isolated", DEPTH, _TAKEN, _JUMP, BOOL["height", "width"].out)
# Depths, states, jump; the remaining depths, with short holes bridged.
bridge_holes = kernel("without_holes", DEPTH, _TAKEN, _JUMP, F32["height", "width"].out)
# Depths, jump, depth and reach of creases; px to the nearest edge, with a frame of one pixel.
edge_distances = kernel("edge_distance", DEPTH, _JUMP, float, float, F32["rows", "columns"].out)
# Depths, pieces, jump, radius; room for a pixel each.
grow_pieces = kernel("grow", DEPTH, I32["height", "width"].out, _JUMP, float, I32["size"].out)


class Jump(NamedTuple):
    """Neighbouring pixels at depth z are connected if their depths differ by less than
    ``slope * z + noise * z**2``: the steepest surface plus four standard deviations of noise."""

    slope: float
    noise: float


def _jump(image: WorkingImage, config: RegionConfig) -> Jump:
    slope = math.tan(math.radians(config.steepest_degrees)) * image.footprint
    return Jump(slope, 4 * config.noise_mm / REFERENCE_MM**2)


def remove_flying(image: WorkingImage, config: RegionConfig) -> None:
    """Remove pixels with few neighbours at their depth: between two surfaces, or isolated."""
    isolated = np.empty(image.pixel_class.shape, np.bool_)
    find_isolated(image.depth_mm, image.pixel_class, _jump(image, config), isolated)
    image.remove(isolated, FLYING)


def find_edges(
    image: WorkingImage, config: RegionConfig, folds: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The remaining depths (h, w), mm, with short holes bridged, NaN otherwise; and the distance
    (h, w) of every pixel to the nearest edge, px. ``folds``: are edges, too."""
    jump = _jump(image, config)
    depth_mm = np.empty_like(image.depth_mm)
    bridge_holes(image.depth_mm, image.pixel_class, jump, depth_mm)
    height, width = depth_mm.shape
    distance = np.empty((height + 2, width + 2), np.float32)
    crease = config.crease_mm * folds, _CREASE_REACH_MM / image.footprint
    edge_distances(depth_mm, jump, *crease, distance)
    return depth_mm, distance[1:-1, 1:-1].copy()


def find_pieces(
    image: WorkingImage, edges: tuple[np.ndarray, np.ndarray], config: RegionConfig, wider: float
) -> tuple[np.ndarray, int]:
    """Piece number of every pixel (h, w), int32, 0 for none, and the number of pieces, at ``wider``
    times the configured opening."""
    from scipy.ndimage import label

    depth_mm, distance = edges
    radius = wider * config.opening_mm / image.footprint  # px at distance 1
    pieces, count = label(distance * depth_mm > radius)
    grow_pieces(depth_mm, pieces, _jump(image, config), radius, np.empty(pieces.size, np.int32))
    pieces[image.pixel_class != ORGAN] = 0  # bridged holes
    return pieces, count
