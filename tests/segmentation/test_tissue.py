"""The organ by colour and depth, trained by clicks: laws, known answers, and what is gained where
depth alone cannot tell the organ from its surroundings."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

import tumortrack as tt
from colour_objects import clicks_on, painted, random_colours, random_light
from depth_objects import SMALL, dome, pixels
from region_objects import DRAPED, FAT, ORGAN, make_scene, precision_recall
from tumortrack.core.camera import deproject
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.segmentation import Hints, RegionConfig, organ_points
from tumortrack.segmentation.tissue import sample_click, train_tissue_classifier
from tumortrack_benchmarks.physics.kidneys import random_anatomy

CONFIG = RegionConfig(crop=CloudConfig(near_mm=60.0, far_mm=400.0))
RED, YELLOW, GREEN = (168, 82, 70), (222, 188, 112), (62, 108, 102)
ON, BESIDE = [(120, 150), (100, 190), (140, 170)], [(120, 260), (100, 280), (30, 40), (200, 380)]


def two_tissues(yellow=YELLOW):
    """A smooth dome over a table, its left half red and its right half yellow: to depth one thing.
    Frame, picture, and where the dome is."""
    depth_mm = dome().depth_mm
    on = np.isfinite(depth_mm)
    u, _ = pixels(SMALL)
    kind = np.where(on, 1 + (u > 212), 0)
    colours = np.array([GREEN, RED, yellow], float)[kind]
    noise = np.random.default_rng(3).normal(0, 4, colours.shape)
    picture = np.clip(0.8 * colours + noise, 0, 255).astype(np.uint8)
    return DepthFrame(np.where(on, depth_mm, 180.0), SMALL, 9), picture, on


def clicks_of(frame, picture, on=ON, beside=BESIDE):
    return [sample_click(frame, picture, p, organ) for some, organ in ((on, True), (beside, False))
            for p in some]  # fmt: skip


def find(frame, picture, trained):
    hints = Hints(picture=picture, tissue_classifier=trained)
    return organ_points(frame, CONFIG, hints, np.random.default_rng(0))


def test_colour_parts_what_is_one_thing_to_depth():
    frame, picture, on = two_tissues()
    u, _ = pixels(SMALL)
    alone = organ_points(frame, CONFIG, Hints(), np.random.default_rng(0))
    assert (alone.pixel_class == 0)[on].mean() > 0.9
    trained = train_tissue_classifier(clicks_of(frame, picture))
    assert trained.right == 1
    region = find(frame, picture, trained)
    organ = region.pixel_class == 0
    assert region.doubt == ""
    assert organ[on & (u < 205)].mean() > 0.95
    assert organ[on & (u > 219)].mean() < 0.01
    assert region.counts["colour"] > 0.9 * (on & (u > 212)).sum()
    assert sum(region.counts.values()) == organ.size
    # Python's way, and of a picture twice as large: every second pixel is looked at.
    same = tt.train_tissue_classifier(frame, picture, ON, BESIDE)
    assert np.array_equal(same.centres, trained.centres)
    cloud = tt.find_organ(frame, range_mm=(60, 400), picture=picture, tissue_classifier=same)
    assert cloud.points_mm[:, 0].max() < 2


def test_the_order_of_clicks_changes_nothing():
    frame, picture, _ = two_tissues()
    clicks = clicks_of(frame, picture)
    first, second = (
        find(frame, picture, trained)
        for trained in (
            train_tissue_classifier(clicks),
            train_tissue_classifier([clicks[k] for k in (5, 0, 3, 6, 1, 4, 2)]),
        )
    )
    assert np.array_equal(first.pixel_class, second.pixel_class)
    assert np.array_equal(first.cloud.points_mm, second.cloud.points_mm)


def test_exposure_and_shading_change_hardly_a_pixel():
    frame, picture, on = two_tissues()
    trained = train_tissue_classifier(clicks_of(frame, picture))
    as_taught = find(frame, picture, trained).pixel_class == 0
    shades = (0.5, 0.75, 1.15, np.linspace(0.6, 1.1, SMALL.width)[:, None])
    for shade in shades:
        other = np.clip(picture * shade, 0, 255).astype(np.uint8)
        changed = (find(frame, other, trained).pixel_class == 0) != as_taught
        assert changed.sum() < 0.02 * on.sum()


def test_clicks_that_do_not_tell_are_refused():
    frame, picture, _ = two_tissues()
    clicks = clicks_of(frame, picture)
    _, same, _ = two_tissues(RED)
    mixed = [replace(click, organ=k % 2 == 0) for k, click in enumerate(clicks)]
    for wrong in (clicks[:3], clicks[:1], clicks_of(frame, same), mixed):
        with pytest.raises(InputError):
            train_tissue_classifier(wrong)
    depth_mm = frame.depth_mm.copy()
    depth_mm[:20, :20] = np.nan
    holed = DepthFrame(depth_mm, SMALL)
    white = np.full_like(picture, 255)
    for shown, pixel in ((picture, (0, 0)), (white, (120, 150)), (picture[1:], (3, 3))):
        with pytest.raises(InputError):
            sample_click(holed, shown, pixel, True)


def test_where_it_cannot_be_used_depth_decides_and_it_is_said():
    frame, picture, _ = two_tissues()
    trained = train_tissue_classifier(clicks_of(frame, picture))
    alone = organ_points(frame, CONFIG, Hints(), np.random.default_rng(0))
    blue, dark = (
        np.clip(picture * gain, 0, 255).astype(np.uint8) for gain in ([0.3, 0.7, 2], 0.02)
    )
    grey = np.repeat(picture.mean(-1, keepdims=True).astype(np.uint8), 3, axis=2)
    for other in (None, blue, dark, grey):
        region = find(frame, other, trained)
        assert region.doubt
        assert np.array_equal(region.pixel_class, alone.pixel_class)
    assert find(SensorCloud(deproject(frame)), picture, trained).doubt
    with pytest.raises(NoEstimate):
        tt.find_organ(frame, range_mm=(60, 400), picture=blue, tissue_classifier=trained)


def test_grey_pictures_teach_only_large_differences():
    frame, picture, on = two_tissues()
    grey = picture.mean(-1).astype(np.uint8)
    with pytest.raises(InputError):
        train_tissue_classifier(clicks_of(frame, grey))
    u, _ = pixels(SMALL)
    grey[~on | (u > 212)] = 14 + grey[~on | (u > 212)] // 20
    trained = train_tissue_classifier(clicks_of(frame, grey))
    organ = find(frame, grey, trained).pixel_class == 0
    assert organ[on & (u < 205)].mean() > 0.9
    assert organ[on & (u > 219)].mean() < 0.05


# Random kidneys, lights, colours and noise; fat against a third to a half of the organ, flush
# with it; with a hand and a shaft; a hand alone. Three clicks on the organ, five beside it, in turn
# on each thing that there is. Least mean precision and recall, and share of good scenes.
NEAR = replace(DRAPED, distance_mm=(110.0, 220.0))
KINDS = {
    "fat": (replace(NEAR, fat=True), 0.95, 0.85, 0.85),
    "fat, hand, shaft": (replace(NEAR, fat=True, hand=True, shafts=1), 0.9, 0.75, 0.75),
    "hand, shaft": (replace(NEAR, hand=True, shafts=1), 0.94, 0.75, 0.85),
}
SCENES = 6


@pytest.fixture(scope="module")
def kidneys():
    return [random_anatomy(seed)[0].organ for seed in range(301, 309)]


def clicked(scene, picture, rng):
    """As a user does it: where a click shows too little, somewhere else."""
    clicks = []
    for organ, left in ((True, 3), (False, 5)):
        for pixel in clicks_on(scene, organ, 4 * left, rng):
            if left:
                with suppress(InputError):
                    clicks.append(sample_click(scene.frame, picture, pixel, organ))
                    left -= 1
    return clicks


def scene_with_colours(kidneys, props, seed, same=False):
    """A scene, its picture, and what clicks on it teach; ``same``: fat of the organ's colour."""
    rng = np.random.default_rng((53, seed))
    scene, colours = make_scene(kidneys[seed], props, rng), random_colours(rng)
    if same:
        colours[FAT] = colours[ORGAN] * np.exp(rng.normal(0, 0.02, 3))
    picture = painted(scene, colours, random_light(rng), rng)
    return scene, picture, clicked(scene, picture, rng)


