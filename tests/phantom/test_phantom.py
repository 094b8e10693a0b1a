"""The built-in phantom: its geometry and its parameters."""

import itertools

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.phantom.digital import (
    PhantomParameters,
    TumorParameters,
    organ_field,
    phantom_labels,
)
from tumortrack.phantom.scanner import ScannerParameters
from tumortrack_lab.study.methods import second_phantom
from volume_points import lps_of, read_at

VOXEL = 1.0
FIRST = PhantomParameters()


@pytest.fixture(scope="module")
def labels():
    return phantom_labels(FIRST, VOXEL)


def box_mm(mask, lps_from_index):
    index = np.argwhere(mask)
    return (index.max(0) - index.min(0) + 1) * spacing_mm(lps_from_index)


def test_the_organ_fills_the_stated_box():
    for parameters in (FIRST, second_phantom()):
        axes = (np.arange(-70.0, 70, 1.0),) * 3
        organ = organ_field(parameters, axes) < 0
        assert np.abs(box_mm(organ, np.eye(4)) - parameters.size_mm).max() <= 1.5
        assert ndimage.label(organ)[1] == 1
        edge = np.argwhere(organ)[:, 0]
        assert abs(axes[0][[edge.min(), edge.max()]].mean()) <= 1  # centred


def test_labels_are_ordered_by_size_and_the_diameters_are_as_stated(labels):
    volumes = np.bincount(labels.labels.ravel())[2:] * VOXEL**3
    assert np.allclose((6 / np.pi * volumes) ** (1 / 3), [38, 32], atol=0.4)
    for n, diameter in ((2, 38), (3, 32)):
        tumor = labels.labels == n
        assert ndimage.label(tumor)[1] == 1
        assert np.abs(box_mm(tumor, labels.lps_from_index) - diameter).max() <= 2 * VOXEL


