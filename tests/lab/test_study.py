"""The study: what is measured once, known numbers in tables, blocks replaced and nothing else."""

from __future__ import annotations

import os
import runpy
import signal
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
import trimesh

from stories import write_phantom_case
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError, NoEstimate
from tumortrack.core.estimate import OneWay
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.simulate.deform import RestConfig
from tumortrack.simulate.deform.drag import CONFIGURATIONS
from tumortrack.simulate.elastic.body import BodyConfig, build_body
from tumortrack.simulate.occupancy import OccupancyConfig
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator
from tumortrack.simulate.scene_folder import Scene
from tumortrack.training.presets import clinic, quick
from tumortrack_lab.peers.base import Fit, estimate_of, rigid_carry
from tumortrack_lab.peers.kinds import peer_kinds
from tumortrack_lab.study import tables, tumor_sites
from tumortrack_lab.study.bound import BOUNDS, Bound, BoundConfig, BoundMotion, laid_on
from tumortrack_lab.study.document import ReportWriter, closing, fill, opening, table
from tumortrack_lab.study.goals import goal_table
from tumortrack_lab.study.measure import (
    Job,
    MeasurementStore,
    StudyStatus,
    displacements,
    measure,
    point_errors,
)
from tumortrack_lab.study.methods import (
    ABLATED,
    Answer,
    Method,
    Presets,
    StudyCase,
    Trainer,
    peer_method,
    study_case,
    train_config,
)
from tumortrack_lab.study.plan import FULL, QUICK, SECTIONS, Methods, StudyPlan, jobs_of
from tumortrack_lab.study.report import gallery_block, section_blocks
from tumortrack_lab.study.tables import NOT_FOUND, by_seed, text, tidy

ROOT = Path(__file__).parents[2]
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
CAMERA_FROM_CT = rigid(TURN, np.array([3.0, -2, 130]))


def ball(radius_mm, center_mm=(0.0, 0.0, 0.0)):
    solid = trimesh.creation.icosphere(3, radius_mm)
    return Mesh(solid.vertices + np.array(center_mm), solid.faces)


def anatomy():
    """A deep tumor in the middle; one whose cap is the organ's own surface is not in this one."""
    return Anatomy((ball(30), ball(8), ball(6, (15, 0, 0))))


def moved(parts, camera_from_ct, shifts=()):
    carry = rigid_carry(camera_from_ct)
    out = [part.moved(carry(part.vertices_mm)) for part in parts.parts]
    for number, shift in shifts:
        out[number] = out[number].moved(out[number].vertices_mm + np.array(shift))
    return Anatomy(tuple(out))


@pytest.fixture
def case(tmp_path):
    """Two scenes of a rigidly moved anatomy, as a study's case."""
    folder = tmp_path / "case"
    folder.mkdir()
    store.write_json(folder / store.MANIFEST, {"kind": "case"})
    for variant in ("D1", "D2"):
        truth = moved(anatomy(), CAMERA_FROM_CT)
        points = truth.organ.vertices_mm
        cloud = SensorCloud(points[points[:, 2] < 120])
        Scene(cloud, truth).write(tmp_path / "scenes" / f"{variant}-clean")
    return StudyCase("balls", folder, tmp_path / "scenes", anatomy(), (0.0, -1.0, 0.0), True)


@dataclass
class Shifted(Method):
    """Answers the truth, shifted along x; leaves out parts; dies or says nothing when told."""

    shift_mm: float = 2.0
    seed: int = 0
    without: tuple[str, ...] = ()
    nothing: bool = False
    dies_at: int | None = None
    calls: list[str] = field(default_factory=list)
    name: str = "M_lim"
    device: str = "cpu"
    prepare_s: float | None = 60.0

    @property
    def identity(self):
        return {"kind": "stub", "name": self.name, "seed": self.seed, "shift_mm": self.shift_mm}

    @property
    def about(self):
        return {"prepare_s": self.prepare_s}

    def locate(self, scene, grid):
        self.calls.append(scene.meta.get("variant", "scene"))
        if self.dies_at == len(self.calls):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.nothing:
            raise NoEstimate("no organ was found")
        shifted = CAMERA_FROM_CT.copy()
        shifted[0, 3] += self.shift_mm
        fit = Fit(rigid_carry(shifted), 0.25)
        estimate = estimate_of(fit, anatomy(), grid=grid)
        for part in self.without:
            del estimate.meshes[part]
        return Answer(replace(estimate, motion=OneWay(fit.carry)), fit.seconds)