@pytest.mark.parametrize("kind", KINDS)
def test_what_clicks_gain_in_scenes(kind, kidneys):
    props, least_precision, least_recall, least_good = KINDS[kind]
    rows = []
    for seed in range(SCENES):
        scene, picture, clicks = scene_with_colours(kidneys, props, seed)
        regions = [organ_points(scene.frame, CONFIG, Hints(), np.random.default_rng(0))] * 2
        with suppress(InputError):  # of clicks that look alike
            regions[1] = find(scene.frame, picture, train_tissue_classifier(clicks))
        rows.append([precision_recall(scene, region.pixel_class) for region in regions])
    (before, after), means = np.swapaxes(rows, 0, 1), np.mean(rows, axis=0)
    good = [((part[:, 0] > 0.85) & (part[:, 1] > 0.6)).sum() for part in (before, after)]
    assert means[1, 0] > least_precision
    assert means[1, 1] > least_recall
    assert good[1] >= least_good * SCENES
    if "fat" in kind:
        assert good[0] < min(0.5 * SCENES, good[1])


def test_fat_of_the_organs_colour_is_told_by_nobody(kidneys):
    trained = 0
    for seed in range(SCENES):
        scene, picture, clicks = scene_with_colours(kidneys, KINDS["fat"][0], seed, same=True)
        with suppress(InputError):
            trained += not find(scene.frame, picture, train_tissue_classifier(clicks)).doubt
    assert trained <= 0.1 * SCENES
