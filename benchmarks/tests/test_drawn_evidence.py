"""Evidence drawn from a scene errs as its stated deviations say, and otherwise tells the truth."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
import pandas as pd
import pytest
from evidence import errors, foresight

import stress_objects
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.geometry import triangles_of
from tumortrack.core.mesh_query import contains
from tumortrack.io.scene_folder import Scene
from tumortrack.report.metrics import distance_to_surface
from tumortrack_benchmarks.physics.evidence import (
    ALL_TRUE,
    ERRORS,
    EvidenceErrors,
    EvidenceSource,
    hidden,
    met,
    mirrored,
)
from tumortrack_benchmarks.physics.scenes import StressConfig, stress_scenes

EXACT = EvidenceErrors(
    tip_mm=0.0, hand_eye_mm=(0.0, 0.0), hand_eye_degrees=0.0, probe_mm=0.0, click_mm=0.0,
    grip_mm=0.0, false_contacts=0.0, slips=0.0,
)  # fmt: skip


@cache
def scene() -> Scene:
    return stress_objects.world(hidden=0.0, segmentation=0.0).scene(0)


def source(errors=EXACT, *seed) -> EvidenceSource:
    return EvidenceSource.of(scene(), seed or (0,), errors)


def places_of(pieces):
    return np.concatenate([np.array(piece.evidence.places) for piece in pieces])


def test_without_errors_evidence_is_the_truth():
    drawn, reference = source(), scene().reference
    touches = drawn.touches_at_random(20, drawn.unseen)
    assert distance_to_surface(places_of(touches), reference.organ) == pytest.approx(0, abs=1e-3)
    outline = drawn.outline(0)
    assert outline.evidence.part == "tumor_1"
    places = places_of([outline])
    assert distance_to_surface(places, reference.tumors[0]) == pytest.approx(0, abs=1e-3)
    assert np.linalg.svd(places - places.mean(0))[1][2] == pytest.approx(0, abs=1e-3)  # a plane
    known = dict(zip(map(tuple, drawn.targets.points_ct), drawn.targets.points_mm, strict=True))
    for piece in (*drawn.landmarks(5), drawn.held()):
        assert piece.evidence.place_mm == pytest.approx(known[piece.evidence.point_ct], abs=1e-3)


def test_an_aim_off_the_surface_is_met_on_its_line():
    organ = scene().reference.organ
    centres, doubled = triangles_of(organ.vertices_mm, organ.faces)
    normal = doubled[7] / np.linalg.norm(doubled[7])
    for off_mm in (-4.0, 0.0, 9.0):
        place, there = met(organ, centres[7] + off_mm * normal, normal)
        assert place == pytest.approx(centres[7], abs=1e-6)
        assert there == pytest.approx(normal)
    beside = organ.box_mm[1] + [50.0, 0, 0]  # a line that misses
    assert distance_to_surface(met(organ, beside, np.array([0, 0, 1.0]))[0][None], organ) < 1e-3


@pytest.mark.parametrize("kind", ["touch", "outline", "landmark", "held"])
def test_the_stated_deviation_is_that_of_what_is_drawn(kind):
    of = {
        "touch": lambda s: s.touches(*aims())[0],
        "outline": lambda s: s.outline(0, np.array([0.0, 0.0, 1.0])),
        "landmark": lambda s: s.landmarks(1)[0],
        "held": lambda s: s.held(),
    }[kind]
    shares, known = [], {tuple(p): q for p, q in zip(*pairs(), strict=True)}
    plain = places_of([of(source())])
    for seed in range(400):
        piece = of(source(msgspec.structs.replace(ALL_TRUE, grip_mm=0.0), seed)).evidence
        true = known[piece.point_ct] if hasattr(piece, "point_ct") else plain
        shares.append((np.array(piece.places) - true) / np.hypot(piece.std_mm, piece.shared_std_mm))
    assert np.sqrt(np.mean(np.square(shares))) == pytest.approx(1.0, abs=0.06)


def aims():
    organ = scene().reference.organ
    centres, doubled = triangles_of(organ.vertices_mm, organ.faces)
    return centres[:1], doubled[:1]


def pairs():
    return source().targets.points_ct, source().targets.points_mm


def test_a_scene_has_one_hand_eye_error():
    only = msgspec.structs.replace(EXACT, hand_eye_mm=(1.5, 1.5))
    drawn = source(only)
    told = places_of([drawn.touches(*aims())[0], drawn.outline(0, np.array([0.0, 0.0, 1.0]))])
    exact = source()
    true = places_of([exact.touches(*aims())[0], exact.outline(0, np.array([0.0, 0.0, 1.0]))])
    off = told - true
    assert np.linalg.norm(off, axis=1) == pytest.approx(1.5)
    assert np.ptp(off, axis=0) == pytest.approx(0, abs=1e-9)


def test_false_pieces_are_named_and_lie_outside():
    wrong = msgspec.structs.replace(EXACT, false_contacts=0.3, slips=1.0)
    touches = source(wrong).touches_at_random(300, None)
    false = np.array([piece.false for piece in touches])
    assert false.mean() == pytest.approx(0.3, abs=0.1)
    places, organ = places_of(touches), scene().reference.organ
    assert distance_to_surface(places[~false], organ).max() < 1e-3
    assert not contains(organ, places[false]).any()
    assert distance_to_surface(places[false], organ).max() < 15.1
    held, known = source(wrong).held(), {tuple(p): q for p, q in zip(*pairs(), strict=True)}
    assert held.false
    slipped = np.linalg.norm(held.evidence.place_mm - known[held.evidence.point_ct])
    assert 5 <= slipped <= 15


def test_seeds_repeat():
    def drawn(*seed):
        of = source(ERRORS, *seed)
        return [*of.touches_at_random(4, of.unseen), of.outline(0), *of.landmarks(2), of.held()]

    assert drawn(3, 1) == drawn(3, 1)
    assert drawn(3, 1) != drawn(3, 2)


def test_a_share_is_hidden_and_the_organ_mirrored():
    whole, part = scene(), hidden(scene(), 0.4, np.random.default_rng(0))
    count = len(whole.cloud.points_mm)
    assert len(part.cloud.points_mm) == pytest.approx(0.6 * count, rel=0.01)
    depth, left = (np.isfinite(s.depth.depth_mm) for s in (whole, part))
    assert left.sum() < depth.sum()
    assert not (left & ~depth).any()
    other = mirrored(whole)
    assert other.reference.organ.volume_mm3 == pytest.approx(whole.reference.organ.volume_mm3)
    # What the mirrored image shows lies where the mirrored cloud is.
    camera = other.depth.intrinsics
    x, y, z = other.cloud.points_mm[::50].T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    seen = other.depth.depth_mm[np.round(v).astype(int), np.round(u).astype(int)]
    near = np.isfinite(seen)
    assert np.median(np.abs(seen[near] - z[near])) < 1.0
    assert near.mean() > 0.9


def test_tables_count_pieces_by_scene_and_misses_by_tumor():
    about = {
        "organ": "own",
        "kidney": 1,
        "kind": "3 touches",
        "family": "rest",
        "rigid_mm": 2.0,
        "tumor": "tumor_1",
        "held": "tumor_1",
    }
    pieces = {"pieces": 3, "false": 1, "false_out": 1, "true_out": 1}
    told = {"std_mm": 2.0, "then_std_mm": 1.0, "off_before_mm": 3.0, "off_after_mm": 1.0}
    answers = [
        {**about, **pieces, **told, "scene": name, "quality": quality, "finding": None,
         "largest_error_mm": miss}
        for name, quality, misses in (("a", "good", (1.0, 2.0)), ("b", "none", (np.nan,)))
        for miss in misses
    ]  # fmt: skip
    rows = pd.DataFrame(answers)
    line = errors(rows).iloc[0]
    assert (line["tumors"], line["answers %"], line["median, mm"]) == (3, "67", "1.5")
    assert (line["false left out %"], line["true left out %"]) == ("100", "50")
    pulled = rows.assign(family="pull", kind="held tumor")
    pulled.loc[0, "tumor"] = "tumor_2"  # not the one that is held
    lines = errors(pd.concat([rows, pulled], ignore_index=True)).set_index("kind")
    assert list(lines.index) == ["3 touches", "held tumor", "pulled, held tumor"]
    assert lines.loc["pulled, held tumor", "median, mm"] == "2.0"
    assert foresight(rows).iloc[0]["found/foreseen gain: median"] == "2.00"


def test_scenes_that_were_made_or_tried_are_not_made_again(tmp_path):
    (case := tmp_path / "case").mkdir()
    (case / store.MANIFEST).write_text("{}")
    config = StressConfig(families=("rest", "plate"))
    assert stress_scenes(case, tmp_path / "scenes", config, 0) == []
    scene().write(tmp_path / "scenes" / "00000-rest")
    store.write_json(tmp_path / "scenes" / "failures.json", {"00001-plate": "no equilibrium"})
    made = stress_scenes(case, tmp_path / "scenes", config, 2)
    assert [path.name for path in made] == ["00000-rest"]
    with pytest.raises(ArtifactError):  # the case is too empty to make the third from
        stress_scenes(case, tmp_path / "scenes", config, 3)
    with pytest.raises(InputError):
        stress_scenes(case, tmp_path / "scenes", StressConfig(seed=1), 2)
