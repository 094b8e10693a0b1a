import json

import numpy as np
import pytest

from organ_objects import liver, prostate
from refused import refused
from tumortrack.case.options import PrepareOptions
from tumortrack.case.prepare import prepare
from tumortrack.case.select import select_labels
from tumortrack.case.surface import surfaces
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.organ import KIDNEY, Organ, organ_first, organ_name
from tumortrack.core.patient import Patient
from tumortrack.core.types import Anatomy, LabelVolume
from tumortrack.io.case import Case, load_case, save_case
from tumortrack.io.mesh_files import write_anatomy
from tumortrack.io.scene_folder import organ_of_folder
from tumortrack.io.segmentation_files import segments
from tumortrack.simulation.scene import SceneConfig

LIVER = Organ(name="liver")
UP = (0.0, -1.0, 0.0)


@pytest.mark.parametrize(
    "name", ["Liver", "tumor_1", "left kidney", "", "2nd", "../x", "a" * 33, "cloud", "a_margin"]
)
def test_names_that_no_file_could_bear_are_refused(name):
    with refused(InputError, "--name"):
        Organ(name=name)


def test_terms_are_known_by_name_stated_or_an_organs():
    assert LIVER.snomed == ("10200004", "Liver")
    assert Organ(name="phantom").snomed == ("113343008", "Organ")
    assert Organ(name="appendix", term=("66754008", "Appendix")).snomed[1] == "Appendix"
    for term in (("liver", "Liver"), ("10200004", "a^b")):
        with refused(InputError, term[0]):
            Organ(name="liver", term=term)
    organ, tumor = segments(("liver", "tumor_1"), organ=LIVER)
    assert "SCT^10200004^Liver" in organ.terminology
    assert "SCT^10200004^Liver" in tumor.terminology  # where it lies
    assert "Kidney" not in organ.terminology + tumor.terminology


def test_sides_are_asked_for_only_of_what_has_them():
    with refused(InputError, "liver"):
        PrepareOptions(name="liver", side="left")
    PrepareOptions(name="lung", side="left")
    named = Patient("P1")
    assert LIVER.identified(named)
    assert not KIDNEY.identified(named)
    assert KIDNEY.identified(Patient("P1", "left"))
    assert not LIVER.identified(Patient())


def test_a_livers_files_bear_its_name(tmp_path):
    labels = liver((((-50, -20, 10), 15.0),), voxel_mm=5.0)
    anatomy, report = surfaces(labels, LIVER)
    assert report["mesh_ml"][0] == pytest.approx(1660, rel=0.02)
    case = Case(anatomy, labels, UP)
    save_case(case, tmp_path)
    assert {"liver.ply", "tumor_1.ply"} <= {path.name for path in tmp_path.iterdir()}
    again = load_case(tmp_path).anatomy
    assert again.names == ("liver", "tumor_1")
    assert again.with_parts(again.tumors).organ_kind == LIVER.__replace__(term=LIVER.snomed)


def test_a_case_that_names_no_organ_or_a_strange_one_is_refused(tmp_path):
    anatomy = surfaces(prostate(voxel_mm=2.0))[0]
    save_case(Case(anatomy, prostate(voxel_mm=2.0), UP), tmp_path)
    path = tmp_path / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["organ"]
    path.write_text(json.dumps(manifest))
    with refused(ArtifactError, tmp_path):
        load_case(tmp_path)
    path.write_text(json.dumps({**manifest, "organ": {"name": "../../x"}}))
    with refused(ArtifactError, "--name"):
        load_case(tmp_path)


def test_the_largest_piece_is_taken_of_what_has_no_sides():
    labels = prostate(voxel_mm=2.0).labels
    two = np.concatenate([labels, labels[:, :, : labels.shape[2] // 2 + 3]], axis=2)
    volume = LabelVolume(np.pad(two, 4), np.diag([2.0, 2, 2, 1]))
    found, notes, side = select_labels(volume, organ_kind=Organ(name="prostate"))
    assert found.labels.sum() == pytest.approx(labels.sum(), rel=0.01)
    assert side == "unknown"
    assert any("2 large pieces" in note for note in notes)


def test_thirty_tumors_and_none(tmp_path):
    places = [(x, y, z) for x in (-60, -40, -20, 0, 20) for y in (-18, 0, 18) for z in (-9, 9)]
    labels = liver(tuple((place, 7.0) for place in places), voxel_mm=3.0)
    found, _, _ = select_labels(labels, organ_kind=LIVER)
    anatomy, _ = surfaces(found, LIVER)
    assert len(anatomy.tumors) == 30
    write_anatomy(tmp_path, Anatomy(anatomy.parts[:1], LIVER))
    case = prepare(tmp_path, PrepareOptions(name="liver"))
    assert case.anatomy.names == ("liver",)
    assert list(case.report["volumes_ml"]) == ["liver"]


def test_only_larger_organs_than_kidneys_are_seen_from_farther():
    config = SceneConfig()
    wide = surfaces(liver(voxel_mm=5.0), LIVER)[0]
    assert config.seen_whole(wide.with_parts(wide.parts)).pose.nearest_mm[0] > 200
    assert config.seen_whole(Anatomy(wide.parts)) is config  # a kidney's scenes never change
    small = surfaces(prostate(voxel_mm=2.0), Organ(name="prostate"))[0]
    assert config.seen_whole(small) is config


def test_the_organ_is_found_among_files(tmp_path):
    assert organ_name(["tumor_1", "uterus"]) == "uterus"
    assert organ_name(["tumor_1"]) is None
    assert organ_first({"tumor_2", "uterus", "tumor_1"}) == ["uterus", "tumor_1", "tumor_2"]
    for name in ("cloud", "spleen", "tumor_1"):
        (tmp_path / f"{name}.ply").touch()
    assert organ_of_folder(tmp_path, {}).name == "spleen"
    (tmp_path / "liver.ply").touch()
    with refused(InputError, "meta.json"):
        organ_of_folder(tmp_path, {})
    assert organ_of_folder(tmp_path, {"organ": {"name": "liver"}}) == LIVER
