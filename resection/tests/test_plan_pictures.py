"""Pictures of a plan: what is drawn stands where it should."""

# ruff: noqa: F811 (fixtures)

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from picture_objects import (  # noqa: F401 (fixtures)
    KEPT_MM,
    TOOLS,
    TUMOR,
    TUMOR_MM,
    ellipsoid,
    level,
    located,
    plan,
    published,
    ring,
    solid,
)
from tumortrack.core.colours import NONE, sweep_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.core.mesh_query import contains
from tumortrack.core.patient import Patient
from tumortrack.report.renderer import Body, ParallelView, Viewpoint, corner_normals, render
from tumortrack_resection.pictures import (
    FROM_ABOVE,
    draw_plan,
    organ_surfaces,
    plan_figure,
)
from tumortrack_resection.sections import section_view, side_view
from tumortrack_resection.sweeps import Lines, sweeps_of
from tumortrack_resection.values import (
    CUTS_TUMOR,
    ELECTRODE,
    Clearance,
    Cut,
    Located,
    ResectionPlan,
)


class Picture:
    """A figure's pixels, by places of the table in one of its axes."""

    def __init__(self, figure: Figure) -> None:
        figure.canvas.draw()  # type: ignore[attr-defined]
        self._axes = figure.axes
        rgba = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
        self.pixels = rgba[:, :, :3].astype(int)

    def at(
        self, number: int, view: ParallelView, place_mm: np.ndarray, reach: int = 1
    ) -> np.ndarray:
        """The pixels around a place."""
        x, y = self._axes[number].transData.transform(view.project(place_mm[None])[0, :2])
        row, column = round(self.pixels.shape[0] - y - 0.5), round(x - 0.5)
        around = (slice(middle - reach, middle + reach + 1) for middle in (row, column))
        return self.pixels[tuple(around)].reshape(-1, 3)


def test_paths_and_tumor_are_drawn_where_they_are(
    published: ResectionPlan, located: Located
) -> None:
    picture = Picture(plan_figure(published, located))
    views = FROM_ABOVE, side_view(published, located)
    near = {  # share of a stroke's points that have its colour, in both views
        (n, cut.sweep): np.mean(
            [
                (np.abs(picture.at(n, view, p, 3) - sweep_colour(cut.sweep, 2)).max(1) < 30).any()
                for p in cut.path_mm[contains(located.organ, cut.path_mm)]
            ]
        )
        for n, view in enumerate(views)
        for cut in published.cuts
    }
    assert min(near.values()) > 0.7  # from above too: the lower stroke shows beside the upper
    red, green, blue = picture.at(1, views[1], TUMOR + [0, 0, 8]).T
    assert (red > green + 40).all()  # the first tumor's orange
    assert (green > blue + 80).all()
    assert (picture.pixels[:3] == 255).all()


