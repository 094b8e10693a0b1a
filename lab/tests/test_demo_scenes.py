"""How the scenes that the package brings are made: by a rule that no answer enters."""

from __future__ import annotations

import demo
import numpy as np
import pytest

from tumortrack.core.errors import NoEstimate, TumortrackError
from tumortrack.core.geometry import transform_points
from tumortrack.io.case import load_case
from tumortrack.simulation import datasets
from tumortrack_lab.world import twin
from tumortrack_lab.world.families import Deformed

pytestmark = pytest.mark.slow


def test_the_first_state_and_the_first_view_that_there_are(phantom_case, tmp_path, monkeypatch):
    """All states at rest. The first seed has no equilibrium, the first view shows no organ."""
    tried, views, find = [], [], demo.organ_cloud

    def at_rest(organ):
        return Deformed(organ, organ.mesh.nodes_mm, organ.mesh.tets, 10.0, None, {})

    def solve(organ, family, seed):
        tried.append((family, seed))
        if seed == 0:
            raise TumortrackError("no equilibrium")
        return at_rest(organ)

    def found(view, organ, rng):
        views.append(view)
        if len(views) == 1:
            raise NoEstimate("not in the image")
        return find(view, organ, rng)

    monkeypatch.setattr(twin, "EDGE_MM", 10.0)
    monkeypatch.setattr(demo, "solve", solve)
    monkeypatch.setattr(demo, "solve_twin", lambda bench, *_: at_rest(bench.stage.organ))
    monkeypatch.setattr(demo, "organ_cloud", found)
    case = load_case(phantom_case)
    scenes = demo.scenes_of(case, tmp_path)
    assert list(scenes) == list(datasets.phantom_scenes())
    assert tried == [(f, seed) for f in ("cut", "pull", "clamp") for seed in (0, 1)]
    assert [scene.meta["attempt"] for scene in scenes.values()] == [1, *[0] * 9]
    assert 0.2 < scenes["9-hidden"].meta["hidden_share"] < 0.8
    for scene in scenes.values():
        pose = np.array(scene.meta["camera_from_ct"])
        carried = transform_points(pose, case.anatomy.organ.vertices_mm)
        np.testing.assert_allclose(scene.reference.organ.vertices_mm, carried, atol=1e-6)
    content = datasets.packed(scenes, case.anatomy)
    (tmp_path / datasets.FILE).write_bytes(content)
    monkeypatch.setattr(datasets.resources, "files", lambda _: tmp_path)
    for name, kept in datasets.phantom_scenes().items():
        for part, true in zip(kept.reference.parts, scenes[name].reference.parts, strict=True):
            np.testing.assert_allclose(part.vertices_mm, true.vertices_mm, atol=0.00052)
        np.testing.assert_allclose(kept.depth.depth_mm, scenes[name].depth.depth_mm, atol=1e-4)
        assert kept.evidence == scenes[name].evidence
