"""What cameras see past the rim of a flap, and of how much of a flap nothing is seen."""

from __future__ import annotations

import msgspec
import numpy as np
import trimesh

from tumortrack.assessment.sight import cloud_shares, seen_through
from tumortrack.assessment.verdict import Sight, finding_of
from tumortrack.core.camera import d405
from tumortrack.core.evidence import Touch
from tumortrack.core.render import render_depth
from tumortrack.core.report import CutReport, EvidenceReport, FitReport, PartReport
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud

LIMIT = 0.05  # from which an answer is poor


def stepped(shift_mm: float, deep_mm: float = 12.0) -> Mesh:
    """A plate of 60 x 40 mm, 150 mm away, on which a block of 30 x 30 mm is lifted."""
    plate = trimesh.creation.box((60, 40, 20))
    plate.apply_translation((0, 0, 160))
    block = trimesh.creation.box((30, 30, deep_mm))
    block.apply_translation((shift_mm, 0, 150 - deep_mm / 2))
    both = trimesh.util.concatenate([plate, block])
    return Mesh(np.asarray(both.vertices, float), np.asarray(both.faces))


def seen(mesh: Mesh) -> DepthFrame:
    return render_depth(mesh.vertices_mm, mesh.faces, d405())


def cloud(frame: DepthFrame) -> SensorCloud:
    rows, columns = np.nonzero(np.isfinite(frame.depth_mm))
    z, camera = frame.depth_mm[rows, columns], frame.intrinsics
    x, y = (columns - camera.cx) * z / camera.fx, (rows - camera.cy) * z / camera.fy
    return SensorCloud(np.stack([x, y, z], axis=1).astype(np.float32)[::20])


def test_a_flap_a_little_off_is_not_seen_through():
    estimate, frame = stepped(0.0), seen(stepped(2.5))
    intact, _, in_sight = seen_through(estimate, frame)
    cut, _, same = seen_through(estimate, frame, cut=True)
    assert intact > 0.02
    assert cut < 0.3 * intact
    assert same == in_sight
    assert cloud_shares(estimate, cloud(frame), cut=True)[0] < 0.3 * intact


def test_a_flap_that_is_elsewhere_is_seen_through():
    estimate, frame = stepped(0.0), seen(stepped(12.0))
    assert seen_through(estimate, frame, cut=True)[0] > LIMIT
    assert cloud_shares(estimate, cloud(frame), cut=True)[0] > LIMIT


def report_of(share: float, *evidence: EvidenceReport) -> FitReport:
    part = PartReport(
        label=1, found=True, center_mm=(0.0, 0.0, 150.0), box_mm=((-9.0, -9, 141), (9.0, 9, 159))
    )
    return FitReport(
        parts={"kidney": part, "tumor_1": part},
        cut=CutReport(places=100, kerf_mm=1.5, flaps={"tumor_1": share}),
        evidence=evidence,
    )


def kind(report: FitReport) -> str | None:
    finding = finding_of(report, {}, Sight())
    return None if finding is None else finding.kind


def test_an_answer_that_shows_nothing_of_a_flap_is_poor():
    assert kind(report_of(0.14)) == "flap"
    assert kind(report_of(0.6)) != "flap"
    assert kind(msgspec.structs.replace(report_of(0.14), cut=None)) != "flap"


def test_a_flap_that_a_tool_holds_need_not_be_seen():
    def touch(place, **more):
        known = {"name": Touch(place_mm=place).name, "part": "", "tool": "", "std_mm": 1.0}
        known |= {"off_mm": 0.2, "information_gain": 0.5, "rejected": False, "before": False}
        return EvidenceReport(**known | {"places_mm": (place,)} | more)

    assert kind(report_of(0.14, touch((0.0, 0.0, 140.0)))) != "flap"
    assert kind(report_of(0.14, touch((80.0, 0.0, 150.0)))) == "flap"
    assert kind(report_of(0.14, touch((0.0, 0.0, 140.0), rejected=True))) == "flap"