def jobs(case, method, grid=24):
    return [Job(case, method, variant, "clean", grid) for variant in ("D1", "D2")]


def test_a_killed_study_goes_on_and_measures_nothing_twice(case, tmp_path):
    kept = MeasurementStore(tmp_path / "cells")
    child = os.fork()
    if child == 0:  # dies in the middle of the second measurement
        measure(jobs(case, Shifted(dies_at=2)), kept)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert len(list(kept.folder.rglob("*.json"))) == 1
    first = next(kept.folder.rglob("*.json")).read_bytes()

    method, told = Shifted(), list[StudyStatus]()
    resumed = measure(jobs(case, method), kept, told.append)
    assert len(method.calls) == 1
    assert [(s.done, s.total, s.measured) for s in told] == [(2, 2, 1)]
    assert told[0].seconds_left == 0
    assert first in [path.read_bytes() for path in kept.folder.rglob("*.json")]

    again = measure(jobs(case, method), kept)
    assert again == resumed
    assert len(method.calls) == 1
    whole = measure(jobs(case, Shifted()), MeasurementStore(tmp_path / "others"))
    sites = tumor_sites.tumor_sites_of(anatomy())
    assert tables.accuracy(tidy(whole), sites) == tables.accuracy(tidy(resumed), sites)


def test_what_decides_a_measurement_makes_it_another_one(case, tmp_path):
    kept, method = MeasurementStore(tmp_path / "cells"), Shifted()
    measure(jobs(case, method), kept)
    measure(jobs(case, method, grid=32), kept)
    assert len(method.calls) == 4
    scene = case.scene("D1", "clean")
    store.write_json(scene / "meta.json", {"note": "another", "organ_includes_tumors": True})
    measure(jobs(case, method), kept)
    assert len(method.calls) == 5  # the other scene is as it was
    store.write_json(case.folder / store.MANIFEST, {"kind": "case", "other": True})
    measure(jobs(case, method), kept)
    assert len(method.calls) == 7
    with pytest.raises(InputError, match="tumortrack twin"):
        measure([Job(case, method, "D3", "clean", 24)], kept)
    for path in kept.folder.rglob("*.json"):
        path.write_text("{")
    with pytest.raises(ArtifactError, match="cannot be read"):
        measure(jobs(case, method), kept)


def test_known_errors_reach_the_table(case, tmp_path):
    kept = MeasurementStore(tmp_path / "cells")
    seeds = [Shifted(shift_mm=shift, seed=n) for n, shift in enumerate((1.0, 2.0, 3.0))]
    found = [one for method in seeds for one in measure(jobs(case, method), kept)]
    turned = [
        {**one, "spec": {**one["spec"], "variant": "Rot90"}}
        for one in measure(jobs(case, Shifted(shift_mm=9.0)), kept)
    ]
    written = tables.accuracy(tidy([*found, *turned]), tumor_sites.tumor_sites_of(anatomy()))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in written.splitlines()]
    deep = "tumor 1, endophytic: centre"
    assert rows[0] == ["state", "figure", "slim network, limited turns"]
    assert rows[2] == ["deformed", "scenes x seeds", "2 x 3"]
    assert [row[2] for row in rows if row[1] == deep] == [
        "2.0 / 3.0 / 3.0 / 3.0",  # neither seeds nor scenes are averaged
        "9.0 / 9.0 / 9.0 / 9.0",
    ]
    assert [row[2] for row in rows if row[1] == "target error"] == ["–", "–"]  # no targets.csv


def test_shares_are_by_nearest_rank_and_never_in_our_favour():
    values = pd.Series([*range(1, 11), np.inf], dtype=float)
    assert tables.spread(values) == "6.0 / 10.0 / not found / not found"
    assert tables.spread(values[:4] / 10, 2, high=True) == "0.25 / 0.10 / 0.10 / 0.10"


@pytest.mark.parametrize(("load", "shown"), [(1.2, "0.25"), (3.0, "0.25 (busy)")])
def test_seconds_say_whether_the_machine_was_busy(case, tmp_path, load, shown):
    found = measure(jobs(case, Shifted()), MeasurementStore(tmp_path / "cells"))
    found = [{**one, "provenance": {**one["provenance"], "load": load}} for one in found]
    written = tables.accuracy(tidy(found), tumor_sites.tumor_sites_of(anatomy()))
    assert f"|  | s a frame | {shown} |" in written


