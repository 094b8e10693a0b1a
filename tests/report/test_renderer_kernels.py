"""The renderer's loop against every triangle tried in every pixel."""

import numpy as np
import pytest

from render_objects import bumpy
from tumortrack.report.renderer import Viewpoint, blend, nearest

WIDTH, HEIGHT = 60, 45


def nearness(seen, limit):
    """The greatest nearness up to the limit of a picture's triangles (t, 3, 3), pixel by pixel, and
    whose it is; and which pixels lie so near to an edge that rounding decides."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    best, whose = np.full((HEIGHT, WIDTH), -np.inf), np.full((HEIGHT, WIDTH), -1)
    close = np.zeros((HEIGHT, WIDTH), bool)
    for t, (a, b, c) in enumerate(seen.astype(float)):
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        of_b = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        of_c = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        least = np.minimum(np.minimum(of_b, of_c), 1 - of_b - of_c)
        here = a[2] + of_b * (b[2] - a[2]) + of_c * (c[2] - a[2])
        close |= np.abs(least) * np.abs(area) < 0.05
        better = (least >= 0) & (here <= limit) & (here > best)
        best[better], whose[better] = here[better], t
    return best, whose, close


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("limited", [False, True])
def test_a_pixel_sees_the_nearest_triangle(parallel, limited):
    mesh = bumpy(30, (10, 20, 30), 3)
    view = Viewpoint.towards(np.array([12.0, 18, 30]), np.array([60.0, -200, 140]), 50.0, parallel)
    corners = view.project(mesh.vertices_mm, (WIDTH, HEIGHT)).astype(np.float32)[mesh.faces]
    limit = float(np.median(corners[..., 2])) if limited else np.inf
    near, winner = nearest(corners, WIDTH, HEIGHT, limit, not parallel)
    expected, whose, close = nearness(corners, limit)
    assert close.mean() < 0.1
    sure = ~close
    np.testing.assert_array_equal(winner[sure], whose[sure])
    np.testing.assert_allclose(near[sure], expected[sure], rtol=1e-5)
    assert (winner >= 0).mean() > 0.5


def test_what_reaches_behind_the_eye_or_has_no_size_is_not_seen():
    whole = np.array([[[5, 5, 1], [40, 5, 1], [5, 40, 1]]], np.float32)
    behind = whole - np.array([0, 0, 1], np.float32) * [[[0], [0], [1]]]
    line = whole[:, [0, 1, 1]]
    beyond = np.array([[[np.inf, 5, 1], [-np.inf, 9, 1], [1e30, 1e30, 1]]], np.float32)
    for seen in (behind.astype(np.float32), line, beyond * np.nan):
        assert (nearest(seen, WIDTH, HEIGHT, np.inf, True)[1] == -1).all()
    nearest(beyond, WIDTH, HEIGHT, np.inf, True)  # whatever it shows, it stays within the picture
    assert (nearest(whole, WIDTH, HEIGHT, np.inf, True)[1] == 0).sum() > 600


@pytest.mark.parametrize("perspective", [False, True])
def test_a_pixel_has_its_share_of_each_corners_colour(perspective):
    """Half way between two corners, one of them twice as near."""
    seen = np.array([[[0, 0, 2], [40, 0, 1], [0, 40, 1]]], np.float32)
    colours = np.array([[[1, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, 1, 0.5]]], np.float32)
    winner = nearest(seen, WIDTH, HEIGHT, np.inf, perspective)[1]
    picture = np.ones((HEIGHT, WIDTH, 3), np.float32)
    blend(picture, winner, seen, colours, perspective)
    share = 2 / 3 if perspective else 1 / 2
    expected = 0.5 + 0.5 * np.array([share, 1 - share, 0])
    np.testing.assert_allclose(picture[0, 20], expected, rtol=1e-5)
    assert (picture[winner < 0] == 1).all()
