"""Pictures: what they show lies where the meshes and volumes say."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from report_objects import anatomy, ball
from tumortrack.core.colours import name_colour
from tumortrack.core.types import Anatomy, LabelVolume, Mesh, Volume
from tumortrack.report.metrics import label_grid
from tumortrack.report.pictures import (
    PLANES,
    border_letters,
    in_voxels,
    qc_picture,
    sampled,
    write_sheet,
)
from tumortrack.report.renderer import ParallelView
from tumortrack.report.slices import ORIENTATIONS, SlicePlane
from tumortrack.report.wrapping import wrapped

FROM_CAMERA, FROM_SIDE = (ParallelView(way, *ORIENTATIONS[way]) for way in list(ORIENTATIONS)[:2])
CORONAL, SAGITTAL = (ParallelView(way, *PLANES[way]) for way in ("coronal", "sagittal"))


def test_sections_of_a_ball_are_circles_of_the_right_size():
    mesh = ball(10, (3, 4, 120), subdivisions=5)
    through = np.array([0.0, 0.0, 126.0])
    for view, center, radius in (
        (FROM_CAMERA, (3, 4), 8.0),
        (FROM_SIDE, (3, 120), np.sqrt(100 - 16)),
    ):
        plane = SlicePlane(through, *view.axes[:2], 60.0)
        outline = plane.section(mesh) + view.project(through[None])[0, :2]
        away = np.linalg.norm(outline.reshape(-1, 2) - center, axis=1)
        np.testing.assert_allclose(away, radius, atol=0.03)
        length = np.linalg.norm(outline[:, 1] - outline[:, 0], axis=1).sum()
        assert length == pytest.approx(2 * np.pi * radius, rel=1e-3)  # closed, nothing doubled


@pytest.mark.parametrize("view", [FROM_CAMERA, FROM_SIDE, CORONAL, SAGITTAL])
def test_depths_and_outlines_are_those_of_the_mesh(view):
    middle = np.array([30.0, -40.0, 150.0])
    mesh = ball(10, middle, subdivisions=5)
    right, down, depth = view.project(middle[None])[0]
    frame = view.frame_around(mesh.vertices_mm).widened(1.5)
    found = view.depth_of(mesh, frame)
    x, y = np.meshgrid(*frame.pixel_centres())
    away = np.hypot(x - right, y - down)
    clear = np.abs(away - 10) > 0.3
    np.testing.assert_array_equal(np.isfinite(found)[clear], (away < 10)[clear])
    inner = away < 9
    expected = depth - np.sqrt(100 - away[inner] ** 2)
    np.testing.assert_allclose(found[inner], expected, atol=0.06)


# A marker on each side of the patient must appear at its own letter.
MARKS = {"L": (30, 0, 0), "R": (-30, 0, 0), "P": (0, 30, 0), "A": (0, -30, 0), "S": (0, 0, 30),
         "I": (0, 0, -30)}  # fmt: skip
TURNS = {
    "LPS": np.eye(3),
    "flipped": np.diag([-1.0, -1.0, 1.0]),
    "slices first": np.eye(3)[[2, 1, 0]] * [1, -1, 1],
    "oblique": trimesh.transformations.rotation_matrix(0.4, (1, 2, 3))[:3, :3],
}


@pytest.mark.parametrize("name", TURNS)
@pytest.mark.parametrize("way", PLANES)
def test_letters_stand_where_the_patients_sides_are(way, name):
    size, step, pixels = 64, 1.5, 90
    lps_from_index = np.eye(4)
    lps_from_index[:3, :3] = TURNS[name] * step
    center = np.array([100.0, -50.0, 700.0])
    lps_from_index[:3, 3] = center - lps_from_index[:3, :3] @ np.full(3, (size - 1) / 2)
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1)
    lps = index @ lps_from_index[:3, :3].T + lps_from_index[:3, 3] - center
    plane = SlicePlane(center, *np.array(PLANES[way]), 90.0)
    half = {"left": np.s_[:, :45], "right": np.s_[:, 45:], "top": np.s_[:45], "bottom": np.s_[45:]}
    letters = border_letters(PLANES[way])
    assert len(set(letters.values())) == 4
    for border, letter in letters.items():
        mark = (np.linalg.norm(lps - MARKS[letter], axis=-1) < 8).astype(np.uint8)
        values = sampled(mark, lps_from_index, plane.points(pixels))
        picture = values.reshape(pixels, pixels) == 1
        assert picture.sum() > 100
        assert picture[half[border]].sum() == picture.sum()


def test_radiological_convention():
    axial, coronal, sagittal = map(border_letters, PLANES.values())
    assert axial == {"left": "R", "right": "L", "top": "A", "bottom": "P"}
    assert coronal == {"left": "R", "right": "L", "top": "S", "bottom": "I"}
    assert sagittal == {"left": "A", "right": "P", "top": "S", "bottom": "I"}


def coloured(path, name):
    """Where a picture has a part's colour."""
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    return np.abs(pixels - name_colour(name)).max(2) < 8


