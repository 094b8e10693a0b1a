"""Squeezing and bending keep volumes; chains apply their links in order; both replay."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulation.deform import ChainConfig, DragConfig, StretchConfig
from tumortrack.simulation.deform.base import View
from tumortrack.simulation.deform.stretch import Stretch


@pytest.fixture(scope="module")
def view() -> View:
    ball = trimesh.creation.icosphere(subdivisions=4)
    organ = Mesh(ball.vertices * [30, 25, 55] + [60.0, -20, 900], ball.faces)
    return View(Anatomy((organ,)), lambda points: np.ones(len(points), bool))


@pytest.mark.parametrize("seed", range(8))
def test_a_stretch_keeps_the_volume_and_moves_the_organ(view, seed):
    organ = view.anatomy_ct.organ
    stretch = StretchConfig().sample(view, np.random.default_rng(seed))
    moved = organ.with_vertices(stretch.apply(organ.vertices_mm))
    assert moved.volume_mm3 == pytest.approx(organ.volume_mm3, rel=2e-3)  # facets of a sphere
    assert np.abs(moved.vertices_mm - organ.vertices_mm).max() > 0.5
    assert np.linalg.det(stretch.matrix) == pytest.approx(1, abs=1e-12)
    assert stretch.along @ stretch.across == pytest.approx(0, abs=1e-12)


def test_a_bend_lifts_the_end_by_its_sagitta_and_leaves_the_centre():
    bend = Stretch(
        centre_ct=np.zeros(3),
        matrix=np.eye(3),
        along=np.array([0.0, 0.0, 1.0]),
        across=np.array([1.0, 0.0, 0.0]),
        sagitta_mm=6.0,
        reach_mm=55.0,
    )
    points = np.array([[0.0, 0, 0], [0, 0, 55], [0, 0, -55], [0, 9, 27.5]])
    moved = bend.apply(points) - points
    np.testing.assert_allclose(moved, [[0, 0, 0], [6, 0, 0], [6, 0, 0], [1.5, 0, 0]], atol=1e-5)


def test_a_chain_applies_its_links_in_order_and_replays(view):
    config = ChainConfig(links=(DragConfig(), StretchConfig()))
    points = view.anatomy_ct.organ.vertices_mm
    chain = config.sample(view, np.random.default_rng(5))
    drag, stretch = chain.links
    np.testing.assert_array_equal(chain.apply(points), stretch.apply(drag.apply(points)))
    again = config.sample(view, np.random.default_rng(5))
    np.testing.assert_array_equal(chain.apply(points), again.apply(points))
    assert [link["kind"] for link in chain.record()["links"]] == ["drag", "stretch"]
