"""Pictures of a plan and the film: what is drawn stands where it should, and moves."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from live_objects import small_update
from tumortrack.core.colours import sweep_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.core.mesh_query import contains
from tumortrack.core.patient import Patient
from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.live.values import Polyline, RigidShape, Workcell
from tumortrack.report.renderer import Body, Viewpoint, corner_normals, render
from tumortrack_resection.film import Reel, Tracked, film, moments_s, tube
from tumortrack_resection.motions import PULL, Motions, MotionStage
from tumortrack_resection.pictures import (
    draw_plan,
    organ_surfaces,
    parted,
    plan_figure,
)
from tumortrack_resection.values import Cut, CutLayer, Located, ResectionPlan
from workcell_objects import stopped

CENTRE, RADII = np.array([0.0, 0.0, 145.0]), np.array([55.0, 30.0, 25.0])
TUMOR, TUMOR_MM = np.array([18.0, -6.0, 163.0]), 14.0


def solid(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(shape.vertices, shape.faces)


def ellipsoid(centre: np.ndarray, radii: np.ndarray | float, fine: int = 3) -> Mesh:
    ball = trimesh.creation.icosphere(fine)
    return Mesh(ball.vertices * radii + centre, ball.faces)


def ring(radius_mm: float, height_mm: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 90)
    x, y = TUMOR[:2, None] + radius_mm * np.stack([np.cos(turn), np.sin(turn)])
    return np.stack([x, y, np.full(90, height_mm)], axis=1)


@pytest.fixture(scope="module")
def located() -> Located:
    tumor = ellipsoid(TUMOR, TUMOR_MM)
    kidney = mesh_of(solid_of(ellipsoid(CENTRE, RADII), "organ") + solid_of(tumor, "tumor"))
    points = np.random.default_rng(0).uniform(*kidney.box_mm, (20_000, 3))
    in_tumor = np.linalg.norm(points - TUMOR, axis=1) < TUMOR_MM
    in_organ = np.linalg.norm((points - CENTRE) / RADII, axis=1) < 1
    labels = np.where(in_tumor, 2, np.where(in_organ, 1, 0)).astype(np.uint8)
    return Located(points[labels > 0], labels[labels > 0], {"kidney": kidney, "tumor_1": tumor})


@pytest.fixture(scope="module")
def plan() -> ResectionPlan:
    return ResectionPlan(
        method="published",
        tumor="tumor_1",
        label=2,
        grasp_mm=TUMOR + [0, 0, TUMOR_MM],
        cuts=(Cut(1, ring(19.0, 160.0)), Cut(2, ring(19.0, 149.0))),
        layers=(CutLayer(149.0, np.inf, (ring(19.0, 0.0)[:-1, :2],)),),
        margin_mm=5.0,
        volumes_ml={
            "organ": 180.0,
            "parenchyma": 168.5,
            "tumor": 11.5,
            "piece": 20.0,
            "healthy": 8.5,
        },
        exophytic=0.5,
    )


def test_strokes_and_tumor_are_drawn_where_they_are(plan: ResectionPlan, located: Located) -> None:
    figure = plan_figure(plan, located)
    figure.canvas.draw()  # type: ignore[attr-defined]
    picture = np.asarray(figure.canvas.buffer_rgba())[:, :, :3].astype(int)  # type: ignore[attr-defined]

    def colour_at(panel: int, point_mm: np.ndarray, reach: int = 1) -> np.ndarray:
        """The pixels around a place of the table."""
        flat = point_mm[:2] * [1, -1] if panel == 0 else point_mm[[0, 2]] * [1, -1]
        x, y = figure.axes[panel].transData.transform(flat)
        row, column = round(picture.shape[0] - y - 0.5), round(x - 0.5)
        around = (slice(middle - reach, middle + reach + 1) for middle in (row, column))
        return picture[tuple(around)].reshape(-1, 3)

    near = {  # share of a stroke's points that have its colour, in both panels
        (panel, cut.sweep): np.mean(
            [
                (np.abs(colour_at(panel, p, 3) - sweep_colour(cut.sweep, 2)).max(1) < 30).any()
                for p in cut.path_mm[contains(located.meshes["kidney"], cut.path_mm)]
            ]
        )
        for panel in (0, 1)
        for cut in plan.cuts
    }
    assert min(near.values()) > 0.7  # from above too: the lower stroke shows beside the upper
    red, green, blue = colour_at(1, TUMOR + [0, 0, 8]).T
    assert (red > green + 40).all()  # the first tumor's orange
    assert (green > blue + 80).all()
    assert (picture[:3] == 255).all()


def test_the_piece_and_the_rest_are_the_organ(located: Located) -> None:
    half = np.array([[-99.0, -99.0], [CENTRE[0], -99.0], [CENTRE[0], 99.0], [-99.0, 99.0]])
    ball = ellipsoid(CENTRE, 20.0, 4)
    piece, rest = parted(
        ball, (CutLayer(CENTRE[2], np.inf, (half,)), CutLayer(100.0, CENTRE[2], (half,)))
    )
    assert piece.volume_mm3 == pytest.approx(ball.volume_mm3 / 2, rel=1e-3)
    assert rest.volume_mm3 == pytest.approx(ball.volume_mm3 / 2, rel=1e-3)
    assert piece.box_mm[1, 0] == pytest.approx(CENTRE[0])
    quarter, _ = parted(ball, (CutLayer(CENTRE[2], np.inf, (half[::-1],)),))  # either way round
    assert quarter.volume_mm3 == pytest.approx(ball.volume_mm3 / 4, rel=1e-3)


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


def test_a_line_becomes_a_closed_tube() -> None:
    turn = np.linspace(0, 1.5 * np.pi, 200)
    path = np.stack([50 * np.cos(turn), 50 * np.sin(turn), 10 * turn], axis=1)
    mesh = tube(path, 1.0, sides=24)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert mesh.volume_mm3 == pytest.approx(np.pi * length, rel=0.02)
    shape = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    assert shape.is_watertight
    assert shape.is_winding_consistent


@pytest.fixture(scope="module")
def workcells(plan: ResectionPlan) -> list[Workcell]:
    """A table, and two arms of which one comes nearer to the organ."""
    table = solid(trimesh.creation.box((900, 600, 20)))
    rod = solid(trimesh.creation.cylinder(20, 300))
    cuts = tuple(Polyline(f"cut/{c.sweep}", c.path_mm, sweep_colour(c.sweep, 2)) for c in plan.cuts)
    grey, frames = (180, 190, 200), []
    for n in range(6):
        places = {
            "table": rigid(np.eye(3), np.array([0.0, 0.0, -10.0])),
            "holder/rod": rigid(np.eye(3), np.array([-300.0, 0.0, 150.0])),
            "cutter/rod": rigid(np.eye(3), np.array([300.0 - 30 * n, 0.0, 150.0])),
        }
        shapes = tuple(
            RigidShape(name, table if name == "table" else rod, place, grey)
            for name, place in places.items()
        )
        frames.append(Workcell("approach" if n < 3 else "sweep 1", None, {}, shapes, cuts))
    return frames


def test_the_film_shows_every_frame_and_what_moves(
    workcells: list[Workcell], located: Located, tmp_path: Path
) -> None:
    told: list[int] = []
    path = tmp_path / "film.gif"
    film(iter(workcells), located, path, (320, 240), lambda: told.append(1))
    assert len(told) == 6
    pictures, lasting = [], []
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.width, gif.info["loop"]) == (6, 320, 0)  # type: ignore[attr-defined]
        strip = gif.height - 240  # of words
        for n in range(6):
            gif.seek(n)
            lasting.append(gif.info["duration"])
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    assert lasting == [100] * 5 + [1600]
    moved = np.stack([(a != b).any(2) for a, b in pairwise(pictures)])
    assert (moved.sum((1, 2)) > 50).all()
    holder = moved[:, strip + 45 : strip + 130, :100]
    assert holder.sum() < 0.02 * moved.sum()  # it stands still
    assert (moved[2, :strip] | ~moved[[0, 1, 3, 4], :strip].any(0)).all()  # the words change
    assert moved[2, :strip].sum() > 50
    close = pictures[0][strip + 130 :, 170:]
    for sweep in (1, 2):  # the cuts show in the close-up
        assert (np.abs(close - sweep_colour(sweep, 2)).max(2) < 60).sum() > 20


def test_the_same_frames_are_the_same_film(
    workcells: list[Workcell], located: Located, tmp_path: Path
) -> None:
    halted = [replace(workcells[0], halt=stopped("no fresh estimate")), workcells[1]]
    for name in ("one.gif", "two.gif"):
        film(halted, located, tmp_path / name, size=(200, 160))
    assert (tmp_path / "one.gif").read_bytes() == (tmp_path / "two.gif").read_bytes()
    with Image.open(tmp_path / "one.gif") as gif:
        picture = np.asarray(gif.convert("RGB")).astype(int)
    red = (picture[..., 0] > picture[..., 1] + 90) & (picture[..., 0] > picture[..., 2] + 90)
    assert red[:-160].sum() > 10  # that it stands still is said in red


def test_the_film_of_a_run_shows_the_organ_where_it_was_tracked(
    workcells: list[Workcell], located: Located, tmp_path: Path
) -> None:
    reel, up_mm = Reel(), (0.0, 0.0, 12.0)
    cell = replace(
        workcells[0], state=f"{PULL} (with a note)", lines=(), shapes=workcells[0].shapes
    )
    for n in range(3):
        update = small_update(stamp_ns=n * 10**9)
        meshes = {
            name: mesh.moved(mesh.vertices_mm + [0.0, 0.0, up_mm[n]])
            for name, mesh in located.meshes.items()
        }
        estimate = None if n == 1 else replace(update.estimate, meshes=meshes)  # type: ignore[type-var]
        reel.publish(replace(update, workcell=cell, estimate=estimate))
        reel.publish(replace(update, workcell=cell, estimate=estimate))  # too soon
    reel.close()
    cells, seen = reel.frames(3)
    assert len(cells) == len(seen) == 3
    assert seen[1] is seen[0]  # without an estimate as it was last
    film(cells, located, tmp_path / "film.gif", (320, 240), tracked=Tracked("A RUN", seen))
    with Image.open(tmp_path / "film.gif") as gif:
        pictures = []
        for n in range(gif.n_frames):  # type: ignore[attr-defined]
            gif.seek(n)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    last, first = pictures[-1], pictures[0]
    assert (np.abs(last - first).max(2) > 30).sum() > 100  # it has moved
    with pytest.raises(InputError, match="never located"):
        Reel().frames(3)
    for n in range(3000):  # however long a stage lasts
        reel.publish(replace(update, stamp_ns=n * 10**9, workcell=cell))
    assert 30 <= len(reel.frames(10**6)[0]) <= 61


def test_every_stage_has_its_moments() -> None:
    def stage(name: str, seconds: float) -> MotionStage:
        times = np.array([0.0, seconds]) if seconds else np.zeros(1)
        return MotionStage(name, times, np.zeros((len(times), 12)), np.zeros(len(times), bool))

    lasting = {"approach": 4.0, "grasp": 1.0, "hold": 0.0, "sweep 1": 64.0, "home": 4.0}
    motions = Motions(tuple(stage(name, seconds) for name, seconds in lasting.items()))
    moments = moments_s(motions, 130)
    assert (np.diff(moments) >= 0).all()
    assert (moments[0], moments[-1]) == (0.0, motions.seconds)
    assert len(moments) == pytest.approx(130, abs=6)
    ends = np.cumsum(list(lasting.values()))
    found = [int(((moments >= end - s) & (moments < end)).sum()) for end, s in
             zip(ends, lasting.values(), strict=True)]  # fmt: skip
    assert found[3] == pytest.approx(4 * found[0], abs=3)  # 16 times as long
    assert found[0] == pytest.approx(2 * found[1], abs=1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"path": "film.mp4"}, "animated GIF"),
        ({"frames": []}, "no frame"),
        ({"frames": [Workcell("approach")]}, "nothing to film"),
    ],
)
def test_a_film_that_cannot_be(
    change: dict, said: str, workcells: list[Workcell], located: Located, tmp_path: Path
) -> None:
    asked: dict = {"frames": workcells[:1], "located": located, "path": "film.gif"} | change
    with pytest.raises(InputError, match=said):
        film(**asked | {"path": tmp_path / asked["path"]})
    assert not list(tmp_path.iterdir())


def test_sweeps_have_colours_of_their_own() -> None:
    colours = [sweep_colour(n, 8) for n in range(1, 9)]
    assert len(set(colours)) == 8
    assert sweep_colour(1, 1) == sweep_colour(1, 8) == colours[0]


def test_the_piece_leaves_with_the_holder(
    workcells: list[Workcell], located: Located, plan: ResectionPlan, tmp_path: Path
) -> None:
    cup = solid(trimesh.creation.cylinder(5, 10))
    frames = []
    for state, up_mm in (
        ("sweep 2", 0.0),
        ("lift", 0.0),
        ("lift", 60.0),
        ("release", 60.0),
        ("home", 90.0),
    ):
        place = rigid(np.eye(3), plan.grasp_mm + [0, 0, 5 + up_mm])
        shapes = (*workcells[0].shapes, RigidShape("holder/cup", cup, place, (70, 76, 92)))
        frames.append(replace(workcells[0], state=state, shapes=shapes, lines=()))
    film(frames, located, tmp_path / "film.gif", (320, 240), plan=plan)
    with Image.open(tmp_path / "film.gif") as gif:
        pictures = []
        for n in range(5):
            gif.seek(n)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int)[-105:-15, -140:-10])
    orange = [
        ((p[..., 0] > p[..., 2] + 90) & (p[..., 1] > p[..., 2] + 50)).astype(bool) for p in pictures
    ]
    there, begun, lifted, released, home = (int(where.sum()) for where in orange)
    assert there > 300
    assert begun > 300
    rows = [np.nonzero(where)[0] for where in orange]
    assert lifted == 0 or rows[2].mean() < rows[0].mean() - 10  # higher, or out of the close-up
    assert abs(released - lifted) < 20
    assert home == 0
