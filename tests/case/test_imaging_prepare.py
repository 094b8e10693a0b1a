"""prepare end to end, cases on disk, and readers under random damage."""

import contextlib
import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imaging_objects import kidney_labels, write_dicom, write_nifti
from refused import refused
from tumortrack.case.options import PrepareOptions
from tumortrack.case.prepare import prepare
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.patient import Patient
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.io.case import load_case, save_case
from tumortrack.io.volume import read_raw
from tumortrack.simulation.phantom.dicom import write_dicom_series


def ct_of(labels: LabelVolume) -> np.ndarray:
    return np.choose(labels.labels, [-1000, 40, 570, 570]).astype(np.int16)


def saved(case, folder):
    with store.new_folder(folder) as aside:
        save_case(case, aside)
    return load_case(folder)


def test_a_case_survives_the_disk_and_notices_changes(tmp_path):
    truth = kidney_labels((1.5, 1.5, 1.5))
    write_nifti(tmp_path / "ct.nii.gz", ct_of(truth), truth.lps_from_index, "both")
    case = prepare(tmp_path / "ct.nii.gz", PrepareOptions(up="left"))
    again = saved(case, tmp_path / "case")
    assert again.up_lps == (1.0, 0.0, 0.0)
    assert again.report == json.loads(json.dumps(case.report))
    assert again.report["source_sha256"] == store.sha256_of(tmp_path / "ct.nii.gz")
    assert np.array_equal(again.labels.labels, case.labels.labels)
    assert np.allclose(again.labels.lps_from_index, case.labels.lps_from_index, atol=1e-4)
    assert np.array_equal(again.ct.hu, case.ct.hu)
    assert (case.ct.hu[case.labels.labels == 2] == 570).mean() > 0.95  # it is the labels' crop
    for a, b in zip(again.anatomy.parts, case.anatomy.parts, strict=True):
        assert a.volume_mm3 == pytest.approx(b.volume_mm3, rel=1e-4)
        assert len(a.faces) == len(b.faces)
    (tmp_path / "case" / "tumor_1.ply").write_bytes(b"ply")
    with refused(ArtifactError, "tumor_1.ply"):
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


@pytest.mark.slow
def test_patient_and_side_come_from_the_tags_or_the_user(tmp_path):
    plain = tagged(tmp_path / "plain", PatientName="Doe^Jane", PatientBirthDate="19500101")
    assert prepare(plain).patient == Patient()
    stated = PrepareOptions(patient="P7", side="left")
    assert prepare(plain, stated).patient == Patient("P7", "left")
    ct = tagged(tmp_path / "ct", PatientID=" 4711 ", PatientName="Doe^Jane", Laterality="L")
    case = prepare(ct)
    assert case.patient == saved(case, tmp_path / "case").patient == Patient("4711", "left")
    manifest = (tmp_path / "case" / "manifest.json").read_text()
    assert "4711" in manifest
    assert "Doe" not in manifest
    assert prepare(ct, PrepareOptions(patient="study-3")).patient == Patient("study-3", "left")
    with refused(InputError, "left", "right"):
        prepare(ct, PrepareOptions(side="right"))
    by_image = tagged(tmp_path / "image", ImageLaterality="R")
    assert prepare(by_image).patient == Patient(side="right")
    pair = tagged(tmp_path / "pair", ImageLaterality="B")  # both kidneys: says nothing of this one
    assert prepare(pair, PrepareOptions(side="right")).patient == Patient(side="right")


@pytest.mark.parametrize("series", [None, "1.2.3"])
def test_a_folder_of_two_patients_is_refused(tmp_path, series):
    mixed = tagged(tmp_path, PatientID=["A", "B"])
    with refused(InputError, "A, B"):
        prepare(mixed, PrepareOptions(series=series))


def test_missing_empty_and_foreign_inputs(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    for path in (tmp_path, tmp_path / "notes.txt", tmp_path / "empty", tmp_path / "nothing"):
        with refused(InputError, path.name):
            prepare(path)


@pytest.mark.parametrize(
    ("wrong", "allowed"),
    [
        ({"side": "up"}, "right"), ({"organ": 0}, "1..255"), ({"unit": "cm"}, "mm"),
        ({"min_tumor_ml": np.nan}, "min_tumor_ml"), ({"up": "sideways"}, "anterior"),
    ],
)  # fmt: skip
def test_options_that_are_not_allowed_are_refused(wrong, allowed):
    with refused(InputError, allowed):
        PrepareOptions(**wrong)


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


fuzzed = settings(
    max_examples=80,
    deadline=10_000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def damage(content, data, most):
    """Some bytes changed, most of them in the head."""
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(0, most)) if damaged else 0):
        limit = data.draw(st.sampled_from([min(len(damaged), 400), len(damaged)]))
        damaged[data.draw(st.integers(0, limit - 1))] = data.draw(st.integers(0, 255))
    return damaged


@pytest.fixture(scope="module")
def slices(tmp_path_factory):
    """The files of a small DICOM series, by name, and their voxels."""
    hu = np.arange(12 * 9 * 11, dtype=np.float32).reshape(12, 9, 11)
    folder = tmp_path_factory.mktemp("slices") / "dicom"
    write_dicom_series(Volume(hu, np.eye(4)), folder)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}, hu


@pytest.mark.slow
@fuzzed
@given(data=st.data())
def test_damaged_slices_give_a_whole_volume_a_note_or_an_input_error(tmp_path, slices, data):
    files, hu = slices
    folder = tmp_path / "dicom"
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    name = data.draw(st.sampled_from(sorted(files)))
    whole = files[name]
    if data.draw(st.booleans()):
        whole = whole[: data.draw(st.integers(0, len(whole)))]
    (folder / name).write_bytes(damage(whole, data, 4))
    with contextlib.suppress(InputError), warnings.catch_warnings():
        warnings.simplefilter("error")  # no other program's warning on the user's terminal
        raw = read_raw(folder)
        assert raw.array.shape == hu.shape or raw.notes  # a slice never goes without a word


def test_swapped_labels_a_misspelt_name_and_a_lost_geometry_are_noted(tmp_path):
    index = np.indices((70, 70, 70)) - 35
    labels = ((index**2).sum(0) < 30**2).astype(np.uint8)
    labels[(index[0] > 24) & (labels > 0)] = 2  # a cap
    path = tmp_path / "l.nii.gz"
    write_nifti(path, labels, np.diag([-1.0, -1, 1, 1]), "sform")  # RAS: identity
    swapped = PrepareOptions(name="livr", organ=2, tumor=1)
    termed = replace(swapped, term=("10200004", "Liver"))
    saying = "identity", "swapped", 'name="liver"'
    for options, told in (
        (PrepareOptions(name="liver"), saying[:1]), (swapped, saying), (termed, saying[:2]),
    ):  # fmt: skip
        notes = " ".join(prepare(path, options).report["notes"])
        assert tuple(word for word in saying if word in notes) == told
