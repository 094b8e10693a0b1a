"""What is late or stretched in all images of a tracked probe is found, or said to be open."""

from dataclasses import replace

import numpy as np
import pytest

import tumortrack as tt
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.report import Cause
from tumortrack.core.ultrasound import ImageErrors, ProbeRecording
from tumortrack.registration.probe import UNKNOWN, FoundErrors, believed
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks.probe import Sweep, record

ERRORS = ImageErrors(lag_s=0.35, depth=0.09, width=-0.02)
NOTHING = np.zeros((0, 3))
STEADY = {"passes": 1, "tilt_deg": 0.0}


@pytest.fixture(scope="module")
def tracker(elastic_model):
    return Tracker(tt.load_model(elastic_model, "cpu"))


@pytest.fixture(scope="module")
def scene(phantom_case):
    return tt.simulate_scenes(phantom_case, seed=5)[0]


SWEPT: dict[Sweep, ProbeRecording] = {}  # each takes seconds


def swept(scene, **changed) -> ProbeRecording:
    sweep = Sweep(errors=changed.pop("errors", ERRORS), **changed)
    if sweep not in SWEPT:
        SWEPT[sweep] = record(scene.reference, sweep, np.random.default_rng(3))
    return SWEPT[sweep]


def off_mm(estimate, scene):
    there = estimate.motion.forward(scene.targets.points_ct)
    return np.linalg.norm(there - scene.targets.points_mm, axis=1)


def located(tracker, scene, camera, evidence):
    points, frame = (scene.cloud, "camera") if camera else (NOTHING, "Tracker")
    return tracker.locate(points, evidence=evidence, frame=frame, grid=32)


@pytest.mark.parametrize("camera", [True, False])
def test_lag_and_scales_are_found_with_the_organ(tracker, scene, camera):
    recording = swept(scene)
    estimate = located(tracker, scene, camera, [recording])
    (probe,) = estimate.report.probes
    assert not probe.undetermined
    assert probe.lag_s == pytest.approx(ERRORS.lag_s, abs=0.03)
    assert probe.depth == pytest.approx(ERRORS.depth, abs=0.02)
    assert probe.width == pytest.approx(ERRORS.width, abs=0.02)
    off = [probe.lag_s, probe.depth, probe.width] - np.array(ERRORS)
    std = np.array([probe.lag_std_s, probe.depth_std, probe.width_std])
    assert (np.abs(off) < 3 * std).all()
    assert probe.tool == "probe"
    places = sum(len(each.places_mm) for each in estimate.report.evidence)
    assert 0.9 * probe.places < places <= probe.places  # some have no pose so early
    assert off_mm(estimate, scene).mean() < 1.2
    assert estimate.frame == ("camera" if camera else "Tracker")
    assert (probe.shift_std_mm > 0) is not camera


def test_a_recording_without_errors_has_none(tracker, scene):
    (probe,) = located(tracker, scene, True, [swept(scene, errors=ImageErrors())]).report.probes
    assert np.abs([probe.lag_s, probe.depth, probe.width]).max() < 0.02


def test_the_pose_does_not_take_up_what_a_steady_sweep_leaves_open(tracker, scene):
    recording = swept(scene, **STEADY)
    alone = located(tracker, scene, False, [recording])
    (probe,) = alone.report.probes
    assert "lag" in probe.undetermined
    assert alone.quality == "poor"
    assert alone.assessment.causes[0].cause is Cause.PROBE
    off, bounds = off_mm(alone, scene), alone.assessment.bounds
    assert off.max() < max(bound.error_bound95_mm for bound in bounds.values())
    with_camera, without = (
        located(tracker, scene, True, evidence) for evidence in ([recording], [])
    )
    assert off_mm(with_camera, scene).mean() < off_mm(without, scene).mean() + 0.1


def test_what_errors_leave_open_is_in_the_deviations_of_places(scene):
    recording = swept(scene, pose_std_mm=0.0, **STEADY).thinned(200)
    places_mm = recording.places_mm()
    known = np.isfinite(places_mm).all(1)
    of_lag = FoundErrors(ImageErrors(), np.diag([0.2**2, 0.0, 0.0]), 0.0)
    by_lag = believed(recording, of_lag)
    assert by_lag.shared_std_mm == pytest.approx(np.hypot(1.0, 0.2 * 10), rel=0.02)
    assert by_lag.std_mm == pytest.approx(1.0, abs=0.02)
    of_depth = FoundErrors(ImageErrors(), np.diag([0.0, 0.05**2, 0.0]), 0.0)
    depths_mm = recording.places_px[known, 1] * recording.probe_from_image[1, 1]
    by_depth = believed(recording, of_depth)
    assert by_depth.shared_std_mm == pytest.approx(np.hypot(1, 0.05 * depths_mm.mean()), rel=0.02)
    own_mm = 0.05 * depths_mm.std() / 3**0.5
    assert by_depth.std_mm == pytest.approx(np.hypot(1, own_mm), rel=0.02)
    assert believed(recording, UNKNOWN).std_mm > 1.0