def test_what_a_sweep_covers_is_its_facet(plan: ResectionPlan, located: Located) -> None:
    picture, means = Picture(plan_figure(plan, located)), []
    for sweep, plane in zip(sweeps_of(plan, located, TOOLS), plan.facets, strict=True):
        strip = sweep.strip()
        corners = strip.vertices_mm[np.unique(strip.faces)]
        np.testing.assert_allclose(corners @ plane[:3], plane[3], atol=1e-9)
        tips, exits = corners[::2], corners[1::2]
        np.testing.assert_array_equal(tips[:, 2], plan.cuts[0].path_mm[0, 2])
        back = -plan.cuts[sweep.number - 1].axis
        assert contains(located.organ, exits - 0.01 * back).all()
        assert not contains(located.organ, exits + 0.51 * back).any()  # its step
        middles = (0.4 * tips + 0.6 * exits)[:: len(tips) // 8]
        seen = np.abs(middles - TUMOR)[:, :2].max(1) > TUMOR_MM + 2  # from above
        assert seen.sum() >= 3
        colours = np.concatenate([picture.at(0, FROM_ABOVE, place) for place in middles[seen]])
        means.append(colours.mean(0))
        apart = np.linalg.norm(means[-1] - [sweep_colour(n, 2) for n in (1, 2)], axis=1)
        assert apart.argmin() == sweep.number - 1
    assert np.abs(means[0] - means[1]).max() > 30


def test_a_strip_ends_where_the_instrument_leaves(plan: ResectionPlan, located: Located) -> None:
    """Not across the way from one stroke to the next."""
    path = plan.cuts[0].path_mm
    parts = path[20:30], path[45:55]
    cuts = tuple(Cut(1, part, plan.cuts[0].axis) for part in parts)
    sweep = sweeps_of(replace(plan, cuts=cuts), located, TOOLS)[0]
    assert len(sweep.paths_mm) == 2
    assert len(sweep.strip().faces) == 2 * 9 * 2
    outside = sweeps_of(replace(plan, cuts=(Cut(1, path - [0, 0, 200], cuts[0].axis),)), located,
                        TOOLS)[0]  # fmt: skip
    assert np.isnan(outside.exits_mm).all()
    assert not len(outside.strip().faces)


def test_distances_of_sweeps_are_those_of_the_line(
    plan: ResectionPlan, published: ResectionPlan, located: Located, level: Lines
) -> None:
    for sweep in sweeps_of(plan, located, TOOLS):
        near = sweep.near["tumor_1"]
        assert near.mm == pytest.approx(KEPT_MM, abs=0.15)
        assert near.axis_mm @ plan.facets[sweep.number - 1, :3] == pytest.approx(
            plan.facets[sweep.number - 1, 3]
        )
        assert np.linalg.norm(near.part_mm - TUMOR) == pytest.approx(TUMOR_MM, abs=0.1)
        assert sweep.lines[near.pose, 0, 1] == pytest.approx(TUMOR[1], abs=1.5)
    axis = np.array([0.0, 0.0, -1.0])  # straight ahead of the tip the distance is that of its end
    path = TUMOR + [[-3.0, 0.0, TUMOR_MM + 4.0], [0.0, 0.0, TUMOR_MM + 4.0]]
    over = sweeps_of(replace(plan, cuts=(Cut(1, path, axis),)), located, TOOLS)[0]
    assert over.near["tumor_1"].mm == pytest.approx(4.0, abs=0.1)
    upper, lower = sweeps_of(published, located, TOOLS, level)
    for sweep, height in ((upper, 160.2), (lower, 149.1)):
        np.testing.assert_allclose(sweep.lines[:, 0, 2], height)
        below = TUMOR[2] - height  # of the middle: as deep as a line so far from it can be
        assert sweep.near["tumor_1"].mm == pytest.approx(below - TUMOR_MM, abs=0.3)
    assert not any(sweep.near for sweep in sweeps_of(published, located, TOOLS))


def test_sections_contain_the_electrode_and_what_it_is_nearest_to(
    plan: ResectionPlan, published: ResectionPlan, located: Located, level: Lines
) -> None:
    for planned, poses in ((plan, None), (published, level)):
        figure = plan_figure(planned, located, TOOLS, poses)
        picture, sweeps = Picture(figure), sweeps_of(planned, located, TOOLS, poses)
        assert len(figure.axes) == 2 + len(sweeps)
        for n, sweep in enumerate(sweeps, start=2):
            view, frame = section_view(sweep, planned)
            near, middle = sweep.near["tumor_1"], sweep.lines[sweep.near["tumor_1"].pose]
            in_plane = view.project(np.stack([*middle, near.axis_mm, near.part_mm]))
            assert np.ptp(in_plane[:, 2]) < 0.5  # a shorter way gives no direction
            assert np.ptp(in_plane[:3, 2]) < 1e-6
            assert view.axes[1, 2] <= 1e-9  # up is up
            assert view.axes[0, 0] >= 0
            for x, y in in_plane[2:, :2]:
                assert frame.left < x < frame.right
                assert frame.top < y < frame.bottom
            colour = picture.at(n, view, middle[0] + 3.0 * sweep.back[near.pose])
            assert (np.abs(colour - sweep_colour(sweep.number, 2)).max(1) < 40).all()
            words = figure.axes[n].get_title()
            assert f"{abs(near.mm):.1f} mm" in words
            assert (figure.axes[n].title.get_color() == tuple(np.array(NONE) / 255)) == (
                near.mm < 0
            )


def test_parts_beside_each_other_are_seen_beside_each_other(
    plan: ResectionPlan, located: Located
) -> None:
    for other in ([-20.0, 10.0, 150.0], [18.0, 12.0, 140.0], [18.0, -6.0, 140.0]):
        meshes = {**located.meshes, "tumor_2": ellipsoid(np.array(other), 4.0)}
        view = side_view(plan, replace(located, meshes=meshes))
        flat = view.project(np.stack([TUMOR, other]))
        level_mm = np.linalg.norm((TUMOR - other)[:2])
        assert abs(np.diff(flat[:, 0])[0]) == pytest.approx(level_mm, abs=0.01)
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-9)
        assert view.down == (0.0, 0.0, -1.0)
        assert flat[0, 2] <= view.project(located.organ.box_mm.mean(0)[None])[0, 2] + 0.5


