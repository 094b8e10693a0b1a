"""Laws that hold whatever the file: nothing is dropped or taken for a tumor without a word, an
organ at the image's border is told, tolerances are stated, segments may overlap, names decide."""

from __future__ import annotations

import gzip
import os
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import trimesh

from imaging_objects import kidney_labels, write_dicom, write_nifti
from refused import refused
from tumortrack.case.options import PrepareOptions
from tumortrack.case.prepare import prepare as with_half_turns
from tumortrack.case.surface import surface_of
from tumortrack.core import store
from tumortrack.core.config import findings_in
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS, transform_points
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.core.wording import for_caller
from tumortrack.io.case import load_case, save_case
from tumortrack.io.mesh_files import write_mesh
from tumortrack.io.segmentation_files import segments, write_dicom_seg
from tumortrack.io.segments import is_organ, is_tumor
from tumortrack.io.volume import read_raw, read_several
from tumortrack.simulation.phantom.dicom import write_dicom_series
from tumortrack.simulation.phantom.digital import PhantomParameters, phantom_labels

prepare = partial(with_half_turns, turns_of=lambda _: [])  # they take as long as all else
VOXEL_MM = 2.4
KIDNEY_ML, TUMORS_ML = 185.15, (28.8, 17.1)  # of the labels
OTHER_ML = 4 / 3 * np.pi * 11**3 / 1000  # of a ball
NAMES = ("kidney", "tumor_1", "tumor_2")


@dataclass(frozen=True)
class Scene:
    """Masks by name, on one grid; numbered in their order, if ``numbers`` says nothing else."""

    masks: dict[str, np.ndarray]
    affine: np.ndarray
    numbers: dict[str, int] = field(default_factory=dict)

    def number(self, name: str) -> int:
        return self.numbers.get(name, list(self.masks).index(name) + 1)

    def map(self) -> np.ndarray:
        """Later masks win."""
        out = np.zeros(next(iter(self.masks.values())).shape, np.uint8)
        for name, mask in self.masks.items():
            out[mask] = self.number(name)
        return out

    def of(self, *names: str, **more: np.ndarray) -> Scene:
        """These of its masks, and more."""
        return Scene({name: self.masks[name] for name in names} | more, self.affine)

    def hu(self) -> np.ndarray:
        return np.choose(self.map(), [-1000, 40, 570, 570]).astype(np.int16)


@pytest.fixture(scope="module")
def phantom() -> Scene:
    volume = phantom_labels(PhantomParameters(), VOXEL_MM)
    labels = np.pad(volume.labels, 8)
    masks = {"kidney": labels > 0, "tumor_a": labels == 2, "tumor_b": labels == 3}
    return Scene(masks, moved(volume.lps_from_index, -8))


def moved(affine: np.ndarray, voxels: float) -> np.ndarray:
    out = affine.copy()
    out[:3, 3] += affine[:3, :3] @ ([voxels] * 3)
    return out


def with_ball(scene: Scene, name: str, out_mm: float, radius_mm: float = 11.0) -> Scene:
    """A ball beside the kidney's side, whose middle lies ``out_mm`` outside of it, to the right."""
    kidney = scene.masks["kidney"]
    places = transform_points(scene.affine, np.indices(kidney.shape).reshape(3, -1).T.astype(float))
    middle = places[kidney.ravel()].mean(0)
    row = np.abs(places[:, 1:] - middle[1:]).max(1) < VOXEL_MM / 1.5
    middle[0] = places[row & kidney.ravel(), 0].min() - out_mm
    ball = (np.linalg.norm(places - middle, axis=1) < radius_mm).reshape(kidney.shape)
    return replace(scene, masks={**scene.masks, name: ball & ~kidney})


def nifti(scene: Scene, folder: Path) -> Path:
    write_nifti(folder / "map.nii.gz", scene.map(), scene.affine, "both")
    return folder / "map.nii.gz"


def write_layers(path: Path, scene: Scene, array: np.ndarray, fields: str = "") -> Path:
    i, j, k, origin = (",".join(map(str, c)) for c in scene.affine[:3].T.tolist())
    head = (
        f"NRRD0004\ntype: unsigned char\ndimension: {array.ndim}\n"
        f"space: left-posterior-superior\nsizes: {' '.join(map(str, array.shape))}\n"
        f"space directions: {'none ' * (array.ndim - 3)}({i}) ({j}) ({k})\nencoding: gzip\n"
        f"space origin: ({origin})\n{fields}\n"
    )
    path.write_bytes(head.encode() + gzip.compress(array.tobytes(order="F")))
    return path


