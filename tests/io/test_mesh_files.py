"""What is written as PLY is read again without trimesh, and as trimesh reads it."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
import trimesh

from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import exact_margin, nearest_places
from tumortrack.core.types import Mesh
from tumortrack.io.mesh_files import read_mesh, write_mesh


@pytest.fixture
def ball() -> Mesh:
    sphere = trimesh.creation.icosphere(3, 20.0)
    return Mesh(sphere.vertices + [1 / 3, 50.0, -7.0], sphere.faces)


def test_a_mesh_is_read_as_it_was_written(ball, tmp_path, monkeypatch):
    file = tmp_path / "ball.ply"
    write_mesh(file, ball)
    stored = trimesh.load_mesh(io.BytesIO(file.read_bytes()), "ply", process=False)
    monkeypatch.setitem(sys.modules, "trimesh", None)  # importing it now fails
    read = read_mesh(file)
    corners, wanted = read.vertices_mm[read.faces], np.asarray(stored.vertices)[stored.faces]
    np.testing.assert_array_equal(corners, wanted)
    np.testing.assert_allclose(corners, ball.vertices_mm[ball.faces], rtol=1e-6)


@pytest.mark.parametrize("end", [-1, -13])
def test_a_cut_mesh_is_refused(ball, tmp_path, end):
    file = tmp_path / "ball.ply"
    write_mesh(file, ball)
    file.write_bytes(file.read_bytes()[:end])
    with refused(InputError, "ball.ply"):
        read_mesh(file)


@pytest.mark.parametrize("margin_mm", [0.5, 3.0, 12.0])
def test_a_shell_lies_everywhere_at_its_distance(ball, margin_mm):
    shell = exact_margin(ball, margin_mm)
    away_mm = np.linalg.norm(nearest_places(ball, shell.vertices_mm) - shell.vertices_mm, axis=1)
    np.testing.assert_allclose(away_mm, margin_mm, atol=0.2)
    radius_mm = np.cbrt(0.75 / np.pi * np.array([ball.volume_mm3, shell.volume_mm3]))
    np.testing.assert_allclose(np.diff(radius_mm), margin_mm, atol=0.1)
