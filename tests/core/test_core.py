"""Core: transforms, values and configuration."""

import json
import tomllib
from importlib.resources import files
from typing import get_args

import jaxtyping
import msgspec
import numpy as np
import pytest
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st

from refused import refused
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import (
    DIRECTIONS_LPS,
    direction_lps,
    rigid,
    rotation_onto,
    transform_points,
)
from tumortrack.core.report import Kind
from tumortrack.core.types import (
    Anatomy,
    Intrinsics,
    LabelVolume,
    Mesh,
    SensorCloud,
    Volume,
)

finite = st.floats(-1e3, 1e3)
vectors = st.tuples(finite, finite, finite).filter(lambda v: np.linalg.norm(v) > 1e-3)


def box(extents=(2, 3, 4), center=(0, 0, 0)):
    solid = trimesh.creation.box(extents)
    return Mesh(solid.vertices + np.array(center, float), solid.faces)


# geometry


def test_shapes_in_annotations_are_executed():
    with pytest.raises(jaxtyping.TypeCheckError):
        transform_points(np.eye(3), np.zeros((5, 3)))
    with pytest.raises(jaxtyping.TypeCheckError):
        transform_points(np.eye(4), np.zeros((5, 2)))


@given(vectors, vectors)
@example((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
@example((3.0, -2.0, 1.0), (-6.0, 4.0, -2.0))
@example((0.0, 0.0, 1.0), (3e-6, 0.0, -1.0))  # almost opposite
@example((0.0, 0.0, 1.0), (0.0, 2e-8, -1.0))
def test_rotation_onto_is_the_smallest_rotation_that_maps(source, target):
    a, b = (np.array(v) / np.linalg.norm(v) for v in (source, target))
    rotation = rotation_onto(np.array(source), np.array(target))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ a, b, atol=2e-8)
    assert np.trace(rotation) == pytest.approx(1 + 2 * a @ b, abs=1e-7)  # 1 + 2 cos(angle)


def test_transform_keeps_the_points_precision_and_known_place():
    quarter = rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))
    out = transform_points(quarter, np.array([[1, 2, 3]], np.float32))
    assert out.dtype == np.float32
    np.testing.assert_array_equal(out, [[8, 21, 33]])


def test_directions_are_dicoms():
    assert direction_lps("left") == (1, 0, 0)
    assert direction_lps("Anterior") == (0, -1, 0)
    assert direction_lps("superior") == (0, 0, 1)
    for one, other in (("left", "right"), ("posterior", "anterior"), ("superior", "inferior")):
        np.testing.assert_array_equal(
            np.array(DIRECTIONS_LPS[one]), -np.array(direction_lps(other))
        )
    assert direction_lps("0, 3 -4") == pytest.approx((0, 0.6, -0.8))


@pytest.mark.parametrize(
    "text",
    ["", "up", "0,0,0", "1,2", "1,2,3,4", "nan,0,1", "inf 0 0", "1e308,1e308,1e308", "a,b,c"],
)
def test_other_directions_are_refused_with_the_choices(text):
    with np.errstate(over="ignore"), refused(InputError, "anterior"):
        direction_lps(text)


# values


def test_volume_of_a_box_wherever_it_lies_and_however_it_turns():
    turn = rotation_onto(np.array([1.0, 0, 0]), np.array([1.0, 2, 3]))
    mesh = box((2, 3, 4), (1000, -2000, 500))
    assert mesh.volume_mm3 == pytest.approx(24)
    assert mesh.with_vertices(mesh.vertices_mm @ turn.T).volume_mm3 == pytest.approx(24)
    assert Mesh(mesh.vertices_mm, mesh.faces[:, ::-1]).volume_mm3 == pytest.approx(-24)
    np.testing.assert_allclose(mesh.box_mm, [[999, -2001.5, 498], [1001, -1998.5, 502]])


def test_values_are_frozen_and_copies():
    vertices = box().vertices_mm.copy()
    mesh = Mesh(vertices, box().faces)
    vertices[0] = 99
    assert mesh.vertices_mm[0].max() <= 2
    with refused(ValueError):
        mesh.vertices_mm[0] = 0
    with pytest.raises(AttributeError):
        mesh.faces = mesh.faces


@pytest.mark.parametrize(
    "make",
    [
        lambda: Mesh(np.zeros((4, 2)), [[0, 1, 2]]),
        lambda: Mesh(np.zeros((3, 3)), [[0, 1, 3]]),
        lambda: Mesh(np.zeros((3, 3)), [[0, 1, -1]]),
        lambda: Mesh(np.zeros((3, 3)), np.array([[0, 1, 2**32 + 2]])),
        lambda: Mesh(np.full((3, 3), np.nan), [[0, 1, 2]]),
        lambda: Anatomy(()),
        lambda: Volume(np.zeros((2, 2)), np.eye(4)),
        lambda: Volume(np.zeros((2, 2, 2)), np.diag([1.0, 1, 0, 1])),
        lambda: Volume(np.zeros((2, 2, 2)), np.full((4, 4), np.nan)),
        lambda: LabelVolume(np.full((2, 2, 2), 257), np.eye(4)),
        lambda: LabelVolume(np.full((2, 2, 2), 0.5), np.eye(4)),
        lambda: SensorCloud([[0, 0, np.inf]]),
        lambda: Intrinsics(10, 10, 0, 5, 5, 5),
        lambda: Intrinsics(10, 10, 5, 5, np.nan, 5),
        lambda: Intrinsics(0, 10, 5, 5, 5, 5),
        lambda: Intrinsics(100_000, 10, 5, 5, 5, 5),
    ],
)
def test_values_that_cannot_be_are_refused(make):
    with pytest.raises(InputError):
        make()


# configuration


class Inner(Config, frozen=True, tag="inner"):
    span_mm: tuple[float, float] = (1.0, 2.0)


class Other(Config, frozen=True, tag="other"):
    count: int = 3


class Outer(Config, frozen=True):
    name: str
    kinds: tuple[Inner | Other, ...] = (Inner(),)


def test_configuration_survives_json():
    config = Outer(name="x", kinds=(Other(count=5), Inner(span_mm=(0.1, 7.0))))
    data = json.loads(json.dumps(to_builtins(config)))
    assert data["kinds"][0] == {"type": "other", "count": 5}
    assert from_builtins(data, Outer, "here") == config
    with pytest.raises(AttributeError):
        config.name = "y"


@pytest.mark.parametrize(
    ("data", "named"),
    [
        ({"name": "x", "colour": 1}, "colour"),
        ({"name": 1}, "name"),
        ({}, "name"),
        ({"name": "x", "kinds": [{"type": "third"}]}, "third"),
        ([], "run.json"),
    ],
)
def test_wrong_configuration_is_refused_by_name(data, named):
    with refused(InputError, "run.json", named):
        from_builtins(data, Outer, "run.json")
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(data, Outer)


def test_every_kind_of_finding_has_one_sentence():
    findings = tomllib.loads(files("tumortrack.core").joinpath("findings.toml").read_text("utf-8"))
    assert sorted(kind for part in findings.values() for kind in part) == sorted(get_args(Kind))
