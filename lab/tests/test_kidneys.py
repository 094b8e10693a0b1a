"""Random kidneys: closed, with tumors inside, and no two alike."""

import manifold3d
import numpy as np
import pytest

from tumortrack.core.types import Mesh
from tumortrack_lab.world.kidneys import random_anatomy


@pytest.mark.parametrize("seed", range(6))
def test_a_random_kidney_is_closed_and_holds_its_tumors(seed):
    anatomy, up = random_anatomy(seed)
    again, _ = random_anatomy(seed)
    assert np.array_equal(anatomy.organ.vertices_mm, again.organ.vertices_mm)
    assert np.linalg.norm(up) == pytest.approx(1)
    solids = [solid(part) for part in anatomy.parts]
    assert 1 <= len(anatomy.tumors) <= 3
    spread = anatomy.organ.vertices_mm - anatomy.organ.vertices_mm.mean(0)
    axis = np.linalg.svd(spread, full_matrices=False)[2][0]
    assert 80 < np.ptp(spread @ axis) < 165  # 90 to 130 mm, and bulging tumors
    for part, tumor in zip(anatomy.tumors, solids[1:], strict=True):
        assert 0.4 < part.volume_mm3 / 1000 < 55  # balls of 10 to 45 mm, in ml
        outside = (tumor - solids[0]).volume()
        assert outside < 0.01 * tumor.volume()


def solid(mesh: Mesh) -> manifold3d.Manifold:
    made = manifold3d.Manifold(
        manifold3d.Mesh(mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.uint32))
    )
    assert made.status() == manifold3d.Error.NoError
    assert made.volume() == pytest.approx(mesh.volume_mm3, rel=1e-3)
    assert made.volume() > 0
    return made


def test_kidneys_differ():
    volumes = {round(random_anatomy(seed)[0].organ.volume_mm3) for seed in range(4)}
    assert len(volumes) == 4
