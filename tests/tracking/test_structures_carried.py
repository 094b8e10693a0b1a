"""A structure rides along with the organ's motion: estimate, files, planner, sinks."""

from dataclasses import replace

import numpy as np
import pytest

import tumortrack as tt
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh, SensorCloud
from tumortrack.io.run_folder import write_estimate
from tumortrack.organ.rest_shape import RestShape
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker


@pytest.fixture(scope="module")
def carried(slim_model):
    """An estimate of a model that knows a planned cut, an open sheet through the organ."""
    model = load_model(slim_model, "cpu")
    anatomy = model.shape.anatomy_ct
    low, high = anatomy.organ.box_mm
    x, y = np.meshgrid(np.linspace(low[0], high[0], 9), np.linspace(low[1], high[1], 9))
    points = np.stack([x.ravel(), y.ravel(), np.full(81, (low + high)[2] / 2)], axis=1)
    a = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    sheet = Mesh(
        points,
        np.concatenate([np.stack([a, a + 1, a + 9], 1), np.stack([a + 1, a + 10, a + 9], 1)]),
    )
    known = replace(model.shape, anatomy_ct=replace(anatomy, structures={"cut": sheet}))
    again = RestShape.from_arrays(known.to_arrays(), len(anatomy.parts))
    assert (again.anatomy_ct.structures["cut"].vertices_mm == points).all()
    case_like = replace(model, shape=again)
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[:3, 3] = [0, 0, 150]
    turned = transform_points(down, anatomy.organ.vertices_mm - anatomy.organ.box_mm.mean(0))
    cloud = SensorCloud(turned[turned[:, 2] < 150][::4])
    estimate = Tracker(case_like).locate(cloud, grid=24)
    return sheet, estimate


def test_it_moves_as_the_motion_says(carried):
    sheet, estimate = carried
    there = estimate.motion.forward(sheet.vertices_mm)
    assert estimate.structures["cut"].vertices_mm == pytest.approx(there, abs=1e-4)
    assert np.linalg.norm(there - sheet.vertices_mm, axis=1).min() > 10
    assert set(estimate.meshes) == set(estimate.report.parts)
    assert estimate.report.structures == ("cut",)


def test_it_is_written_and_read_as_what_it_is(carried, tmp_path):
    _, estimate = carried
    write_estimate(tmp_path / "run", estimate)
    back = tt.load_estimate(tmp_path / "run")
    assert set(back.meshes) == set(estimate.meshes)
    written, read = (np.sort(e.structures["cut"].vertices_mm, 0) for e in (estimate, back))
    assert read == pytest.approx(written, abs=1e-3)