def nrrd(scene: Scene, folder: Path) -> Path:
    return write_layers(folder / "map.nrrd", scene, scene.map())


def seg_nrrd(scene: Scene, folder: Path, names: tuple[str, ...] = ()) -> Path:
    """Each segment in a layer of its own, as Slicer writes segments that overlap."""
    fields = "".join(
        f"Segment{n}_ID:=Segment_{n}\nSegment{n}_Name:={name}\nSegment{n}_LabelValue:=1\n"
        f"Segment{n}_Layer:={n}\n"
        for n, name in enumerate(names or scene.masks)
    )
    layers = np.stack([*scene.masks.values()]).astype(np.uint8)
    return write_layers(folder / "map.seg.nrrd", scene, layers, fields)


def files(scene: Scene, folder: Path) -> Path:
    """A folder with a file for each, as TotalSegmentator writes it."""
    (folder / "files").mkdir()
    for name, mask in scene.masks.items():
        path = folder / "files" / f"{name}.nii.gz"
        write_nifti(path, mask.astype(np.uint8), scene.affine, "both")
    return folder / "files"


def meshes(scene: Scene, folder: Path) -> Path:
    (folder / "meshes").mkdir()
    for name, mask in scene.masks.items():
        mesh = surface_of(name, mask, scene.affine, VOXEL_MM, keep=lambda whole: whole)
        write_mesh(folder / "meshes" / f"{name}.stl", mesh)
    return folder / "meshes"


NUMBERED, NAMED = {"nifti": nifti, "nrrd": nrrd}, {"seg.nrrd": seg_nrrd, "files": files}
LABELS = {**NUMBERED, **NAMED}
READERS = {**LABELS, "meshes": meshes}
every, labelled, numbered, named = (
    pytest.mark.parametrize("write", group.values(), ids=group)
    for group in (READERS, LABELS, NUMBERED, NAMED)
)


def volumes(case) -> list[float]:
    return [part.volume_ml for part in case.anatomy.parts]


def ml(*expected: float, rel: float = 0.015):
    return pytest.approx(list(expected), rel=rel)


def kinds(case) -> dict[str, dict]:
    return {warning.kind: warning.values for warning in case.warnings}


@every
def test_the_phantom_is_the_phantom_by_every_reader_and_nothing_is_warned_of(
    phantom, tmp_path, write
):
    case = prepare(write(phantom, tmp_path))
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML)
    assert case.warnings == ()


@labelled
def test_an_organ_at_the_border_is_told_and_stays_told(phantom, tmp_path, write):
    middle = phantom.map().shape[2] // 2
    half = Scene({k: mask[..., :middle] for k, mask in phantom.masks.items()}, phantom.affine)
    case = prepare(write(half, tmp_path))
    cut = kinds(case)["cut"]
    voxels = int(half.masks["kidney"][..., -1].sum())
    assert cut["voxels"] == pytest.approx(voxels, abs=2)
    assert cut["area_cm2"] == pytest.approx(voxels * VOXEL_MM**2 / 100, rel=0.015)
    with store.new_folder(tmp_path / "case") as aside:
        save_case(case, aside)
    assert kinds(load_case(tmp_path / "case")) == kinds(case)


def test_a_ct_that_ends_in_the_organ_is_refused(tmp_path):
    truth = kidney_labels((1.5, 1.5, 1.5))
    first = int(np.flatnonzero(truth.labels.any((0, 1)))[0]) + 1
    hu = np.choose(truth.labels[..., first:], [-1000, 40, 570, 570])
    write_dicom(tmp_path / "ct", hu, truth.lps_from_index)
    with pytest.raises(InputError):
        prepare(tmp_path / "ct")


@pytest.mark.parametrize("kind", ["of_another_version", "cut"])
def test_warnings_of_another_version_are_refused(kind):
    with pytest.raises(InputError):
        findings_in([{"kind": kind, "values": {}}], "x")


