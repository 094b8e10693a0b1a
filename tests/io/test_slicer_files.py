"""What 3D Slicer and viewers of DICOM open: read back by others, and nothing mirrored."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from imaging_objects import (
    BLOB_VALUES,
    BLOBS_LPS,
    OBLIQUE,
    SHAPE,
    affine_lps,
    blob_array,
    blob_centres,
    kidney_labels,
    write_dicom,
)
from live_objects import small_estimate
from refused import refused
from tumortrack.case.meshes import read_meshes
from tumortrack.case.surface import surfaces
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.core.patient import Patient
from tumortrack.core.types import CameraLabels, LabelVolume, Mesh, Volume
from tumortrack.io.case import Case, save_case
from tumortrack.io.mesh_files import read_mesh, write_mesh
from tumortrack.io.run_folder import write_estimate
from tumortrack.io.segmentation_files import segments, write_dicom_seg, write_seg_nrrd
from tumortrack.io.volume import read_labels
from tumortrack.simulation.phantom.dicom import write_dicom_series

PARTS = ("kidney", "tumor_1", "tumor_2", "tumor_3")  # the four blobs
ORIENTATIONS = ("LPS", "RAS", "SAR", "PIL", "ALI")


def blob_labels(lps_from_index: np.ndarray) -> LabelVolume:
    """The unequal blobs with labels 1, 2, 3, 4 instead of their values."""
    array = blob_array(lps_from_index, SHAPE)
    labels = np.zeros(SHAPE, np.uint8)
    for label, value in enumerate(BLOB_VALUES, 1):
        labels[array == value] = label
    return LabelVolume(labels, lps_from_index)


def centres_by_label(labels: np.ndarray, lps_from_index: np.ndarray) -> np.ndarray:
    lookup = np.array([0, *BLOB_VALUES])
    return blob_centres(lookup[labels], lps_from_index)


@pytest.mark.parametrize("axes", ORIENTATIONS)
@pytest.mark.parametrize("oblique", [False, True])
def test_seg_nrrd_keeps_every_blob_in_its_place(tmp_path: Path, axes: str, oblique: bool) -> None:
    """Read by SimpleITK, which is in LPS, and by our own reader."""
    import SimpleITK as sitk  # noqa: N813

    affine = affine_lps(axes, (0.9, 1.1, 1.3), OBLIQUE if oblique else np.eye(3))
    volume = blob_labels(affine)
    path = tmp_path / "labels.seg.nrrd"
    write_seg_nrrd(path, volume.labels, affine, segments(PARTS))
    image = sitk.ReadImage(str(path))
    theirs = np.eye(4)
    theirs[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    theirs[:3, 3] = image.GetOrigin()
    array = sitk.GetArrayFromImage(image).transpose(2, 1, 0)
    np.testing.assert_allclose(centres_by_label(array, theirs), BLOBS_LPS, atol=0.3)
    assert b"\nspace: left-posterior-superior\n" in path.read_bytes()
    ours = read_labels(path)
    np.testing.assert_array_equal(ours.labels, volume.labels)
    np.testing.assert_allclose(ours.lps_from_index, affine, atol=1e-12)


def test_a_runs_files_share_one_frame(tmp_path: Path) -> None:
    """Voxels of labels.seg.nrrd lie inside the meshes beside it, both taken as LPS."""
    estimate = small_estimate()
    with pytest.raises(InputError):
        write_estimate(tmp_path / "live", estimate)
    assert not (tmp_path / "live").exists()
    shape, voxel_mm = (60, 62, 64), 1.0
    camera_from_index = np.eye(4)
    camera_from_index[:3, 3] = [-26, -33, 98]
    index = np.indices(shape).reshape(3, -1).T * voxel_mm + camera_from_index[:3, 3]
    labels = np.zeros(len(index), np.uint8)
    for label, mesh in enumerate(estimate.meshes.values(), 1):
        middle, radius = mesh.box_mm.mean(0), np.ptp(mesh.box_mm[:, 0]) / 2
        labels[np.linalg.norm(index - middle, axis=1) < 0.98 * radius] = label
    volume = CameraLabels(labels.reshape(shape), camera_from_index)
    estimate = type(estimate)(estimate.cloud, volume, estimate.meshes, estimate.report)
    write_estimate(tmp_path / "run", estimate)
    found = read_labels(tmp_path / "run" / "labels.seg.nrrd")
    np.testing.assert_array_equal(found.labels, volume.labels)
    for label, name in ((2, "tumor_1"), (3, "tumor_2")):
        file = tmp_path / "run" / f"{name}.ply"
        assert b"\ncomment SPACE=LPS\n" in file.read_bytes()[:200]
        voxels = np.argwhere(found.labels == label) @ found.lps_from_index[:3, :3].T
        voxels += found.lps_from_index[:3, 3]
        box = read_mesh(file).box_mm
        assert (voxels > box[0]).all()
        assert (voxels < box[1]).all()
        np.testing.assert_allclose(voxels.mean(0), box.mean(0), atol=0.2)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_meshes_state_lps_and_read_as_before(tmp_path: Path, suffix: str) -> None:
    box = trimesh.creation.box((30.0, 40.0, 50.0))
    box.apply_translation((5, -7, 11))
    mesh = Mesh(box.vertices, box.faces)
    path = tmp_path / f"kidney{suffix}"
    write_mesh(path, mesh)
    head = path.read_bytes()[:120]
    assert b"SPACE=LPS" in (head[:80] if suffix == ".stl" else head)
    if suffix == ".ply":
        assert head.split(b"\n")[1].startswith(b"format ")  # where strict readers want it
    again = read_mesh(path)
    np.testing.assert_allclose(again.box_mm, mesh.box_mm, atol=1e-6)
    assert again.volume_mm3 == pytest.approx(60_000, rel=1e-6)
    anatomy, notes = read_meshes([*tmp_path.iterdir()])
    assert not any("SPACE" in note for note in notes)  # LPS is what it takes anyway
    np.testing.assert_allclose(anatomy.organ.box_mm, mesh.box_mm, atol=1e-3)


# ---------------------------------------------------------------- DICOM segmentation


def seg_voxels_lps(path: Path) -> dict[int, np.ndarray]:
    """Segment number -> LPS mm of its voxels, by pydicom from each frame's own position."""
    import pydicom

    data = pydicom.dcmread(path)
    shared = data.SharedFunctionalGroupsSequence[0]
    spacing = [float(x) for x in shared.PixelMeasuresSequence[0].PixelSpacing]
    directions = shared.PlaneOrientationSequence[0].ImageOrientationPatient
    along_row, along_column = np.reshape([float(x) for x in directions], (2, 3))
    found: dict[int, list] = {}
    for frame, group in zip(data.pixel_array, data.PerFrameFunctionalGroupsSequence, strict=True):
        corner = [float(x) for x in group.PlanePositionSequence[0].ImagePositionPatient]
        number = int(group.SegmentIdentificationSequence[0].ReferencedSegmentNumber)
        row, column = np.nonzero(frame)
        points = np.outer(column * spacing[1], along_row) + np.outer(row * spacing[0], along_column)
        found.setdefault(number, []).append(points + corner)
    return {number: np.concatenate(parts) for number, parts in found.items()}


