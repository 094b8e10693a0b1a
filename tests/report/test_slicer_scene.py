"""Scenes for 3D Slicer as its core opens them: all lies where the case and the run say."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import clients
from imaging_objects import kidney_labels
from live_objects import small_estimate
from refused import refused
from reports import NOWHERE, bounded, reporting
from tumortrack.case.prepare import prepare
from tumortrack.case.surface import surfaces
from tumortrack.cli.cases import Export
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS, rigid, transform_points
from tumortrack.core.patient import Patient
from tumortrack.core.types import CameraLabels, Volume
from tumortrack.io.case import Case, load_case, save_case
from tumortrack.io.mesh_files import read_mesh
from tumortrack.io.points import PointTable, read_points
from tumortrack.io.run_folder import write_estimate

CAMERA_FROM_CT = rigid(Rotation.from_euler("x", 60, degrees=True).as_matrix(), np.arange(3) * 40.0)
RAS = np.array([-1.0, -1, 1])  # of LPS, and back
MASS = ["Mass", "", "Kidney", "Left"]
MEANINGS = {"kidney": ["Kidney", "Left", "", ""], "tumor_1": MASS, "tumor_2": MASS}
WRITES = "slicer_peer.py", "write"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A case with a CT, and a run of its model."""
    top = tmp_path_factory.mktemp("slicer")
    labels = kidney_labels((2.0, 2.0, 2.0))
    ct = Volume(np.where(labels.labels > 0, 100, -100).astype(np.float32), labels.lps_from_index)
    (top / "case").mkdir()
    parts, left = surfaces(labels)[0], Patient("P1", "left")
    save_case(Case(parts, labels, (0.0, -1.0, 0.0), ct=ct, patient=left), top / "case")
    found = reporting(
        bounded(small_estimate(), tumor_1=5.04),
        motion={**NOWHERE, "camera_from_ct": CAMERA_FROM_CT.tolist()},
    )
    volume = CameraLabels(np.ones((4, 4, 4), np.uint8), np.eye(4))
    estimate = replace(found, volume=volume, motion=Shift())
    table = PointTable(np.array([[1.0, 2, 3]]), ("label", "ct_x", "ct_y", "ct_z"), (tuple("A123"),))
    about = {"model": {"case_sha256": store.sha256_of(top / "case" / store.MANIFEST)}}
    write_estimate(top / "run", estimate, points=table, about=about)
    return top / "case", top / "run"


class Shift:
    """10 mm along x; how surely is unknown."""

    def forward(self, points):
        return points + [10.0, 0, 0]

    def inverse(self, points):
        return points - [10.0, 0, 0]

    def std_mm(self, points):
        return None

    largest_std_mm = covariance_mm2 = std_mm


@pytest.fixture(scope="module")
def scenes(
    folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Path], dict[str, dict]]:
    """Each scene's folder, and what 3D Slicer makes of it: its nodes by name."""
    environment = clients.environment("slicer-core")
    (case, run), top = folders, tmp_path_factory.mktemp("scenes")
    out = {name: top / name for name in ("case", "both", "alone", "live")}
    Export(case=case, out=out["case"]).run()
    Export(case=case, out=out["both"], located=run).run()
    Export(case=run, out=out["alone"]).run()
    Export(case=case, out=out["live"], live="theatre:18945").run()
    files = [folder / "scene.mrb" for folder in out.values()]
    said = clients.said(environment, "slicer_peer.py", "read", *files)
    return out, dict(zip(out, said, strict=True))


def check_points(node: dict, places_lps: dict[str, np.ndarray]) -> None:
    assert list(node["places"]) == list(places_lps)
    for label, place in places_lps.items():
        np.testing.assert_allclose(node["places"][label], place * RAS, atol=1e-3)


def check_models(nodes: dict[str, dict], folder: Path, *names: str) -> None:
    for name in names:
        wanted = read_mesh(folder / f"{name}.ply").vertices_mm * RAS
        shown = np.array(nodes[name]["points"])  # in an order of Slicer's
        assert cKDTree(wanted).query(shown)[0].max() < 1e-4
        assert cKDTree(shown).query(wanted)[0].max() < 1e-4
        assert nodes[name]["seen"]
        assert (nodes[name]["opacity"] < 1) == (name not in ("tumor_1", "tumor_2"))


def test_slicer_shows_a_case_where_it_lies(folders, scenes) -> None:
    (case, _), (_, made) = folders, scenes
    assert made["case"]["good"]
    nodes, stored = made["case"]["nodes"], load_case(case)
    assert set(nodes) == {"CT", "CT segmentation", "kidney", "tumor_1", "tumor_2", "tumors"}
    assert not any(node["under"] for node in nodes.values())
    check_models(nodes, case, "kidney", "tumor_1", "tumor_2")
    labels, affine = stored.labels.labels, stored.labels.lps_from_index
    for label, (name, one) in enumerate(nodes["CT segmentation"]["segments"].items(), 1):
        assert name == stored.anatomy.names[label - 1]
        assert one["meaning"] == MEANINGS[name]
        np.testing.assert_allclose(one["colour"], nodes[name]["colour"], atol=1e-4)
        voxels = np.argwhere(labels == label)
        middle = transform_points(affine, voxels.astype(float)).mean(0)
        np.testing.assert_allclose(one["middle"], middle * RAS, atol=1e-6)
        assert one["volume_mm3"] == pytest.approx(8 * len(voxels))  # voxels of 2 mm
    bright = transform_points(affine, np.argwhere(labels > 0).astype(float)).mean(0)
    np.testing.assert_allclose(nodes["CT"]["brightest"], bright * RAS, atol=1e-4)
    tumors = zip(stored.anatomy.names[1:], stored.anatomy.tumors, strict=True)
    check_points(nodes["tumors"], {name: mesh.box_mm.mean(0) for name, mesh in tumors})