def test_the_cup_comes_from_where_the_piece_goes(plan: ResectionPlan, located: Located) -> None:
    lift = np.array([-0.6, 0.0, 0.8])
    picture = Picture(plan_figure(replace(plan, lift=lift), located))
    for n, view in enumerate((FROM_ABOVE, side_view(plan, located))):
        along = [picture.at(n, view, plan.grasp_mm + mm * lift, 2) for mm in (8, 12, 16, 20)]
        assert all((pixels.max(1) < 60).any() for pixels in along)
        mirrored = lift * [-1, -1, 1]
        other = [picture.at(n, view, plan.grasp_mm + mm * mirrored, 2) for mm in (12, 16, 20)]
        assert not any((pixels.max(1) < 60).any() for pixels in other)


def clearance(part: str, least_mm: float, solid: str = ELECTRODE) -> Clearance:
    return Clearance(solid, part, least_mm, least_mm, "sweep 1", 1.0, (0.0, 0.0, 0.0))


def words(figure: Figure) -> str:
    return " ".join(" ".join(text.get_text().split()) for text in figure.texts)


def test_least_distances_stand_in_the_title(plan: ResectionPlan, located: Located) -> None:
    two = {**located.meshes, "tumor_2": ellipsoid(np.array([-25.0, 5.0, 150.0]), 5.0)}
    found = [clearance("tumor_1", 4.87), clearance("tumor_2", 23.41), clearance("vein", 2.26)]
    found += [clearance("tumor_1", 0.31, "pencil")]
    checked = replace(plan, clearances=tuple(found))
    figure = plan_figure(checked, replace(located, meshes=two))
    title = figure.texts[0]
    for number in ("4.9", "23.4", "2.3"):
        assert number in title.get_text()
    assert "0.3" not in title.get_text()
    assert title.get_fontsize() >= 13
    assert title.get_weight() == "bold"
    assert "11.0 ml" in words(figure)  # of healthy tissue: with the kerf
    assert "2.5" in words(figure)
    assert "7%" in words(figure)
    foreseen = plan_figure(plan, located).texts[0].get_text()
    assert "5.0 mm from tumor_1" in foreseen
    assert "unchecked" in foreseen


def test_a_tumor_that_is_cut_is_a_warning(
    plan: ResectionPlan, published: ResectionPlan, located: Located
) -> None:
    into = replace(published, cuts=(Cut(1, ring(9.0, 160.0)), published.cuts[1]))
    warning = plan_figure(into, located).texts[0]
    assert CUTS_TUMOR in warning.get_text()
    paper = warning.get_bbox_patch()
    assert paper is not None
    assert np.allclose(paper.get_facecolor()[:3], np.array(NONE) / 255)
    note = f"{CUTS_TUMOR} tumor_1, up to 8.1 mm deep."
    found = (clearance("tumor_1", -8.1),)
    figure = plan_figure(replace(into, clearances=found, notes=(note,)), located)
    assert words(figure).count(CUTS_TUMOR) == 1
    assert CUTS_TUMOR not in words(plan_figure(plan, located))