def ct_series(folder: Path, affine: np.ndarray) -> Path:
    write_dicom_series(Volume(blob_array(affine, SHAPE).astype(np.float32), affine), folder)
    return folder


@pytest.mark.parametrize(("axes", "oblique"), [("LPS", False), ("PIL", True), ("RAS", True)])
def test_dicom_seg_lies_on_the_blobs(tmp_path: Path, axes: str, oblique: bool) -> None:
    """The labels' grid is a turned and cropped one of the CT's: the place counts, not the index."""
    import highdicom as hd

    affine = affine_lps(axes, (0.9, 1.1, 1.3), OBLIQUE if oblique else np.eye(3))
    ct = ct_series(tmp_path / "ct", affine)
    whole = blob_labels(affine)
    crop = np.eye(4)
    crop[:3, 3] = [2, 1, 3]
    turn = np.array([[0, 0, -1, 30], [1, 0, 0, 0], [0, -1, 0, 30], [0, 0, 0, 1.0]])
    index = np.indices((33, 31, 31)).reshape(3, -1).T
    source = np.rint(index @ (crop @ turn)[:3, :3].T + (crop @ turn)[:3, 3]).astype(int)
    labels = LabelVolume(whole.labels[tuple(source.T)].reshape(33, 31, 31), affine @ crop @ turn)
    path = tmp_path / "segmentation.dcm"
    write_dicom_seg(path, labels, segments(PARTS, "left"), ct)
    places = seg_voxels_lps(path)
    for label, centre in enumerate(BLOBS_LPS, 1):
        inside = np.argwhere(labels.labels == label) @ labels.lps_from_index[:3, :3].T
        inside += labels.lps_from_index[:3, 3]
        assert len(places[label]) == len(inside) > 50
        np.testing.assert_allclose(places[label].mean(0), inside.mean(0), atol=1e-4)
        np.testing.assert_allclose(places[label].mean(0), centre, atol=0.3)
    read = hd.seg.segread(path)
    assert [read.get_segment_description(n).segment_label for n in (1, 2)] == ["kidney", "tumor_1"]
    volume = read.get_volume(combine_segments=True)
    np.testing.assert_array_equal(
        np.bincount(volume.array.ravel(), minlength=5)[1:], np.bincount(labels.labels.ravel())[1:]
    )


