"""Kits: beads that tell where they are, stands that press as far as they say, files that agree."""

import json
import re
import zipfile
from itertools import combinations

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from tumortrack.case.meshes import label_meshes
from tumortrack.cli.main import run
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy
from tumortrack.io.case import Case, save_case
from tumortrack.io.mesh_files import read_mesh
from tumortrack_experiment.kit import recipe
from tumortrack_experiment.kit.base import (
    BaseConfig,
    base_design,
    uniqueness_mm,
)
from tumortrack_experiment.kit.checks import checked, plate_height_mm
from tumortrack_experiment.kit.split import laid_mesh
from tumortrack_experiment.kit.stands import midsection_top_mm, poke_point
from tumortrack_experiment.kit_file import read_kit
from tumortrack_experiment.register.beads import CAMERA, name_beads

ANTERIOR = (0.0, -1.0, 0.0)
STATES = ("D1", "D2", "D3", "P1", "T10")


@pytest.fixture(scope="module")
def anatomy():
    """An egg, its long axis along the patient, with a tumor that pokes out in front."""
    egg = Manifold.sphere(1.0, 24).scale((12, 10, 20)).translate((60, -20, 5))
    tumor = Manifold.sphere(5.0, 16).translate((62, -29, 12))
    return Anatomy((mesh_of(egg + tumor), mesh_of(tumor)))


@pytest.fixture(scope="module")
def base(anatomy):
    return base_design(anatomy, ANTERIOR, BaseConfig(beads=6, states=STATES))


@pytest.fixture(scope="module")
def kit(anatomy, tmp_path_factory):
    """As a user makes it."""
    folder = tmp_path_factory.mktemp("kit")
    (folder / "case").mkdir()
    save_case(Case(anatomy, label_meshes(anatomy), ANTERIOR), folder / "case")
    made = ["phantom-kit", str(folder / "case"), str(folder / "kit")]
    assert run([*made, "--states", "D2", "--beads", "6"]) == 0
    return folder / "kit"


def test_the_organ_lies_as_in_its_ct_and_is_told_apart_from_its_mirror(base, anatomy):
    organ = base.anatomy.organ
    assert organ.box_mm[0, 2] == pytest.approx(0)
    assert np.allclose(organ.box_mm[:, :2].sum(0), 0)
    assert np.ptp(organ.box_mm, axis=0).argmax() == 0
    way = base.base_from_ct[:3, :3]
    assert way @ ANTERIOR == pytest.approx([0, 0, 1])
    assert np.linalg.det(way) == pytest.approx(1)
    gap, mirror = uniqueness_mm(base.beads_mm)
    pairs = np.linalg.norm(base.beads_mm[:, None] - base.beads_mm, axis=2)[np.triu_indices(6, 1)]
    apart = np.abs(pairs[:, None] - pairs)[~np.eye(15, dtype=bool)]
    assert gap == pytest.approx(apart.min())
    assert gap >= 1
    # The best proper fit to the mirrored beads is as bad as it is said to be.
    a = base.beads_mm - base.beads_mm.mean(0)
    u, _, vt = np.linalg.svd(a.T @ (a * [1, 1, -1]))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    left = np.sqrt((((a @ turn) - a * [1, 1, -1]) ** 2).sum(1).mean())
    assert left == pytest.approx(mirror)
    assert mirror >= 10


def test_any_four_beads_are_named_in_any_order(kit):
    told, rng = read_kit(kit), np.random.default_rng(0)
    for count in (4, 5, 6):
        for some in combinations(range(6), count):
            order = rng.permutation(some)
            turn = Rotation.random(random_state=rng).as_matrix()
            found = told.beads_mm[order] @ turn.T + rng.normal(0, 0.1, (count, 3))
            named = name_beads(told, found, CAMERA)
            assert np.array_equal(named.points_mm[order], found)


def test_a_ball_in_its_cone_has_its_middle_where_the_kit_says(base):
    plate = solid_of(base.parts[0].mesh, "base")
    for bead in base.beads_mm:
        assert (Manifold.sphere(2.97, 96).translate(bead) ^ plate).volume() == 0
        touching = Manifold.sphere(3.03, 96).translate(bead) ^ plate
        assert touching.volume() > 0
        points = touching.to_mesh64().vert_properties[:, :3] - bead
        assert np.abs(points[:, :2].mean(0)).max() < 0.05  # all round
    # Nothing of the plate is in the organ's way upwards.
    organ = solid_of(base.anatomy.organ, "organ").translate((0, 0, 0.5))
    assert all((organ.translate((0, 0, z)) ^ plate).volume() < 1 for z in (0, 2, 5, 20))


def test_plates_and_rod_press_as_far_as_their_states_say(base):
    parts = {part.name: part for part in base.parts}
    top, plate = midsection_top_mm(base.anatomy.organ), solid_of(parts["base"].mesh, "base")
    for name, by in (("D1", 4), ("D2", 8), ("D3", 12)):
        press = parts[f"press_{name}"]
        assert top - plate_height_mm(press) == pytest.approx(by, abs=0.01)
        assert press.mesh.box_mm[0, 2] == 0  # its legs stand on the plate, in the sockets
        assert (solid_of(press.mesh, name) ^ plate).volume() == pytest.approx(0, abs=1e-6)
    place = poke_point(base.anatomy)
    tip = parts["rod_P1"].mesh.box_mm
    assert tip[0, 2] == pytest.approx(place[2] - 10, abs=0.01)
    assert tip[:, :2].mean(0) == pytest.approx(place[:2], abs=0.01)
    rod, guide = (solid_of(parts[n].mesh, n) for n in ("rod_P1", "guide_P1"))
    assert (rod ^ guide).volume() == pytest.approx(0)
    assert (rod.translate((0, 0, -0.1)) ^ guide).volume() > 1
    # Laid as it is printed, the bar's lower face lies flat: the base's plane is then at 10 degrees.
    wedge = parts["wedge_T10"]
    assert np.degrees(np.arccos(wedge.print_from_frame[2, 2])) == pytest.approx(10)
    for part in base.parts:
        assert laid_mesh(part).box_mm[0, 2] == pytest.approx(0, abs=1e-6)


