"""prepare end to end, cases on disk, and readers under random damage."""

import contextlib
import json
import re
import warnings

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imaging_objects import kidney_labels, write_dicom, write_nifti, write_nrrd
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.mesh_files import write_anatomy
from tumortrack.core.patient import Patient
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.imaging.case import load_case, save_case
from tumortrack.imaging.options import PrepareOptions
from tumortrack.imaging.prepare import prepare
from tumortrack.imaging.surface import surfaces
from tumortrack.imaging.volume import read_labels, read_raw, read_volume
from tumortrack.phantom.dicom import write_dicom_series


def ct_of(labels: LabelVolume) -> np.ndarray:
    return np.choose(labels.labels, [-1000, 40, 570, 570]).astype(np.int16)


@pytest.mark.slow
def test_the_same_organ_through_every_door_is_the_same_case(tmp_path):
    """DICOM, NIfTI and NRRD CT, a label map, and meshes: the same parts at the same places."""
    truth = kidney_labels((1.0, 1.0, 1.5))
    affine = truth.lps_from_index
    write_dicom(tmp_path / "dicom", ct_of(truth), affine)
    write_nifti(tmp_path / "ct.nii.gz", ct_of(truth), affine, "both")
    write_nrrd(tmp_path / "ct.nrrd", ct_of(truth), affine, True)
    write_nifti(tmp_path / "labels.nii.gz", truth.labels, affine, "sform")
    (tmp_path / "meshes").mkdir()
    write_anatomy(tmp_path / "meshes", surfaces(truth)[0])
    cases = {p.name: prepare(p) for p in sorted(tmp_path.iterdir())}
    assert len(cases) == 5
    reference = surfaces(truth)[0]
    for name, case in cases.items():
        assert case.anatomy.names == ("kidney", "tumor_1", "tumor_2"), name
        for part, wanted in zip(case.anatomy.parts, reference.parts, strict=True):
            assert part.volume_mm3 == pytest.approx(wanted.volume_mm3, rel=0.03), name
            assert part.box_mm == pytest.approx(wanted.box_mm, abs=0.8), name
        assert case.up_lps == (0.0, -1.0, 0.0)
        assert (case.ct is not None) == (name in ("dicom", "ct.nii.gz", "ct.nrrd"))
        assert case.labels.labels[0].max() == 0  # a margin round everything
    ct = cases["ct.nrrd"].ct
    assert ct.hu.shape == cases["ct.nrrd"].labels.labels.shape
    in_tumor = ct.hu[cases["ct.nrrd"].labels.labels == 2]
    assert (in_tumor == 570).mean() > 0.95  # the CT's crop lies where the labels' does


def test_a_case_survives_the_disk_and_notices_changes(tmp_path):
    truth = kidney_labels((1.5, 1.5, 1.5))
    write_nifti(tmp_path / "ct.nii.gz", ct_of(truth), truth.lps_from_index, "both")
    case = prepare(tmp_path / "ct.nii.gz", PrepareOptions(up="left"))
    with store.new_folder(tmp_path / "case") as aside:
        save_case(case, aside)
    again = load_case(tmp_path / "case")
    assert again.up_lps == (1.0, 0.0, 0.0)
    assert again.report == json.loads(json.dumps(case.report))
    assert again.report["source_sha256"] == store.sha256_of(tmp_path / "ct.nii.gz")
    assert np.array_equal(again.labels.labels, case.labels.labels)
    assert np.allclose(again.labels.lps_from_index, case.labels.lps_from_index, atol=1e-4)
    assert np.array_equal(again.ct.hu, case.ct.hu)
    for a, b in zip(again.anatomy.parts, case.anatomy.parts, strict=True):
        assert a.volume_mm3 == pytest.approx(b.volume_mm3, rel=1e-4)
        assert len(a.faces) == len(b.faces)
    (tmp_path / "case" / "tumor_1.ply").write_bytes(b"ply")
    with pytest.raises(ArtifactError, match=r"tumor_1\.ply was changed"):
        load_case(tmp_path / "case")


