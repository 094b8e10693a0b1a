"""Organs that look the same after half a turn: recognised, said, and tried both ways round."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from elastic_objects import bent, organ
from tumortrack.case.symmetry import AMBIGUOUS_MM, ambiguous, half_turns, warning
from tumortrack.cli.main import run
from tumortrack.core import store
from tumortrack.core.types import Anatomy
from tumortrack.io.mesh_files import write_anatomy
from tumortrack_benchmarks.physics.kidneys import random_anatomy

# Of the ellipsoid's tumor, 8 mm and 20 mm from the middle along two of its axes: half a turn about
# the third moves it by twice its distance, about one of them by twice the other's.
AWAY_MM = [16.0, 40.0, 2 * np.hypot(8, 20)]


def test_an_ellipsoid_looks_the_same_after_each_half_turn():
    turns = half_turns(organ())
    assert len(ambiguous(turns)) == 3
    assert max(turn.p90_mm for turn in turns) < 0.2  # facets
    away_mm = sorted(turn.tumors_mm["tumor_1"] for turn in turns)
    assert away_mm == pytest.approx(AWAY_MM, abs=0.2)
    for turn in turns:
        rotation = Rotation.from_matrix(turn.ct_from_ct[:3, :3])
        assert np.degrees(rotation.magnitude()) == pytest.approx(180, abs=1)
    assert "tumor_1 43 mm" in warning(turns)
    assert warning(half_turns(Anatomy((organ().organ,))))


def test_figures_do_not_depend_on_where_the_organ_lies():
    anatomy = bent(organ(), 0.5)
    turn, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), [30.0, -70.0, 400.0]
    moved = tuple(part.with_vertices(part.vertices_mm @ turn.T + shift) for part in anatomy.parts)
    here, there = half_turns(anatomy), half_turns(Anatomy(moved))
    for first, second in zip(here, there, strict=True):
        assert second.mean_mm == pytest.approx(first.mean_mm, abs=0.02)
        assert second.tumors_mm["tumor_1"] == pytest.approx(first.tumors_mm["tumor_1"], abs=1)


def test_the_less_it_is_alike_the_farther_apart_the_surfaces():
    means = [half_turns(bent(organ(), share))[0].mean_mm for share in (0, 0.3, 0.6, 1.0)]
    assert means == sorted(means)
    assert means[0] < 0.1
    assert means[-1] > AMBIGUOUS_MM
    kidney = half_turns(random_anatomy(0)[0])
    assert kidney[0].mean_mm > AMBIGUOUS_MM
    assert warning(ambiguous(kidney)) == ""


@pytest.mark.parametrize(("share", "says"), [(0.0, True), (1.0, False)])
def test_prepare_says_it_and_inspect_repeats_it(tmp_path, models_at_once, capsys, share, says):
    (tmp_path / "meshes").mkdir()
    write_anatomy(tmp_path / "meshes", bent(organ(), share))
    case = tmp_path / "case"
    assert run(["prepare", str(tmp_path / "meshes"), "--out", str(case)]) == 0
    report = store.read_json(case / store.MANIFEST)["report"]
    warned = report["half_turn"]["warning"]
    assert bool(warned) == says
    assert (warned in report["notes"]) == says
    assert warned in capsys.readouterr().out
    assert run(["inspect", str(case)]) == 0
    assert warned in capsys.readouterr().out
    assert len(report["half_turn"]["turns"]) == 3