@every
def test_a_body_apart_is_dropped_with_its_ml(phantom, tmp_path, write):
    scene = with_ball(phantom, "apart", 20.0)
    both = scene.masks["kidney"] | scene.masks["apart"]
    case = prepare(write(replace(phantom, masks={**phantom.masks, "kidney": both}), tmp_path))
    assert volumes(case)[0] == pytest.approx(KIDNEY_ML, rel=0.015)
    assert kinds(case)["dropped"]["ml"] == pytest.approx(OTHER_ML, rel=0.1)


@every
def test_the_pieces_of_one_tumor_are_tumors(phantom, tmp_path, write):
    both = phantom.masks["tumor_a"] | phantom.masks["tumor_b"]
    case = prepare(write(phantom.of("kidney", tumor=both), tmp_path))
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML)


@labelled
def test_what_touches_and_nobody_named_is_left_out_with_its_ml_or_counts_if_asked(
    phantom, tmp_path, write
):
    """A cyst on the surface, half outside."""
    scene = with_ball(phantom, "cyst", 0.0)
    path, cyst_ml = write(scene, tmp_path), float(scene.masks["cyst"].sum()) * VOXEL_MM**3 / 1000
    names = sorted(scene.masks) if path.is_dir() else list(scene.masks)  # as they are numbered
    kidney, a, b, cyst = (names.index(name) + 1 for name in scene.masks)
    stated = PrepareOptions(organ=kidney, tumor=(a, b))
    case = prepare(path, stated)
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML)
    beside = kinds(case)["beside"]
    assert (beside["label"], beside["ml"]) == (cyst, pytest.approx(cyst_ml))
    case = prepare(path, replace(stated, organ=(kidney, cyst)))
    assert volumes(case) == ml(KIDNEY_ML + cyst_ml, *TUMORS_ML)
    assert case.warnings == ()


@numbered
def test_a_tumor_that_nobody_named_is_asked_for_and_never_filled(phantom, tmp_path, write):
    path = write(replace(phantom, numbers={"kidney": 2, "tumor_a": 1}), tmp_path)
    with refused(InputError, "--tumor 1"):
        prepare(path, PrepareOptions(organ=2))
    case = prepare(path, PrepareOptions(organ=2, tumor=(1, 3)))
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML)
    assert len(prepare(path, PrepareOptions(organ=2, tumor=0)).anatomy.parts) == 1


@numbered
def test_of_a_map_of_many_organs_only_the_named_one_is_taken(phantom, tmp_path, write):
    liver = with_ball(phantom, "liver", 20.0, 25.0).masks["liver"]
    masks = {"spleen": np.zeros_like(liver), "kidney": phantom.masks["kidney"], "liver": liver}
    case = prepare(write(replace(phantom, masks=masks), tmp_path), PrepareOptions(organ=2))
    assert volumes(case) == ml(KIDNEY_ML)
    liver_ml = float(liver.sum()) * VOXEL_MM**3 / 1000
    assert kinds(case)["beside"] == pytest.approx({"label": 3, "name": "", "ml": liver_ml})


@named
def test_names_decide_not_the_order(phantom, tmp_path, write):
    scene = with_ball(phantom, "liver", 20.0, 15.0)
    masks = {**scene.masks, "kidney_left": scene.masks["kidney"]}
    order = ("tumor_b", "liver", "kidney_left", "tumor_a")
    path = write(replace(scene, masks={name: masks[name] for name in order}), tmp_path)
    case = prepare(path)
    assert volumes(case)[0] == pytest.approx(KIDNEY_ML, rel=0.015)
    assert sorted(volumes(case)[1:]) == ml(*sorted(TUMORS_ML))
    with refused(InputError, "prostate"):
        prepare(path, PrepareOptions(name="prostate"))
    with refused(InputError, "--side"):
        prepare(path, PrepareOptions(side="right"))
    carried = prepare(path, PrepareOptions(structure=("hepar=liver",)))
    assert list(carried.anatomy.structures) == ["hepar"]


def test_one_name_twice_is_one_organ_and_one_label_twice_is_refused(phantom, tmp_path):
    kidney = phantom.masks["kidney"]
    upper = np.arange(kidney.shape[2]) >= kidney.shape[2] // 2
    scene = phantom.of(a=kidney & upper, b=kidney & ~upper)
    path = seg_nrrd(scene, tmp_path, ("Kidney", "Kidney"))
    assert volumes(prepare(path)) == ml(KIDNEY_ML)
    path.write_bytes(path.read_bytes().replace(b"Segment1_Layer:=1", b"Segment1_Layer:=0"))
    with refused(InputError, "label 1"):
        prepare(path)


