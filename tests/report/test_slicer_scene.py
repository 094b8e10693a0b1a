"""Scenes for 3D Slicer: what they refer to is there, and lies where the case and the run say."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imaging_objects import kidney_labels
from live_objects import small_estimate
from reports import NOWHERE, reporting
from tumortrack.cli.cases import Export
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS, rigid
from tumortrack.core.mesh_files import read_mesh
from tumortrack.core.types import CameraLabels, Volume
from tumortrack.imaging.case import Case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.tracking.files import write_estimate
from tumortrack.tracking.points import PointTable

CAMERA_FROM_CT = rigid(Rotation.from_euler("x", 60, degrees=True).as_matrix(), np.arange(3) * 40.0)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A case with a CT, and a run of its model with a stated margin."""
    top = tmp_path_factory.mktemp("slicer")
    labels = kidney_labels((2.0, 2.0, 2.0))
    ct = Volume(np.where(labels.labels > 0, 100, -100).astype(np.float32), labels.lps_from_index)
    (top / "case").mkdir()
    save_case(Case(surfaces(labels)[0], labels, (0.0, -1.0, 0.0), ct=ct), top / "case")
    found = reporting(
        replace(small_estimate(), finding=None),
        parts={"tumor_1": {"center_std_mm": 1.26}},
        motion={**NOWHERE, "camera_from_ct": CAMERA_FROM_CT.tolist()},
        margin={"stated": [{"confidence": 0.95, "mm": {"tumor_1": 5.0}}]},
    )
    volume = CameraLabels(np.ones((4, 4, 4), np.uint8), np.eye(4))
    estimate = replace(found, volume=volume, motion=Shift())
    table = PointTable(np.array([[1.0, 2, 3]]), ("label", "ct_x", "ct_y", "ct_z"), (tuple("A123"),))
    about = {"model": {"case_sha256": store.sha256_of(top / "case" / store.MANIFEST)}}
    write_estimate(top / "run", estimate, points=table, about=about)
    return top / "case", top / "run"


class Shift:
    """10 mm along x; how surely is unknown."""

    def carry(self, points):
        return points + [10.0, 0, 0]

    def back(self, points):
        return points - [10.0, 0, 0]

    def std_mm(self, points):
        return None

    largest_std_mm = covariance_mm2 = std_mm


def opened(out: Path, into: Path) -> dict[str, dict[str, str]]:
    """The scene's nodes by name, each with what it refers to; files unpacked into ``into``."""
    with zipfile.ZipFile(out / "scene.mrb") as archive:
        assert archive.testzip() is None
        archive.extractall(into)
        names = set(archive.namelist())
    (scene,) = (name for name in names if name.endswith(".mrml"))  # Slicer opens the first it finds
    root = ElementTree.parse(into / scene).getroot()
    assert root.tag == "MRML"
    by_id = {node.attrib["id"]: node for node in root}
    assert len(by_id) == len(root)
    found, files = {}, set()
    for node in root:
        said = dict(node.attrib, kind=node.tag)
        for reference in filter(None, said.pop("references", "").split(";")):
            role, other = reference.split(":")
            said[role] = by_id[other].attrib.get("fileName", by_id[other].attrib["name"])
        if "storage" in said:
            said["file"] = str(into / Path(scene).parent / said["storage"])
            files.add(f"{Path(scene).parent}/{said['storage']}")
        if "display" in said or "storage" not in said:
            found[said["name"]] = said
    assert names == files | {scene}
    return found


def points_of(node: dict[str, str]) -> dict[str, list[float]]:
    (markup,) = json.loads(Path(node["file"]).read_text())["markups"]
    assert (markup["type"], markup["coordinateSystem"]) == ("Fiducial", "LPS")
    return {one["label"]: one["position"] for one in markup["controlPoints"]}