@pytest.mark.parametrize("with_ct", [True, False])
def test_a_cases_picture_shows_outlines(tmp_path, with_ct):
    parts, lps_from_index = anatomy(), np.eye(4)
    lps_from_index[:3, 3] = (-30, -30, 100)
    labels = label_grid(parts, lps_from_index, (60, 60, 60))
    ct = Volume(np.where(labels, 50.0 * labels, -80.0), lps_from_index) if with_ct else None
    qc_picture(LabelVolume(labels, lps_from_index), ct, parts, tmp_path / "qc.png", "patient")
    for name in parts.names:
        assert coloured(tmp_path / "qc.png", name).sum() > 300
    assert list(tmp_path.iterdir()) == [tmp_path / "qc.png"]


def test_a_cases_picture_cuts_through_every_tumor(tmp_path):
    """Tumors in opposite corners share no slice: each has its outline in its own row."""
    corners = [ball(5, (-20, -20, -20)), ball(7, (20, 20, 20))]
    parts = Anatomy((ball(48, (0, 0, 0)), *corners))
    lps_from_index = np.diag([2.0, 2.0, 2.0, 1.0])
    lps_from_index[:3, 3] = -60
    labels = label_grid(parts, lps_from_index, (60, 60, 60))
    qc_picture(LabelVolume(labels, lps_from_index), None, parts, tmp_path / "qc.png")
    for n, name in enumerate(parts.names[1:]):
        drawn = coloured(tmp_path / "qc.png", name)
        top, left = drawn.shape[0] // 10, int(0.74 * drawn.shape[1])  # no legend, no 3-D view
        row = np.array_split(drawn[top:, :left], 2)[n]
        assert all(part.sum() > 50 for part in np.array_split(row, 3, axis=1))


def test_slice_and_outline_of_coarse_voxels_belong_together():
    """A bar that leans by 45 degrees, in voxels of 3 mm; the plane asked for lies between two
    layers of voxels, so that the nearest one's slice is 1.5 mm beside the bar's own section."""
    step, n = 3.0, 31
    lps_from_index = np.diag([step, step, step, 1.0])
    i, j, k = np.indices((n, n, n))
    bar = ((np.abs(i - k) <= 2) & (np.abs(j - 15) <= 2)).astype(np.uint8)
    corners = step * np.array(
        [[k + x, 15 + y, k] for k in (5, 25) for x in (-2.5, 2.5) for y in (-2.5, 2.5)]
    )
    hull = trimesh.convex.convex_hull(corners)
    mesh, between_mm = Mesh(hull.vertices, hull.faces), step * np.array([15.0, 15.0, 15.5])

    def distance_mm(through_mm):
        plane = SlicePlane(through_mm, *np.array(PLANES["axial"]), 90.0)
        places = plane.points(360)
        inside = sampled(bar, lps_from_index, places) == 1
        edges = plane.section(mesh)[..., 0] + through_mm[0]
        return abs(np.unique(places[inside, 0]).mean() - edges.mean())

    through_mm = in_voxels(between_mm, lps_from_index)
    assert np.abs(through_mm - between_mm).max() == pytest.approx(step / 2)
    assert distance_mm(between_mm) == pytest.approx(step / 2, abs=0.3)
    assert distance_mm(through_mm) < 0.3
    turned = trimesh.transformations.rotation_matrix(0.4, (1, 2, 3)) @ lps_from_index
    index = np.linalg.inv(turned) @ [*in_voxels(np.array([20.0, 31.0, 7.0]), turned), 1.0]
    np.testing.assert_allclose(index, np.rint(index), atol=1e-9)


def test_no_word_of_a_sheet_is_cut(tmp_path):
    """A sheet grows with its words, and nothing is drawn at its right border."""
    heights = []
    for times in (1, 10):
        legend = {f"vein {n} " + "a" * 10: (9, 9, 9) for n in range(9 * times)}
        lines = ["word " * 30 * times + "x" * 300] * times
        write_sheet(tmp_path / "sheet.png", [], lines, legend, [])
        with Image.open(tmp_path / "sheet.png") as picture:
            pixels = np.asarray(picture.convert("L"))
        assert (pixels[:, -8:] == 255).all()
        heights.append(len(pixels))
    assert heights[1] > 10 * heights[0]


def test_wrapping_loses_nothing():
    text = "one two three " + "x" * 25 + " four\nfive"
    for width in (1, 3, 8, 100):
        lines = wrapped(text, width, len)
        assert "".join(lines).replace(" ", "") == "".join(text.split())
        assert max(map(len, lines)) <= width
    assert wrapped("a bc def", 4, len) == ["a bc", "def"]