def test_several_files_in_one_call_and_a_tumors_file_alone(phantom, tmp_path):
    folder = files(phantom, tmp_path)
    paths = [folder / f"{name}.nii.gz" for name in ("tumor_a", "kidney")]
    assert volumes(prepare(paths)) == ml(KIDNEY_ML, TUMORS_ML[0])
    with refused(InputError, "tumor_a"):
        prepare(paths[0])
    other = phantom.affine + np.eye(4, k=3)
    write_nifti(paths[0], phantom.masks["tumor_a"].astype(np.uint8), other, "both")
    with refused(InputError, "tumor_a"):
        prepare(paths)


def test_a_size_that_no_kidney_has_is_told(phantom, tmp_path):
    large = replace(phantom, affine=phantom.affine * [[2.0], [2.0], [2.0], [1.0]])
    case = prepare(nifti(large, tmp_path))
    assert kinds(case)["volume"]["ml"] == pytest.approx(8 * KIDNEY_ML, rel=0.015)


@pytest.mark.parametrize(("off", "fits"), [(2e-8, True), (-3e-4, True), (2e-3, False)])
def test_labels_with_a_scale_are_rounded_within_a_thousandth(phantom, tmp_path, off, fits):
    array = phantom.map() * np.float64(1 + off)
    write_nifti(tmp_path / "l.nii.gz", array.astype(np.float32), phantom.affine, "both")
    with nullcontext() if fits else pytest.raises(InputError):
        case = prepare(tmp_path / "l.nii.gz", PrepareOptions(labels=True))
        assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML)


def test_a_shear_that_a_quaternion_cannot_hold_is_no_contradiction(phantom, tmp_path):
    affine = RAS_FROM_LPS @ phantom.affine
    affine[1, 2] += 0.5  # a gantry tilted by 17 degrees
    image = nibabel.Nifti1Image(phantom.map(), affine)
    image.set_sform(affine, code=1)
    image.set_qform(affine, code=1)  # as nibabel strips it
    nibabel.save(image, tmp_path / "l.nii.gz")
    assert not np.allclose(image.get_qform(), affine, atol=0.05)
    assert np.allclose(read_raw(tmp_path / "l.nii.gz").lps_from_index, RAS_FROM_LPS @ affine)
    image.set_qform(affine @ np.diag([-1.0, 1, 1, 1]), code=1)
    nibabel.save(image, tmp_path / "l.nii.gz")
    with refused(InputError, "sform"):
        read_raw(tmp_path / "l.nii.gz")


@pytest.mark.parametrize("name", ["a.vtk", "a.mha", "a.vtp", "a.mgz", "a.npy"])
def test_a_format_that_is_not_read_says_what_to_save_instead(tmp_path, name):
    (tmp_path / name).write_bytes(b"x" * 100)
    for given in (tmp_path, tmp_path / name):
        with refused(InputError, name):
            prepare(given)


def test_a_ct_beside_a_label_map_is_kept_if_it_has_its_grid(phantom, tmp_path):
    path, ct = nifti(phantom, tmp_path), tmp_path / "ct.nii.gz"
    write_nifti(ct, np.pad(phantom.hu(), 3), moved(phantom.affine, -3), "both")
    case = prepare(path, PrepareOptions(ct=ct))
    assert (case.ct.hu[case.labels.labels == 2] == 570).all()
    write_nifti(ct, phantom.hu(), moved(phantom.affine, 0.4), "both")
    with refused(InputError, "--ct"):
        prepare(path, PrepareOptions(ct=ct))


@pytest.mark.parametrize("flipped", [[1], [0, 1], [2]])
def test_a_ct_stored_turned_to_its_labels_is_theirs(phantom, tmp_path, flipped):
    labels, turned = phantom.map(), phantom.affine.copy()
    for axis in flipped:
        turned[:3, 3] += turned[:3, axis] * (labels.shape[axis] - 1)
        turned[:3, axis] *= -1
    write_nifti(tmp_path / "map.nii.gz", np.flip(labels, flipped), turned, "both")
    write_nifti(tmp_path / "ct.nii.gz", phantom.hu(), phantom.affine, "both")
    case = prepare(tmp_path / "map.nii.gz", PrepareOptions(ct=tmp_path / "ct.nii.gz"))
    assert (case.ct.hu[case.labels.labels >= 2] == 570).all()
    assert (case.ct.hu[case.labels.labels == 1] == 40).all()


