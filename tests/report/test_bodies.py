"""Bodies for simulators, as the simulators' own readers see them, and what a body must be."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

import clients
import tumortrack as tt
from refused import refused
from stories import cloud_by_rays, looking_down
from tumortrack.cli.cases import Export
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.mesh_query import nearest_places
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.io.case import load_case, save_case
from tumortrack.io.mesh_files import read_mesh
from tumortrack.io.ply import write_cloud_ply
from tumortrack.io.run_folder import MOTION
from tumortrack.organ.tets import FACES, lattice, tet_volumes
from tumortrack.registration.motion import ElasticMotion
from tumortrack.report.bodies import YOUNG_KPA, tumor_shares
from tumortrack.tracking.model_files import load_model

SLICER, USD, NEWTON = ("slicer-core",), ("usd-core", "pxr"), ("newton", "newton")


def ball(radius_mm: float, middle: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    import trimesh

    sphere = trimesh.creation.icosphere(4, radius_mm)
    return Mesh(np.array(sphere.vertices) + middle, np.array(sphere.faces))


@pytest.fixture(scope="module")
def runs(ready_case: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], Path]:
    """The case located in a cloud that is so many times too large."""
    top, case = tmp_path_factory.mktemp("runs"), load_case(ready_case)
    cloud = cloud_by_rays(case, looking_down(case)).astype(np.float32)

    def run(scale: float) -> Path:
        folder = top / f"{scale:g}"
        if not folder.exists():
            write_cloud_ply(top / f"{scale:g}.ply", np.float32(scale) * cloud)
            tt.locate_files(ready_case, top / f"{scale:g}.ply", grid=24).save(folder)
        return folder

    return run


@pytest.fixture(scope="module")
def made(ready_case: Path, runs, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Exports by name."""
    top = tmp_path_factory.mktemp("bodies")
    for format_ in ("vtk", "usd"):
        Export(case=ready_case, out=top / format_, format=format_, located=runs(1.0)).run()
    Export(case=ready_case, out=top / "rest", format="vtk").run()
    return {folder.name: folder for folder in top.iterdir()}


def located(case: Path, run: Path) -> ElasticMotion:
    arrays = load((run / MOTION).read_bytes())
    return ElasticMotion.from_arrays(load_model(case / "model").shape.compliant, arrays)


def outer_faces(tets: np.ndarray) -> np.ndarray:
    """The triangles of one tetrahedron alone; none has more than two."""
    every = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    faces, times = np.unique(every, axis=0, return_counts=True)
    assert times.max() == 2
    return faces[times == 1]


def check_body(nodes_mm: np.ndarray, tets: np.ndarray, organ: Mesh) -> None:
    """It fills the organ: no node twice or unused, no triangle of three tetrahedra, one piece of
    surface (Euler's number of a ball), all of it near the organ's."""
    volumes = tet_volumes(nodes_mm, tets)
    assert volumes.min() > 0.15 * np.median(volumes)
    assert volumes.sum() == pytest.approx(organ.volume_mm3, rel=0.02)
    assert len(np.unique(nodes_mm.round(4), axis=0)) == len(nodes_mm) == len(np.unique(tets))
    faces = outer_faces(tets)
    assert len(faces) % 2 == 0
    corners = len(np.unique(faces))
    assert corners - len(faces) // 2 == 2
    outer_mm = nodes_mm[np.unique(faces)]
    edge_mm = np.cbrt(6 * np.median(volumes) * 2)  # twelve to a cube
    assert np.linalg.norm(nearest_places(organ, outer_mm) - outer_mm, axis=1).max() < edge_mm / 2


def test_parts_are_as_large_as_they_are() -> None:
    organ, tumors = ball(30.0), (ball(10.0, (12, 0, 0)), ball(6.0, (-16, 4, 0)))
    tets = lattice(organ, 5.0)
    check_body(tets.nodes_mm, tets.tets, organ)
    shares = tumor_shares(Anatomy((organ, *tumors)), tets)
    wanted = [tumor.volume_mm3 for tumor in tumors]
    np.testing.assert_allclose(shares @ tets.volumes_mm3, wanted, rtol=0.05)
    middles_mm = tets.nodes_mm[tets.tets].mean(1)
    for share, middle, radius_mm in zip(shares, ((12, 0, 0), (-16, 4, 0)), (10, 6), strict=True):
        away_mm = np.linalg.norm(middles_mm - middle, axis=1)
        assert set(share[away_mm < radius_mm - 3.5]) == {1.0}
        assert not share[away_mm > radius_mm + 3.5].any()
    assert tumor_shares(Anatomy((organ,)), tets).shape == (0, len(tets.tets))