def tagged(folder, **tags):
    """A DICOM CT of a kidney; the tags of every slice, or of the first if they are lists."""
    import pydicom

    truth = kidney_labels((1.5, 1.5, 1.5))
    for number, path in enumerate(write_dicom(folder, ct_of(truth), truth.lps_from_index)):
        data = pydicom.dcmread(path)
        for name, value in tags.items():
            value = value[min(number, len(value) - 1)] if isinstance(value, list) else value
            setattr(data, name, value)
        data.save_as(path)
    return folder


def test_patient_and_side_come_from_the_tags_or_the_user(tmp_path):
    plain = tagged(tmp_path / "plain", PatientName="Doe^Jane", PatientBirthDate="19500101")
    assert prepare(plain).patient == Patient()
    stated = PrepareOptions(patient="P7", side="left")
    assert prepare(plain, stated).patient == Patient("P7", "left")
    ct = tagged(tmp_path / "ct", PatientID=" 4711 ", PatientName="Doe^Jane", Laterality="L")
    case = prepare(ct)
    assert case.patient == Patient("4711", "left")
    with store.new_folder(tmp_path / "case") as aside:
        save_case(case, aside)
    assert load_case(tmp_path / "case").patient == case.patient
    assert prepare(ct, PrepareOptions(patient="study-3")).patient == Patient("study-3", "left")
    with pytest.raises(InputError, match=r"states the left side .* the right one was selected"):
        prepare(ct, PrepareOptions(side="right"))
    manifest = (tmp_path / "case" / "manifest.json").read_text()
    assert "Doe" not in manifest
    assert "4711" in manifest
    by_image = tagged(tmp_path / "image", ImageLaterality="R")
    assert prepare(by_image).patient == Patient(side="right")
    pair = tagged(tmp_path / "pair", ImageLaterality="B")  # both kidneys: says nothing of this one
    assert prepare(pair, PrepareOptions(side="right")).patient == Patient(side="right")


def test_a_folder_of_two_patients_is_refused(tmp_path):
    mixed = tagged(tmp_path / "mixed", PatientID=["A", "B"])
    for series in (None, "1.2.3"):
        with pytest.raises(InputError, match=r"images of 2 patients \(PatientID A, B\)"):
            prepare(mixed, PrepareOptions(series=series))


