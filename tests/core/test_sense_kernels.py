"""The compiled work on depth images agrees with known answers and with plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.special import ndtri

from tumortrack.core import depth_kernels as kernels
from tumortrack.core.camera import Pinhole
from tumortrack.core.types import SensorCloud
from tumortrack.segmentation import choose, pieces, plane, working_image
from tumortrack.segmentation.smoothing import smooth_depth
from tumortrack.segmentation.working_image import LAST_BOX, RANGE, WorkingImage

CAMERA = Pinhole(50.0, 52.0, 14.3, 9.8)
JUMP = 0.01, 1e-5
# The normal quantile of SplitMix64's first number of seed 0, of 2^14, scaled to a variance of 1.
EVERY = ndtri((np.arange(2**14) + 0.5) / 2**14)
FIRST = np.float32(EVERY[0xE220A8397B1DCDAF % 2**14] / EVERY.std())


def image_of(depth_mm, taken=None):
    depth_mm = np.asarray(depth_mm, np.float32)
    taken = np.zeros(depth_mm.shape, np.uint8) if taken is None else np.asarray(taken, np.uint8)
    return WorkingImage(depth_mm, taken, CAMERA, np.flatnonzero, np.asarray)


def rough(seed=0, shape=(24, 31)):
    """A bumpy surface with steps, holes and removed pixels."""
    rng = np.random.default_rng(seed)
    depth_mm = 120 + rng.normal(0, 0.6, shape) + 20 * (rng.random(shape) < 0.15)
    taken = (rng.random(shape) < 0.2).astype(np.uint8)
    return image_of(np.where(taken, np.nan, depth_mm), taken)


def tolerance(z):
    return JUMP[0] * z + JUMP[1] * z * z


def test_noise_is_hashed_by_splitmix():
    depth_mm = np.full(2, 100.0, np.float32)
    seen = kernels.Seen(np.array([0, 1], np.int32), np.array([0, 2], np.int32))
    kernels.jitter(depth_mm, seen, 0, 1e-4, 0.0, np.zeros(2, np.float32))
    assert depth_mm[0] == pytest.approx(100 + FIRST, abs=1e-5)
    assert depth_mm[1] != depth_mm[0]
    assert kernels.smooth_at(seen, (1, 2), 4, 0)[0] == FIRST  # a node


def test_a_list_of_another_image_reaches_nowhere_outside():
    wide, small = kernels.seen_pixels(np.zeros((6, 9), np.float32)), np.zeros((4, 5), np.float32)
    depths_mm = np.zeros(54, np.float32)
    kernels.lose_grazing(small, depths_mm, wide, 3, 1.0, 1.0, CAMERA, np.zeros(5))
    kernels.fly(small, depths_mm, wide, 3, (1.0, 5.0, 10**18, 0.0))
    assert (depths_mm[5:9] == 0).all()
    assert np.isfinite(kernels.smooth_at(wide, (4, 5), 3, 0)[:5]).all()


def test_smoothing_is_the_plane_through_its_neighbours():
    depth_mm = rough(1).depth_mm
    rows, columns, out = np.arange(2, 22, 3), np.arange(30), np.empty((7, 30), np.float32)
    reach, relative, slope = 2, 4e-5, 0.01
    smooth_depth(depth_mm, rows, columns, reach, relative, slope, out)
    changed = 0
    for n, v in enumerate(rows):
        for m, u in enumerate(columns):
            z, low = float(depth_mm[v, u]), (max(v - reach, 0), max(u - reach, 0))
            part = depth_mm[low[0] : v + reach + 1, low[1] : u + reach + 1].astype(float)
            y, x = np.indices(part.shape)
            design = np.stack(
                [np.ones(part.size), (y + low[0] - v).ravel(), (x + low[1] - u).ravel()]
            )
            fitted, away = np.array([z, 0, 0]), np.abs(design[1:]).max(0)
            for times, steep in ((4.2, slope * z), (3.0, 0.0)):
                near = (
                    np.abs(part.ravel() - fitted @ design) < times * relative * z * z + steep * away
                )
                if near.sum() < 0.3 * 25:
                    fitted = np.array([z, 0, 0])
                    break
                fitted = np.linalg.lstsq(design[:, near].T, part.ravel()[near], rcond=None)[0]
            np.testing.assert_allclose(out[n, m], fitted[0], rtol=1e-6)
            changed += out[n, m] != depth_mm[v, u]
    assert changed > 100


def test_a_box_keeps_what_lies_in_it():
    image = rough()
    low, high = np.array([-15.0, -9.0, 119.5]), np.array([11.0, 20.0, 139.0])
    v, u = np.indices(image.depth_mm.shape)
    z = image.depth_mm
    places = [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]
    inside = np.all([(a < p) & (p < b) for a, b, p in zip(low, high, places, strict=True)], axis=0)
    numbers = np.where(image.pixel_class == 0, 1 + (u > 12), 0).astype(np.int32)
    area = choose.area_inside(image, numbers, low, high, 3)
    for number in (1, 2):
        expected = (z[inside & (numbers == number)] ** 2).sum() / (CAMERA.fx * CAMERA.fy)
        assert area[number] == pytest.approx(expected, rel=1e-6)
    before = image.pixel_class.copy()
    working_image.keep_inside(image, np.array([high, low]), RANGE)
    np.testing.assert_array_equal(
        image.pixel_class, np.where((before == 0) & ~inside, RANGE, before)
    )
    assert 50 < (image.pixel_class == 0).sum() < (before == 0).sum()


def test_a_cloud_is_seen_from_its_origin():
    rng = np.random.default_rng(4)
    points = rng.uniform([-60, -40, 60], [60, 50, 150], (4000, 3)).astype(np.float32)
    points[:40, 2] *= -1  # behind the camera
    points[40:60, 0] = 500  # too far aside
    tangents, (low, high, inner) = working_image.tangents_of(points)
    expected = points[60:, :2] / points[60:, 2:]
    np.testing.assert_array_equal(tangents[60:], expected)
    assert np.isnan(tangents[:60]).all()
    np.testing.assert_array_equal([low, high], [expected.min(0), expected.max(0)])
    middle = np.ptp(np.quantile(expected, [0.02, 0.98], axis=0), axis=0)
    np.testing.assert_allclose(inner, middle, atol=0.01)
    depth_mm, pixel = np.full((20, 30), np.nan, np.float32), np.empty(4000, np.int32)
    working_image.rasterise(tangents, points[:, 2].copy(), CAMERA, depth_mm, pixel)
    u, v = np.trunc(tangents[60:].T * [[CAMERA.fx], [CAMERA.fy]] + [[CAMERA.cx], [CAMERA.cy]] + 0.5)
    there = (u >= 0) & (u < 30) & (v >= 0) & (v < 20)
    np.testing.assert_array_equal(pixel[60:], np.where(there, 30 * v + u, -1))
    nearest = np.full(600, np.inf, np.float32)
    np.minimum.at(nearest, pixel[pixel >= 0], points[pixel >= 0, 2])
    np.testing.assert_array_equal(depth_mm.ravel(), np.where(nearest < np.inf, nearest, np.nan))
    nothing = working_image.image_of_cloud(SensorCloud(-np.abs(points)))
    assert not len(nothing.remaining(nothing.pixel_class))


def test_the_best_plane_has_the_best_score():
    rng = np.random.default_rng(5)
    points = rng.uniform([-60, -60, 90], [60, 60, 150], (300, 3))
    points[:200, 2] = 140 + 0.2 * points[:200, 0] + rng.normal(0, 0.5, 200)
    points, triples = points.astype(np.float32), rng.integers(300, size=(60, 3))
    best = -np.inf
    for a, b, c in points[triples].astype(float):
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 100 or abs(normal[2]) < 0.35 * length:
            continue
        normal *= -np.sign(normal[2]) / length
        height = points @ normal - normal @ a
        behind = (height < 0) & (height > -60) & (np.abs(height) >= 3)
        score = np.maximum(1 - (height / 3) ** 2, 0).sum() - 2 * behind.sum()
        if score > best:
            best, expected = score, (*normal, normal @ a)
    found, offset = np.zeros(3, np.float32), np.zeros(1)
    score = plane.consensus(points, triples, (3.0, 60.0), found, offset)
    assert score == pytest.approx(best, rel=1e-4)
    np.testing.assert_allclose([*found, *offset], expected, rtol=1e-4)
    none = plane.consensus(points, triples[:, [0, 0, 0]].copy(), (3.0, 60.0), found, offset)
    assert none == -np.inf


def test_pixels_with_few_neighbours_are_isolated():
    image = rough(3)
    z, taken = np.pad(image.depth_mm, 1), np.pad(image.pixel_class, 1)
    outside = np.pad(np.zeros(image.pixel_class.shape, bool), 1, constant_values=True)
    near = np.zeros(image.pixel_class.shape, int)
    for shift in ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)):
        there = [np.roll(values, shift, (0, 1))[1:-1, 1:-1] for values in (z, taken, outside)]
        apart = np.abs(there[0] - image.depth_mm)
        near += there[2] | ((there[1] == 0) & (apart < tolerance(image.depth_mm)))
    out = np.empty(near.shape, bool)
    pieces.find_isolated(image.depth_mm, image.pixel_class, JUMP, out)
    np.testing.assert_array_equal(out, (image.pixel_class == 0) & (near < 3))
    assert 20 < out.sum() < 400


def test_short_holes_whose_ends_agree_are_bridged():
    gaps = [
        [100, 0, 0, 0, 101, 0, 130, 0, 0, 0, 0, 0, 0, 130, 0],
        [0, 0, 90, 0, 0, 0, 0, 0, 90.6] + 6 * [0],
    ]
    depth_mm = np.array(gaps, np.float32)
    out = np.empty_like(depth_mm)
    pieces.bridge_holes(depth_mm, (depth_mm == 0).astype(np.uint8), JUMP, out)
    expected = np.where(depth_mm == 0, np.nan, depth_mm)
    expected[0, :5] = np.linspace(100, 101, 5)
    expected[1, 2:9] = np.linspace(90, 90.6, 7)
    np.testing.assert_allclose(out, expected, rtol=1e-6)


def test_edges_are_jumps_holes_and_folds():
    depth_mm = np.full((60, 80), 100.0, np.float32)
    depth_mm[:, 50:] = 120
    depth_mm[10, 10] = np.nan
    edge = np.isnan(depth_mm)
    edge[:, 49:51] = True
    edge[[9, 11], 10] = edge[10, [9, 11]] = True

    def distance(crease_mm):
        out = np.empty((62, 82), np.float32)
        pieces.edge_distances(depth_mm, JUMP, crease_mm, 400.0, out)
        return out[1:-1, 1:-1]

    exact = distance_transform_edt(~edge)
    np.testing.assert_allclose(distance(0.0), exact, rtol=0.05)  # chamfer's: 4.5 %
    depth_mm[40:, :48] += 0.5 * (4 - np.abs(np.arange(48) - 30)).clip(0)  # a valley
    assert (distance(0.0)[45:, 30] > 0).all()
    assert (distance(1.0)[45:56, 30] == 0).all()
    assert (distance(1.0)[45:56, 20] > 0).all()


def test_pieces_grow_by_rounds_and_not_across_a_jump():
    depth_mm, numbers = np.full((30, 40), 100.0, np.float32), np.zeros((30, 40), np.int32)
    depth_mm[:, 22:] = 120
    numbers[15, 19], numbers[3, 35] = 1, 2
    pieces.grow_pieces(depth_mm, numbers, JUMP, 200.0, np.empty(1200, np.int32))
    expected = np.zeros((30, 40), int)
    expected[10:21, 14:22] = 1  # 1.4 * 200 / 100 + 2: five rounds
    expected[:9, 30:40] = 2  # and at 120 mm too
    np.testing.assert_array_equal(numbers, expected)


def test_a_piece_is_measured():
    image = image_of(np.full((20, 30), 100.0))
    numbers, distance = np.zeros((20, 30), np.int32), np.ones((20, 30), np.float32)
    numbers[5:9, 10:16], numbers[12:, 3] = 1, 2
    distance[6, 12] = 2.5
    image.pixel_class[4, 10:13] = LAST_BOX
    sizes = choose.measure(image, distance, numbers, 3)
    np.testing.assert_allclose(sizes.area_mm2, [0, 24e4 / 2600, 8e4 / 2600, 0])
    np.testing.assert_allclose(sizes.thick_mm, [0, 10, 4, 0])  # at 100 mm a pixel is 2 mm wide
    assert sizes.wide_mm[1] == pytest.approx(0.7071 * (5 * 2 + 3 * 100 / 52))
    assert sizes.wide_mm[2] == pytest.approx(700 / 52)
    np.testing.assert_allclose(
        sizes.border_fraction[1:3], [6 / np.sqrt(24e4 / 2600), 2 / np.sqrt(8e4 / 2600)]
    )
    aside = np.hypot((12.5 - 14.3) / 50, (6.5 - 9.8) / 52)
    assert sizes.aside[1] == pytest.approx(aside)
    assert sizes.aside[3] == sizes.wide_mm[3] == sizes.border_fraction[3] == 0
