"""From a CT by HU windows, and from label maps: only the organ and its tumors remain."""

import numpy as np
import pytest
from scipy import ndimage

from imaging_objects import kidney_labels
from refused import refused
from tumortrack.case.hu_windows import segment_ct
from tumortrack.case.select import select_labels
from tumortrack.case.surface import surfaces
from tumortrack.core.errors import InputError
from tumortrack.core.grid import voxel_ml
from tumortrack.core.report import Finding
from tumortrack.core.types import LabelVolume, Volume


def volumes(labels: LabelVolume) -> np.ndarray:
    return np.bincount(labels.labels.ravel()) * voxel_ml(labels.lps_from_index)


def scene(*, table_mm: int, block_hu: float) -> tuple[Volume, LabelVolume]:
    """The test kidney on a table (gel-like HU), a block beside it, blurred and noisy."""
    truth = kidney_labels()
    labels = np.pad(truth.labels, ((30, 60), (30, 40), (15, 15)))
    affine = truth.lps_from_index.copy()
    affine[:3, 3] -= [30, 30, 15]
    hu = np.choose(labels, [-1000.0, 40.0, 570.0, 570.0])
    bottom = int(np.flatnonzero(labels.any((0, 2)))[-1]) + 1
    hu[12:210, bottom : bottom + table_mm, 4:-4] = 20.0
    hu[168:198, bottom - 40 : bottom, 30:70] = block_hu
    hu = ndimage.gaussian_filter(hu, 0.7)
    hu += np.random.default_rng(5).normal(0, 15, hu.shape)
    return Volume(hu, affine), LabelVolume(labels, affine)


@pytest.mark.parametrize(
    ("table_mm", "block_hu"), [(3, 400.0), (20, 1800.0), (3, 20.0), (20, 600.0)]
)
def test_table_block_and_rims_go_and_the_rest_keeps_its_place(table_mm, block_hu):
    volume, truth = scene(table_mm=table_mm, block_hu=block_hu)
    found, notes = segment_ct(volume)
    assert found.labels.max() == 3, notes
    expected, have = volumes(truth), volumes(found)
    assert have[2:] == pytest.approx(expected[2:], rel=0.05)
    assert have[1:].sum() == pytest.approx(expected[1:].sum(), rel=0.05)
    for label in (2, 3):  # the same place, not only the same size
        centres = [
            a.lps_from_index @ [*np.argwhere(a.labels == label).mean(0), 1] for a in (truth, found)
        ]
        assert np.linalg.norm(centres[0] - centres[1]) < 0.3


def test_small_bright_pieces_are_reported_and_dropped():
    volume, truth = scene(table_mm=3, block_hu=400.0)
    hu = volume.hu.copy()
    middle = np.argwhere(truth.labels == 1).mean(0).astype(int)
    hu[tuple(slice(m + 8, m + 12) for m in middle)] = 600.0  # 0.064 ml
    found, notes = segment_ct(Volume(hu, volume.lps_from_index))
    assert found.labels.max() == 3
    assert any("0.2 ml" in note for note in notes)
    with_it, _ = segment_ct(Volume(hu, volume.lps_from_index), min_tumor_ml=0.02)
    assert with_it.labels.max() == 4


def test_windows_are_half_open_and_checked():
    truth = kidney_labels()
    hu = np.choose(truth.labels, [-1000.0, -300.0, 300.0, 1000.0])  # the limits themselves
    ct = Volume(hu, truth.lps_from_index)
    found, _ = segment_ct(ct)
    # 1000 lies outside the tumor's window: a hole, filled as organ.
    assert volumes(found)[1] == pytest.approx(volumes(truth)[[1, 3]].sum(), rel=0.01)
    assert volumes(found)[2] == pytest.approx(volumes(truth)[2], rel=0.02)
    for windows in [((300.0, -300.0), (300.0, 1000.0)), ((-300.0, 400.0), (300.0, 1000.0))]:
        with refused(InputError, *windows):
            segment_ct(ct, *windows)


@pytest.mark.parametrize("fill", [-1000.0, 40.0])
def test_an_empty_or_body_like_ct_is_refused(fill):
    with refused(InputError, "--labels"):
        segment_ct(Volume(np.full((90, 90, 90), fill), np.diag([2.0, 2, 2, 1])))


