"""Beads by their names and a frame by its beads: known answers, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack_experiment.kit_file import Bead, Kit
from tumortrack_experiment.register import beads

BEADS_MM = np.array(
    [[-80, -50, 12], [-70, 62, 30], [5, 70, 18], [82, 55, 24], [76, -48, 36], [10, -72, 20.0]]
)
TUMORS_MM = np.array([[20.0, 10, 25], [-30, -5, 40]])


def a_kit(beads_mm=BEADS_MM):
    return Kit(
        case_sha256="0" * 64,
        bead_diameter_mm=6.0,
        beads=tuple(
            Bead(name=f"B{n}", center_mm=tuple(at)) for n, at in enumerate(beads_mm.tolist(), 1)
        ),
        base_from_ct=tuple(map(tuple, np.eye(4).tolist())),
        organ_ml=180.0,
        tumors_ml=(20.0, 10.0),
    )


def a_pose(seed):
    rng = np.random.default_rng(seed)
    return rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-300, 300, 3))


def seen(pose, which=slice(None), clutter=0, error_mm=0.0, seed=0):
    rng = np.random.default_rng(seed)
    at = transform_points(pose, BEADS_MM)[which]
    at = at + rng.normal(0, error_mm / np.sqrt(3), at.shape)
    others = transform_points(pose, rng.uniform([-90, -90, 0], [90, 90, 60], (clutter, 3)))
    return rng.permutation(np.concatenate([at, others]))


def named(points_mm, device=beads.CT, kit=None):
    return beads.name_beads(kit or a_kit(), points_mm, device)


@pytest.mark.parametrize("seed", range(4))
def test_beads_are_named_among_other_things(seed):
    pose = a_pose(seed)
    found = named(seen(pose, [0, 1, 3, 4, 5], clutter=12, error_mm=0.2, seed=seed))
    assert found.found.tolist() == [True, True, False, True, True, True]
    true = transform_points(pose, BEADS_MM)
    assert np.abs(found.points_mm - true)[found.found].max() < 0.6
    (note,) = found.notes
    assert "B3" in note


def test_a_moved_bead_is_named_and_left_out():
    points = transform_points(a_pose(1), BEADS_MM)
    points[2] += [0, 3, 2]
    found = named(points)
    (note,) = found.notes
    assert "B3" in note
    assert "3.6 mm" in note
    assert not found.found[2]
    assert found.found.sum() == 5


def test_three_beads_are_refused():
    with refused(InputError, "B4", "B5", "B6"):
        named(seen(a_pose(2), [0, 1, 2]))


def test_of_four_with_one_moved_none_is_guessed():
    points = transform_points(a_pose(3), BEADS_MM[:4])
    points[1] += [0, 0, 4]
    with refused(InputError, "B2", "4.0 mm"):
        named(points)


SQUARE = np.array([[-50, -50, 10], [50, -50, 10], [50, 50, 10], [-50, 50, 10.0]])
LINE = np.array([[-70, 0, 10], [-20, 0, 10], [40, 0, 10], [80, 0, 10], [0, 0, 11.0]])


@pytest.mark.parametrize(
    ("kit_mm", "seen_mm"),
    [(BEADS_MM, BEADS_MM * [-1, 1, 1]), (SQUARE, SQUARE), (LINE, LINE)],
    ids=["a mirror image", "the same after a turn", "on a line"],
)
def test_beads_that_do_not_determine_a_frame_are_refused(kit_mm, seen_mm):
    with pytest.raises(InputError):
        named(transform_points(a_pose(4), seen_mm), kit=a_kit(kit_mm))


def both(error_mm, seed, kit=None, moved=None):
    """CT and camera of one base, with errors; the registration, and where the camera truly is."""
    poses = a_pose(seed), a_pose(seed + 100)
    rng = np.random.default_rng(seed)
    found = []
    for pose, device in zip(poses, (beads.CT, beads.CAMERA), strict=True):
        at = transform_points(pose, BEADS_MM) + rng.normal(0, error_mm / np.sqrt(6), (6, 3))
        if moved is not None and device is beads.CAMERA:
            at[moved[0]] += moved[1]
        found.append(beads.NamedBeads(device, at, pose))
    return beads.register(kit or a_kit(), *found), poses[1] @ np.linalg.inv(poses[0]), poses[0]


def test_without_errors_the_frames_are_found_exactly():
    one, true, pose = both(0.0, 0)
    assert np.allclose(one.to_from, true, atol=1e-9)
    assert one.fre_mm < 1e-9
    # What the devices are known for is stated nevertheless.
    usual = np.hypot(beads.CT.error_mm, beads.CAMERA.error_mm)
    assert one.fle_mm == pytest.approx(usual)
    assert one.tre_mm(transform_points(pose, TUMORS_MM)).max() > usual / 3


def test_the_expected_error_is_the_one_that_occurs():
    """Monte Carlo: rms error at each tumor, and at the beads, over 1,500 draws of one error."""
    rng = np.random.default_rng(7)
    fle_mm, errors, left = 0.6, [], []
    for _ in range(1500):
        noisy = BEADS_MM + rng.normal(0, fle_mm / np.sqrt(3), BEADS_MM.shape)
        to_from, left_mm = beads.fit_rigid(BEADS_MM, noisy)
        errors.append(transform_points(to_from, TUMORS_MM) - TUMORS_MM)
        left.append(left_mm)
    true_mm = np.sqrt((np.array(errors) ** 2).sum(2).mean(0))
    expected_mm = beads.expected_tre_mm(BEADS_MM, TUMORS_MM, fle_mm)
    assert true_mm == pytest.approx(expected_mm, rel=0.05)
    assert np.sqrt((np.array(left) ** 2).mean()) == pytest.approx(fle_mm * np.sqrt(1 - 2 / 6), 0.03)


def test_the_stated_bound_holds():
    """In 95 of 100 registrations at least, where devices err as they are known to."""
    usual = np.hypot(beads.CT.error_mm, beads.CAMERA.error_mm)
    held = 0
    for seed in range(60):
        one, true, pose = both(usual, seed)
        at = transform_points(pose, TUMORS_MM)
        off = transform_points(one.to_from, at) - transform_points(true, at)
        held += np.linalg.norm(off, axis=1).max() < one.bound_mm(at)
    assert held >= 57


def test_a_bead_that_moved_between_two_devices_is_named():
    one, _, _ = both(0.3, 3, moved=(4, [3.0, 1, 2]))
    assert "B5" not in one.beads
    assert len(one.beads) == 5
    assert "B5" in one.notes[0]
