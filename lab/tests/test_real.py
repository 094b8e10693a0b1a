"""Real organs and deformations: the frozen list, landmarks laid on an organ, a slab made whole."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from live_objects import small_anatomy
from reports import report_of
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points, triangles_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.real import kidneys, lungs, silicone
from tumortrack_lab.study.document import MeasuredTable, ReportWriter

SCRIPT = Path(__file__).parents[2] / "lab" / "scripts" / "real.py"
ORGAN = small_anatomy().organ


def voxels(rng: np.random.Generator) -> np.ndarray:
    """(row, column, slice), all over a chest."""
    return rng.uniform([50, 20, 5], [200, 240, 90], (1500, 3))


def landmarks(tmp_path: Path, patient: int, exhaled: np.ndarray, inhaled: np.ndarray):
    path = lungs.landmark_file(tmp_path, patient)
    path.parent.mkdir(exist_ok=True)
    savemat(path, {"landmark_EE": exhaled, "landmark_EI": inhaled})
    return lungs.read_landmarks(path, patient)


def linear_field(matrix: np.ndarray, shift_mm: tuple = (4.0, -3.0, 9.0)) -> lungs.Field:
    """Every point of the lung at ``matrix`` x + shift; LPS, mm."""
    points_mm = np.random.default_rng(1).uniform(-110, 110, (1500, 3))
    return lungs.Field(lungs.Landmarks(points_mm, points_mm @ matrix.T + shift_mm))


def test_the_frozen_list_is_what_its_rule_says_and_has_no_case_that_is_set_aside():
    rows = kidneys.frozen()
    numbers = [row["case"] for row in rows]
    assert len(set(numbers)) == len(rows) == 12
    assert not set(numbers) & {0, 2, 3, 91, 93, 96, 146, 155}
    assert len({row["sha256"] for row in rows}) == len(rows)
    assert [row["kind"] for row in rows] == [*kidneys.KINDS] * 6  # in turn
    for row in rows:
        assert re.fullmatch("[0-9a-f]{64}", row["sha256"])
        assert row["side"] in ("left", "right")
        assert row["kind"] == kidneys.kind_of(row["outer_share"])
        assert 100 <= row["organ_ml"] <= 400
        assert 1 <= row["tumors_ml"][0] <= 100
        assert row["tumors_ml"] == sorted(row["tumors_ml"], reverse=True)


def test_a_case_that_is_set_aside_is_not_loaded_and_a_missing_one_says_where_it_comes_from(
    tmp_path,
):
    for number in (91, 1):
        (tmp_path / "kits19" / kidneys.name_of(number)).mkdir(parents=True)
    (tmp_path / "kits19" / "case_00091" / "segmentation.nii.gz").write_bytes(b"there")
    with pytest.raises(InputError, match="case_00091 is set aside"):
        kidneys.label_map(tmp_path, 91)
    with pytest.raises(InputError, match=r"put a copy of .*neheller/kits19"):
        kidneys.label_map(tmp_path, 1)


def test_a_label_map_of_another_hash_is_refused(tmp_path):
    row = kidneys.frozen()[0]
    path = tmp_path / "kits19" / kidneys.name_of(row["case"]) / "segmentation.nii.gz"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"another")
    with pytest.raises(InputError, match="is not the file in the list"):
        kidneys.check(tmp_path, tmp_path / "cases", [row])


def test_the_outer_share_counts_the_tumors_surface_that_is_near_the_organs():
    middle = ORGAN.vertices_mm.mean(0)
    inner = ORGAN.moved(middle + 0.3 * (ORGAN.vertices_mm - middle))
    assert kidneys.outer_share(ORGAN, ORGAN) == 1
    assert kidneys.outer_share(inner, ORGAN) == 0
    assert kidneys.kind_of(0.249) == "endophytic"
    assert kidneys.kind_of(0.25) == kidneys.kind_of(0.499) == "between"
    assert kidneys.kind_of(0.5) == kidneys.kind_of(1.0) == "exophytic"


def test_landmarks_are_rows_columns_and_slices_with_the_images_spacing(tmp_path):
    exhaled = voxels(np.random.default_rng(0))
    moved = exhaled + [2.0, -1.0, 3.0]  # down the rows, against the columns, down the slices
    given = landmarks(tmp_path, 2, exhaled, moved)  # 1.16 mm in the plane
    off_mm = given.inhaled_mm - given.exhaled_mm
    np.testing.assert_allclose(off_mm, [[-1.16, 2 * 1.16, -7.5]] * len(off_mm), atol=1e-5)
    at_mm = lungs.Field(given).at(np.array([[150.0, 140.0, -120.0]]))
    np.testing.assert_allclose(at_mm, [[-1.16, 2.32, -7.5]], atol=1e-3)
    assert lungs.held_out_mm(given, lungs.SMOOTHING, np.random.default_rng(0)).max() < 1e-3
    with pytest.raises(InputError, match="shapes"):
        landmarks(tmp_path, 2, exhaled, moved[:-1])
    with pytest.raises(InputError, match="deshanyang/DIR-QA"):
        lungs.read_landmarks(tmp_path / "case3.mat", 3)


def test_a_lung_that_only_turns_and_grows_leaves_its_growth_or_nothing():
    turn = Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix()
    found = lungs.states(linear_field(1.1 * turn), ORGAN, np.random.default_rng(2))
    vertices = ORGAN.vertices_mm
    grown = ORGAN.moved(found["as in the lung"].apply(vertices))
    assert grown.volume_mm3 / ORGAN.volume_mm3 == pytest.approx(1.1**3, rel=1e-4)
    np.testing.assert_allclose(found["volume kept"].apply(vertices), vertices, atol=0.01)
    np.testing.assert_allclose(found["volume kept"].stretch(vertices[:9]), 1, atol=1e-3)


def test_a_stretch_of_the_lung_is_laid_on_the_organ_in_its_own_directions_and_to_scale():
    stretched = np.diag([1.0, 1.0, 1.3])  # from head to feet
    state = lungs.states(linear_field(stretched), ORGAN, np.random.default_rng(3))["as in the lung"]
    along_ct = np.linalg.inv(state.lung_from_ct)[:3, :3] @ [0, 0, 1]
    along_ct /= np.linalg.norm(along_ct)
    middle = ORGAN.vertices_mm.mean(0)
    both = state.apply(np.stack([middle, middle + 10 * along_ct]))
    np.testing.assert_allclose(both[1] - both[0], 13 * along_ct, atol=0.05)
    twice = lungs.LungState(state.field, state.lung_from_ct, state.back, 2.0)
    both = twice.apply(np.stack([middle, middle + 10 * along_ct]))
    np.testing.assert_allclose(both[1] - both[0], 16 * along_ct, atol=0.1)


def test_an_organ_lies_among_landmarks_or_is_refused():
    near = linear_field(np.eye(3)).landmarks.exhaled_mm
    lung_from_ct = lungs.place(near, ORGAN, np.random.default_rng(0))
    laid = transform_points(lung_from_ct, ORGAN.vertices_mm)
    far = np.linalg.norm(laid[:, None] - near[None], axis=2).min(1) > lungs.WITHIN_MM
    assert far.mean() <= 0.06
    with pytest.raises(InputError, match="no place for an organ"):
        lungs.place(3 * near, ORGAN, np.random.default_rng(0))


def test_folded_states_are_refused_and_counted_before_anything_is_located():
    script, anatomy = runpy.run_path(str(SCRIPT)), small_anatomy()
    organ = SimpleNamespace(
        name="o", options=SimpleNamespace(seed=0), tracker=lambda: None,
        case=SimpleNamespace(anatomy=anatomy, up_lps=(0.0, -1.0, 0.0)),
    )  # fmt: skip
    points_mm = np.random.default_rng(1).uniform(-60, 60, (2500, 3))
    waves_mm = -20 * np.sin(points_mm[:, :1] / 10) * [1, 0, 0]
    folding = lungs.Field(lungs.Landmarks(points_mm, points_mm + waves_mm))  # slope -2 at x = 0
    rows = list(script["_states"](organ, 1, folding))
    assert [row["verdict"] for row in rows] == ["folded"] * len(lungs.VARIANTS)
    assert all(row["least_stretch"] < 0 for row in rows)


def test_a_slab_is_closed_by_its_walls_and_its_underside():
    x, y = (part.ravel() for part in np.meshgrid(np.arange(11.0), np.arange(11.0), indexing="ij"))
    bump = -4.0 * ((np.abs(x - 5) < 2) & (np.abs(y - 5) < 2))  # out of the slab: -z
    corner = np.arange(10)[:, None] * 11 + np.arange(10)
    a, b, c, d = (n.ravel() for n in (corner, corner + 11, corner + 12, corner + 1))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    top = Mesh(np.stack([x, y, bump], 1), faces)
    solid = silicone.closed(top, 6.0)
    edges = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]])
    both_ways = {tuple(edge) for edge in edges.tolist()}
    assert len(both_ways) == len(edges)  # each edge once in each direction: closed and oriented
    assert {(b, a) for a, b in both_ways} == both_ways
    under = np.array([a, d, c, b])  # of the height, two triangles a square
    columns = 6.0 - bump[under]
    wanted = (columns[[0, 2, 3]].mean(0) + columns[[0, 1, 2]].mean(0)).sum() / 2
    assert solid.volume_mm3 == pytest.approx(wanted)
    with pytest.raises(InputError, match="vu-arma-dev/cpd-registration"):
        silicone.file(Path("nowhere"), silicone.REST)
    pose = silicone.facing_pose(top, np.random.default_rng(0))
    assert pose[2, :3] @ [0, 0, -1] < -0.9  # the outer side looks back at the camera


def height_mm(points: np.ndarray) -> np.ndarray:
    """Of a slab with one bump beside its middle, out of it: -z."""
    return -8.0 * np.exp(-(((points - [30, 20]) / 9) ** 2).sum(1))


def test_a_scanned_cloud_becomes_a_surface_whose_holes_stay_open_when_told():
    flat = np.random.default_rng(0).uniform(0, 60, (60_000, 2))
    cloud = np.column_stack([flat, height_mm(flat)])
    holed = cloud[np.linalg.norm(flat - [40, 45], axis=1) > 6]
    filled, open_ = (silicone.surface_over(holed, hole) for hole in (np.inf, silicone.HOLE_MM))
    areas = []
    for mesh in (filled, open_):
        _, normals = triangles_of(mesh.vertices_mm, mesh.faces)
        assert (normals[:, 2] < 0).all()
        areas.append(-normals[:, 2].sum() / 2)  # in the plane
        assert np.abs(mesh.vertices_mm[:, 2] - height_mm(mesh.vertices_mm[:, :2])).max() < 0.3
    assert areas[0] == pytest.approx(59**2, rel=0.03)
    assert np.pi * 6**2 < areas[0] - areas[1] < np.pi * 7**2


class Told(Tracker):
    """Says what it was told to."""

    def __init__(self, estimate):
        self.estimate = estimate

    def follow(self, cloud):
        return self.estimate


def test_the_carried_curve_is_held_against_the_traced_one(monkeypatch):
    flat = np.random.default_rng(0).uniform(0, 60, (40_000, 2))
    top = silicone.surface_over(np.column_stack([flat, height_mm(flat)]), np.inf)
    case = Anatomy((silicone.closed(top, 10.0),))
    there = silicone.facing_pose(top, np.random.default_rng(3))  # the first thing that is drawn
    beside = there @ np.array([[1, 0, 0, 0], [0, 1, 0, 5], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    found = SimpleNamespace(camera_from_ct=beside)
    monkeypatch.setattr(silicone, "PoseSearch", lambda *_: SimpleNamespace(poses=lambda _: [found]))
    motion = SimpleNamespace(
        carry=lambda points: transform_points(there, points),
        std_mm=lambda points: np.full(len(points), 0.5),
    )
    cost = {"now": 3.0, "without_strays": 3.0, "usual": 2.0, "strays": 0.0}
    report = report_of(fit_cost=cost)
    estimate = SimpleNamespace(motion=motion, quality="good", reason="", report=report)
    at = np.linspace(5, 55, 500)
    rest = np.column_stack([at, np.full(500, 45.0), np.zeros(500)])
    curves = rest, rest[100:400] + [0, -2, 0]
    told = Told(estimate)
    rows = silicone.measured(told, case, top, top, np.random.default_rng(3), curves)
    assert [row["share"] for row in rows] == list(silicone.SHARES)
    for row in rows:
        assert (row["verdict"], row["cost"], row["std_mm"]) == ("good", 1.5, 0.5)
        parts = [part for part in ("seen", "unseen") if f"curve_{part}_mm" in row]
        for part in parts:  # beside by 2 mm across; the rigid one is 5 the other way
            assert row[f"curve_{part}_mm"] == pytest.approx([2] * 3, abs=0.01)
            assert row[f"ratio_{part}_mm"] == pytest.approx([4] * 3, abs=0.02)
            assert row[f"rigid_curve_{part}_mm"] == pytest.approx([7] * 3, abs=0.01)
        assert parts[:1] == ["seen"]
        assert row["share"] < 1 or len(parts) == 1
        assert max(row["seen_mm"]) < 0.1


def test_a_summary_counts_verdicts_and_gives_errors_of_answers_and_of_what_was_called_good():
    def row(verdict, middle_mm):
        tumor = {"rigid_middle_mm": 2.0, "rigid_hausdorff_mm": 3.0, "rigid_fit_middle_mm": 4.0}
        if middle_mm is not None:
            tumor |= {"middle_mm": middle_mm, "hausdorff_mm": 2 * middle_mm, "std_mm": 0.5}
        return {"verdict": verdict, "tumors": [tumor]}

    rows = [row("good", 1.0), row("good", 3.0), row("poor", 9.0), row("refused", None)]
    rows.append({"verdict": "folded", "tumors": []})
    found = runpy.run_path(str(SCRIPT))["summary"](rows)
    assert [*found.values()][:4] == [5, 2, 1, 1]
    shares = ("median", "90 %", "95 %", "worst")
    spread = {
        of: [found[f"{of} {share}{unit}"] for share in shares]
        for of, unit in {
            "centre": " mm", "best rigid pose's centre": " mm", "rigid fit's centre": " mm",
            "good answers' centre": " mm", "error / stated": "",
        }.items()
    }  # fmt: skip
    assert [*spread.values()] == [
        ["3.0", "7.8", "8.4", "9.0"],  # linear between 3 and 9
        ["2.0"] * 4,
        ["4.0"] * 4,
        ["2.0", "2.8", "2.9", "3.0"],
        ["6.0", "15.6", "16.8", "18.0"],
    ]


def test_tables_have_the_columns_of_what_was_measured(tmp_path):
    script = runpy.run_path(str(SCRIPT))
    errors = dict.fromkeys(("middle_mm", "rigid_middle_mm", "hausdorff_mm"), 2.0)
    tumor = {**errors, "rigid_hausdorff_mm": 3.0, "std_mm": 4.0}
    rows = [{"verdict": verdict, "tumors": [tumor]} for verdict in ("good", "poor")]
    made = {"by": "tumors", "of": "exophytic", "deformation": "as in the lung"}
    made |= script["summary"](rows)
    assert (made["scenes"], made["good"], made["error / stated median"]) == (2, 1, "0.5")
    page = tmp_path / "real.md"
    page.write_text("<!-- results:real-lungs -->\n<!-- /results:real-lungs -->\n")
    writer = ReportWriter(page, "make real")
    script["_tables"](writer, "real-lungs", [made], [made])
    text = page.read_text()
    ours = "2.0 / 2.0 / 2.0"
    assert f"| exophytic | as in the lung | 2 | 1 | {ours} | {ours} | – |" in text  # has no fits
    bent = {"cast": "1", "share": 0.5, "verdict": "poor", "cost": 1.0, "std_mm": 2.0}
    keys = ("curve_seen_mm", "rigid_curve_seen_mm", "ratio_seen_mm")
    bent |= {key: [1.0, 2.0, 3.0] for key in keys}
    lines = [
        {"distance of": "curve", **row} for row in script["_bent_rows"]("view", [bent], "curve_")
    ]
    writer.tables({"real-slab": pd.DataFrame(lines)})
    header = MeasuredTable.read(tmp_path / "data" / "real-slab.csv").header
    assert header[:5] == ["distance of", "view", "scan seen %", "verdict", "cost / usual"]
    assert {"seen median mm", "best rigid pose seen worst mm", "error / stated seen median"} <= set(
        header
    )