def test_missing_empty_and_foreign_inputs(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        prepare(tmp_path / "nothing")
    with pytest.raises(InputError, match="holds no files"):
        prepare(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(InputError):
            prepare(path)
    for wrong in ({"side": "up"}, {"organ": 0}, {"min_tumor_ml": float("nan")}, {"unit": "cm"}):
        with pytest.raises(InputError):
            PrepareOptions(**wrong)
    with pytest.raises(InputError, match="direction"):
        prepare(tmp_path, PrepareOptions(up="sideways"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "side", "kidney_ml", "tumor_ml"),
    [
        ("00000", "right", 215.8, 7.8),
        ("00002", "left", 289.1, 35.0),
        ("00003", "right", 202.5, 10.2),
    ],
)
def test_real_patients_become_cases(shared_data, name, side, kidney_ml, tumor_ml):
    path = shared_data / "kits19" / f"case_{name}" / "segmentation.nii.gz"
    case = prepare(path)
    assert any(f"{side} kidney was chosen" in note for note in case.report["notes"])
    volumes = case.report["volumes_ml"]
    assert volumes["kidney"] == pytest.approx(kidney_ml, abs=0.1)
    assert volumes["tumor_1"] == pytest.approx(tumor_ml, abs=0.1)
    assert np.abs(case.report["surface"]["change_percent"]).max() < 1
    assert max(case.report["surface"]["distance_95_voxels"]) < 0.5
    for mesh in case.anatomy.parts:
        assert trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).is_volume


@pytest.mark.parametrize(("side", "ml"), [("left", 138.9), ("right", 188.9)])
def test_single_kidney_masks_become_cases(shared_data, side, ml):
    path = shared_data / "totalsegmentator" / f"kidney_{side}.nii.gz"
    case = prepare(path, PrepareOptions(side=side))
    assert case.report["volumes_ml"]["kidney"] == pytest.approx(ml, abs=0.1)
    assert case.anatomy.names == ("kidney",)
    with pytest.raises(InputError, match="other side"):
        prepare(path, PrepareOptions(side="left" if side == "right" else "right"))


fuzzed = settings(
    max_examples=80,
    deadline=10_000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """One tiny valid file of each type, and what reads it."""
    from tumortrack.imaging.meshes import read_meshes

    folder = tmp_path_factory.mktemp("samples")
    array = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
    write_nifti(folder / "v.nii", array, np.eye(4), "both")
    write_nifti(folder / "v.nii.gz", array, np.eye(4), "both")
    write_nrrd(folder / "raw.nrrd", array, np.eye(4), False)
    write_nrrd(folder / "gz.nrrd", array, np.eye(4), True)
    ball = trimesh.creation.icosphere(1, 30.0)
    for suffix in ("ply", "stl", "obj"):
        ball.export(folder / f"kidney.{suffix}")
    readers = {}
    for path in sorted(folder.iterdir()):
        is_mesh = path.stem == "kidney"
        read = (lambda p: read_meshes([*p.parent.iterdir()])) if is_mesh else read_either
        readers[path.name] = (path.read_bytes(), read)
    return readers


def read_either(path):
    return read_volume(path), read_labels(path)


@pytest.mark.parametrize(
    "name",
    ["v.nii", "v.nii.gz", "raw.nrrd", "gz.nrrd", "kidney.ply", "kidney.stl", "kidney.obj"],
)
@fuzzed
@given(data=st.data())
def test_damaged_files_give_a_value_or_an_input_error(tmp_path, samples, name, data):
    content, read = samples[name]
    damaged = bytearray(content[: data.draw(st.sampled_from([len(content), len(content) // 2]))])
    head = min(len(damaged), 400)
    for _ in range(data.draw(st.integers(0, 6))):
        limit = data.draw(st.sampled_from([head, len(damaged)]))
        damaged[data.draw(st.integers(0, limit - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / name
    path.write_bytes(damaged)
    with contextlib.suppress(InputError):  # any other exception fails the test
        read(path)


@pytest.fixture(scope="module")
def slices(tmp_path_factory):
    """The files of a small DICOM series, by name, and their voxels."""
    hu = np.arange(12 * 9 * 11, dtype=np.float32).reshape(12, 9, 11)
    folder = tmp_path_factory.mktemp("slices") / "dicom"
    write_dicom_series(Volume(hu, np.eye(4)), folder)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}, hu


@fuzzed
@given(data=st.data())
def test_damaged_slices_give_a_whole_volume_a_note_or_an_input_error(tmp_path, slices, data):
    files, hu = slices
    folder = tmp_path / "dicom"
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    name = data.draw(st.sampled_from(sorted(files)))
    damaged = bytearray(files[name])
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged))) :]
    for _ in range(data.draw(st.integers(0, 4))):
        if len(damaged):
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    (folder / name).write_bytes(damaged)
    with contextlib.suppress(InputError), warnings.catch_warnings():
        warnings.simplefilter("error")  # no other program's warning on the user's terminal
        raw = read_raw(folder)
        assert raw.array.shape == hu.shape or raw.notes  # a slice never goes without a word


def test_swapped_labels_a_misspelt_name_and_a_lost_geometry_are_noted(tmp_path):
    index = np.indices((70, 70, 70)) - 35
    labels = ((index**2).sum(0) < 30**2).astype(np.uint8)
    labels[(index[0] > 24) & (labels > 0)] = 2  # a cap
    write_nifti(tmp_path / "l.nii.gz", labels, np.diag([-1.0, -1, 1, 1]), "sform")  # RAS: identity
    right = prepare(tmp_path / "l.nii.gz", PrepareOptions(name="liver")).report["notes"]
    assert not [note for note in right if "swapped" in note or "not an organ" in note]
    assert [note for note in right if "the affine is the identity" in note]
    swapped = PrepareOptions(name="livr", organ=2, tumor=1)
    notes = prepare(tmp_path / "l.nii.gz", swapped).report["notes"]
    assert [note for note in notes if re.match(r"tumor_1 takes 9\d% of organ and tumors", note)]
    assert [note for note in notes if "did you mean --name liver?" in note]
    termed = PrepareOptions(name="livr", term=("10200004", "Liver"))
    assert not [n for n in prepare(tmp_path / "l.nii.gz", termed).report["notes"] if "known" in n]
