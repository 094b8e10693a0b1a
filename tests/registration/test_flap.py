"""An organ that is being cut: its walls, what holds the flap yet, and where the flap is found."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from elastic_objects import CENTER, UP, organ
from refused import refused
from tumortrack.core.camera import d405
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Cut
from tumortrack.core.mesh_query import contains
from tumortrack.core.render import render_depth
from tumortrack.io.evidence_files import read_evidence
from tumortrack.organ.body import BodyConfig, build_body
from tumortrack.organ.finite import LatticeSolid
from tumortrack.organ.rest_shape import RestShape, distances_of
from tumortrack.registration import flap
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.flap import carried_over, carried_to_ct, cut_shape
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.registration import Registration
from tumortrack.registration.search import PosePrior
from warp_objects import PLACE_MM

KERF_MM, MARGIN_MM, POISSON = 1.5, 5.0, 0.49
# The tumor's side faces the camera.
FACING = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@cache
def intact() -> RestShape:
    body = BodyConfig(cells=500, modes=20, responses=80, patches=200, states=80)
    return RestShape(organ(), build_body(organ(), UP, body, 3), distances_of(organ()))


def shell(share):
    """Places of a cut round the tumor, of which so much has been cut, from one side on."""
    middle = intact().middles_ct[1]
    rng = np.random.default_rng(0)
    out = rng.normal(size=(20_000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    radius_mm = 11 + MARGIN_MM
    places = middle + radius_mm * out
    places = places[contains(intact().anatomy_ct.organ, places)]
    along = places @ [0.0, 0.0, 1.0]
    places = places[along <= np.quantile(along, share)]
    return places[rng.choice(len(places), min(len(places), 1500), replace=False)]


def cut_of(share, **more):
    return Cut(
        **{"points_ct": tuple(map(tuple, shell(share).tolist())), "kerf_mm": KERF_MM, **more}
    )


@cache
def parted(share) -> RestShape:
    return cut_shape(intact(), [cut_of(share)], POISSON)


def prior_mm(shape):
    """Root mean square of a flap's shift, before anything is seen."""
    shift = shape.body.covariance[-6:-3, -6:-3]
    return float(np.sqrt(np.trace(shift)))


def test_a_cut_has_walls_half_a_kerf_to_either_side():
    places = shell(0.8)
    middle = intact().middles_ct[1]
    out = (places - middle) / np.linalg.norm(places - middle, axis=1, keepdims=True)
    deep = intact().distances_mm(places, 0) < -3.0
    shape = parted(0.8)
    for off_mm, inside in ((0.0, False), (-2.0, True), (2.0, True)):
        distance_mm = shape.distances_mm((places + off_mm * out)[deep], 0)
        assert np.mean((distance_mm < 0) == inside) > 0.97
    # The surface has them, too: the volume of a kerf is gone.
    ball = np.random.default_rng(1).normal(size=(4000, 3))
    ball *= (11 + MARGIN_MM) / np.linalg.norm(ball, axis=1, keepdims=True)
    in_organ = contains(intact().anatomy_ct.organ, middle + ball).mean()
    area_mm2 = 0.8 * in_organ * 4 * np.pi * (11 + MARGIN_MM) ** 2
    gone_mm3 = intact().anatomy_ct.organ.volume_mm3 - shape.anatomy_ct.organ.volume_mm3
    assert 0.7 < gone_mm3 / (KERF_MM * area_mm2) < 1.4


def test_away_from_a_cut_the_organ_stays_as_it_is():
    shape = parted(0.8)
    vertices = intact().anatomy_ct.organ.vertices_mm
    far = np.linalg.norm(vertices - intact().middles_ct[1], axis=1) > 30
    same = shape.distances_mm(vertices, 0)[far] - intact().distances_mm(vertices, 0)[far]
    assert np.abs(same).max() < 0.15
    kept = {tuple(v) for v in shape.anatomy_ct.organ.vertices_mm.round(4).tolist()}
    assert all(tuple(v) in kept for v in vertices[far].round(4).tolist())
    assert np.array_equal(shape.body.modes[..., :-6], intact().body.modes)
    library = slice(0, intact().body.modes.shape[-1])
    covariance = shape.body.covariance
    assert np.allclose(covariance[library, library], intact().body.covariance, atol=1e-4)
    assert np.abs(covariance[library, -6:]).max() < 1e-4