def test_dicom_seg_refers_to_its_ct(tmp_path: Path) -> None:
    import pydicom

    affine = affine_lps("LPS", (1.0, 1.0, 1.0), np.eye(3))
    ct = ct_series(tmp_path / "ct", affine)
    path = tmp_path / "seg.dcm"
    write_dicom_seg(path, blob_labels(affine), segments(PARTS, "right"), ct)
    data = pydicom.dcmread(path)
    slices = [pydicom.dcmread(file, stop_before_pixels=True) for file in ct.iterdir()]
    assert data.Modality == "SEG"
    assert data.SegmentationType == "BINARY"
    for tag in ("StudyInstanceUID", "FrameOfReferenceUID", "PatientID"):
        assert data[tag].value == slices[0][tag].value
    assert data.SeriesInstanceUID != slices[0].SeriesInstanceUID
    kidney, tumor = data.SegmentSequence[:2]
    assert kidney.SegmentedPropertyTypeCodeSequence[0].CodeValue == "64033007"
    modifier = kidney.SegmentedPropertyTypeCodeSequence[0]
    modifier = modifier.SegmentedPropertyTypeModifierCodeSequence[0]
    assert (modifier.CodeValue, modifier.CodeMeaning) == ("24028007", "Right")
    assert tumor.SegmentedPropertyTypeCodeSequence[0].CodeValue == "4147007"
    region = tumor.AnatomicRegionSequence[0]
    assert region.AnatomicRegionModifierSequence[0].CodeValue == "24028007"
    position = {one.SOPInstanceUID: one.ImagePositionPatient for one in slices}
    for group in data.PerFrameFunctionalGroupsSequence:
        source = group.DerivationImageSequence[0].SourceImageSequence[0]
        place = group.PlanePositionSequence[0].ImagePositionPatient
        assert place == position[source.ReferencedSOPInstanceUID]


def test_another_ct_is_refused(tmp_path: Path) -> None:
    affine = affine_lps("LPS", (1.0, 1.0, 1.0), np.eye(3))
    labels, parts = blob_labels(affine), segments(PARTS)
    ct, path = ct_series(tmp_path / "ct", affine), tmp_path / "seg.dcm"
    finer, aside, away = np.diag([0.5, 1, 1, 1.0]), np.eye(4), np.eye(4)
    aside[0, 3], away[0, 3] = 0.4, 30
    for by in (finer, aside, away):
        with pytest.raises(InputError):
            write_dicom_seg(path, LabelVolume(labels.labels, affine @ by), parts, ct)
    bare = tmp_path / "bare"
    write_dicom(bare, blob_array(affine, SHAPE), affine)  # without a patient's tags
    with pytest.raises(InputError):
        write_dicom_seg(path, labels, parts, bare)
    assert not path.exists()


def test_without_highdicom_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "highdicom", None)
    affine = affine_lps("LPS", (1.0, 1.0, 1.0), np.eye(3))
    ct = ct_series(tmp_path / "ct", affine)
    with refused(InputError, to_install("tumortrack[dicom]")):
        write_dicom_seg(tmp_path / "seg.dcm", blob_labels(affine), segments(PARTS), ct)


def test_export_writes_both(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from tumortrack.cli.cases import Export

    labels = kidney_labels((2.0, 2.0, 2.0))
    anatomy, _ = surfaces(labels)
    whose = Patient("P1", "left")
    case = Case(anatomy, labels, (0.0, -1.0, 0.0), patient=whose)
    (tmp_path / "case").mkdir()
    save_case(case, tmp_path / "case")
    hu = np.where(labels.labels > 0, 100, -100).astype(np.float32)
    write_dicom_series(Volume(hu, labels.lps_from_index), tmp_path / "ct")
    with refused(InputError, "PHANTOM"):
        Export(case=tmp_path / "case", out=tmp_path / "out", dicom=tmp_path / "ct").run()
    asked = {"case": tmp_path / "case", "dicom": tmp_path / "ct", "patient": "PHANTOM"}
    Export(out=tmp_path / "out", **asked).run()
    assert "segmentation.dcm" in capsys.readouterr().out
    again = read_labels(tmp_path / "out" / "case.seg.nrrd")
    np.testing.assert_array_equal(again.labels, labels.labels)
    assert b"SCT^7771000^Left" in (tmp_path / "out" / "case.seg.nrrd").read_bytes()
    places = seg_voxels_lps(tmp_path / "out" / "segmentation.dcm")
    counts = np.bincount(labels.labels.ravel())
    assert [len(places[n]) for n in (1, 2, 3)] == counts[1:].tolist()
    Export(case=tmp_path / "case", out=tmp_path / "plain").run()
    assert sorted(p.name for p in (tmp_path / "plain").iterdir()) == ["case.seg.nrrd", "scene.mrb"]
    with pytest.raises(InputError):
        Export(case=tmp_path / "case", out=tmp_path / "out").run()
    for option in ({"series": "1"}, {"patient": "PHANTOM"}):
        with refused(InputError, f"--{next(iter(option))}"):
            Export(case=tmp_path / "case", out=tmp_path / "new", **option).run()
    with pytest.raises(InputError):  # of an empty variable, say
        Export(out=tmp_path / "new", **{**asked, "patient": ""}).run()
