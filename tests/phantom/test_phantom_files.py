"""The phantom's CT as DICOM series, and as NIfTI."""

import numpy as np
import pytest

from phantom_objects import QUICK_SCAN, first_labels
from tumortrack.core.errors import InputError
from tumortrack.core.types import Volume
from tumortrack.imaging.nifti import write_nifti, write_volume_nifti
from tumortrack.phantom.dicom import write_dicom_series
from tumortrack.phantom.scanner import scan
from volume_points import lps_of, read_at


@pytest.fixture(scope="module")
def labels():
    return first_labels()


@pytest.fixture(scope="module")
def oblique(labels):
    return scan(labels, QUICK_SCAN, seed=3)


@pytest.fixture(scope="module")
def series(oblique, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dicom") / "series"
    write_dicom_series(oblique, folder, seed=4)
    return folder


def by_simpleitk(image):
    import SimpleITK as sitk  # noqa: N813

    directions = np.array(image.GetDirection()).reshape(3, 3)
    affine = np.eye(4)
    affine[:3, :3] = directions * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return Volume(sitk.GetArrayFromImage(image).transpose(2, 1, 0), affine)


def read_series(folder):
    import SimpleITK as sitk  # noqa: N813

    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    return by_simpleitk(reader.Execute())


def test_dicom_series_reads_back_exactly(series, oblique):
    back = read_series(series)
    assert np.abs(back.lps_from_index - oblique.lps_from_index).max() < 1e-3
    corner = lps_of(back, [np.array(back.hu.shape) - 1])
    assert np.abs(corner - lps_of(oblique, [np.array(oblique.hu.shape) - 1])).max() < 1e-3
    assert np.array_equal(back.hu, oblique.hu)


def test_dicom_headers(series, oblique):
    import pydicom

    slices = [pydicom.dcmread(path) for path in sorted(series.iterdir())]
    assert len(slices) == oblique.hu.shape[2]
    order = [s.InstanceNumber for s in slices]
    assert order != sorted(order)
    assert sorted(order) == list(range(1, len(slices) + 1))
    assert len({s.SOPInstanceUID for s in slices}) == len(slices)
    assert len({s.SeriesInstanceUID for s in slices}) == 1
    first = slices[0]
    assert first.SOPClassUID.name == "CT Image Storage"
    assert (first.Modality, first.PatientPosition) == ("CT", "HFS")
    assert str(first.PatientName) == "PHANTOM^TUMORTRACK"
    assert (first.KVP, first.XRayTubeCurrentInuA) == (90, 13600)
    assert all(np.isclose(first.PixelSpacing, (1.1, 1.0)))  # between rows first


def test_dicom_is_deterministic_by_seed(series, oblique, tmp_path):
    import pydicom

    write_dicom_series(oblique, tmp_path / "same", seed=4)
    write_dicom_series(oblique, tmp_path / "other", seed=5)
    name = "CT00000.dcm"
    assert (tmp_path / "same" / name).read_bytes() == (series / name).read_bytes()
    uids = [pydicom.dcmread(f / name).SeriesInstanceUID for f in (series, tmp_path / "other")]
    assert uids[0] != uids[1]


def test_nifti_and_dicom_agree_in_the_patient(series, oblique, labels, tmp_path):
    import nibabel

    write_volume_nifti(tmp_path / "ct.nii.gz", oblique.hu, oblique.lps_from_index)
    image = nibabel.load(tmp_path / "ct.nii.gz")
    dicom = read_series(series)
    index = np.random.default_rng(1).integers(1, np.array(oblique.hu.shape) - 1, (500, 3))
    ras = nibabel.affines.apply_affine(image.affine, index)
    hu = np.asarray(image.dataobj)[tuple(index.T)]
    assert np.array_equal(hu, read_at(dicom, ras * [-1, -1, 1]))
    # Not mirrored: the exophytic tumor lies right, anterior and inferior of the endophytic one.
    write_nifti(tmp_path / "labels.nii", labels.labels, labels.lps_from_index, lps=True)
    stored = nibabel.load(tmp_path / "labels.nii")
    centers = [
        nibabel.affines.apply_affine(stored.affine, np.argwhere(stored.get_fdata() == n).mean(0))
        for n in (2, 3)
    ]
    assert np.allclose(centers[1] - centers[0], (14, 16.5, -39), atol=0.5)  # RAS
    assert stored.get_data_dtype() == np.uint8


def test_nifti_is_read_alike_by_simpleitk(oblique, tmp_path):
    import SimpleITK as sitk  # noqa: N813

    write_volume_nifti(tmp_path / "ct.nii.gz", oblique.hu, oblique.lps_from_index)
    back = by_simpleitk(sitk.ReadImage(str(tmp_path / "ct.nii.gz")))
    assert np.abs(back.lps_from_index - oblique.lps_from_index).max() < 1e-4
    assert np.array_equal(back.hu, oblique.hu)


def test_files_refuse_what_they_cannot_hold(oblique, tmp_path):
    hot = Volume(np.full((3, 3, 3), 7e4), np.eye(4))
    with pytest.raises(InputError, match="DICOM"):
        write_dicom_series(hot, tmp_path / "hot")
    holes = Volume(np.full((3, 3, 3), np.nan), np.eye(4))
    with pytest.raises(InputError, match="finite"):
        write_dicom_series(holes, tmp_path / "a")
    sheared = np.eye(4)
    sheared[0, 1] = 0.2
    with pytest.raises(InputError, match="perpendicular"):
        write_dicom_series(Volume(np.zeros((3, 3, 3)), sheared), tmp_path / "b")
    with pytest.raises(InputError, match="exists"):
        write_dicom_series(oblique, tmp_path)
    assert list(tmp_path.iterdir()) == []