def retagged(paths: list[Path], **change) -> None:
    for n, path in enumerate(paths):
        data = pydicom.dcmread(path)
        for tag, of in change.items():
            setattr(data, tag, of(n, data.get(tag)))
        data.save_as(path)


def late_decimals(by: float):
    return lambda n, values: [f"{float(v) + by * (n % 3):.9g}" for v in values]


@pytest.mark.parametrize(
    ("change", "read"),
    [
        ({"ImageOrientationPatient": late_decimals(5e-4)}, True),
        ({"ImageOrientationPatient": late_decimals(5e-3)}, False),
        ({"PixelSpacing": late_decimals(2e-4)}, True),
        ({"PixelSpacing": late_decimals(2e-2)}, False),
        ({"RescaleIntercept": lambda n, _: f"{-1024 + 0.02 * (n % 3)}"}, True),
        ({"RescaleIntercept": lambda n, _: f"{-1024 + 2 * (n % 3)}"}, False),
    ],
)
def test_slices_may_differ_by_what_rounding_leaves(phantom, tmp_path, change, read):
    paths = write_dicom(tmp_path / "ct", phantom.hu(), phantom.affine)
    retagged(paths, **change)
    with nullcontext() if read else pytest.raises(InputError):
        raw = read_raw(tmp_path / "ct")
        assert raw.notes == ()
        assert np.abs(raw.array - phantom.hu()).max() < 0.1


def test_slices_without_a_preamble_and_with_names_of_no_encoding_are_read(phantom, tmp_path):
    paths = write_dicom(tmp_path / "ct", phantom.hu(), phantom.affine)
    for n, path in enumerate(paths):
        content = path.read_bytes()[132:]
        path.unlink()
        (tmp_path / "ct" / os.fsdecode(b"sch\xf6n%d" % n)).write_bytes(content)
    raw = read_raw(tmp_path / "ct")
    assert raw.notes == ()
    assert np.array_equal(raw.array, phantom.hu())


def test_a_multi_frame_ct_is_read_from_its_folder_or_itself(phantom, tmp_path):
    legacy = pytest.importorskip("highdicom").legacy
    volume = Volume(phantom.hu().astype(np.float32), phantom.affine)
    write_dicom_series(volume, tmp_path / "classic")  # in shuffled files
    data = [pydicom.dcmread(path) for path in (tmp_path / "classic").iterdir()]
    whole = legacy.LegacyConvertedEnhancedCTImage(data, "1.2.3", 1, "1.2.4", 1)
    (tmp_path / "enhanced").mkdir()
    whole.save_as(tmp_path / "enhanced" / "ct.dcm")
    for given in (tmp_path / "enhanced", tmp_path / "enhanced" / "ct.dcm"):
        raw = read_raw(given)
        assert np.array_equal(raw.array, phantom.hu())
        assert np.allclose(raw.lps_from_index, phantom.affine, atol=1e-4)


def segmentation(scene: Scene, folder: Path) -> Path:
    """Of a CT beside it, by highdicom."""
    pytest.importorskip("highdicom")
    labels = LabelVolume(scene.map(), scene.affine)
    if not (folder / "ct").exists():
        write_dicom_series(Volume(scene.hu().astype(np.float32), scene.affine), folder / "ct")
    parts = segments(NAMES[: int(labels.labels.max())])
    write_dicom_seg(folder / "segmentation.dcm", labels, parts, folder / "ct")
    return folder / "segmentation.dcm"


def test_our_own_dicom_segmentation_is_read_as_it_was_written(phantom, tmp_path):
    path, labels = segmentation(phantom, tmp_path), phantom.map()
    case, raw = prepare(path), read_raw(path)
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML)
    first = int(np.flatnonzero(labels.any((0, 1)))[0]) - 1  # an empty slice at either end
    stop = first + raw.array.shape[2]
    assert np.array_equal(raw.array, labels[..., first:stop])
    assert not labels[..., stop:].any()
    assert not case.warnings
    where_it_ends = for_caller(raw.notes[0])  # the file does not say
    assert where_it_ends in case.report["notes"]