def two_kidneys(tumor_left: int, tumor_right: int) -> LabelVolume:
    """Spheres of 25 mm radius at x = +60 (patient's left) and -60, a tumor in each, specks."""
    labels = np.zeros((190, 60, 60), np.uint8)
    x, y, z = np.ogrid[-95:95, -30:30, -30:30]
    for centre, value in ((60, tumor_left), (-60, tumor_right)):
        labels[(x - centre) ** 2 + y**2 + z**2 < 25**2] = 1
        labels[(x - centre) ** 2 + y**2 + (z - 20) ** 2 < 9**2] = value
    labels[93:95, 30, 30] = 1
    labels[93, 40:42, 30] = 2
    affine = np.eye(4)
    affine[0, 3] = -95
    return LabelVolume(labels, affine)


def centre_x(labels: LabelVolume) -> float:
    return float((labels.lps_from_index @ [*np.argwhere(labels.labels > 0).mean(0), 1])[0])


def test_side_is_the_patients_and_known_where_the_map_has_two_kidneys():
    both = two_kidneys(2, 2)
    # The same patient, array index running the other way.
    flip = np.diag([-1.0, 1, 1, 1])
    flip[0, 3] = both.labels.shape[0] - 1
    mirrored = LabelVolume(both.labels[::-1], both.lps_from_index @ flip)
    for labels, asked, x_mm in (
        (both, "left", 60), (both, "right", -60), (mirrored, "left", 60),
        (two_kidneys(2, 1), "unknown", 60), (two_kidneys(1, 2), "unknown", -60),
    ):  # fmt: skip
        chosen, _, side = select_labels(labels, asked)
        assert centre_x(chosen) == pytest.approx(x_mm, abs=1)
        assert side == ("left" if x_mm > 0 else "right")
    alone = LabelVolume(two_kidneys(2, 0).labels[100:], np.eye(4))  # cut: its middle says nothing
    assert select_labels(alone)[2] == "unknown"
    assert select_labels(alone, "left")[2] == "left"
    only_left = two_kidneys(2, 2).labels.copy()
    only_left[:95] = 0
    with refused(InputError, "--side"):
        select_labels(LabelVolume(only_left, both.lps_from_index), "right")
    torn = LabelVolume(np.concatenate([both.labels[:62], both.labels[128:]]), np.eye(4))
    assert select_labels(torn)[2] == "unknown"  # two pieces, no two kidneys
    with refused(InputError, "--side"):
        select_labels(two_kidneys(1, 1))
    assert select_labels(two_kidneys(1, 1), "left")[0].labels.max() == 1
    assert any("2 specks" in note for note in select_labels(both, "left")[1])


def test_tumor_numbers_are_kept_split_and_closed_up():
    truth = kidney_labels()
    large_first = volumes(truth)
    assert large_first[2] > large_first[3]
    for numbers, tumors, noted in (
        ([0, 1, 2, 3], large_first[2:], None),
        ([0, 1, 3, 2], large_first[:1:-1], None),
        ([0, 1, 7, 4], large_first[:1:-1], "7 is now 3"),
        ([0, 1, 2, 2], large_first[2:], "2 separate pieces"),
    ):
        labels = LabelVolume(np.array(numbers)[truth.labels], truth.lps_from_index)
        kept, notes, _ = select_labels(labels)
        assert volumes(kept)[2:] == pytest.approx(tumors)
        assert any(noted in note for note in notes) if noted else notes == []


def test_chosen_numbers_and_missing_labels():
    truth = kidney_labels()
    other = LabelVolume(np.array([0, 9, 5, 6])[truth.labels], truth.lps_from_index)
    chosen, _, _ = select_labels(other, organ=9, tumors=(6,))
    assert volumes(chosen)[2] == pytest.approx(volumes(truth)[3])
    assert select_labels(other, organ=9, tumors=())[0].labels.max() == 1
    for labels, options, named in (
        (other, {}, ("label 1", "[5, 6, 9]")),
        (other, {"organ": 9, "tumors": (4,)}, ("label 4",)),
        (LabelVolume(np.zeros((5, 5, 5)), np.eye(4)), {}, (0,)),
        (LabelVolume(truth.labels, np.diag([0.1, 0.1, 0.1, 1.0])), {}, ("ml", "--organ")),
    ):
        with refused(InputError, *named):
            select_labels(labels, **options)


