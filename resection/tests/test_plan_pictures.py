"""Pictures and films of plans: what is drawn stands where it should, and no word is lost."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from live_objects import STAMP_NS, small_anatomy, small_setting, small_update
from picture_words import LONG, PATIENT, check
from plan_objects import TUMOR_MM, located, sphere
from tumortrack.core.colours import ENERGISED, NONE, NOW, sweep_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.core.patient import Patient
from tumortrack.core.types import Mesh
from tumortrack.live.values import RigidShape
from tumortrack.report.drawing import new_figure
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.film import TRUE, FilmSinkConfig, divided, film, moments
from tumortrack_resection.motions import Motions, MotionStage
from tumortrack_resection.operation import Operation, OperationConfig, Planned
from tumortrack_resection.pictures import ABOVE, Body, draw_plan, plan_figure, shaded, side_view
from tumortrack_resection.values import (
    CUTS_TUMOR,
    ELECTRODE,
    OVER_BUDGET,
    POOR_ESTIMATE,
    UNGUARDED,
    Clearance,
    Cut,
    Located,
    ResectionConfig,
    ResectionPlan,
)
from tumortrack_resection.workcell import Workcell

WARNINGS = (
    f"{POOR_ESTIMATE}: only 12% of the organ's surface is seen, and 3 of 1000 points lie farther "
    "than 5 mm from it; another organ, or another patient's: take a view from which more of it can "
    "be seen, uncover fat and drape, and locate again.",
    f"{OVER_BUDGET}: 18.6 mm of error, most of it tracking (15.5), against a margin of 4.9 mm.",
    f"{UNGUARDED} {', '.join(f'segmental_artery_of_the_lower_pole_{n}' for n in range(8))}.",
)


@cache
def seen() -> Located:
    return located(n=12_000)


@cache
def planned(method="margin") -> ResectionPlan:
    return plan_resection(seen(), ResectionConfig(method=method))


def pixels(figure: Figure) -> np.ndarray:
    figure.canvas.draw()  # type: ignore[attr-defined]
    return np.asarray(figure.canvas.buffer_rgba()).astype(int)[..., :3]  # type: ignore[attr-defined]


def around(figure: Figure, number: int, flat: np.ndarray, size: int = 2) -> np.ndarray:
    """The pixels at a place (right, down) of one of a figure's axes."""
    picture = pixels(figure)
    x, y = figure.axes[number].transData.transform(flat)
    row, column = round(picture.shape[0] - 1 - y), round(x)
    return picture[row - size : row + size + 1, column - size : column + size + 1].reshape(-1, 3)


def clearance(part: str, least_mm: float, solid: str = ELECTRODE) -> Clearance:
    return Clearance(solid, part, least_mm, least_mm, "sweep 1", 1.0, (0.0, 0.0, 0.0))


def words(figure: Figure) -> str:
    return " ".join(" ".join(text.get_text().split()) for text in figure.texts)


@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_no_word_of_a_plan_is_lost_and_warnings_come_first(count):
    warnings = (*WARNINGS, f"{OVER_BUDGET} {LONG}")[:count]
    notes = (*warnings, "tumor_2 comes away with tumor_1.", "a note that goes on " * 30)
    figure = plan_figure(replace(planned(), notes=notes), replace(seen(), patient=PATIENT))
    check(figure, warnings)
    told = "".join(words(figure).split())
    assert all("".join(note.split()) in told for note in notes)
    assert not any(word in figure.texts[count].get_text() for word in ("kept", "safe", "good"))


@pytest.mark.parametrize("method", ["margin", "published"])
def test_paths_are_drawn_where_they_are(method):
    plan = planned(method)
    figure = plan_figure(plan, seen())
    assert len(figure.axes) == 2 + (len(plan.cuts) if method == "margin" else 0)
    for n, view in enumerate((ABOVE, side_view(plan, seen()))):
        assert view @ view.T == pytest.approx(np.eye(3))
        assert np.linalg.det(view) == pytest.approx(1.0)
        colour = sweep_colour(plan.sweeps, plan.sweeps)  # drawn last
        path = plan.cuts[-1].path_mm[5:-5:9] @ view[:2].T
        near = [np.abs(around(figure, n, at) - colour).max(1).min() < 40 for at in path]
        assert np.mean(near) > 0.7
    tumor_2 = sphere(TUMOR_MM + [-30.0, 10.0, 0.0], 4.0)
    two = replace(seen(), meshes={**seen().meshes, "tumor_2": tumor_2})
    flat = np.stack([TUMOR_MM, TUMOR_MM + [-30.0, 10.0, 0.0]]) @ side_view(plan, two).T
    assert abs(np.diff(flat[:, 0])[0]) == pytest.approx(np.hypot(30, 10), abs=0.5)  # side by side


def test_a_section_says_how_near_the_electrode_comes():
    plan = planned()
    for axes in plan_figure(plan, seen()).axes[2:]:
        mm = float(axes.get_title().split(": ")[1].split(" mm")[0])
        assert mm == pytest.approx(plan.margin_mm, abs=0.3)
    into = replace(plan.cuts[0], path_mm=plan.cuts[0].path_mm * 0 + TUMOR_MM)
    title = plan_figure(replace(plan, cuts=(into,), facets=plan.facets[:1]), seen()).axes[2].title
    assert "INTO" in title.get_text()
    assert title.get_color() == pytest.approx(np.array(NONE) / 255)