def test_a_dicom_segmentation_is_cut_where_its_ct_ends(phantom, tmp_path):
    middle = phantom.map().shape[2] // 2
    half = Scene({k: mask[..., :middle] for k, mask in phantom.masks.items()}, phantom.affine)
    path = segmentation(half, tmp_path)
    assert "cut" not in kinds(prepare(path))
    assert list(kinds(prepare(path, PrepareOptions(ct=tmp_path / "ct")))) == ["flat", "cut"]


def test_a_segmentation_of_a_tilted_gantry_lies_where_its_labels_lie(phantom, tmp_path):
    tilted = replace(phantom, affine=phantom.affine + 0.7 * np.eye(4, k=1) * [[0], [1], [0], [0]])
    paths = write_dicom(tmp_path / "ct", tilted.hu(), tilted.affine)
    needed = ["PatientName", "PatientBirthDate", "PatientSex", "StudyID", "StudyDate", "StudyTime"]
    needed += ["AccessionNumber", "ReferringPhysicianName", "PatientID"]
    tags = dict.fromkeys(needed, lambda *_: "")
    tags |= {"FrameOfReferenceUID": lambda *_: "1.2.7", "InstanceNumber": lambda n, _: n + 1}
    retagged(paths, **tags, SliceThickness=lambda *_: VOXEL_MM)
    told, read = (prepare(write(tilted, tmp_path)).anatomy for write in (nifti, segmentation))
    for part, same in zip(told.parts, read.parts, strict=True):
        assert np.abs(part.box_mm - same.box_mm).max() < 0.1


def test_an_organ_cut_flat_within_its_image_is_told(phantom, tmp_path):
    """One empty slice behind the cut, or a crop to a box, and the border says nothing."""
    labels = phantom.map()
    labels[..., labels.shape[2] // 2 :] = 0
    half = phantom.of(kidney=labels > 0)
    assert kinds(prepare(nifti(half, tmp_path)))["flat"]["area_cm2"] > 10
    assert "flat" in kinds(prepare(meshes(half, tmp_path)))


@numbered
@pytest.mark.parametrize("kept", [(1, 0), (1, 0, 0), (1,) * 30 + (0,)])
def test_an_organ_drawn_in_some_slices_alone_is_refused(phantom, tmp_path, write, kept):
    drawn = np.resize(kept, phantom.map().shape[2]).astype(bool)
    masks = {name: mask & drawn for name, mask in phantom.masks.items()}
    with refused(InputError, tmp_path):
        prepare(write(phantom.of(**masks), tmp_path))


def test_a_slice_that_is_all_tumor_is_no_empty_one(phantom, tmp_path):
    kidney = phantom.masks["kidney"]
    tumor = kidney & (np.arange(kidney.shape[2]) == kidney.shape[2] // 2)
    case = prepare(nifti(phantom.of("kidney", tumor=tumor), tmp_path))
    assert volumes(case)[0] == pytest.approx(KIDNEY_ML, rel=0.03)


def test_a_label_that_no_segment_describes_is_refused_and_none_is_overlooked(phantom, tmp_path):
    path = seg_nrrd(phantom, tmp_path)
    text = path.read_bytes()
    path.write_bytes(text.replace(b"Segment1_", b"Segment7_"))  # numbers need not be whole
    assert sorted(volumes(prepare(path))) == ml(*sorted([KIDNEY_ML, *TUMORS_ML]), rel=0.03)
    start = text.index(b"Segment1_")
    path.write_bytes(text[:start] + text[text.index(b"Segment2_") :])
    with refused(InputError, "label 1"):
        prepare(path)


@named
def test_what_lies_in_something_else_that_nobody_uses_is_not_asked_for(phantom, tmp_path, write):
    body = np.ones_like(phantom.masks["kidney"])
    other = np.zeros_like(body)
    other[:3, :3, :3] = True
    masks = {"body": body & ~phantom.masks["kidney"], **phantom.masks, "other": other}
    case = prepare(write(replace(phantom, masks=masks), tmp_path))
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML, rel=0.03)


@named
def test_what_lies_in_the_organ_under_an_unknown_name_is_asked_for(phantom, tmp_path, write):
    path = write(phantom.of("kidney", thing=phantom.masks["tumor_a"]), tmp_path)
    with refused(InputError, "thing"):
        prepare(path)
    case = prepare(path, PrepareOptions(tumor=2))
    assert volumes(case)[1] == pytest.approx(TUMORS_ML[0], rel=0.03)


@pytest.mark.parametrize(
    ("name", "organ", "tumor"),
    [
        ("kidney", True, False), ("Kidneys", True, False), ("KidneyLeft", True, False),
        ("kidney_segmentation", True, False), ("case_00001_kidney", True, False),
        ("kidney tumor", False, True), ("TumorLeft", False, True), ("RCC", False, True),
        ("GTV2", False, True), ("renal mass", False, True), ("adenocarcinoma", False, True),
        ("metastasis 3", False, True), ("non-tumor kidney", False, False),
        ("peritumoral fat", False, False), ("tumor-free rim", False, False),
        ("biomass", False, False), ("mass effect", False, False), ("adrenal", False, False),
    ],
)  # fmt: skip
def test_what_names_say(name, organ, tumor):
    assert (is_organ(name, "kidney"), is_tumor(name)) == (organ, tumor)


def test_a_solid_within_a_solid_is_refused_and_a_cavity_is_not(tmp_path):
    outer, inner = trimesh.creation.icosphere(3, 30.0), trimesh.creation.icosphere(3, 10.0)
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "kidney.stl")
    with refused(InputError, "kidney"):
        prepare(tmp_path / "kidney.stl")
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "kidney.stl")
    assert volumes(prepare(tmp_path / "kidney.stl")) == ml(outer.volume / 1000)