def test_a_tumor_is_lobulated_yet_its_diameters_agree():
    ball = TumorParameters(diameter_mm=38.0, center_mm=(-3.0, 1.0, 17.0), lobulation=0.0)
    lobed = msgspec.structs.replace(ball, lobulation=0.1)
    masks = [
        phantom_labels(PhantomParameters(tumors=(t,)), VOXEL).labels == 2 for t in (ball, lobed)
    ]
    overlap = (masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum()
    assert 0.8 < overlap < 0.97


def test_endophytic_is_covered_and_exophytic_half_outside(labels):
    # By labels alone: what is outside the organ's own surface is measured on a tumor-free phantom.
    bare = phantom_labels(msgspec.structs.replace(FIRST, tumors=()), VOXEL)
    points = lps_of(labels, np.argwhere(labels.labels == 3))
    outside = np.nan_to_num(read_at(bare, points)) == 0
    assert 0.4 < outside.mean() < 0.6
    endophytic = read_at(bare, lps_of(labels, np.argwhere(labels.labels == 2)))
    assert (endophytic == 1).all()
    deep = ndimage.distance_transform_edt(labels.labels > 0, sampling=VOXEL)
    assert deep[labels.labels == 2].min() >= 2


def test_tumors_stay_apart(labels):
    for parameters in (FIRST, second_phantom()):
        tumors = phantom_labels(parameters, 1.5)
        for n in range(2, tumors.labels.max() + 1):
            others = (tumors.labels > 1) & (tumors.labels != n)
            gap = ndimage.distance_transform_edt(~others, sampling=1.5)
            assert gap[tumors.labels == n].min() >= 3


def test_the_exophytic_tumor_faces_an_anterior_camera(labels):
    first_seen = (labels.labels > 0).argmax(axis=1)  # along +y: from anterior to posterior
    seen = np.take_along_axis(labels.labels, first_seen[:, None], 1)[:, 0]
    columns = (labels.labels == 3).any(axis=1)
    assert (seen[columns] == 3).mean() > 0.9
    assert not (seen == 2).any()


@pytest.mark.parametrize(("side", "medial"), [("right", 1), ("left", -1)])
def test_the_hilum_is_medial(side, medial):
    bare = phantom_labels(PhantomParameters(tumors=(), side=side), VOXEL)
    # Dents are what a ball of 15 mm cannot reach from outside: closing fills them.
    organ = np.pad(bare.labels > 0, 18)
    near = ndimage.distance_transform_edt(~organ) < 15
    closed = ndimage.distance_transform_edt(near) >= 15
    dent = np.argwhere(closed & ~ndimage.binary_dilation(organ)) - 18
    assert len(dent) > 500
    offset = lps_of(bare, dent)[:, 0] - FIRST.center_lps_mm[0]
    assert (np.sign(offset) == medial).mean() > 0.95


def test_left_is_the_mirror_image_of_right(labels):
    left = phantom_labels(msgspec.structs.replace(FIRST, side="left"), VOXEL)
    points = lps_of(labels, np.argwhere(labels.labels))
    points[:, 0] = 2 * FIRST.center_lps_mm[0] - points[:, 0]
    assert np.array_equal(read_at(left, points), labels.labels[labels.labels > 0])


def test_no_mirror_image_or_half_turn_passes_for_the_organ():
    axes = (np.arange(-60.0, 60.5, 1.5),) * 3
    organ = organ_field(FIRST, axes) < 0
    for flips in itertools.product((False, True), repeat=3):
        turned = np.flip(organ, [axis for axis in range(3) if flips[axis]])
        overlap = (organ & turned).sum() / (organ | turned).sum()
        assert (overlap == 1) == (not any(flips))
        assert overlap < 0.96 or not any(flips)


def test_every_parameter_is_read():
    changed = {
        "size_mm": (64.0, 50.0, 110.0),
        "bend_mm": 6.0,
        "taper": 0.02,
        "hilum_depth_mm": 8.0,
        "lump_mm": 0.0,
        "shape_seed": 5,
        "tumors": FIRST.tumors[:1],
        "side": "left",
        "center_lps_mm": (0.0, 0.0, 0.0),
    }
    assert set(changed) == set(FIRST.__struct_fields__)
    before = phantom_labels(FIRST, 2.0)
    for key, value in changed.items():
        after = phantom_labels(msgspec.structs.replace(FIRST, **{key: value}), 2.0)
        same = np.array_equal(before.labels, after.labels)
        assert not (same and np.array_equal(before.lps_from_index, after.lps_from_index)), key


def test_parameters_survive_json():
    data = msgspec.json.decode(msgspec.json.encode(to_builtins(second_phantom())))
    assert from_builtins(data, PhantomParameters, "test") == second_phantom()
    with pytest.raises(InputError, match="unknown field"):
        from_builtins({**data, "colour": 3}, PhantomParameters, "test")


def test_refusals():
    near = (TumorParameters(diameter_mm=30.0, center_mm=(0.0, 0.0, 0.0)),) * 2
    with pytest.raises(InputError, match=r"3\.0 mm or more apart"):
        PhantomParameters(tumors=near)
    far = (TumorParameters(diameter_mm=10.0, center_mm=(90.0, 0.0, 0.0)),)
    with pytest.raises(InputError, match="wholly outside"):
        phantom_labels(PhantomParameters(tumors=far), 2.0)
    with pytest.raises(InputError, match=r"0\.2 to 4"):
        phantom_labels(FIRST, 20.0)
    with pytest.raises(InputError, match="20 to 250"):
        PhantomParameters(size_mm=(0.06, 0.05, 0.11))
    with pytest.raises(InputError, match="psf_sigma_mm"):
        ScannerParameters(psf_sigma_mm=float("nan"))
    with pytest.raises(InputError, match="50 million"):
        phantom_labels(PhantomParameters(size_mm=(200.0, 200.0, 200.0)), 0.3)
    with pytest.raises(InputError, match="-200 to 200"):
        TumorParameters(diameter_mm=30.0, center_mm=(0.0, float("nan"), 0.0))
    with pytest.raises(InputError, match="block_size_mm"):
        ScannerParameters(block_size_mm=(-1.0, 2.0, 3.0))
    with pytest.raises(InputError, match="tilt_deg"):
        ScannerParameters(tilt_deg=(float("nan"), 0.0, 0.0))
    with pytest.raises(InputError, match="spacing"):
        ScannerParameters(spacing_mm=(0.0, 1.0, 1.0))