def test_modes_are_the_covariance(ready_case: Path, runs) -> None:
    """What is kept in a run gives the places and covariances that it told."""
    motion, run = located(ready_case, runs(1.0)), runs(1.0)
    anatomy = load_case(ready_case).anatomy
    for name, part in zip(anatomy.names, anatomy.parts, strict=True):
        told = read_mesh(run / f"{name}.ply")
        off_mm = nearest_places(told, motion.forward(part.vertices_mm))
        np.testing.assert_allclose(off_mm, motion.forward(part.vertices_mm), atol=1e-3)
    told_mm = json.loads((run / "report.json").read_text())["parts"]["tumor_1"]["center_std_mm"]
    middle = anatomy.tumors[0].box_mm.mean(0)[None]
    assert motion.std_mm(middle)[0] == pytest.approx(told_mm)
    other = motion.changed(np.full(len(motion.covariance), 0.02))
    twofold = replace(motion, alternatives=((other, 0.2),), depth_share=0.01, std_scale=1.3)
    again = ElasticMotion.from_arrays(motion.shape, load(save(twofold.to_arrays())))
    points, weights = anatomy.organ.vertices_mm[::50], np.ones(len(anatomy.organ.vertices_mm[::50]))
    modes = again.spread_modes(points, weights)
    wanted = twofold.covariance_mm2(points)
    np.testing.assert_allclose(np.einsum("nxk,nyk->nxy", modes, modes), wanted, atol=1e-9)
    products = np.einsum("nxa,nxb->ab", modes, modes)
    assert (np.diff(np.diag(products)) < 1e-9 * products[0, 0]).all()  # the largest first
    assert np.abs(products - np.diag(np.diag(products))).max() < 1e-9 * products[0, 0]


def test_vtk_reads_what_a_case_and_a_run_hold(made, ready_case: Path, runs) -> None:
    environment, anatomy = clients.environment(*SLICER), load_case(ready_case).anatomy
    files = [
        made["rest"] / "body.tets.vtk",
        made["vtk"] / "body.tets.vtk",
        made["vtk"] / "rest.tets.vtk",
    ]
    files += [made["vtk"] / f"{name}.vtk" for name in anatomy.names]
    rest, now, kept, *surfaces = clients.said(environment, "simulator_peer.py", "vtk", *files)
    motion = located(ready_case, runs(1.0))
    tets = np.array(rest["cells"]).reshape(-1, 4)
    check_body(np.array(rest["nodes"]), tets, anatomy.organ)
    for one in (rest, now, kept):
        assert one["types"] == [10]
        assert one["cells"] == rest["cells"]
        assert one["of_cells"] == rest["of_cells"]
        assert one["least_degrees"] > 15  # the smallest angle between two of its faces
    assert kept["nodes"] == rest["nodes"]
    nodes_mm, rest_mm = np.array(now["nodes"]), np.array(rest["nodes"])
    np.testing.assert_allclose(nodes_mm, motion.forward(rest_mm), atol=1e-3)
    for name, part, surface in zip(anatomy.names, anatomy.parts, surfaces, strict=True):
        assert surface["types"] == [5], name
        assert surface["cells"] == part.faces.ravel().tolist()
        np.testing.assert_allclose(surface["nodes"], motion.forward(part.vertices_mm), atol=1e-3)
    # The parts, and how stiff each is.
    labels, young = (np.array(rest["of_cells"][k]) for k in ("part", "young_modulus_kpa"))
    volumes = tet_volumes(rest_mm, tets)
    for label, part in enumerate(anatomy.tumors, 2):
        assert volumes[labels == label].sum() == pytest.approx(part.volume_mm3, rel=0.1)
    ratios = young / YOUNG_KPA
    assert ratios[labels == 1].max() <= 2 <= ratios[labels > 1].min()  # half of it a tumor
    assert [ratios.min(), ratios.max()] == pytest.approx([1.0, 3.0], rel=1e-5)
    np.testing.assert_allclose(rest["of_cells"]["poisson_ratio"], 0.49, rtol=1e-6)
    # How surely it is there.
    about = json.loads((made["vtk"] / "body.json").read_text())
    squares = 0
    weights = np.bincount(tets.ravel(), np.repeat(volumes, 4)) / volumes.sum() / 4
    for entry in about["modes"]:
        mode = np.array(now["of_nodes"][entry["name"]])
        squares = squares + mode**2
        assert (weights @ mode**2).sum() ** 0.5 == pytest.approx(entry["rms_mm"], rel=1e-4)
    share = sum(entry["share"] for entry in about["modes"])
    whole = 3 * motion.std_mm(rest_mm) ** 2
    assert 0.8 < share < 1
    assert weights @ squares.sum(1) == pytest.approx(share * (weights @ whole), rel=1e-4)
    assert (squares.sum(1) < whole * (1 + 1e-4)).all()