def beside(gap: int, radius_mm: float = 9.0, spacing_mm: float = 1.0) -> LabelVolume:
    """A ball of organ (25 mm radius) and a ball of tumor, ``gap`` empty voxels between them."""
    n = round(50 / spacing_mm)
    x, y, z = (axis * spacing_mm for axis in np.ogrid[-n : 2 * n, -n:n, -n:n])
    labels = (x**2 + y**2 + z**2 < 25**2).astype(np.uint8)
    first = int(np.flatnonzero(labels.any((1, 2)))[-1]) + 1 + gap
    reach = round(radius_mm / spacing_mm)
    centre = (first + reach - n) * spacing_mm
    labels[(x - centre) ** 2 + y**2 + z**2 <= (reach * spacing_mm) ** 2] = 2
    return LabelVolume(labels, np.diag([spacing_mm] * 3 + [1.0]))


@pytest.mark.parametrize(("gap", "radius_mm"), [(1, 9.0), (3, 9.0), (1, 16.0), (2, 5.0)])
def test_a_tumor_behind_a_thin_gap_belongs_to_its_kidney(gap, radius_mm):
    """Also one larger than 10 ml (radius 16 mm), which is no kidney of its own."""
    truth = beside(gap, radius_mm)
    before = volumes(truth)
    found, notes, _ = select_labels(truth)
    after = volumes(found)
    assert after[2] == before[2]  # the tumor is whole
    assert 0 < after[1] - before[1] < 0.3  # and the gap is filled, no wider than it is
    assert any(f"lies {gap:.1f} mm off" in note for note in notes), notes
    assert ndimage.label(found.labels > 0, np.ones((3, 3, 3)))[1] == 1
    anatomy, _ = surfaces(found)
    assert anatomy.organ.volume_mm3 == pytest.approx(1000 * after[1:].sum(), rel=0.01)
    assert np.ptp(anatomy.organ.box_mm[:, 0]) > 49 + gap + 2 * radius_mm - 1


def test_a_gap_is_closed_at_fine_voxels_too_and_touching_tumors_need_none():
    assert select_labels(beside(4, 9.0, 0.7))[0].labels.max() == 2
    touching = beside(0)
    found, notes, _ = select_labels(touching)
    assert volumes(found)[1:] == pytest.approx(volumes(touching)[1:])
    assert notes == []


def test_a_tumor_far_off_is_refused_or_loudly_left_out():
    far = beside(8, 16.0)
    with refused(InputError, "3 mm", "--tumor 0"):
        select_labels(far)
    alone, _, _ = select_labels(far, tumors=())
    assert alone.labels.max() == 1
    labels = far.labels.copy()
    middle = np.argwhere(labels == 1).mean(0)
    ball = ((np.indices(labels.shape) - middle[:, None, None, None]) ** 2).sum(0) < 9**2
    labels[ball] = 2
    found, notes, _ = select_labels(LabelVolume(labels, far.lps_from_index))
    assert volumes(found)[2] == pytest.approx(float(ball.sum()) / 1000)
    (left_out,) = (note for note in notes if isinstance(note, Finding))
    assert (left_out.kind, left_out.values["what"]) == ("left_out", "tumor")
    assert 17 <= left_out.values["ml"] < 18


def test_a_kidney_mostly_tumor_is_a_kidney_still():
    """5 ml of organ round a tumor of 50 ml, and a speck."""
    x, y, z = np.ogrid[-30:30, -30:30, -30:30]
    distance = np.sqrt(x**2 + y**2 + z**2)
    labels = np.where(distance < 22.8, 2, np.where(distance < 23.6, 1, 0)).astype(np.uint8)
    labels[:2, :2, :2] = 1
    found, _, _ = select_labels(LabelVolume(labels, np.eye(4)))
    assert 3 < volumes(found)[1] < 10
    assert volumes(found)[2] == pytest.approx(49.6, abs=0.5)