def test_targets_are_measured_where_a_scene_has_them(case, tmp_path):
    ct = np.random.default_rng(0).normal(size=(20, 3))
    camera = rigid_carry(CAMERA_FROM_CT)(ct)
    lines = [",".join(map(str, ["1", *a, *b])) for a, b in zip(ct, camera, strict=True)]
    head = "label,ct_x,ct_y,ct_z,camera_x,camera_y,camera_z"
    path = case.scene("D1", "clean") / "targets.csv"
    path.write_text("\n".join([head, *lines]) + "\n")
    kept = MeasurementStore(tmp_path / "cells")
    (one,) = measure(jobs(case, Shifted(shift_mm=3.5))[:1], kept)
    assert one["targets_mm"]["mean"] == pytest.approx(3.5)
    assert one["targets_mm"]["count"] == 20


def test_parts_that_were_not_found_follow_the_rule(case, tmp_path):
    kept = MeasurementStore(tmp_path / "cells")
    methods = [
        Shifted(seed=0),
        Shifted(seed=1, without=("tumor_2",)),
        Shifted(seed=2, nothing=True),
    ]
    frame = tidy([one for method in methods for one in measure(jobs(case, method), kept)])
    first, second = (frame[frame.part == f"tumor_{n}"] for n in (1, 2))
    assert text(by_seed(first, "center_mm")) == "2.0 (2 of 3)"
    assert text(by_seed(second, "center_mm")) == NOT_FOUND
    assert by_seed(second, "iou")[2] == 0.0
    written = tables.accuracy(frame, tumor_sites.tumor_sites_of(anatomy()))
    assert "| scenes with a part not found | 4 |" in written
    assert "| tumor 2, endophytic: HD | not found / not found / not found / not found |" in written
    seeds = pd.DataFrame({"seed": [0, 0, 0, 1, 1], "mm": [1.0, np.inf, 3.0, 1.0, np.inf]})
    assert list(by_seed(seeds, "mm")) == [3.0, np.inf]
    assert text(pd.Series([1.0, 2.0, 4.5])) == "2.5 ± 1.8"
    assert text(pd.Series([1.0]), 2) == "1.00"
    assert text(pd.Series([], dtype=float)) == "–"


def test_conditions_say_the_change_against_their_base(case, tmp_path):
    kept, found = MeasurementStore(tmp_path / "cells"), []
    for fault, shift in (("clean", 1.0), ("offset", 2.5)):
        measured = measure(jobs(case, Shifted(shift_mm=shift)), kept)
        found += [{**one, "spec": {**one["spec"], "fault": fault}} for one in measured]
    conditions = tables.conditions(tidy(found), "fault", "clean")
    assert "| slim network, limited turns | none (clean depth) | 1.0 | 1.0 |" in conditions
    assert "| systematic 2 mm offset | 2.5 (+1.5) | 2.5 (+1.5) |" in conditions


def test_point_errors_know_depth_displacement_and_distance():
    rest = anatomy()
    truth = moved(rest, CAMERA_FROM_CT, shifts=[(2, (0, 0, 4.0))])
    moves = displacements(truth, rest)
    assert np.abs(moves["tumor_1"]).max() < 1e-9
    np.testing.assert_allclose(moves["tumor_2"], 4.0)
    estimate = moved(rest, CAMERA_FROM_CT)
    meshes = {"tumor_1": estimate.parts[1]}
    seen = np.array([[3.0, -2.0, 100.0]])  # straight above the middle, on the organ's surface
    points = point_errors(truth, rest, seen, meshes)
    assert set(points) == {"tumor_1"}
    assert max(points["tumor_1"]["error_mm"]) == 0
    depth = points["tumor_1"]["depth_mm"]
    assert 22 <= min(depth) < 26
    assert 34 < max(depth) <= 38
    other = Anatomy((ball(30), ball(8)))
    assert displacements(moved(other, CAMERA_FROM_CT), rest) == {}


def test_how_a_tumor_lies():
    deep = tumor_sites.tumor_sites_of(anatomy())
    assert {site.kind for site in deep.values()} == {"endophytic"}
    assert deep["tumor_2"].cover_mm == pytest.approx(9, abs=0.2)
    # Half of this organ's surface is the tumor's: two caps of one ball.
    outer = tumor_sites.tumor_sites_of(Anatomy((ball(30), ball(30))))["tumor_1"]
    assert (outer.kind, outer.exposed_share) == ("exophytic", pytest.approx(1.0))


