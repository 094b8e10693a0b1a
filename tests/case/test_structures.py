from dataclasses import replace

import numpy as np
import pytest

from organ_objects import liver
from refused import refused
from tumortrack.case.options import PrepareOptions, parse_structures
from tumortrack.case.prepare import prepare
from tumortrack.case.structures import split_structures
from tumortrack.core.errors import InputError
from tumortrack.core.types import LabelVolume, Mesh
from tumortrack.io.case import load_case, save_case
from tumortrack.io.mesh_files import write_mesh
from tumortrack.io.nifti import write_nifti

VESSEL = 4


def with_vessel(voxel_mm=3.0) -> LabelVolume:
    """A tube of 9 mm radius along y: from the liver's middle out of its front by 20 mm and more."""
    volume = liver((((-50, -20, 10), 15.0),), voxel_mm)
    labels = volume.labels.copy()
    index = np.indices(labels.shape).reshape(3, -1).T
    x, y, z = (index * voxel_mm + volume.lps_from_index[:3, 3]).T
    tube = ((x + 10) ** 2 + z**2 < 9.0**2) & (y < 0)
    labels.reshape(-1)[tube] = VESSEL
    return LabelVolume(labels, volume.lps_from_index)


@pytest.fixture(scope="module")
def label_map(tmp_path_factory):
    volume = with_vessel()
    path = tmp_path_factory.mktemp("structures") / "labels.nii.gz"
    write_nifti(path, volume.labels, volume.lps_from_index, lps=True)
    return path


def test_a_label_is_carried_and_leaves_the_organ_whole(label_map, tmp_path):
    options = PrepareOptions(name="liver", structure=(f"vessel={VESSEL}",), tumor=2)
    case = prepare(label_map, options)
    assert case.anatomy.names == ("liver", "tumor_1")  # the vessel is no tumor
    assert case.anatomy.organ.volume_mm3 == pytest.approx(1_660e3, rel=0.01)
    vessel = case.anatomy.structures["vessel"]
    length = -with_vessel().lps_from_index[1, 3]
    assert vessel.volume_mm3 == pytest.approx(np.pi * 81 * length, rel=0.1)
    about = case.report["structures"]["vessel"]
    assert about["outside_mm"] == pytest.approx(length - 50, abs=9)
    assert 0.1 < about["extrapolated"] < 0.6
    assert any("vessel" in note for note in case.report["notes"])
    save_case(case, tmp_path)
    again = load_case(tmp_path).anatomy
    assert list(again.structures) == ["vessel"]
    assert again.structures["vessel"].box_mm == pytest.approx(vessel.box_mm, abs=1e-4)


def test_open_meshes_are_taken_as_they_are(label_map, tmp_path):
    sheet = Mesh(
        np.array([[0.0, -60, 0], [10, -60, 0], [0, 0, 0], [10, 0, 3]]),
        np.array([[0, 1, 2], [1, 3, 2]]),
    )
    write_mesh(tmp_path / "cut.stl", sheet)
    options = PrepareOptions(name="liver", structure=(f"cut={tmp_path / 'cut.stl'}",), tumor=2)
    sheet_read = prepare(label_map, options).anatomy.structures["cut"]
    assert len(sheet_read.faces) == 2
    assert sheet_read.box_mm == pytest.approx(sheet.box_mm)
    write_mesh(tmp_path / "far.ply", sheet.with_vertices(sheet.vertices_mm + 500))
    with refused(InputError, "cut", "--unit m"):
        prepare(label_map, replace(options, structure=(f"cut={tmp_path / 'far.ply'}",)))


@pytest.mark.parametrize("options", ["artery", "liver=3", "tumor_1=3", "../x=3", "a=3 a=4"])
def test_what_names_no_structure_is_refused(options):
    with refused(InputError, "--structure"):
        parse_structures(tuple(options.split()), "liver")


@pytest.mark.parametrize("number", [1, 9])
def test_labels_that_are_not_there_or_the_organs_are_refused(number):
    with refused(InputError, f"artery={number}"):
        split_structures(with_vessel(6.0), {"artery": number}, 1)