def test_the_same_plan_is_the_same_file(
    plan: ResectionPlan, located: Located, tmp_path: Path
) -> None:
    for name in ("one.png", "two.png"):
        draw_plan(replace(plan, notes=("as it is",)), located, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert Image.open(tmp_path / "one.png").width == 1200
    odd = replace(located, patient=Patient(r"$\frac$", "left"))  # no formula
    draw_plan(plan, odd, tmp_path / "odd.png")
    figure = plan_figure(plan, odd)
    assert r"tumor 1, patient $\frac$, left side" in figure.texts[0].get_text()
    with pytest.raises(InputError, match="was not located"):
        draw_plan(replace(plan, label=3, tumor="tumor_2"), located, tmp_path / "none.png")


def test_surfaces_are_by_label(located: Located) -> None:
    meshes = organ_surfaces(located)
    assert meshes[1] is located.meshes["kidney"]
    assert meshes[2] is located.meshes["tumor_1"]


BLUE, RED = (0.16, 0.24, 0.86), (0.86, 0.2, 0.16)
OBLIQUE = Viewpoint.towards(np.zeros(3), np.array([0.0, -400.0, 300.0]), 200.0)


def test_the_nearer_body_is_seen_in_any_order() -> None:
    near, far = ellipsoid(np.array([0.0, -40.0, 30.0]), 15.0), ellipsoid(np.zeros(3), 30.0)
    for bodies in (
        [Body(near, RED), Body(far, BLUE)],
        [Body(far, BLUE), Body(near, RED)],
    ):
        picture = render(bodies, OBLIQUE, (160, 120)).astype(int)
        assert picture[60, 80, 0] > picture[60, 80, 2]
        assert picture[60, 98, 2] > picture[60, 98, 0]
    behind_cut = replace(OBLIQUE, before_mm=25.0)  # the near one begins 35 mm before the target
    picture = render([Body(near, RED), Body(far, BLUE)], behind_cut, (160, 120)).astype(int)
    assert picture[60, 80, 2] > picture[60, 80, 0]


@pytest.mark.parametrize("parallel", [False, True])
def test_a_body_covers_the_pixels_that_it_projects_to(parallel: bool) -> None:
    viewpoint = replace(OBLIQUE, parallel=parallel)
    place = np.array([35.0, -20.0, 12.0])
    picture = render([Body(ellipsoid(place, 4.0), BLUE)], viewpoint, (320, 240))
    rows, columns = np.nonzero(picture[:, :, 0] < 150)
    column, row, near = viewpoint.project(place[None], (320, 240))[0]
    np.testing.assert_allclose([columns.mean(), rows.mean()], [column, row], atol=0.6)
    mm = viewpoint.width_mm / 320 / (1.0 if parallel else viewpoint.distance_mm * near)
    assert len(rows) == pytest.approx(np.pi * (4 / mm) ** 2, rel=0.06)


def test_see_through_bodies_tint_what_is_behind_them_alone() -> None:
    down = Viewpoint.towards(np.zeros(3), np.array([0.0, -1.0, 400.0]), 100.0)
    plate = solid(trimesh.creation.box((90, 90, 2)))
    glass = Body(plate, BLUE, 0.4, rigid(np.eye(3), np.array([0.0, 0.0, 20.0])))
    under = replace(glass, world_from_mesh=rigid(np.eye(3), np.array([0.0, 0.0, -20.0])))
    red = Body(plate, RED)
    alone, both = (render(bodies, down, (64, 64))[32, 32] for bodies in ([red], [red, glass]))
    blue = render([replace(glass, opacity=1.0)], down, (64, 64))[32, 32]
    np.testing.assert_allclose(both, 0.6 * alone + 0.4 * blue, atol=2.0)
    np.testing.assert_array_equal(render([red, under], down, (64, 64))[32, 32], alone)


def test_edges_stay_sharp_and_balls_smooth() -> None:
    box = solid(trimesh.creation.box((10, 20, 30)))
    assert np.abs(corner_normals(box)).max(2) == pytest.approx(1.0)
    ball = ellipsoid(np.zeros(3), 1.0, 3)
    np.testing.assert_allclose(corner_normals(ball), ball.vertices_mm[ball.faces], atol=0.02)


def test_sweeps_have_colours_of_their_own() -> None:
    colours = [sweep_colour(n, 8) for n in range(1, 9)]
    assert len(set(colours)) == 8
    assert sweep_colour(1, 1) == sweep_colour(1, 8) == colours[0]
