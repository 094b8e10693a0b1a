"""The phantom's CT as DICOM series, and as NIfTI."""

import nibabel
import numpy as np
import pydicom
import pytest

from phantom_objects import QUICK_SCAN, first_labels
from tumortrack.core.errors import InputError
from tumortrack.core.types import Volume
from tumortrack.io.nifti import write_nifti, write_volume_nifti
from tumortrack.simulation.phantom.dicom import write_dicom_series
from tumortrack.simulation.phantom.scanner import scan


@pytest.fixture(scope="module")
def oblique():
    return scan(first_labels(), QUICK_SCAN, seed=3)


@pytest.fixture(scope="module")
def series(oblique, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dicom") / "series"
    write_dicom_series(oblique, folder, seed=4)
    return folder


def by_simpleitk(path):
    import SimpleITK as sitk  # noqa: N813

    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(path)) if path.is_dir() else str(path)
    image = sitk.ReadImage(names)
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return Volume(sitk.GetArrayFromImage(image).transpose(2, 1, 0), affine)


def test_series_and_nifti_are_read_back_exactly_by_simpleitk(series, oblique, tmp_path):
    write_volume_nifti(tmp_path / "ct.nii.gz", oblique.hu, oblique.lps_from_index)
    for path in (series, tmp_path / "ct.nii.gz"):
        back = by_simpleitk(path)
        assert np.abs(back.lps_from_index - oblique.lps_from_index).max() < 1e-3
        assert np.array_equal(back.hu, oblique.hu)


def test_dicom_headers(series, oblique):
    slices = [pydicom.dcmread(path) for path in sorted(series.iterdir())]
    order, count = [s.InstanceNumber for s in slices], oblique.hu.shape[2]
    assert order != sorted(order) == list(range(1, count + 1))
    assert len({s.SOPInstanceUID for s in slices}) == count
    assert len({s.SeriesInstanceUID for s in slices}) == 1
    first = slices[0]
    assert first.SOPClassUID.name == "CT Image Storage"
    assert (first.Modality, first.PatientPosition) == ("CT", "HFS")
    assert (first.KVP, first.XRayTubeCurrentInuA) == (90, 13600)
    assert all(np.isclose(first.PixelSpacing, (1.1, 1.0)))  # between rows first


def test_dicom_is_deterministic_by_seed(series, oblique, tmp_path):
    first = [series / "CT00000.dcm"]
    for seed in (4, 5):
        write_dicom_series(oblique, tmp_path / str(seed), seed=seed)
        first.append(tmp_path / str(seed) / "CT00000.dcm")
    assert first[0].read_bytes() == first[1].read_bytes()
    assert len({pydicom.dcmread(path).SeriesInstanceUID for path in first}) == 2


def test_an_anatomy_is_not_mirrored(tmp_path):
    """The exophytic tumor lies right, anterior and inferior of the endophytic one."""
    labels = first_labels()
    write_nifti(tmp_path / "labels.nii", labels.labels, labels.lps_from_index, lps=True)
    stored = nibabel.load(tmp_path / "labels.nii")
    centers = [
        nibabel.affines.apply_affine(stored.affine, np.argwhere(stored.get_fdata() == n).mean(0))
        for n in (2, 3)
    ]
    assert np.allclose(centers[1] - centers[0], (14, 16.5, -39), atol=0.5)  # RAS
    assert stored.get_data_dtype() == np.uint8


def test_files_refuse_what_they_cannot_hold(oblique, tmp_path):
    sheared = np.eye(4) + 0.2 * np.eye(4, k=1) * [[1], [0], [0], [0]]
    for hu, affine, name in (
        (np.full((3, 3, 3), 7e4), np.eye(4), "hot"),
        (np.full((3, 3, 3), np.nan), np.eye(4), "holes"),
        (np.zeros((3, 3, 3)), sheared, "sheared"),
        (np.zeros((3, 3, 3)), np.eye(4), "."),  # it exists
    ):
        with pytest.raises(InputError):
            write_dicom_series(Volume(hu, affine), tmp_path / name)
    assert list(tmp_path.iterdir()) == []