def test_a_case_opens_as_it_lies(folders: tuple[Path, Path], tmp_path: Path) -> None:
    case, _ = folders
    Export(case=case, out=tmp_path / "out").run()
    nodes = opened(tmp_path / "out", tmp_path / "scene")
    for name in ("kidney", "tumor_1", "tumor_2"):
        assert nodes[name]["kind"] == "Model"
        assert Path(nodes[name]["file"]).read_bytes() == (case / f"{name}.ply").read_bytes()
    assert Path(nodes["CT"]["file"]).read_bytes() == (case / "ct.nii.gz").read_bytes()
    assert nodes["CT segmentation"]["kind"] == "Segmentation"
    middle = read_mesh(case / "tumor_1.ply").box_mm.mean(0)
    np.testing.assert_allclose(points_of(nodes["tumors"])["tumor_1"], middle, atol=1e-4)
    assert not any("transform" in node for node in nodes.values())


def test_a_run_opens_with_its_ct_where_the_organ_is(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    case, run = folders
    Export(case=case, out=tmp_path / "both", located=run).run()
    nodes = opened(tmp_path / "both", tmp_path / "scene")
    assert {n for n, node in nodes.items() if "transform" in node} == {"CT", "CT segmentation"}
    matrix = np.array(nodes["ct"]["matrixTransformToParent"].split(), float).reshape(4, 4)
    point_lps = np.array([12.0, -7, 30, 1])
    now_ras = matrix @ RAS_FROM_LPS @ point_lps  # as Slicer moves it
    np.testing.assert_allclose(RAS_FROM_LPS @ now_ras, CAMERA_FROM_CT @ point_lps, atol=1e-5)
    assert Path(nodes["kidney"]["file"]).read_bytes() == (run / "kidney.ply").read_bytes()
    assert nodes["tumor_1_margin"]["kind"] == "Model"
    centres = points_of(nodes["tumors"])
    assert list(centres) == [
        "tumor_1, std 1.3 mm, 95 % margin 5.0 mm", "tumor_2, no margin stated",
    ]  # fmt: skip
    np.testing.assert_allclose(next(iter(centres.values())), [14, -3, 120], atol=1e-3)
    assert points_of(nodes["mapped_points"]) == {"A": [11.0, 2.0, 3.0]}
    Export(case=run, out=tmp_path / "alone").run()
    alone = opened(tmp_path / "alone", tmp_path / "other")
    assert set(nodes) - set(alone) >= {"CT", "CT segmentation", "ct"}
    assert alone["located"]["kind"] == "Segmentation"


def test_a_live_scene_connects_and_shows_nothing_before(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    case, _ = folders
    Export(case=case, out=tmp_path / "out", live="theatre:18945").run()
    nodes = opened(tmp_path / "out", tmp_path / "scene")
    client = nodes["tumortrack"]
    assert client["kind"] == "IGTLConnector"
    assert (client["connectorType"], client["serverHostname"]) == ("CLIENT", "theatre")
    assert (client["serverPort"], client["persistent"], client["state"]) == ("18945", "1", "1")
    models = {name for name, node in nodes.items() if node["kind"] == "Model"}
    shells = {f"tumor_{n}_margin" for n in (1, 2)}
    assert models == {"kidney", "tumor_1", "tumor_2"} | shells  # the devices that the sink sends
    assert not any("file" in nodes[name] for name in models)
    assert nodes["CT"]["transform"] == nodes["ct"]["name"] == "ct"


def test_what_does_not_fit_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    case, run = folders
    out = tmp_path / "out"
    for options, word in (
        ({"located": run, "live": "localhost:1"}, "one of them"),
        ({"live": "18944"}, "HOST:PORT"),
        ({"located": case}, "'run' is needed"),
    ):
        with pytest.raises(InputError, match=word):
            Export(case=case, out=out, **options).run()
    with pytest.raises(InputError, match="are for a case"):
        Export(case=run, out=out, live="localhost:1").run()
    other = tmp_path / "other"
    other.mkdir()
    case_of = store.read_manifest(case, "case")
    for file in case_of["files"]:
        (other / file).write_bytes((case / file).read_bytes())
    keys = ("organ", "structures", "parts", "up_lps", "patient")
    keys += ("rotations", "tilt_degrees", "sensor")
    store.seal(other, "case", {**{k: case_of[k] for k in keys}, "report": {"notes": []}}, "lps")
    with pytest.raises(InputError, match="give its case"):
        Export(case=other, out=out, located=run).run()
    assert not out.exists()
