"""Clicks in the viewer teach the organ's colour to the running loop: fat that lies flush with it is
taken for it before, and not afterwards; what cannot be used is said."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from clock import PATIENCE_S, until
from colour_objects import COLOURS, Light, clicks_on, painted
from elastic_objects import UP
from region_objects import FAT, Props, make_scene
from tumortrack.core.camera import deproject_pixels
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import DepthFrame
from tumortrack.live.loop import Loop, LoopConfig
from tumortrack.live.values import (
    Controls,
    Observation,
    PublishedFrame,
    SinkContext,
    SourceEnded,
)
from tumortrack.live.workers import SinkWorker, SourceWorker
from tumortrack.segmentation import RegionConfig
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_devices.sinks.viewer import ViewerSinkConfig
from tumortrack_devices.viewer.panel import CLICKS
from viewer_page import page
from warp_objects import ANATOMY

REGION = RegionConfig(crop=CloudConfig(near_mm=60.0, far_mm=400.0))
BESIDE_FAT = Props(distance_mm=(120.0, 130.0), tilt_degrees=5.0, waves_mm=2.0, fat=True, up=UP)


class Script:
    """A source that gives frames in order, and does what stands between them."""

    dropped, lossless, host_clock, on_demand = 0, True, False, False

    def __init__(self, items):
        self.items = list(items)

    def read(self, timeout_s):
        while self.items and callable(self.items[0]):
            self.items.pop(0)()
        if not self.items:
            raise SourceEnded("that was all")
        return self.items.pop(0)

    def close(self):
        self.items = []


def click(viewer, visitor, frame, pixel, organ):
    """In the page, from the camera's place towards a pixel; until the viewer has taken it."""
    button, label = viewer.panel.clicks[organ], CLICKS[organ]
    visitor.change(label)
    until(lambda: button.label != label, "the button")
    row, column = pixel
    index = np.array([row * frame.intrinsics.width + column])
    visitor.click(deproject_pixels(index, np.array([1.0]), frame.intrinsics)[0])
    until(lambda: button.label == label, "the click")


def stamp_ns(number):
    return 10**15 + number * 33_000_000


def frames_of(scene, picture, first, count):
    return [
        Observation(
            DepthFrame(scene.frame.depth_mm, scene.frame.intrinsics, stamp_ns(n)),
            arrived_ns=stamp_ns(n),
            picture=picture,
        )
        for n in range(first, first + count)
    ]


def test_clicks_teach_the_running_loop(slim_model):
    tracker = Tracker(load_model(slim_model, "cpu"))
    rng = np.random.default_rng(10)
    scene = make_scene(ANATOMY.organ, BESIDE_FAT, rng)
    colours = {kind: np.array(some[0], float) for kind, some in COLOURS.items()}
    picture = painted(scene, colours, Light(), rng)
    context = SinkContext(tracker.model.parts, PublishedFrame(), tracker.anatomy_ct, Controls())
    viewer = ViewerSinkConfig(port=0).open(context)
    results, failures = [], list[BaseException]()

    def step(act):
        """Of the script, run by the thread that reads it: what fails there ends the run."""

        def acted():
            try:
                act()
            except BaseException as failure:
                failures.append(failure)
                raise SourceEnded("a step failed") from failure

        return acted

    def shown(number):
        return f"frame no. {number}<" in viewer.panel.stage.content

    def clicking():
        until(lambda: shown(2))
        for organ, pixels in (
            (True, clicks_on(scene, True, 9, rng)),
            (False, clicks_on(scene, False, 12, rng)),
        ):
            for pixel in pixels:
                if sum(one.organ is organ for one in context.controls.clicks) < 3:
                    click(viewer, visitor, scene.frame, pixel, organ)
            if organ:
                assert context.controls.tissue_classifier is None

    def forgetting():
        until(lambda: shown(10))
        assert context.controls.tissue_classifier is not None
        assert viewer.panel.colour.content
        assert viewer.panel.forget.visible
        visitor.change("Forget")
        until(lambda: viewer.panel.colour.content == "", "forgetting")
        assert context.controls.clicks == ()

    items = [
        *frames_of(scene, picture, 0, 3),
        step(clicking),
        *frames_of(scene, picture, 3, 5),
        *frames_of(scene, None, 8, 3),
        step(forgetting),
        *frames_of(scene, picture, 11, 2),
    ]
    loop = Loop(tracker, context, LoopConfig(region=REGION, frozen_s=0.0, stale_s=PATIENCE_S / 2))
    with closing(viewer), page(viewer) as visitor:
        outlets = [SinkWorker("viewer", viewer, 1000)]
        reader = SourceWorker(lambda: Script(items))
        loop.run(reader, outlets, results.append)
        reader.close()
        outlets[0].close()
    if failures:
        raise failures[0]
    framed = [result for result in results if result.observation is not None]
    assert len(framed) == 13
    share = [fat_share(scene, one) for one in framed]
    off_mm = [organ_error_mm(scene, one) for one in framed]
    assert min(share[:3]) > 0.15
    assert max(share[3:8]) < 0.02
    assert max(share[3:8]) < min(share[11:])  # forgotten: depth alone again
    assert np.median(off_mm[3:8]) < 0.6 * np.median(off_mm[:3])
    for one in framed[8:11]:
        assert one.quality != "good"
    doubted = [one.finding is not None and one.finding.kind == "frame_in_doubt" for one in framed]
    assert not any(doubted[:8] + doubted[11:])


def fat_share(scene, result):
    """Of the points taken for the organ."""
    organ = result.organ.points_mm.astype(float)
    camera = scene.frame.intrinsics
    columns = np.rint(organ[:, 0] / organ[:, 2] * camera.fx + camera.cx).astype(int)
    rows = np.rint(organ[:, 1] / organ[:, 2] * camera.fy + camera.cy).astype(int)
    return float((scene.kinds[rows, columns] == FAT).mean())


def organ_error_mm(scene, result):
    """Mean distance of the organ's surface points from their true places; far without any."""
    if result.estimate is None:
        return 100.0
    at_rest = ANATOMY.organ.vertices_mm
    true = transform_points(scene.camera_from_organ, at_rest)
    return np.linalg.norm(result.estimate.motion.forward(at_rest) - true, axis=1).mean()


def test_what_teaches_nothing_is_said_and_changes_nothing():
    rng = np.random.default_rng(10)
    scene = make_scene(ANATOMY.organ, BESIDE_FAT, rng)
    colours = {kind: np.array(some[0], float) for kind, some in COLOURS.items()}
    picture = painted(scene, colours, Light(), rng)
    controls = Controls()
    (seen,) = frames_of(scene, None, 0, 1)
    for picture_ in (None, np.full_like(picture, 255)):
        with pytest.raises(InputError):
            controls.click(replace(seen, picture=picture_), np.array([0.0, 0.0, 125.0]), True)
    assert controls.clicks == ()
    assert controls.tissue_classifier is None
    controls.forget()
    assert (controls.clicks, controls.colour, controls.picked_mm) == ((), "", None)