def test_blocks_are_replaced_and_the_rest_stays():
    written = (
        f"# Mine\n{opening('a')}\nold\n{closing('a')}\ntext \\1\n{opening('b')}\n{closing('b')}\n"
    )
    second = f"{opening('b')}\n{closing('b')}\n"
    once = fill(written, {"a": table(["x", "y"], [["1", r"\g<0> | 2"]])})
    assert once.startswith("# Mine\n")
    assert once.endswith(second)
    assert "old" not in once
    assert "text \\1" in once
    assert r"\g<0> \| 2" in once
    assert fill(once, {"a": table(["x", "y"], [["1", r"\g<0> | 2"]])}) == once
    with pytest.raises(InputError, match="exactly once"):
        fill(written, {"c": "new"})
    with pytest.raises(InputError, match="put it after"):
        fill(f"{closing('a')}\n{opening('a')}\n", {"a": "new"})
    with pytest.raises(ValueError, match="a row of 1"):
        table(["x", "y"], [["1"]])


def test_the_document_has_a_place_for_every_section():
    document = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    names = [*SECTIONS, "gallery"]
    assert fill(document, {name: "x" for name in names}).count("\nx\n<!-- /results:") == len(names)


@pytest.mark.parametrize("name", ["results", "soak", "foreign", "real", "world", "trust"])
def test_scripts_are_imported_and_say_what_they_do(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "lab" / "scripts" / f"{name}.py"), run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_plans_name_what_there_is():
    for plan in (FULL, QUICK):
        assert set(plan.peers) | set(plan.fault_peers) <= {*peer_kinds(), *BOUNDS}
        assert set(plan.configurations) <= set(CONFIGURATIONS)
    assert FULL.seeds == (0, 1, 2)  # and of every case
    assert FULL.case_seeds is None


def tiny(anatomy_ct, rotations):
    """The quick preset, with hardly any validation and few labelled points."""
    config = quick(anatomy_ct, rotations)
    occupancy = OccupancyConfig(per_side=16, pool=2000)
    return msgspec.structs.replace(
        config,
        scene=msgspec.structs.replace(config.scene, occupancy=occupancy),
        validation_pairs=2,
        validation_points=64,
        validate_every=100,
        batch_size=4,
    )


PRESETS = Presets(tiny, clinic)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """The phantom with two simulated scenes under the twin's names."""
    root = tmp_path_factory.mktemp("study")
    case = write_phantom_case(root / "case")
    simulator = Simulator(case.anatomy, case.up_lps, SceneConfig(deform=(RestConfig(),)))
    for number, variant in enumerate(("D0", "D1")):
        stage = simulator.render(SceneRecipe(3, "test", number))
        scene = Scene(stage.cloud, simulator.reference(stage), stage.frame)
        scene.write(root / "scenes" / f"{variant}-clean")
    return study_case("phantom", root / "case", root / "scenes", is_paper=True)


def test_configurations_change_the_drags_alone(phantom):
    plain, fourth = (
        train_config("M_lim", phantom, PRESETS),
        train_config("configuration_4", phantom, PRESETS),
    )
    assert [drag.steps for drag in fourth.scene.deform] == [CONFIGURATIONS[4]]
    back = msgspec.structs.replace(
        fourth, scene=msgspec.structs.replace(fourth.scene, deform=plain.scene.deform)
    )
    assert back == plain
    assert train_config("M_full", phantom, PRESETS).scene.pose.rotations == "full"