def test_slicer_shows_a_run_and_the_ct_where_the_organ_is(folders, scenes) -> None:
    (_, run), (_, made) = folders, scenes
    assert made["both"]["good"]
    nodes, alone = made["both"]["nodes"], made["alone"]["nodes"]
    assert {n for n, node in nodes.items() if node["under"] == "ct"} == {"CT", "CT segmentation"}
    point_lps = np.array([12.0, -7, 30, 1])
    now_ras = np.array(nodes["ct"]["world_from_node"]) @ RAS_FROM_LPS @ point_lps
    np.testing.assert_allclose(RAS_FROM_LPS @ now_ras, CAMERA_FROM_CT @ point_lps, atol=1e-5)
    check_models(nodes, run, "kidney", "tumor_1", "tumor_1_margin", "tumor_2")
    places = {
        "tumor_1, off by at most 5.0 mm (95 %)": np.array([14.0, -3, 120]),
        "tumor_2": np.array([-6.0, 5, 138]),
    }
    check_points(nodes["tumors"], places)
    check_points(nodes["mapped_points"], {"A": np.array([11.0, 2, 3])})
    np.testing.assert_allclose(nodes["located"]["segments"]["kidney"]["middle"], [-1.5, -1.5, 1.5])
    assert set(nodes) - set(alone) == {"CT", "CT segmentation", "ct"}
    assert all(alone[name] == nodes[name] for name in alone)


def test_a_live_scene_connects_and_shows_nothing_before(scenes) -> None:
    """The connector is a node of an extension; without that Slicer says so, and shows the rest."""
    out, made = scenes
    nodes, said = made["live"]["nodes"], made["live"]["said"]
    assert not made["live"]["good"]
    assert said.count("Error") == said.count("vtkMRMLIGTLConnectorNode [") == 1
    models = {name for name, node in nodes.items() if node["kind"] == "vtkMRMLModelNode"}
    shells = {f"tumor_{n}_margin" for n in (1, 2)}
    assert models == {"kidney", "tumor_1", "tumor_2"} | shells  # the devices that the sink sends
    assert not any(nodes[name]["points"] for name in models)
    assert nodes["CT"]["under"] == nodes["CT segmentation"]["under"] == "ct"
    np.testing.assert_array_equal(nodes["ct"]["world_from_node"], np.eye(4))
    with zipfile.ZipFile(out["live"] / "scene.mrb") as archive:
        (client,) = ElementTree.fromstring(archive.read("scene/scene.mrml")).iter("IGTLConnector")
    assert (client.get("connectorType"), client.get("serverHostname")) == ("CLIENT", "theatre")
    assert [client.get(name) for name in ("serverPort", "persistent", "state")] == [
        "18945", "1", "1",
    ]  # fmt: skip


def test_what_slicer_writes_is_read_where_slicer_has_it(tmp_path: Path) -> None:
    """Points, surfaces and a segmentation whose segments overlap; in LPS and in RAS."""
    (segments,) = clients.said(clients.environment("slicer-core"), *WRITES, tmp_path)
    middle, tumor = np.array([-10.0, -20, 30]), np.array([-24.0, -20, 30])  # LPS
    for axes in ("LPS", "RAS"):
        for suffix in ("mrk.json", "fcsv"):
            table = read_points(tmp_path / f"{axes}.{suffix}")
            np.testing.assert_array_equal(table.points_ct, [middle, tumor])
            assert [row[0] for row in table.rows] == ["hilum, left", "F-2"]
        case = prepare(tmp_path / axes)
        found = [part.box_mm.mean(0) for part in case.anatomy.parts]
        np.testing.assert_allclose(found, [middle, tumor], atol=0.01)
    labels = prepare(tmp_path / "S.seg.nrrd").labels
    for one, inside in zip(segments, (labels.labels > 0, labels.labels == 2), strict=True):
        places = transform_points(labels.lps_from_index, np.argwhere(inside).astype(float))
        np.testing.assert_allclose(places.mean(0), np.array(one["middle"]) * RAS, atol=1e-6)


def test_what_does_not_fit_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    case, run = folders
    out = tmp_path / "out"
    for given, options in (
        (case, {"located": run, "live": "localhost:1"}),
        (case, {"live": "18944"}),
        (case, {"located": case}),
        (run, {"live": "localhost:1"}),
    ):
        with pytest.raises(InputError):
            Export(case=given, out=out, **options).run()
    other = tmp_path / "other"
    other.mkdir()
    case_of = store.read_manifest(case, "case")
    for file in case_of["files"]:
        (other / file).write_bytes((case / file).read_bytes())
    keys = ("organ", "structures", "parts", "up_lps", "patient")
    keys += ("rotations", "tilt_degrees", "sensor")
    store.seal(other, "case", {**{k: case_of[k] for k in keys}, "report": {"notes": []}}, "lps")
    with refused(InputError, run):
        Export(case=other, out=out, located=run).run()
    assert not out.exists()