def test_least_distances_stand_in_the_title():
    two = {**seen().meshes, "tumor_2": sphere([-25.0, 5.0, 150.0], 5.0)}
    found = [clearance("tumor_1", 4.87), clearance("tumor_2", 23.41), clearance("vein", 2.26)]
    found += [clearance("tumor_1", 0.31, "pencil")]
    checked = replace(planned(), clearances=tuple(found))
    title = plan_figure(checked, replace(seen(), meshes=two)).texts[0].get_text()
    assert [n in title for n in ("4.9", "23.4", "2.3", "0.3 ")] == [True, True, True, False]
    assert "unchecked" in plan_figure(planned(), seen()).texts[0].get_text()


def test_a_tumor_that_is_cut_is_a_warning():
    through = Cut(1, TUMOR_MM + np.linspace([-20.0, 0, 0], [20, 0, 0], 30))
    into = replace(planned("published"), cuts=(through,))
    warning = plan_figure(into, seen()).texts[0]
    assert CUTS_TUMOR in warning.get_text()
    assert np.allclose(warning.get_bbox_patch().get_facecolor()[:3], np.array(NONE) / 255)
    note = f"{CUTS_TUMOR} tumor_1, up to 8.1 mm deep."
    checked = replace(into, clearances=(clearance("tumor_1", -8.1),), notes=(note,))
    assert words(plan_figure(checked, seen())).count(CUTS_TUMOR) == 1
    assert CUTS_TUMOR not in words(plan_figure(planned(), seen()))