def test_files_hold_what_kit_json_says(kit, anatomy):
    told = read_kit(kit)
    assert told.organ_ml == pytest.approx(anatomy.organ.volume_mm3 / 1000, rel=0.01)
    for part in told.parts:
        assert read_mesh(kit / part.file).volume_mm3 / 1000 == pytest.approx(
            part.volume_ml, abs=2e-3
        )
    base = next(part for part in told.parts if part.name == "base")
    placed = transform_points(np.array(base.base_from_part), read_mesh(kit / base.file).vertices_mm)
    assert placed[:, 2].min() == pytest.approx(-5)
    with zipfile.ZipFile(kit / "kit.3mf") as file:
        assert b'unit="millimeter"' in file.read("3D/3dmodel.model")[:2000]
    scene = trimesh.load(kit / "kit.3mf")
    volumes = {name: solid.volume / 1000 for name, solid in scene.geometry.items()}
    assert volumes == pytest.approx({p.name: p.volume_ml for p in told.parts}, abs=2e-3)
    checks = json.loads((kit / "checks.json").read_text())["checks"]
    assert {check["verdict"] for check in checks} <= {"good", "look"}
    sheet = (kit / "sheet.html").read_text()
    assert "@" not in sheet.split("</style>")[1]
    assert "http" not in sheet
    assert "<h1>Phantom kit of case case (patient" in sheet
    bolts = sum(check["value"] for check in checks if check["what"] == "bolts")
    assert re.search(rf"nylon bolts M4 x 25 mm.*<td>{bolts:.0f}<td>", sheet)
    assert sheet.count("<img") == 4  # bench, two molds, D2


def test_a_kit_is_known_and_only_a_kit_is_replaced(kit, capsys):
    assert run(["inspect", str(kit)]) == 0
    assert "a kit" in capsys.readouterr().out
    case = str(kit.parent / "case")
    for arguments, said in (
        ([str(kit)], str(kit)),
        ([case, "--overwrite"], case),
        ([str(kit / "x"), "--states", "D4"], "D4"),
        ([str(kit / "x"), "--bed", "100", "100", "100"], "--bed"),
        ([str(kit / "x"), "--bead-mm", "40"], "bead_mm"),
        ([str(kit / "x"), "--beads", "3"], "4 to 10"),
        ([str(kit / "x"), "--pva", "50"], "pva_percent"),
    ):
        assert run(["phantom-kit", case, *arguments]) == 2
        assert said in capsys.readouterr().err
    assert not (kit / "x").exists()


def test_without_a_tumor_there_is_no_kit(anatomy, tmp_path, capsys):
    (tmp_path / "case").mkdir()
    bare = Anatomy((anatomy.organ,))
    save_case(Case(bare, label_meshes(bare), ANTERIOR), tmp_path / "case")
    assert run(["phantom-kit", str(tmp_path / "case"), str(tmp_path / "kit")]) == 2
    assert str(tmp_path / "case") in capsys.readouterr().err


def test_batches_weigh_what_their_volumes_need():
    mix = recipe.Mix(pva_percent=10, spare=0)
    organ, tumors = recipe.batches(mix, 150.0, (20.0, 10.0))
    assert organ.ml == pytest.approx(120 + recipe.COUPONS_ML)
    assert tumors.ml == pytest.approx(30 + 24.77, abs=0.01)
    for batch, share in ((organ, 0.0), (tumors, 0.0227)):
        total = batch.water_g + batch.pva_g + batch.baso4_g
        assert batch.pva_g / total == pytest.approx(0.10)
        assert batch.baso4_g / total == pytest.approx(share)
        filled = batch.water_g / 0.998 + batch.pva_g / 1.27 + batch.baso4_g / 4.5
        assert filled == pytest.approx(batch.ml)


def test_what_cannot_be_used_is_told_from_what_should_be_looked_at():
    assert checked("x", "cast_error_percent", 1.2).verdict == "FAILS"
    assert checked("x", "cast_error_percent", -0.9).verdict == "good"
    assert checked("x", "least_wall_mm", 0.8).verdict == "look"
    assert checked("x", "pressed_mm", 7.9, 8.0).verdict == "FAILS"
    with pytest.raises(InputError):
        BaseConfig(states=("D1", "D1"))


def test_checks_read_as_sentences_with_their_units():
    assert checked("base", "fits_bed", True).number == "yes"
    assert checked("base", "fits_bed", False).number == "no"
    assert checked("base", "fits_bed", False).limits == "yes"
    assert checked("organ", "keys", 6).number == "6"
    assert checked("organ", "cast_differs_mm", 0.0002).number == "under 0.01 mm"
    assert checked("organ", "least_wall_mm", 1.284).number == "1.28 mm"
