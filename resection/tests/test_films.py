"""Films of plans and runs: what is drawn stands where it should, and moves."""

# ruff: noqa: F811 (fixtures)

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from live_objects import small_update
from picture_objects import TOOLS, ellipsoid, located, plan, published, solid, workcells  # noqa: F401 (fixtures)
from tumortrack.core.colours import ENERGISED, sweep_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.live.values import RigidShape, TrackingResult, Workcell
from tumortrack_resection.arms.body import BLUE as PENCIL
from tumortrack_resection.arms.body import YELLOW
from tumortrack_resection.film import Reel, Tracked, divided, film, moments_s, tube
from tumortrack_resection.motions import PULL, Motions, MotionStage
from tumortrack_resection.operation import Operation, OperationConfig, Planned
from tumortrack_resection.sweeps import sweeps_of
from tumortrack_resection.values import Located, ResectionPlan
from workcell_objects import stopped


def test_a_line_becomes_a_closed_tube() -> None:
    turn = np.linspace(0, 1.5 * np.pi, 200)
    path = np.stack([50 * np.cos(turn), 50 * np.sin(turn), 10 * turn], axis=1)
    mesh = tube(path, 1.0, sides=24)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert mesh.volume_mm3 == pytest.approx(np.pi * length, rel=0.02)
    shape = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    assert shape.is_watertight
    assert shape.is_winding_consistent


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


def test_what_comes_away_leaves_a_gap_as_wide_as_the_electrode(
    plan: ResectionPlan, published: ResectionPlan, located: Located
) -> None:
    meshes = {**located.meshes, "tumor_2": ellipsoid(np.array([-25.0, 5.0, 150.0]), 5.0)}
    meshes["tumor_3"] = ellipsoid(np.array([20.0, 10.0, 150.0]), 3.0)
    three = replace(located, meshes=meshes)
    both = replace(plan, taken=("tumor_1", "tumor_3"))
    stays, goes = divided(three, both)
    organ_mm3 = located.organ.volume_mm3
    kerf_mm3 = organ_mm3 - stays[0].mesh.volume_mm3 - goes[0].mesh.volume_mm3
    strips = [sweep.strip() for sweep in sweeps_of(plan, located, TOOLS)]
    area_mm2 = sum(trimesh.Trimesh(s.vertices_mm, s.faces).area for s in strips)
    assert kerf_mm3 == pytest.approx(2 * TOOLS.radius_mm * area_mm2, rel=0.1)
    assert [body.mesh for body in goes[1:]] == [meshes["tumor_1"], meshes["tumor_3"]]
    assert [body.mesh for body in stays[1:]] == [meshes["tumor_2"]]
    stays, goes = divided(located, published)
    parted_mm3 = stays[0].mesh.volume_mm3 + goes[0].mesh.volume_mm3
    assert parted_mm3 == pytest.approx(organ_mm3, rel=1e-3)


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


def electrode(colour: tuple[int, int, int]) -> RigidShape:
    place = rigid(np.eye(3), np.array([-20.0, -60.0, 150.0]))
    return RigidShape("cutter/electrode", solid(trimesh.creation.box((50, 3, 3))), place, colour)


def test_the_electrode_has_a_colour_of_its_own_while_it_is_energised(
    plan: ResectionPlan, located: Located
) -> None:
    def draw(joints: np.ndarray) -> tuple[RigidShape, ...]:
        return electrode(YELLOW), replace(electrode(PENCIL), name="cutter/pencil")

    times_s = np.linspace(0, 6, 61)
    joints_rad = np.outer(times_s, np.full(12, 0.01))
    cutting = (times_s > 2) & (times_s < 4)
    motions = Motions((MotionStage("sweep 1", times_s, joints_rad, cutting),))
    operation = Operation(Planned(plan, located.meshes, motions), OperationConfig(), draw)
    seen = []
    for now_s in np.arange(0, 7, 0.1):
        cell = operation.act(TrackingResult(0, 0), now_s).workcell
        assert cell is not None
        colours = {shape.name: shape.colour for shape in cell.shapes}
        assert colours["cutter/electrode"] == (ENERGISED if cell.cutting else YELLOW)
        assert colours["cutter/pencil"] == PENCIL
        seen.append(cell.cutting)
    assert 15 <= sum(seen) <= 20
    assert not seen[0]
    assert not seen[-1]


def test_the_film_shows_when_the_electrode_is_energised(
    workcells: list[Workcell], located: Located, tmp_path: Path
) -> None:
    frames = [
        replace(workcells[0], cutting=cuts, lines=(),
                shapes=(*workcells[0].shapes, electrode(ENERGISED if cuts else YELLOW)))
        for cuts in (False, True)
    ]  # fmt: skip
    film(frames, located, tmp_path / "film.gif", (320, 240))
    pictures = []
    with Image.open(tmp_path / "film.gif") as gif:
        for n in range(2):
            gif.seek(n)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    violet = [(p[..., 2] > p[..., 0] + 60) & (p[..., 2] > p[..., 1] + 100) for p in pictures]
    assert violet[1].sum() > violet[0].sum() + 30
    words = [p[:-240] for p in pictures]
    assert (words[0] != words[1]).any()