def test_usd_core_opens_a_body(made, ready_case: Path, runs) -> None:
    environment = clients.environment(*USD)
    (stage,) = clients.said(environment, "simulator_peer.py", "usd", made["usd"] / "body.usda")
    anatomy, motion = load_case(ready_case).anatomy, located(ready_case, runs(1.0))
    assert stage["said"] == []
    assert stage["validators"] > 10
    assert stage["metres"] == 1
    np.testing.assert_allclose(stage["world"], np.diag([1e-3, 1e-3, 1e-3, 1]))
    assert stage["inverted"] == 0
    rest_mm, tets = np.array(stage["rest"]), np.array(stage["cells"])
    check_body(rest_mm, tets, anatomy.organ)
    np.testing.assert_allclose(stage["nodes"], motion.forward(rest_mm), atol=1e-3)
    assert sorted(map(sorted, stage["surface"])) == outer_faces(tets).tolist()
    wanted = {"youngsModulus": 9486.83, "poissonsRatio": 0.49, "density": 1050}  # Pa, kg/m3
    assert stage["tissue"] == pytest.approx(wanted, rel=1e-5)
    values = stage["primvars"]
    assert {name: kind for name, (kind, _) in values.items()} == {
        **dict.fromkeys(("part", "young_modulus_kpa", "poisson_ratio"), "uniform"),
        **dict.fromkeys((f"mode_{k}_mm" for k in range(1, 11)), "vertex"),
    }
    assert all(len(rows) == len(tets if kind == "uniform" else rest_mm)
               for kind, rows in values.values())  # fmt: skip
    assert set(values["part"][1]) == {1, 2, 3}
    for name, part in zip(anatomy.names, anatomy.parts, strict=True):
        nodes_mm, faces = stage["surfaces"].pop(name)
        np.testing.assert_allclose(nodes_mm, motion.forward(part.vertices_mm), atol=1e-3)
        assert faces == part.faces.ravel().tolist()
    assert stage["surfaces"] == {}


