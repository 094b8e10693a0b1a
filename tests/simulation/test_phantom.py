"""The built-in phantom: its geometry and its parameters."""

import itertools

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from phantom_objects import FIRST, VOXEL, first_labels
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.simulation.phantom.digital import (
    PhantomParameters,
    TumorParameters,
    organ_field,
    phantom_labels,
)
from volume_points import lps_of, read_at

SECOND = PhantomParameters(  # another kidney: three tumors, the deep one in the lower pole
    size_mm=(56.0, 47.0, 104.0),
    bend_mm=9.0,
    taper=0.04,
    hilum_depth_mm=16.0,
    shape_seed=7,
    tumors=(
        TumorParameters(diameter_mm=30.0, center_mm=(-3.0, 1.0, -20.0)),
        TumorParameters(diameter_mm=26.0, center_mm=(-20.0, -12.0, 17.0)),
        TumorParameters(diameter_mm=12.0, center_mm=(4.0, 2.0, 25.0)),
    ),
)


@pytest.fixture(scope="module")
def labels():
    return first_labels()


def box_mm(mask, lps_from_index):
    index = np.argwhere(mask)
    return (index.max(0) - index.min(0) + 1) * spacing_mm(lps_from_index)


@pytest.mark.parametrize("parameters", [FIRST, SECOND])
def test_the_organ_fills_the_stated_box_and_its_tumors_stay_apart(parameters):
    axes = (np.arange(-70.0, 70, 1.0),) * 3
    organ = organ_field(parameters, axes) < 0
    assert np.abs(box_mm(organ, np.eye(4)) - parameters.size_mm).max() <= 1.5
    assert ndimage.label(organ)[1] == 1
    edge = np.argwhere(organ)[:, 0]
    assert abs(axes[0][[edge.min(), edge.max()]].mean()) <= 1  # centred
    tumors = phantom_labels(parameters, 1.5).labels
    for n in range(2, tumors.max() + 1):
        gap = ndimage.distance_transform_edt((tumors < 2) | (tumors == n), sampling=1.5)
        assert gap[tumors == n].min() >= 3


def test_labels_are_ordered_by_size_and_the_diameters_are_as_stated(labels):
    volumes = np.bincount(labels.labels.ravel())[2:] * VOXEL**3
    assert np.allclose((6 / np.pi * volumes) ** (1 / 3), [38, 32], atol=0.4)
    for n, diameter in ((2, 38), (3, 32)):
        tumor = labels.labels == n
        assert ndimage.label(tumor)[1] == 1
        assert np.abs(box_mm(tumor, labels.lps_from_index) - diameter).max() <= 2 * VOXEL


def test_endophytic_is_covered_and_exophytic_half_outside_towards_an_anterior_camera(labels):
    # By labels alone: what is outside the organ's own surface is measured on a tumor-free phantom.
    bare = phantom_labels(msgspec.structs.replace(FIRST, tumors=()), VOXEL)
    covered, half = (read_at(bare, lps_of(labels, np.argwhere(labels.labels == n))) for n in (2, 3))
    assert (covered == 1).all()
    assert 0.4 < (np.nan_to_num(half) == 0).mean() < 0.6
    deep = ndimage.distance_transform_edt(labels.labels > 0, sampling=VOXEL)
    assert deep[labels.labels == 2].min() >= 2
    first_seen = (labels.labels > 0).argmax(axis=1)  # along +y: from anterior to posterior
    seen = np.take_along_axis(labels.labels, first_seen[:, None], 1)[:, 0]
    assert (seen[(labels.labels == 3).any(axis=1)] == 3).mean() > 0.9
    assert not (seen == 2).any()


def test_the_hilum_is_medial():
    bare = phantom_labels(PhantomParameters(tumors=()), VOXEL)
    # Dents are what a ball of 15 mm cannot reach from outside: closing fills them.
    organ = np.pad(bare.labels > 0, 18)
    near = ndimage.distance_transform_edt(~organ) < 15
    closed = ndimage.distance_transform_edt(near) >= 15
    dent = np.argwhere(closed & ~ndimage.binary_dilation(organ)) - 18
    assert len(dent) > 500
    assert (lps_of(bare, dent)[:, 0] > FIRST.center_lps_mm[0]).mean() > 0.95  # of a right kidney


def test_left_is_the_mirror_image_of_right(labels):
    left = phantom_labels(msgspec.structs.replace(FIRST, side="left"), VOXEL)
    points = lps_of(labels, np.argwhere(labels.labels))
    points[:, 0] = 2 * FIRST.center_lps_mm[0] - points[:, 0]
    assert np.array_equal(read_at(left, points), labels.labels[labels.labels > 0])


def test_no_mirror_image_or_half_turn_passes_for_the_organ():
    organ = organ_field(FIRST, (np.arange(-60.0, 60.5, 1.5),) * 3) < 0
    for axes in itertools.chain.from_iterable(
        itertools.combinations(range(3), count) for count in (1, 2, 3)
    ):
        turned = np.flip(organ, axes)
        assert (organ & turned).sum() / (organ | turned).sum() < 0.96


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("size_mm", (64.0, 50.0, 110.0)), ("bend_mm", 6.0), ("taper", 0.02), ("side", "left"),
        ("hilum_depth_mm", 8.0), ("lump_mm", 0.0), ("shape_seed", 5), ("tumors", FIRST.tumors[:1]),
        ("center_lps_mm", (0.0, 0.0, 0.0)),
        ("tumors", tuple(msgspec.structs.replace(t, lobulation=0.0) for t in FIRST.tumors)),
    ],
)  # fmt: skip
def test_every_parameter_is_read(key, value):
    before, after = (
        phantom_labels(parameters, 2.0)
        for parameters in (FIRST, msgspec.structs.replace(FIRST, **{key: value}))
    )
    same = np.array_equal(before.labels, after.labels)
    assert not (same and np.array_equal(before.lps_from_index, after.lps_from_index))


def tumors(diameter_mm, *centers_mm):
    return tuple(TumorParameters(diameter_mm=diameter_mm, center_mm=c) for c in centers_mm)


@pytest.mark.parametrize(
    ("make", "limit"),
    [
        (lambda: PhantomParameters(tumors=tumors(30.0, (0.0, 0.0, 0.0), (0.0, 0.0, 32.0))), "3.0"),
        (lambda: phantom_labels(PhantomParameters(tumors=tumors(10.0, (90.0, 0.0, 0.0)))), "1"),
        (lambda: phantom_labels(FIRST, 20.0), "0.2 to 4"),
        (lambda: PhantomParameters(size_mm=(0.06, 0.05, 0.11)), "20 to 250"),
        (lambda: phantom_labels(PhantomParameters(size_mm=(200.0,) * 3), 0.3), "50"),
        (lambda: tumors(30.0, (0.0, float("nan"), 0.0)), "-200 to 200"),
    ],
)
def test_what_no_organ_has_is_refused_with_the_limit(make, limit):
    with refused(InputError, limit):
        make()