def test_a_unit_of_a_mode_moves_the_flap_by_a_millimetre():
    shape = parted(0.8)
    tumor = shape.anatomy_ct.tumors[0].vertices_mm
    inner = (tumor - tumor.mean(0)) * 0.5 + tumor.mean(0)
    moved = shape.body.modes_at(inner)[:, :, -6:].mean(0)
    assert np.allclose(moved[:, :3], np.eye(3), atol=0.25)
    rest = shape.anatomy_ct.organ.vertices_mm
    far = rest[np.linalg.norm(rest - tumor.mean(0), axis=1) > 45]
    assert np.abs(shape.body.modes_at(far)[:, :, -6:]).mean() < 0.3


def test_the_more_is_cut_the_less_is_a_flap_held():
    prior = [prior_mm(parted(share)) for share in (0.1, 0.5, 0.8, 0.95)]
    assert prior == sorted(prior)
    assert prior[0] < 0.5 * prior[-1]


@pytest.mark.parametrize("every", [1, 3])
def test_how_densely_a_cut_is_told_changes_little(every):
    shape = cut_shape(
        intact(), [Cut(points_ct=tuple(map(tuple, shell(0.8)[::every].tolist())))], POISSON
    )
    assert prior_mm(shape) == pytest.approx(prior_mm(parted(0.8)), rel=0.5)


def test_soft_cells_are_those_that_a_cut_crosses():
    shape = intact()
    solid = LatticeSolid(shape.anatomy_ct, flap.lattice_of(shape.body), POISSON)
    crossed = flap.crossed_cells(solid, shell(0.8))
    middles = solid.lattice.origin_mm + solid.lattice.spacing_mm * (solid.cells + 0.5)
    away = np.linalg.norm(middles - shape.middles_ct[1], axis=1) - 11 - MARGIN_MM
    assert np.abs(away[crossed]).max() < solid.lattice.spacing_mm
    assert 10 < crossed.sum() < 0.3 * (solid.organ > 0).sum()


def test_a_lifted_flap_is_found_and_an_organ_that_was_not_cut_is_left():
    shape = parted(0.85)
    coefficients = np.append(intact().body.mean, [0, -7.0, 0, 1.5, 0, 0])
    truth = ElasticMotion(shape, FACING, PLACE_MM, coefficients)
    middle = shape.middles_ct[1:]
    there = truth.forward(middle)
    lifted = np.linalg.norm(there - replace(truth, coefficients=shape.body.mean).forward(middle))
    assert lifted > 5
    seen = cloud_of(truth)
    fits = {}
    for name, known in (("told", shape), ("not told", intact())):
        method = Registration(known, GaussNewtonConfig(), PosePrior(np.array(UP), 180.0))
        fit = method.register(MultiViewCloud.from_points([seen]))
        motion = method.refine_compliance(fit).motion
        fits[name] = float(np.linalg.norm(motion.forward(middle) - there))
    assert fits["told"] < 1.0
    assert fits["told"] < 0.4 * fits["not told"]


def test_a_flap_that_is_a_piece_of_its_own_is_found():
    """What the image shows of the flap is not among the points, but among what may be the
    organ's."""
    shape = parted(0.85)
    coefficients = np.append(intact().body.mean, [0, -7.0, 0, 1.5, 0, 0])
    truth = ElasticMotion(shape, FACING, PLACE_MM, coefficients)
    middle = shape.middles_ct[1:]
    seen = cloud_of(truth)
    flap_ct = shape.cut.flaps["tumor_1"].cells_ct
    off_mm = np.linalg.norm(truth.inverse(seen)[:, None] - flap_ct[None], axis=2).min(1)
    of_flap = off_mm < 8.0
    assert 50 < of_flap.sum() < 0.8 * len(seen)
    method = Registration(shape, GaussNewtonConfig(), PosePrior(np.array(UP), 180.0))
    rest = seen[~of_flap]
    errors = {}
    for name, more in (("as candidates", seen[of_flap]), ("not at all", None)):
        fit = method.register(MultiViewCloud.from_points([rest], candidates_mm=more))
        motion = method.refine_compliance(fit).motion
        errors[name] = float(np.linalg.norm(motion.forward(middle) - truth.forward(middle)))
        if more is None:  # it says that it does not know
            assert motion.std_mm(middle)[0] > 0.5 * errors[name]
    assert errors["as candidates"] < min(0.8, errors["not at all"])