def test_the_same_plan_is_the_same_file(tmp_path: Path):
    odd = replace(seen(), patient=Patient(r"$\frac$", "left"))  # no formula
    for name in ("one.png", "two.png"):
        draw_plan(planned(), odd, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert Image.open(tmp_path / "one.png").width == 1200
    with pytest.raises(InputError):
        draw_plan(replace(planned(), tumor="tumor_2"), seen(), tmp_path / "none.png")


def test_nearer_surfaces_hide_what_is_behind_them():
    balls = [Body(sphere([0, 0, 0], 30.0), (40, 60, 220)), Body(sphere([0, 0, 40], 15.0), NONE)]
    for bodies in (balls, balls[::-1]):
        figure = new_figure(2.0, 2.0)
        axes = figure.add_axes((0, 0, 1, 1))
        shaded(axes, bodies, ABOVE)
        axes.set(xlim=(-40, 40), ylim=(40, -40))
        middle, edge = (around(figure, 0, np.array([x, 0.0]))[0] for x in (0.0, 22.0))
        assert middle[0] > 2 * middle[2]  # from above
        assert edge[2] > 2 * edge[0]


# Films --------------------------------------------------------------------------------------------

LASTING = {"approach": 4.0, "grasp": 1.0, "hold": 0.0, "sweep 1": 64.0, "lift": 1.0, "home": 4.0}


def solid(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(shape.vertices, shape.faces)


def acted(*states: str) -> Motions:
    """The first joint is the cutter's place, the seventh the cup's height, mm."""
    stages = []
    for name in states:
        times = np.array([0.0, LASTING[name]]) if LASTING[name] else np.zeros(1)
        joints = np.zeros((len(times), 12))
        joints[-1, [0, 6]] = 60.0, 60.0 * (name == "lift")
        cutting = np.full(len(times), name.startswith("sweep"))
        stages.append(MotionStage(name, times, joints, cutting))
    return Motions(tuple(stages))


def draw(joints_rad: np.ndarray) -> tuple[RigidShape, ...]:
    cup = rigid(np.eye(3), planned().grasp_mm + [0.0, 0.0, 5.0 + joints_rad[6]])
    rod = rigid(np.eye(3), np.array([60.0 + joints_rad[0], 0.0, 150.0]))
    return (
        RigidShape(
            "table", solid(trimesh.creation.box((900, 600, 20))), np.eye(4), (180, 190, 200)
        ),
        RigidShape("holder/cup", solid(trimesh.creation.cylinder(5, 10)), cup, (70, 76, 92)),
        RigidShape(
            "cutter/electrode", solid(trimesh.creation.cylinder(9, 60)), rod, (120, 120, 120)
        ),
    )


def filmed(motions: Motions, path: Path, plan: ResectionPlan) -> list[np.ndarray]:
    seconds, pictures = film(plan, seen(), motions, draw, path), []
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0
        for n in range(gif.n_frames):  # type: ignore[attr-defined]
            gif.seek(n)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    assert seconds == pytest.approx(len(pictures) / 10, abs=1)
    return pictures


def test_every_stage_has_its_moments():
    found = {name: 0 for name in LASTING}
    for moment in moments(acted(*LASTING), 130):
        found[moment.stage.name] += 1
        assert moment.cutting == (moment.stage.name == "sweep 1")
    assert sum(found.values()) == pytest.approx(130, abs=6)
    assert found["sweep 1"] == pytest.approx(4 * found["approach"], abs=3)  # 16 times as long
    assert min(found.values()) >= 3


def test_a_film_shows_every_frame_what_moves_and_its_words(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("tumortrack_resection.film.FRAMES", 6)
    warned, motions = replace(planned(), notes=WARNINGS[:2]), acted("approach", "sweep 1")
    pictures = filmed(motions, tmp_path / "a.gif", warned)
    assert all(((a != b).any(2).sum() > 50) for a, b in pairwise(pictures))
    blue = [(np.abs(picture - ENERGISED).max(2) < 60).sum() for picture in pictures]
    assert max(blue[:3]) < 20 < min(blue[4:])  # while it cuts
    plain = filmed(motions, tmp_path / "c.gif", planned())
    assert pictures[0].shape[0] > plain[0].shape[0] > 480  # room for every word
    red = [(np.abs(picture - NONE).max(2) < 40).sum() for picture in (*pictures, plain[0])]
    assert min(red[:-1]) > 5_000 > red[-1]
    with pytest.raises(InputError):
        film(planned(), seen(), motions, draw, tmp_path / "a.mp4")


def test_a_film_of_what_is_followed_shows_it_over_the_truth_and_why_the_arms_stand(tmp_path: Path):
    """Also while nothing is found; with every word."""
    stick = trimesh.creation.box((3, 3, 150))
    shapes = (
        RigidShape(
            "cutter/electrode", solid(stick), rigid(np.eye(3), np.array([60.0, 0, 80])), NOW
        ),
    )
    cell = Workcell("sweep 2", line="arms: sweep 2", shapes=shapes)
    halted = replace(cell, stopped="planning again")
    of = Planned(planned(), seen().meshes, acted("sweep 1"))
    arms = replace(small_setting(), controller=Operation(of, OperationConfig(), draw))
    sink = FilmSinkConfig(path=tmp_path / "a.gif", every_s=0.1).open(arms)
    there = small_anatomy()
    lower = there.with_parts(p.with_vertices(p.vertices_mm + [0, 0, 12.0]) for p in there.parts)
    for n in range(6):
        result = replace(small_update(n, STAMP_NS + n * 50_000_000), control=cell)
        seen_there = replace(result.observation, truth=lower if n == 2 else there)
        if n < 5:
            result = replace(result, observation=seen_there)
        if n == 4:
            result = replace(result, estimate=None, quality="none", control=halted)
        sink.publish(result)
    sink.publish(replace(small_update(9, STAMP_NS + 9_000_000_000), control=None))
    sink.close()
    with Image.open(tmp_path / "a.gif") as gif:
        pictures = []
        for n in range(gif.n_frames):
            gif.seek(n)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    assert len(pictures) == 3  # of seven results, 0.1 s apart or more, with arms
    dark, red = (
        [int((np.abs(p - colour).max(2) < 45).sum()) for p in pictures] for colour in (TRUE, NONE)
    )
    orange = [((p[..., 0] > p[..., 2] + 60) & (p[..., 1] > p[..., 2] + 30)).sum() for p in pictures]
    assert dark[1] > dark[0] + 50  # where the truth lies elsewhere
    assert orange[2] < min(orange[:2]) / 2  # nothing was found
    assert red[2] > 1000 > max(red[:2])
    with pytest.raises(InputError):
        FilmSinkConfig(path=tmp_path / "a.mp4")
    with pytest.raises(InputError):
        FilmSinkConfig(path=tmp_path / "a.gif").open(arms)  # it is there
    with pytest.raises(InputError):
        FilmSinkConfig(path=tmp_path / "b.gif").open(small_setting())


def test_the_piece_leaves_with_the_holder(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("tumortrack_resection.film.FRAMES", 6)
    two = {**seen().meshes, "tumor_2": sphere([-25.0, 5.0, 150.0], 5.0)}
    stays, goes = divided(replace(seen(), meshes=two), planned())
    organ_mm3 = seen().organ.volume_mm3
    kerf_mm3 = organ_mm3 - stays[0].mesh.volume_mm3 - goes[0].mesh.volume_mm3
    assert kerf_mm3 == pytest.approx(1000 * planned().volumes_ml["kerf"], rel=0.3)
    assert [body.mesh for body in goes[1:]] == [two["tumor_1"]]
    assert [body.mesh for body in stays[1:]] == [two["tumor_2"]]
    stays, goes = divided(seen(), planned("published"))
    parted_mm3 = stays[0].mesh.volume_mm3 + goes[0].mesh.volume_mm3
    assert parted_mm3 == pytest.approx(organ_mm3, rel=1e-3)
    pictures = filmed(acted("sweep 1", "lift", "home"), tmp_path / "film.gif", planned())
    rows = [
        np.nonzero((p[..., 0] > p[..., 2] + 90) & (p[..., 1] > p[..., 2] + 50))[0] for p in pictures
    ]
    assert min(map(len, rows[:3])) > 100  # the tumor's orange
    assert rows[5].mean() < rows[3].mean()  # it goes up
    assert len(rows[-1]) < len(rows[0]) / 4  # it is gone