def test_meshes_beside_label_files_and_too_many_of_these_are_refused(phantom, tmp_path):
    folder = files(phantom, tmp_path)
    (folder / "tumor_b.nii.gz").rename(folder / "tumor_b.nii")
    (folder / "tumor.stl").write_bytes(b"")
    with refused(InputError, "tumor_b"):
        prepare(folder)
    with refused(InputError, "255"):
        read_several([tmp_path / f"{n}.nii" for n in range(256)])


def test_a_folder_of_masks_may_hold_other_files(phantom, tmp_path):
    folder = files(phantom, tmp_path)
    (folder / "statistics.json").write_text("{}")
    case = prepare(folder)
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML, rel=0.03)
    assert any("statistics.json" in note for note in case.report["notes"])


def test_stated_labels_are_of_a_label_map_however_many_it_has(phantom, tmp_path):
    labels = phantom.map()
    labels[0, 0, :60] = np.arange(60) + 100
    write_nifti(tmp_path / "map.nii.gz", labels, phantom.affine, "both")
    case = prepare(tmp_path / "map.nii.gz", PrepareOptions(organ=1, tumor=(2, 3)))
    assert volumes(case) == ml(KIDNEY_ML, *TUMORS_ML, rel=0.03)


def test_a_slice_that_is_there_twice_is_read_once(phantom, tmp_path):
    paths = write_dicom(tmp_path, phantom.hu(), phantom.affine)
    (tmp_path / "copy").write_bytes(paths[5].read_bytes())
    raw = read_raw(tmp_path)
    assert np.array_equal(raw.array, phantom.hu())
    assert len(raw.notes) == 1
    (tmp_path / "copy").unlink()
    retagged(paths, SOPInstanceUID=lambda *_: "1.2.3")  # of all
    assert np.array_equal(read_raw(tmp_path).array, phantom.hu())


def test_another_organ_by_its_files_name_is_asked_for(phantom, tmp_path):
    path = nifti(phantom, tmp_path).rename(tmp_path / "liver.nii.gz")
    with refused(InputError, "--name liver"):
        prepare(path)
    assert prepare(path, PrepareOptions(name="liver")).anatomy.names[0] == "liver"
    path.rename(tmp_path / "kidney_beside_liver.nii.gz")
    assert len(volumes(prepare(tmp_path / "kidney_beside_liver.nii.gz"))) == 3


def test_thick_slices_of_a_ct_are_told(tmp_path):
    volume = phantom_labels(PhantomParameters(), VOXEL_MM)
    hu = np.choose(np.pad(volume.labels, 8), [-1000, 40, 570, 570]).astype(np.int16)
    write_nifti(tmp_path / "ct.nii.gz", hu, volume.lps_from_index, "both")
    assert kinds(prepare(tmp_path / "ct.nii.gz"))["thick"]["mm"] == pytest.approx(VOXEL_MM)