def cloud_of(motion):
    organ_mesh = motion.shape.anatomy_ct.organ
    depth = render_depth(motion.forward(organ_mesh.vertices_mm), organ_mesh.faces, d405())
    pixels = np.argwhere(np.isfinite(depth.depth_mm))[::40]
    z = depth.depth_mm[tuple(pixels.T)]
    camera = depth.intrinsics
    x = (pixels[:, 1] - camera.cx) * z / camera.fx
    y = (pixels[:, 0] - camera.cy) * z / camera.fy
    return np.stack([x, y, z], axis=1).astype(np.float32)


def test_a_motion_is_carried_over_to_what_more_was_cut():
    first, second = parted(0.5), parted(0.8)
    coefficients = np.append(intact().body.mean, [0, -2.0, 0, 0, 0, 0])
    motion = ElasticMotion(first, FACING, PLACE_MM, coefficients)
    middle = first.middles_ct[1:]
    moved = carried_over(motion, second)
    assert np.linalg.norm(moved.forward(middle) - motion.forward(middle)) < 0.7
    assert moved.shape is second
    uncut = ElasticMotion(intact(), FACING, PLACE_MM, intact().body.mean)
    same = carried_over(uncut, second)
    vertices = intact().anatomy_ct.organ.vertices_mm[::50]
    assert np.allclose(same.forward(vertices), uncut.forward(vertices), atol=1e-3)


def test_what_was_cut_before_a_camera_is_carried_to_the_ct():
    motion = ElasticMotion(intact(), FACING, PLACE_MM, intact().body.mean)
    places = shell(0.5)[:20]
    seen = Cut(places_mm=tuple(map(tuple, motion.forward(places).tolist())), kerf_mm=2.0)
    (cut,) = carried_to_ct([seen], motion)
    assert np.allclose(cut.points_ct, places, atol=0.05)
    assert cut.kerf_mm == 2.0
    assert not cut.places_mm


def test_cuts_grow_and_start_from_the_intact_organ():
    again = cut_shape(parted(0.5), [cut_of(0.8)], POISSON)
    assert np.array_equal(again.distances[0].values_mm, parted(0.8).distances[0].values_mm)
    assert again.cut is not None
    assert again.cut.intact is intact()
    assert tuple(again.cut.flaps) == ("tumor_1",)


def test_cuts_are_refused():
    off = CENTER + np.array([[200.0, 0, 0], [201.0, 0, 0]])
    with refused(InputError):
        cut_shape(intact(), [Cut(points_ct=tuple(map(tuple, off.tolist())))], POISSON)
    with refused(InputError):
        cut_shape(intact(), [Cut(places_mm=((0.0, 0.0, 100.0),))], POISSON)
    for given in ({}, {"places_mm": ((0.0, 0, 100.0),), "points_ct": ((0.0, 0, 0),)}):
        with refused(InputError):
            Cut(**given)
    for kerf_mm in (0.0, 21.0, float("nan")):
        with refused(InputError):
            cut_of(0.5, kerf_mm=kerf_mm)


def test_cuts_are_read_from_files(tmp_path):
    known = {"frame": "camera", "unit": "mm", "evidence": [
        {"kind": "cut", "points_ct": [[1, 2, 3], [4, 5, 6]], "kerf_mm": 2.0, "std_mm": 0.5}
    ]}  # fmt: skip
    (tmp_path / "cut.json").write_text(json.dumps(known))
    (cut,) = read_evidence(tmp_path / "cut.json")[1]
    assert cut == Cut(points_ct=((1, 2, 3), (4, 5, 6)), kerf_mm=2.0, std_mm=0.5)
    rows = ["piece,frame,kind,x_mm,y_mm,z_mm,kerf_mm", "a,ct,cut,1,2,3,2", "a,ct,cut,4,5,6,2",
            "b,camera,cut,0,0,90,"]  # fmt: skip
    (tmp_path / "cut.csv").write_text("\n".join(rows))
    of_ct, seen = read_evidence(tmp_path / "cut.csv")[1]
    assert of_ct == Cut(points_ct=((1, 2, 3), (4, 5, 6)), kerf_mm=2.0)
    assert seen == Cut(places_mm=((0, 0, 90),))