def test_each_model_of_the_ablation_lacks_its_piece_alone(phantom):
    own, slim = (train_config(name, phantom, PRESETS) for name in ("clinic", "M_lim"))
    assert own == clinic(phantom.anatomy_ct, "limited")
    configs = {name: train_config(name, phantom, PRESETS) for name in ABLATED}
    changed = {
        "clinic_drags": ("deform",),
        "clinic_clean": ("occlusion", "clutter", "calibration"),
    }
    for name, fields in changed.items():
        theirs = {field: getattr(own.scene, field) for field in fields}
        assert configs[name] != own
        back = msgspec.structs.replace(configs[name].scene, **theirs)
        assert msgspec.structs.replace(configs[name], scene=back) == own
    drags = [model for model in configs["clinic_drags"].scene.deform if hasattr(model, "steps")]
    assert len(drags) == 10
    assert len(configs["clinic_drags"].scene.deform) == 11
    assert configs["clinic_pointnet"].network.encoder == slim.network.encoder
    assert configs["clinic_pointnet"].scene == own.scene
    assert configs["quick_elastic"].network == slim.network
    assert configs["quick_elastic"].scene.deform == own.scene.deform
    trainer = Trainer(Path("nowhere"), PRESETS)
    for name in ("clinic", "clinic_unrefined", "clinic_clean"):
        assert trainer.steps_for(phantom, name, 3200) * own.batch_size == 3200
    assert trainer.steps_for(phantom, "M_lim", 3200) * slim.batch_size == 3200
    with pytest.raises(InputError, match="quick_elastic"):
        train_config("clinical", phantom, PRESETS)


@pytest.mark.slow
def test_end_to_end_twice_gives_the_same_document(phantom, tmp_path):
    plan = StudyPlan(
        name="tiny",
        models=("M_lim", "M_full"),
        steps=2,
        seeds=(0,),
        variants=("D0", "D1"),
        view="clean",
        grid=24,
        configurations=(3,),
        configuration_variants=("D1",),
        peers=("rigid_bound",),
    )
    document = tmp_path / "results.md"
    names = ["deformation", "accuracy"]
    blocks = "".join(f"{opening(n)}\n{closing(n)}\n" for n in [*names, "gallery"])
    document.write_text(f"mine\n{blocks}yours\n")
    writer = ReportWriter(document, "make results")

    def run():
        told, trained = list[StudyStatus](), []
        trainer = Trainer(
            tmp_path / "models", PRESETS, "cpu", 0, lambda name, _: trained.append(name)
        )

        def model(case, name, seed):  # one training serves under every name
            return replace(trainer.model(case, "configuration_3", seed, plan.steps), name=name)

        for section in names:
            todo = jobs_of(plan, section, (phantom,), Methods(model, peer_method, model))
            found = measure(todo, MeasurementStore(tmp_path / "cells"), told.append)
            writer.write(section_blocks(section, found, (phantom,), writer))
        bound = [Job(phantom, peer_method("rigid_bound", phantom), "D1", "clean", 24)]
        writer.write(gallery_block(bound, 0, writer, tmp_path / "gallery.json"))
        return told, trained

    told, trained = run()
    assert len(told) == 1 + 4 + 2  # networks and the peer
    assert len(set(trained)) == 1  # it is told of every few seconds
    first = document.read_text()
    assert first.startswith("mine\n")
    assert first.endswith("yours\n")
    for words in ("Models: 1 of 2 steps", "(oracle)", "\n| 3 | "):
        assert words in first
    for name in ("depth_phantom", "gallery"):
        assert f"](images/results_{name}.png)" in first
        assert (tmp_path / "images" / f"results_{name}.png").stat().st_size > 5000
    assert run() == ([], [])
    assert document.read_text() == first


SMALL = BodyConfig(cells=120, modes=8, responses=40, patches=60, states=20)


def test_the_bound_finds_a_state_that_its_body_can_take():
    body = build_body(anatomy(), (0.0, -1.0, 0.0), SMALL, 0)
    truth = BoundMotion(body, TURN, np.array([3.0, -2, 130]), body.states[3].astype(float))
    vertices = anatomy().organ.vertices_mm
    moved_mm = np.linalg.norm(body.carry(truth.coefficients, vertices) - vertices, axis=1)
    assert moved_mm.max() > 1
    found = laid_on(body, vertices, truth.carry(vertices), BoundConfig(sigma_mm=0.01))
    inner = anatomy().parts[2].vertices_mm  # was not shown
    np.testing.assert_allclose(found.carry(inner), truth.carry(inner), atol=0.05)


def test_bounds_of_a_rigid_organ_are_near_zero(case, tmp_path):
    kept = MeasurementStore(tmp_path / "cells")
    for name in BOUNDS:
        for one in measure(jobs(case, Bound(name, case, BoundConfig(body=SMALL))), kept):
            assert one["parts"]["tumor_2"]["hausdorff_mm"] < 0.4
            assert one["failed"] is None
    other = replace(case, anatomy_ct=Anatomy((ball(30), ball(8))))
    with pytest.raises(InputError, match="other parts"):
        Bound("basis_bound", other, BoundConfig(body=SMALL)).locate(
            Scene(SensorCloud(ball(30).vertices_mm), anatomy()), 24
        )