def hanging(
    nodes_m: np.ndarray, tets: np.ndarray, young_pa: np.ndarray, held: list[int], axis: int
) -> np.ndarray:
    """Displacements (m) by gravity against an axis, by linear elasticity (Poisson's ratio 0.49)."""
    gradients = np.linalg.inv(nodes_m[tets[:, 1:]] - nodes_m[tets[:, :1]]).transpose(0, 2, 1)
    gradients = np.concatenate([-gradients.sum(1, keepdims=True), gradients], axis=1)  # (t, 4, 3)
    strain = np.zeros((len(tets), 6, 4, 3))
    for row, (a, b) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))):
        strain[:, row, :, a] = gradients[:, :, b]
        strain[:, row, :, b] = gradients[:, :, a]
    strain, volumes = strain.reshape(-1, 6, 12), tet_volumes(nodes_m, tets)
    law = np.diag([2.0, 2, 2, 1, 1, 1]) / (2 * 1.49)
    law[:3, :3] += 0.49 / 1.49 / 0.02
    cells = np.einsum("t,tra,rs,tsb->tab", young_pa * volumes, strain, law, strain, optimize=True)
    unknowns = (3 * tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    where = np.repeat(unknowns, 12, 1).ravel(), np.tile(unknowns, (1, 12)).ravel()
    stiffness = coo_matrix((cells.ravel(), where)).tocsr()
    force = np.zeros_like(nodes_m)
    force[:, axis] = -1050 * 9.81 * np.bincount(tets.ravel(), np.repeat(volumes, 4)) / 4
    free = np.setdiff1d(np.arange(nodes_m.size), 3 * np.array(held)[:, None] + np.arange(3))
    moved = np.zeros(nodes_m.size)
    moved[free] = spsolve(stiffness[free][:, free].tocsc(), force.ravel()[free])
    return moved.reshape(-1, 3)


def test_newton_lets_a_body_hang(made) -> None:
    """A body whose top third is held sags by what it would do by linear statics, and as far again
    as it swings, and keeps its volume; it is at rest as in the CT, whatever it starts from."""
    environment = clients.environment(*NEWTON)
    file = made["usd"] / "body.usda"
    (hung,) = clients.said(environment, "simulator_peer.py", "newton", file)
    (stage,) = clients.said(clients.environment(*USD), "simulator_peer.py", "usd", file)
    rest_m, tets = np.array(stage["rest"]) / 1000, np.array(stage["cells"])
    volumes = tet_volumes(rest_m, tets)
    assert hung["said"] == []
    assert hung["counts"] == [len(rest_m), len(tets)]
    assert hung["mass_kg"] == pytest.approx(1050 * volumes.sum(), rel=1e-4)
    np.testing.assert_allclose(hung["rest_m3"], volumes, rtol=1e-3)
    shear, bulk = 9486.83 / 2 / 1.49, 9486.83 * 0.49 / 1.49 / 0.02
    assert hung["usual"] == pytest.approx([shear, bulk], rel=1e-4)
    assert hung["finite"]
    assert hung["held_moved_m"] == 0
    young = 1000 * np.array(stage["primvars"]["young_modulus_kpa"][1])
    static_m = -hanging(rest_m, tets, young, hung["held"], hung["axis"])[:, hung["axis"]]
    assert 0.9 * static_m.max() < hung["sag_m"] < 2.2 * static_m.max()
    assert min(hung["volume_ratios"]) > 0.98
    assert max(hung["volume_ratios"]) < 1.02
    assert hung["least_ratio"] > 0.5


@pytest.mark.parametrize(("format_", "file"), [("vtk", "body.tets.vtk"), ("usd", "body.usda")])
def test_a_poor_answer_says_so(format_, file, ready_case: Path, runs, tmp_path: Path) -> None:
    run = runs(1.06)
    quality = json.loads((run / "report.json").read_text())["quality"]
    assert quality["verdict"] == "poor"
    Export(case=ready_case, out=tmp_path / "out", format=format_, located=run).run()
    head = (tmp_path / "out" / file).read_text("utf-8")[:400]
    assert f"verdict poor, reason {quality['reason'][:40]}" in head
    about = json.loads((tmp_path / "out" / "body.json").read_text())
    assert (about["verdict"], about["reason"]) == ("poor", quality["reason"])


def test_structures_may_have_any_name(phantom_case: Path, tmp_path: Path) -> None:
    """Also what the body's own files and prims are called."""
    case, folder = load_case(phantom_case), tmp_path / "case"
    structures = {name: ball(5.0, (n, 0, 0)) for n, name in enumerate(("body", "rest", "tissue"))}
    folder.mkdir()
    save_case(replace(case, anatomy=replace(case.anatomy, structures=structures)), folder)
    for format_ in ("vtk", "usd"):
        Export(case=folder, out=tmp_path / format_, format=format_).run()
    names = {*case.anatomy.names, *structures}
    wanted = {f"{name}.vtk" for name in names | {"body.tets", "rest.tets"}} | {"body.json"}
    assert {path.name for path in (tmp_path / "vtk").iterdir()} == wanted
    file = tmp_path / "usd" / "body.usda"
    (stage,) = clients.said(clients.environment(*USD), "simulator_peer.py", "usd", file)
    assert stage["said"] == []
    assert set(stage["surfaces"]) == names
    assert stage["nodes"] == stage["rest"]


def resealed(run: Path, folder: Path, change: Callable[[Path], object]) -> Path:
    shutil.copytree(run, folder)
    manifest = store.read_json(folder / store.MANIFEST)
    change(folder)
    head = {key: manifest[key] for key in ("report", "verdict")}
    store.seal(folder, "run", head, manifest["frame"])
    return folder


def damaged(name: str, value: object) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        arrays = load((folder / MOTION).read_bytes())
        (folder / MOTION).write_bytes(save({**arrays, name: np.asarray(value, float)}))

    return change


def test_what_does_not_fit_is_refused(ready_case: Path, phantom_case: Path, runs, tmp_path) -> None:
    run, out = runs(1.0), tmp_path / "out"

    def of_network(folder: Path) -> None:
        report = store.read_json(folder / "report.json")
        report.pop("motion")
        store.write_json(folder / "report.json", report)
        (folder / MOTION).unlink()

    def of_another_case(folder: Path) -> None:
        report = store.read_json(folder / "report.json")
        report["model"]["case_sha256"] = "0" * 64
        store.write_json(folder / "report.json", report)

    cases = [
        (ready_case, {"live": "localhost:1"}, InputError, "--format"),
        (ready_case, {"patient": "1"}, InputError, "--format"),
        (run, {}, ArtifactError, run),
        (ready_case, {"located": ready_case}, ArtifactError, ready_case),
        (phantom_case, {"located": run}, InputError, run),  # which holds no model
    ]
    changes = [
        (of_network, InputError),
        (of_another_case, InputError),
        (lambda folder: (folder / MOTION).unlink(), InputError),
        (lambda folder: (folder / MOTION).write_bytes(b"\x80" * 64), ArtifactError),
        (damaged("places", np.zeros((1, 3))), InputError),
        (damaged("places", np.zeros((0, 93))), InputError),
        (damaged("places", np.zeros((1, 93))), InputError),
        (damaged("scales", [np.nan, 1.0]), ArtifactError),
        (damaged("covariance", np.zeros(())), InputError),
    ]
    for n, (change, kind) in enumerate(changes):
        folder = resealed(run, tmp_path / f"run_{n}", change)
        cases.append((ready_case, {"located": folder}, kind, folder))
    for given, options, kind, named in cases:
        with refused(kind, *([named] if kind is ArtifactError else [])):
            Export(case=given, out=out, format="usd", **options).run()
        assert not out.exists()
