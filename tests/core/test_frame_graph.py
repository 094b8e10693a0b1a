"""Frames: chains compose and invert; cycles are open by what was put in; what is wrong is named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.frames import FrameGraph, Link, composed, fit_link, read_link
from tumortrack.core.geometry import Affine, rigid, transform_points

ORGAN = np.array([0.0, 0.0, 150.0])
PLACES = np.array([[0.0, 0, 150], [60, 10, 160], [-20, 50, 140], [30, -40, 170]])


def pose(*degrees: float, at: tuple[float, ...] = (0, 0, 0)) -> Affine:
    turn = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    return rigid(turn, np.array(at, float))


BASE_CAMERA = pose(170, 5, 90, at=(420, -30, 510))
TRACKER_BASE = pose(10, 20, 30, at=(-300, 100, 900))
CAMERA_CT = pose(160, 10, 5, at=(120, 160, 330))
TRUE = {
    ("base", "camera"): BASE_CAMERA,
    ("tracker", "base"): TRACKER_BASE,
    ("camera", "ct"): CAMERA_CT,
}
TRACKER_CT = TRACKER_BASE @ BASE_CAMERA @ CAMERA_CT
SEEDS = pytest.mark.parametrize("seed", range(12))


def some(rng: np.random.Generator) -> Affine:
    return pose(*rng.uniform(-170, 170, 3), at=tuple(rng.uniform(-900, 900, 3)))


def graph(*links: Link) -> FrameGraph:
    return FrameGraph(links, "camera")


def true_links() -> list[Link]:
    return [Link(b, a, matrix, f"{a}.json", 0.5, 0.1) for (b, a), matrix in TRUE.items()]


@SEEDS
def test_chains_compose_and_invert(seed):
    rng = np.random.default_rng(seed)
    first, second, third = (some(rng) for _ in range(3))
    links = [Link("b", "a", first, ""), Link("b", "c", second, ""), Link("d", "c", third, "")]
    known = FrameGraph(links, "a")
    want = third @ np.linalg.inv(second) @ first
    np.testing.assert_allclose(composed(known.between("a", "d")), want, atol=1e-9)
    both = composed(known.between("a", "d")) @ composed(known.between("d", "a"))
    np.testing.assert_allclose(both, np.eye(4), atol=1e-9)
    assert known.groups == [["a", "b", "c", "d"]]
    assert not list(known.open_cycles())
    assert not list(FrameGraph([*links, Link("d", "a", want, "")], "a").open_cycles())


def test_what_is_not_connected_is_a_group_of_its_own():
    known = graph(*true_links()[::2], Link("tracker", "probe", np.eye(4), ""))
    assert sorted(map(sorted, known.groups)) == [["base", "camera", "ct"], ["probe", "tracker"]]
    assert known.groups[0][0] == "camera"
    assert known.between("camera", "probe") is None
    np.testing.assert_allclose(known.organ_in("camera")[:3], ORGAN)


@SEEDS
def test_a_cycle_is_open_by_what_was_put_in(seed):
    """By a shift of so many mm, and a turn about the organ."""
    rng = np.random.default_rng(seed)
    axis, mm, degrees = rng.normal(size=3), rng.uniform(4, 40), rng.uniform(2, 50)
    axis /= np.linalg.norm(axis)
    shifted = rigid(np.eye(3), mm * axis)
    turn = Rotation.from_rotvec(axis * np.radians(degrees)).as_matrix()
    turned = rigid(turn, ORGAN - turn @ ORGAN)
    for wrong, off_mm, off_deg in (
        (shifted, mm, 0),
        (turned, 0, degrees),
        (shifted @ turned, mm, degrees),
    ):
        matrix = TRACKER_BASE @ BASE_CAMERA @ wrong @ CAMERA_CT
        [found] = graph(*true_links(), Link("tracker", "ct", matrix, "new")).open_cycles()
        assert found.off_mm == pytest.approx(off_mm, abs=1e-6)
        assert found.off_deg == pytest.approx(off_deg, abs=1e-4)
        assert {link.source for link, _ in found.steps} == {
            *("new", "ct.json", "camera.json", "base.json")
        }


def test_what_errors_allow_is_no_fault():
    off = Link("tracker", "ct", TRACKER_CT @ pose(0, 0, 0, at=(4, 0, 0)), "", 5.0)
    assert not list(graph(*true_links(), off).open_cycles())
    [found] = graph(*true_links(), off._replace(error_mm=1.0)).open_cycles()
    assert 1 < found.allowed_mm < 4


FLIP = np.diag([-1.0, -1, 1, 1])
OPENGL = np.diag([1.0, -1, -1, 1])


@pytest.mark.parametrize(
    ("end", "spoiled", "named"),
    [
        (("base", "camera"), np.linalg.inv(BASE_CAMERA), "inverted"),
        (("tracker", "base"), rigid(TRACKER_BASE[:3, :3], TRACKER_BASE[:3, 3] / 1000), "in m"),
        (("tracker", "base"), rigid(TRACKER_BASE[:3, :3], TRACKER_BASE[:3, 3] * 5), ""),
        (("camera", "ct"), CAMERA_CT @ FLIP, "ct are negated (RAS"),
        (("base", "camera"), BASE_CAMERA @ OPENGL, "camera are negated (OpenGL"),
    ],
)
def test_what_would_close_a_cycle_is_named(end, spoiled, named):
    links = [link._replace(b_from_a=spoiled) if link[:2] == end else link for link in true_links()]
    [found] = graph(*links, Link("tracker", "ct", TRACKER_CT, "new")).open_cycles()
    assert bool(found.cures) == bool(named)
    mine = [words for words in found.cures if named in words and f"({end[1]}.json)" in words]
    assert bool(mine) == bool(named)


def test_numbers_that_cannot_be_right_are_named():
    def faults(rows, metres=False):
        return read_link("base", "camera", rows, "file", metres).faults

    assert not faults(BASE_CAMERA)
    assert not faults(rigid(BASE_CAMERA[:3, :3], BASE_CAMERA[:3, 3] / 1000), metres=True)
    [small] = faults(rigid(np.eye(3), np.array([0.4, 0, 0])))
    [large] = faults(BASE_CAMERA, metres=True)
    assert "0.4 mm" in small
    assert "661.4 m" in large
    far = read_link("base", "camera", BASE_CAMERA, "file", True)
    np.testing.assert_allclose(far.b_from_a, BASE_CAMERA, atol=1e-9)
    columns = read_link("base", "camera", BASE_CAMERA.T, "file")
    np.testing.assert_allclose(columns.b_from_a, BASE_CAMERA, atol=1e-9)
    assert len(columns.faults) == 1
    bent = BASE_CAMERA.copy()
    bent[0, 1] += 0.1
    assert len(faults(bent)) == 1
    assert len(faults(BASE_CAMERA @ np.diag([1, 1, -1, 1]))) == 1


def test_images_have_pixels():
    image = pose(0, 0, 20, at=(1, -2, 0)) @ np.diag([0.085, 0.1, 0.09, 1])
    link = read_link("probe", "image", image, "file")
    assert not link.faults
    np.testing.assert_allclose(link.b_from_a, image, atol=1e-9)
    assert read_link("probe", "tip", image, "file").faults


@pytest.mark.parametrize("rows", [np.zeros((4, 4)), np.full((4, 4), np.nan)])
def test_what_is_no_matrix_is_refused(rows):
    with refused(InputError, "file", "base_from_camera"):
        read_link("base", "camera", rows, "file")


@SEEDS
def test_touches_give_the_transform_that_they_were_made_with(seed):
    base_camera = some(np.random.default_rng(seed))
    link = fit_link("base", "camera", transform_points(base_camera, PLACES), PLACES, "touches")
    np.testing.assert_allclose(link.b_from_a, base_camera, atol=1e-8)
    assert not link.faults
    assert 0 < link.error_mm <= 2


def test_the_error_of_touches_covers_how_far_off_they_leave_the_organ():
    """In 95 of 100, of four touches right to 1.5 mm; and scattered ones are named."""
    rng, within = np.random.default_rng(0), 0
    for _ in range(300):
        there = transform_points(BASE_CAMERA, PLACES) + rng.normal(0, 1.5 / 3**0.5, PLACES.shape)
        link = fit_link("base", "camera", there, PLACES, "touches")
        known = graph(Link("base", "camera", BASE_CAMERA, "", 0.0), link)
        within += not list(known.open_cycles())
    assert within >= 285
    scattered = transform_points(BASE_CAMERA, PLACES) + rng.normal(0, 6, PLACES.shape)
    assert fit_link("base", "camera", scattered, PLACES, "touches").faults


@pytest.mark.parametrize(
    "places",
    [
        PLACES[:2],
        PLACES[:1],
        np.array([[0.0, 0, 0], [50, 0, 1], [100, 0, 0]]),
        PLACES / 1000,
    ],
)
def test_places_that_fix_no_transform_are_refused(places):
    with refused(InputError, "touches", "camera", "base"):
        fit_link("base", "camera", PLACES[: len(places)], places, "touches")