def goal_measurement(method, variant, hd, **spec):
    """A measurement of a case with one tumor, with what the goals read."""
    found = {"found": True, "iou": 0.9}
    shares = {"hausdorff_mm": 1.0, "hausdorff_one_sided_mm": 0.5, "center_mm": 0.25}
    near = {key: share * hd for key, share in shares.items()} if hd else {}
    name = {"kind": "network", "name": method, "seed": spec.pop("seed", 0)}
    whole = {"case": "one", "variant": variant, "fault": "none", "fault_seed": 0, **spec}
    return {
        "spec": {"scene": f"{variant}-noise", "view": "noise", **whole, "method": name},
        "parts": {"kidney": found, "tumor_1": {**found, **near} if hd else {"found": False}},
        "targets_mm": {"mean": hd},
        "miou": 0.89999 if hd else 0.0,
        "failed": None if hd else "not found: tumor_1",
        "method": {"device": "cpu"},
        "prepare_s": 899.0,
        "frame_s": 0.1,
    }


def test_goals_are_judged_by_the_worst_seed_and_never_rounded_in_our_favour():
    sites = {
        "one": {"tumor_1": tumor_sites.TumorSite(0.0, 5.0)},
        "two": {"tumor_1": tumor_sites.TumorSite(0.5, 0.0)},
    }
    found = [goal_measurement("clinic", "D1", hd, seed=n) for n, hd in enumerate((1.0, 2.0001))]
    found += [goal_measurement("clinic", "D2", 2.9999), goal_measurement("clinic", "Rot90", 0.1)]
    found += [goal_measurement("rigid_bound", "D1", 1.994)]
    found += [goal_measurement("clinic", "D1", 1.5, case="two")]
    found += [goal_measurement("clinic", "D2", 2.0, fault="clean")]
    hidden = {"fault": "visible=60"}
    found += [goal_measurement("clinic", "D2", 2.7, **hidden, fault_seed=n) for n in (0, 1)]
    lines = goal_table(tidy(found), sites).splitlines()
    assert lines[0] == "| figure | goal | one: clinic / rigid | two: clinic / rigid |"
    rows = {line.split("|")[1].strip(): line for line in lines}
    assert "| ≤ 2 | 2.01 (no) / 2.00 | – / – |" in rows["tumor HD, D1, endophytic"]
    assert "| ≤ 1.5 | – / – | 1.50 (yes) / – |" in rows["tumor HD, D1, exophytic"]
    assert "| ≤ 3 | 3.00 (yes) / – |" in rows["tumor HD, D2, endophytic"]
    assert "| ≥ 0.9 | 0.89 (no) / 0.89 |" in rows["mIoU, deformed variants"]
    assert "| ≤ 2 | 2.50 (no) / 2.00 |" in rows["target error, deformed variants"]
    assert "| ≤ 2 | 2.01 (no) |" in rows["target error, all variants"].replace(" / 2.00", "")
    assert "| ≤ 1.3 | 1.35 (no) / – |" in rows["hidden surface: tumor HD, times"]

    lost = [*found, goal_measurement("clinic", "D3", None)]
    worst = next(line for line in goal_table(tidy(lost), sites).splitlines() if "worst" in line)
    assert "| ≤ 2.5 | not found (no) / " in worst


def test_the_ablation_says_the_change_against_clinic():
    found = [goal_measurement("clinic", "D2", 2.0), goal_measurement("clinic", "G1", 3.0)]
    found += [
        goal_measurement("clinic_unrefined", "D2", 4.0),
        goal_measurement("clinic_unrefined", "G1", 4.4),
    ]
    ablation = tables.ablation(tidy(found))
    assert "| clinic | 899 | 0.100 | 2.5 | 0.6 | 2.5 | 0.90 | 0 of 2 |" in ablation
    assert "| 4.2 (+1.7) | 1.1 (+0.4) | 4.2 (+1.7) | 0.90 | 0 of 2 |" in ablation


def test_captions_name_command_device_and_models(case, tmp_path):
    found = measure(jobs(case, Shifted()), MeasurementStore(tmp_path / "cells"))
    caption = tables.caption(found, "make results")
    assert caption.startswith("`make results`: 2 measurements, 2 scenes (views: clean)")
    assert "24³" in caption
    assert "cores" in caption