def moving() -> ProbeRecording:
    """10 mm/s along x, three poses; a place in an image before each half."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0, 4, 8]
    return ProbeRecording(
        tool="probe", frame="Tracker", stamps_s=np.array([1.0, 1.4, 1.8]), frame_from_probe=poses,
        probe_from_image=np.diag([0.5, 0.2, 1, 1]), parts=("kidney",),
        places_px=np.array([[10.0, 100.0], [20, 50]]), part=np.zeros(2, int),
        plane=np.array([0, 1]), image_stamps_s=np.array([1.2, 1.7]),
    )  # fmt: skip


def test_lag_moves_places_along_the_way_and_scales_along_and_across_the_beam():
    recording = moving()
    np.testing.assert_allclose(recording.places_mm(), [[7, 20, 0], [17, 10, 0]])
    late = recording.places_mm(ImageErrors(lag_s=0.1))
    np.testing.assert_allclose(late, [[6, 20, 0], [16, 10, 0]])
    scaled = recording.places_mm(ImageErrors(depth=0.1, width=-0.1))
    np.testing.assert_allclose(scaled, [[6.5, 22, 0], [16, 11, 0]])
    assert np.isnan(recording.places_mm(ImageErrors(lag_s=0.3))).tolist() == [
        [True] * 3,
        [False] * 3,
    ]
    moved = recording.moved(np.array([0, 0, 100.0])).places_mm()
    np.testing.assert_allclose(moved, [[7, 20, 100], [17, 10, 100]])


def test_smoothing_keeps_a_steady_way_and_lessens_a_tracker_s_noise():
    many, rng = np.arange(200) / 20, np.random.default_rng(0)
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = 10 * many
    steady = replace(moving(), stamps_s=many, frame_from_probe=poses)
    np.testing.assert_allclose(steady.smoothed().places_mm(), steady.places_mm(), atol=1e-9)
    poses[:, :3, 3] += rng.normal(0, 1, (200, 3))
    noisy = replace(steady, frame_from_probe=poses).smoothed()
    left = noisy.frame_from_probe[:, 0, 3] - 10 * noisy.stamps_s
    assert left.std() < 0.6


def test_thinned_recordings_keep_planes_over_the_whole_time(scene):
    recording = swept(scene)
    thinned = recording.thinned(300)
    assert len(thinned.plane) <= 300
    planes = np.unique(thinned.plane)
    assert planes[0] == recording.plane.min()
    assert planes[-1] == recording.plane.max()
    assert len(planes) >= 100


def test_recordings_are_of_one_answer_not_of_a_stream(tracker, scene):
    recording = swept(scene)
    with refused(InputError):
        tracker.follow(scene.cloud, evidence=[recording])
    with refused(InputError):
        tracker.locate(scene.cloud, evidence=[recording], frame="Tracker")


def stills(scene) -> ProbeRecording:
    """Twelve planes of a sweep, each held still, a minute apart; nothing tells their lag."""
    every = swept(scene, errors=ImageErrors(), pose_std_mm=0.0)
    chosen = np.linspace(5, every.plane.max() - 5, 12).round().astype(int)
    mine = np.isin(every.plane, chosen)
    number = np.searchsorted(chosen, every.plane[mine])
    return replace(
        every, stamps_s=60.0 * np.arange(12), frame_from_probe=every.frame_from_probe[chosen],
        places_px=every.places_px[mine], part=every.part[mine], plane=number,
        image_stamps_s=60.0 * number,
    )  # fmt: skip


@pytest.mark.parametrize("camera", [True, False])
def test_planes_of_a_probe_at_rest_have_no_lag_and_count_all_the_same(tracker, scene, camera):
    estimate = located(tracker, scene, camera, [stills(scene)])
    (probe,) = estimate.report.probes
    assert "lag" in probe.undetermined
    assert probe.lag_s == pytest.approx(0.0, abs=1e-6)
    assert probe.lag_std_s == pytest.approx(0.5, rel=0.01)  # as before anything was known
    assert off_mm(estimate, scene).mean() < 1.5
    assert all(not each.rejected for each in estimate.report.evidence)


def test_recordings_without_poses_and_of_other_parts_are_refused(tracker, scene):
    recording = swept(scene)
    late = replace(recording, image_stamps_s=recording.image_stamps_s + 1000)
    with refused(InputError, "probe"):
        located(tracker, scene, True, [late])
    with refused(InputError, "liver"):
        located(tracker, scene, True, [replace(recording, parts=("liver", *recording.parts[1:]))])
    for poses in (slice(1), slice(None, None, -1)):
        with refused(InputError, "probe"):
            replace(
                recording,
                stamps_s=recording.stamps_s[poses],
                frame_from_probe=recording.frame_from_probe[poses],
            )
