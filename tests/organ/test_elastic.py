"""Elastic deformations: the elements against theory, the modes' laws, what loads do, the flow."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.linalg import expm

from elastic_objects import CENTER, RADII, SMALL, UP, organ
from refused import refused
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.organ.body import ElasticBody, build_body
from tumortrack.organ.finite import CORNERS, ElementLattice, LatticeSolid, cube_stiffness
from tumortrack.organ.loads import (
    KPA,
    LOADS,
    ReducedProblem,
    in_bed,
    random_problem,
    random_states,
    state_of,
)
from tumortrack.organ.modes import (
    ReducedModel,
    compliance_modes,
    modes_of,
    patches_of,
    random_loads,
)
from tumortrack.simulation.deform import ChainConfig, DragConfig, ElasticConfig, StretchConfig
from tumortrack.simulation.deform.base import View
from tumortrack.simulation.scene import PoseConfig, SceneConfig, body_for

ANATOMY = organ()
ORGAN = ANATOMY.organ


@pytest.fixture(scope="module")
def body() -> ElasticBody:
    return build_body(ANATOMY, UP, SMALL, 3)


@pytest.fixture(scope="module")
def solid():
    return LatticeSolid(ANATOMY, ElementLattice.around(ORGAN.box_mm, 9.0), 0.49)


@pytest.fixture(scope="module")
def patches():
    return patches_of(ORGAN, 200, np.random.default_rng(0))


@pytest.fixture(scope="module")
def modes(solid, patches):
    loads = random_loads(solid, patches, np.array(UP), 80, np.random.default_rng(1))
    return modes_of(solid, patches, 20, (1.0, 4.0), loads)


@pytest.fixture(scope="module")
def reduced(solid, modes, patches) -> ReducedModel:
    return ReducedModel(solid, modes, patches)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_a_cube_resists_strain_exactly_and_rigid_motion_not_at_all(poisson):
    stiffness, dilatation = cube_stiffness(poisson)
    np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-12)
    assert (np.linalg.eigvalsh(stiffness) > 1e-6).sum() == 18  # none of them for nothing
    arms = CORNERS - 0.5
    for axis in np.eye(3):
        np.testing.assert_allclose(stiffness @ np.tile(axis, 8), 0, atol=1e-12)
        np.testing.assert_allclose(stiffness @ np.cross(axis, arms).ravel(), 0, atol=1e-12)
    on_face = np.where(CORNERS[:, 0], 0.25, -0.25)  # a corner's share of the x faces, outward
    pulled = arms * [1, -poisson, -poisson]  # strain of 1 along x, the sides free
    np.testing.assert_allclose(
        (stiffness @ pulled.ravel()).reshape(8, 3), np.outer(on_face, [1, 0, 0]), atol=1e-12
    )
    pressed = (stiffness @ arms.ravel()).reshape(8, 3)  # strain of 1 along all axes
    np.testing.assert_allclose(pressed[:, 0], on_face / (1 - 2 * poisson), atol=1e-10)
    assert dilatation @ arms.ravel() == pytest.approx(3)


def test_a_pulled_block_stretches_and_narrows_as_theory_says():
    size = np.array([60.0, 30.0, 20.0])
    box = trimesh.creation.box(size)
    block = Anatomy((Mesh(box.vertices, box.faces),))
    solid = LatticeSolid(block, ElementLattice.around(block.organ.box_mm, 5.0), 0.4)
    assert solid.volume_mm3.sum() == pytest.approx(size.prod())
    side = np.stack(np.meshgrid(*[np.arange(-s / 2 + 0.5, s / 2) for s in size[1:]]), -1)
    face = np.insert(side.reshape(-1, 2), 0, size[0] / 2, axis=1)  # a point each mm2
    stress, ends = 0.01, [solid.lattice.weights(face * [s, 1, 1])[:, solid.nodes] for s in (1, -1)]
    force = np.zeros((len(solid.nodes), 3))
    force[:, 0] = stress * np.asarray(ends[0].sum(0) - ends[1].sum(0)).ravel()
    moved = solid.factor(1.0).solve(force.reshape(-1, 1)).reshape(-1, 3)
    stretch = (ends[0] @ moved - ends[1] @ moved)[:, 0].mean() / size[0]
    assert stretch == pytest.approx(stress, rel=0.03)  # the medium around it takes 1 to 2 %
    top, bottom = (solid.lattice.weights(np.array([[0, s * 15.0, 0]])) for s in (1, -1))
    narrowed = ((top - bottom)[:, solid.nodes] @ moved)[0, 1] / size[1]
    assert narrowed == pytest.approx(-0.4 * stress, rel=0.05)


def test_modes_are_orthonormal_and_free_of_rigid_motion(solid, modes):
    mass = np.repeat(solid.volume_mm3, 3)[:, None] / solid.volume_mm3.sum()
    gram = modes.T @ (mass * modes)
    np.testing.assert_allclose(gram, np.eye(20), atol=1e-6)
    arms = solid.nodes_mm - solid.center_mm
    for axis in np.eye(3):
        for motion in (np.tile(axis, len(arms)), np.cross(axis, arms).ravel() / 30):
            np.testing.assert_allclose(modes.T @ (mass[:, 0] * motion), 0, atol=1e-6)


def free_response(solid, loads, contrast=1.0):
    """Of a solid that inertia holds, to forces at its nodes (f, n), without rigid motion."""
    mass, arms = np.repeat(solid.volume_mm3, 3)[:, None], solid.nodes_mm - solid.center_mm
    eye = np.eye(3)
    shifts = (np.tile(axis, len(arms)) for axis in eye)
    rigid = np.stack([*shifts, *(np.cross(axis, arms).ravel() for axis in eye)], 1)
    moments = np.linalg.inv(rigid.T @ (mass * rigid))
    factor = solid.factor(contrast)
    responses = factor.solve(loads - mass * (rigid @ (moments @ (rigid.T @ loads))))
    return responses - rigid @ (moments @ (rigid.T @ (mass * responses)))


def test_the_organ_fills_its_cells(solid):
    assert solid.volume_mm3.sum() == pytest.approx(ORGAN.volume_mm3, rel=0.02)
    np.testing.assert_allclose(solid.center_mm, CENTER, atol=0.3)
    assert solid.tumor.sum() * 9.0**3 == pytest.approx(ANATOMY.tumors[0].volume_mm3, rel=0.1)


def test_a_stiffer_tumor_strains_less(solid, patches):
    facing = np.clip(patches.normals @ UP, 0, None) * patches.areas_mm2
    away = np.clip(-patches.normals @ UP, 0, None) * patches.areas_mm2
    traction = np.outer(away / away.sum() - facing / facing.sum(), UP)
    force = (solid.lattice.weights(patches.points_mm)[:, solid.nodes].T @ traction).reshape(-1, 1)
    middle = ANATOMY.tumors[0].vertices_mm.mean(0)
    ends = solid.lattice.weights(middle + np.outer([8.0, -8.0], UP))[:, solid.nodes]
    flattened = []
    for contrast in (1.0, 4.0, 16.0):
        moved = solid.factor(contrast).solve(force).reshape(-1, 3)
        flattened.append(-(ends @ moved @ UP) @ [1, -1])
    soft, stiff, stiffest = flattened
    assert soft > 0
    assert stiff < 0.6 * soft
    assert stiffest < 0.6 * stiff


def bed(
    reduced: ReducedModel, kpa_per_mm: float = 5.0, modulus: float = 10 * KPA
) -> ReducedProblem:
    """10 kPa tissue on springs, nothing acting yet."""
    up = np.array(UP)
    stiffness = reduced.stiffness(modulus, 2.0)
    problem = ReducedProblem(reduced, up, modulus, stiffness, np.zeros(len(stiffness)))
    springs = np.clip(-(reduced.patches.normals @ up), 0, 1) * reduced.patches.areas_mm2
    problem.touch(reduced.along(-up), np.zeros(len(springs)), kpa_per_mm * KPA * springs)
    for axis in np.eye(3):
        problem.tie(axis, 0.0, 1e-3 * KPA * springs)
    return problem


def test_a_plate_flattens_the_organ_against_its_bed(reduced):
    problem, up, patches = bed(reduced), np.array(UP), reduced.patches
    top = float((patches.points_mm @ up).max())
    problem.press(up, top - 8.0, (patches.normals @ up > 0).astype(float))
    z = problem.equilibrium()
    assert z is not None
    rise = reduced.along(up) @ z
    above = patches.normals @ up > 0.8
    under = patches.normals @ up < -0.8
    sunk_in = patches.points_mm[above] @ up + rise[above] - (top - 8.0)
    assert sunk_in.max() < 0.3
    pressed = rise[np.argmax(patches.points_mm @ up)]
    assert -8.2 < pressed < -7.0
    assert 5 * rise[under].mean() > pressed  # the bed holds the underside
    pushes = []  # of bed and plate, which nothing else opposes
    for rows, depth, springs in problem.contacts:
        pushes.append(float(springs @ np.clip(depth + rows @ z, 0, None)))
    assert pushes[0] > 0.5
    assert pushes[0] == pytest.approx(pushes[1], rel=0.02)
    across = np.array([1.0, 0, 0])
    aside = reduced.along(across) @ z
    assert aside[patches.normals @ across > 0.9].mean() > 0.3  # and it bulges
    assert aside[patches.normals @ across < -0.9].mean() < -0.3


def test_weight_that_is_no_longer_borne_makes_the_organ_sink_and_flatten(reduced):
    up, patches, sunk = np.array(UP), reduced.patches, []
    for modulus in (3 * KPA, 30 * KPA):
        problem = bed(reduced, 2.0, modulus)
        problem.weigh(-up, 1.0)
        z = problem.equilibrium()
        rise = reduced.along(up) @ z
        above = rise[patches.normals @ up > 0.8].mean()
        under = rise[patches.normals @ up < -0.8].mean()
        assert above < under < 0
        assert up @ reduced.volume_moves @ z < 0
        sunk.append(above - under)
        rows, depth, springs = problem.contacts[0]
        weight_n = ORGAN.volume_mm3 * 1.05e-6 * 9.81
        assert springs @ np.clip(depth + rows @ z, 0, None) == pytest.approx(weight_n, rel=0.03)
    assert sunk[0] < 4 * sunk[1]  # tissue a tenth as stiff flattens more


def test_compliance_is_what_forces_anywhere_do(solid, patches):
    few, many = (compliance_modes(solid, patches, count) for count in (12, 60))
    np.testing.assert_allclose(np.abs(few), np.abs(many[:, :12]), atol=1e-6 * np.abs(few).max())
    mass = np.repeat(solid.volume_mm3, 3)
    shifts = np.tile(np.eye(3), (len(solid.nodes), 1))
    assert np.abs(shifts.T @ (mass[:, None] * many)).max() < 1e-6 * (mass @ np.abs(many)).max()
    # Independent coefficients N(0, 1) move the surface by 1 mm rms along each axis, or a bit less.
    weights = patches.areas_mm2 / patches.areas_mm2.sum()
    squares = (solid.at(patches.points_mm, many) ** 2).sum(2)  # (p, 3)
    assert 0.85 < (weights @ squares).mean() <= 1
    # What any force does lies among them.
    spot = patches.spot(patches.points_mm[0], 8.0) * patches.areas_mm2
    forces = solid.weights(patches.points_mm).T @ (spot[:, None] * patches.normals[0])
    response = free_response(solid, forces.reshape(-1, 1), 3.0)
    left = [
        np.linalg.norm(response - modes @ np.linalg.lstsq(modes, response, rcond=None)[0])
        for modes in (few, many)
    ]
    assert left[1] < 0.6 * left[0]
    assert left[1] < 0.35 * np.linalg.norm(response)


@pytest.mark.parametrize("strain", [-0.02, 0.02])
def test_swelling_changes_the_volume_by_what_is_taken_up(reduced, solid, modes, strain):
    problem = bed(reduced, 0.1)
    problem.expand(strain)
    state = problem.equilibrium()[: reduced.n_modes]
    field = solid.spread(modes)
    lattice = solid.lattice
    swollen = ElasticBody(
        lattice.origin_mm.astype(np.float32),
        lattice.spacing_mm,
        solid.center_mm,
        field.astype(np.float32),
        np.array([state], np.float32),
    )
    moved = ORGAN.with_vertices(swollen.forward(state, ORGAN.vertices_mm))
    assert moved.volume_mm3 / ORGAN.volume_mm3 - 1 == pytest.approx(strain, rel=0.15)


@pytest.mark.parametrize("load", [load for load, _ in LOADS])
def test_every_load_moves_the_organ_and_none_does_not(reduced, load):
    rng, moved = np.random.default_rng(5), []
    for _ in range(12):
        problem = in_bed(reduced, np.array(UP), rng)
        np.testing.assert_allclose(problem.equilibrium(), 0, atol=1e-12)
        load(problem, rng)
        z = problem.equilibrium()
        if z is not None:
            moved.append(np.linalg.norm(z[: reduced.n_modes]))
    assert len(moved) >= 11
    assert np.median(moved) > 0.02


def test_a_library_mixes_strong_and_weak_states(body):
    sizes = np.linalg.norm(body.states, axis=1)  # mm rms: the modes are orthonormal
    assert body.states.shape == (80, 20)
    assert np.percentile(sizes, 10) < 0.6
    assert np.percentile(sizes, 90) > 1.5
    np.testing.assert_allclose(body.mean, body.states.mean(0), atol=1e-6)
    drawn = np.cov(body.states.T.astype(float))
    np.testing.assert_allclose(body.covariance - drawn, 1e-4 * np.eye(20), atol=1e-12)
    assert np.linalg.eigvalsh(body.covariance).min() > 5e-5


def test_every_state_keeps_the_volume_and_can_be_undone(body):
    changes, errors, moved = [], [], []
    for state in body.states:
        carried = body.forward(state, ORGAN.vertices_mm)
        changes.append(ORGAN.with_vertices(carried).volume_mm3 / ORGAN.volume_mm3 - 1)
        errors.append(np.abs(body.forward(-state, carried) - ORGAN.vertices_mm).max())
        moved.append(np.linalg.norm(carried - ORGAN.vertices_mm, axis=1).max())
    assert np.abs(changes).max() < 0.03
    assert max(errors) < 0.01
    assert 8 < max(moved) < 20
    still = np.abs(body.states[:, -1]) < 0.02 * np.abs(body.states[:, -1]).max()
    assert np.abs(np.array(changes)[still]).max() < 0.015


def test_no_state_folds_space(body):
    rng = np.random.default_rng(0)
    points = CENTER + RADII * rng.uniform(-1.2, 1.2, (1500, 3))
    step = 0.25
    for state in body.states[np.argsort(np.linalg.norm(body.states, axis=1))[-15:]]:
        ahead, behind = (
            np.stack([body.forward(state, points + sign * step * axis) for axis in np.eye(3)], -1)
            for sign in (1, -1)
        )
        determinant = np.linalg.det((ahead - behind) / (2 * step))
        assert determinant.min() > 0.1
        inside = (((points - CENTER) / RADII) ** 2).sum(1) < 0.6
        assert determinant[inside].mean() == pytest.approx(1, abs=0.04)


def test_points_follow_a_linear_field_to_its_exponential():
    lattice = ElementLattice(np.full(3, -40.0), 8.0, (11, 11, 11))
    slope = np.array([[0.1, -0.3, 0.0], [0.2, -0.15, 0.1], [0.0, 0.1, 0.05]])
    field = (lattice.nodes_mm() @ slope.T).reshape(11, 11, 11, 3, 1)
    body = ElasticBody(
        np.full(3, -40, np.float32),
        8.0,
        np.zeros(3),
        np.concatenate([field, np.zeros_like(field)], -1).astype(np.float32),
        np.zeros((2, 2), np.float32),
    )
    points = np.random.default_rng(0).uniform(-15, 15, (40, 3))
    moved = body.forward(np.array([1.0, 0.0]), points)
    np.testing.assert_allclose(moved, points @ expm(slope).T, atol=0.02)
    assert np.abs(moved - points).max() > 2


def test_the_same_seed_gives_the_same_body_and_another_another(body):
    again = build_body(ANATOMY, UP, SMALL, 3)
    np.testing.assert_array_equal(again.modes, body.modes)
    np.testing.assert_array_equal(again.states, body.states)
    other = build_body(ANATOMY, UP, SMALL, 4)
    assert np.abs(other.states - body.states).max() > 0.1


def test_a_state_that_moves_far_is_scaled_back(reduced):
    rng = np.random.default_rng(0)
    states = [state_of(random_problem(reduced, np.array(UP), 0.2, rng)) for _ in range(150)]
    farthest = [
        np.linalg.norm(reduced.moves[:, :, : reduced.n_modes] @ s, axis=1).max()
        for s in states
        if s is not None
    ]
    assert len(farthest) > 140
    assert 10 < max(farthest) <= 16 + 1e-9
    in_turn = [s for s in states if s is not None][:140]  # solved in turn, not on two threads
    together = random_states(reduced, np.array(UP), 0.2, np.random.default_rng(0), 140)
    np.testing.assert_array_equal(together, in_turn)


def test_a_body_survives_a_file(body, unchecked):
    back = ElasticBody.from_arrays(body.to_arrays())
    points = ORGAN.vertices_mm[::50]
    np.testing.assert_array_equal(
        back.forward(body.states[0], points), body.forward(body.states[0], points)
    )
    assert back.spacing_mm == body.spacing_mm
    lacking = {k: v for k, v in body.to_arrays().items() if k != "states"}
    with refused(InputError, "states"):
        ElasticBody.from_arrays(lacking)
    torn = {**body.to_arrays(), "states": body.states[:, :7]}
    with refused(InputError, "states"):
        ElasticBody.from_arrays(torn)
    with refused(InputError, "center_ct"):
        ElasticBody.from_arrays({**body.to_arrays(), "center_ct": np.full(3, np.nan)})
    with pytest.raises(InputError):  # no cell along an axis: a kernel would read beyond it
        ElasticBody.from_arrays({**body.to_arrays(), "modes": body.modes[:1]})


@pytest.mark.parametrize(
    "change", [{"modes": 1}, {"modes": 90}, {"cells": 9}, {"poisson": 0.5}, {"contrasts": ()}]
)
def test_numbers_that_make_no_body_are_refused(change):
    with pytest.raises(InputError):
        build_body(ANATOMY, UP, msgspec.structs.replace(SMALL, **change), 0)


def test_a_surface_turned_inside_out_is_refused():
    inside_out = Anatomy((Mesh(ORGAN.vertices_mm, ORGAN.faces[:, ::-1]),))
    with pytest.raises(InputError):
        build_body(inside_out, UP, SMALL, 0)


def visible(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), bool)


def test_scenes_draw_scaled_states_and_replay(body):
    view = View(ANATOMY, visible, body)
    config = ElasticConfig(mixed=0.0, scale=(0.5, 0.5))
    drawn = config.sample(view, np.random.default_rng(1))
    gaps = np.abs(body.states * 0.5 - drawn.coefficients).max(1)
    assert gaps.min() < 1e-6
    points = ORGAN.vertices_mm[::20]
    np.testing.assert_array_equal(drawn.apply(points), body.forward(drawn.coefficients, points))
    again = config.sample(view, np.random.default_rng(1))
    np.testing.assert_array_equal(again.apply(points), drawn.apply(points))
    assert drawn.record() == {"kind": "elastic", "coefficients": drawn.coefficients.tolist()}


def test_a_body_is_built_where_it_is_needed_and_once():
    assert body_for(ANATOMY, UP, SceneConfig(), 0) is None
    model = ElasticConfig(body=SMALL)
    chain = ChainConfig(links=(model, StretchConfig()))
    both = SceneConfig(deform=(DragConfig(), model, chain))
    assert from_builtins(to_builtins(both), SceneConfig, "test") == both
    below = body_for(ANATOMY, UP, both, 0)
    anywhere = body_for(
        ANATOMY, UP, msgspec.structs.replace(both, pose=PoseConfig(rotations="full")), 0
    )
    np.testing.assert_array_equal(below.modes, anywhere.modes)
    assert np.abs(below.states - anywhere.states).max() > 0.1
    finer = ElasticConfig(body=msgspec.structs.replace(SMALL, cells=300))
    with pytest.raises(InputError):
        body_for(ANATOMY, UP, SceneConfig(deform=(model, finer)), 0)
