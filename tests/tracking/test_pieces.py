"""The organ is found in another piece of the image where the most likely one is something else."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tumortrack.core.camera import d405, deproject
from tumortrack.core.errors import NotThisOrgan
from tumortrack.core.render import render_depth
from tumortrack.core.types import SensorCloud, View
from tumortrack.segmentation import Hints
from tumortrack.tracking.options import LocateOptions
from tumortrack.tracking.pieces import select_piece
from tumortrack.tracking.views import ViewFile, as_fitted
from warp_objects import ANATOMY, placed


@pytest.fixture(scope="module")
def image():
    """The organ, and beside it a plate, nearer than the table under both."""
    organ = placed(share=0.3).forward(ANATOMY.organ.vertices_mm)
    frame = render_depth(organ, ANATOMY.organ.faces, d405(424, 240))
    depth = np.where(np.isnan(frame.depth_mm), np.nanmax(frame.depth_mm) + 30, frame.depth_mm)
    there = np.zeros(depth.shape, bool)
    there[90:150, 10:90] = True
    depth[there] = np.nanmin(frame.depth_mm)
    plate = frame.with_depth(np.where(there, depth, np.nan).astype(np.float32))
    organ_alone, plate_alone = (thinned(deproject(each)) for each in (frame, plate))
    return frame.with_depth(depth.astype(np.float32)), organ_alone, plate_alone


def thinned(points):
    return SensorCloud(points[:: len(points) // 1000 + 1].astype(np.float32))


def test_the_organ_is_found_beside_what_looked_more_like_it(tracker, image):
    seen, organ, plate = image
    alone = tracker.locate(organ, grid=16, full_view=seen)
    for locate in (partial(tracker.locate, grid=16), tracker.follow):
        found = locate(replace(plate, others=(organ,)), full_view=seen)
        away_mm = np.abs(found.organ_mesh.box_mm - alone.organ_mesh.box_mm).max()
        assert away_mm < 0.5
        assert found.report.piece == 1
        assert found.report.timings["pieces"] > 0
    with pytest.raises(NotThisOrgan):
        tracker.locate(plate, grid=16, full_view=seen)


def test_what_is_the_organ_is_tried_alone_and_what_is_not_to_the_end(tracker, image):
    seen, organ, plate = image
    tries = []

    def located(views):
        tries.append(len(views[0].cloud.points_mm))
        return tracker.locate(replace(views[0].cloud, others=()), grid=16, full_view=seen)

    for first, others, count in ((organ, (plate,), 1), (plate, (plate, organ, plate), 4)):
        tries.clear()
        view = View(replace(first, others=others), seen, np.eye(4))
        select_piece((view,), located)
        assert len(tries) == count


@pytest.mark.parametrize("width_px", [14, 30])  # 8 and 17 mm: a shaft, a finger
@pytest.mark.parametrize("along", [(0, 0), (10, -35), (-25, 25)])
def test_an_organ_behind_an_occluder_stays_one(tracker, along, width_px):
    """A band parts the organ; both parts are found, and nothing of the band."""
    organ = placed(share=0.3).forward(ANATOMY.organ.vertices_mm)
    clean = render_depth(organ, ANATOMY.organ.faces, d405(424, 240))
    image = np.isfinite(clean.depth_mm)
    v, u = np.indices(image.shape)
    rows, columns = np.nonzero(image)
    across = (
        np.array([1.0, 0.0])
        if along == (0, 0)
        else np.array([along[1], -along[0]]) / np.hypot(*along)
    )
    off = across[0] * (u - columns.mean()) + across[1] * (v - rows.mean())
    band = np.abs(off) < width_px / 2
    depth = np.where(band, np.nanmin(clean.depth_mm) - 15, clean.depth_mm).astype(np.float32)
    view = ViewFile(Path("depth.png"), clean.with_depth(depth))
    found = view.organ(tracker.model, LocateOptions(), Hints())
    estimate = tracker.locate(found.cloud, grid=16, full_view=view.content)
    (fitted,) = as_fitted([view], [found], estimate, tracker.model)
    taken = fitted.pixel_class == 0
    assert not taken[band].any()
    assert taken[image & ~band].mean() > 0.95
