"""The study: what is measured once, known numbers in tables, blocks replaced and nothing else."""

from __future__ import annotations

import os
import runpy
import signal
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from stories import write_phantom_case
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.model_files import load_model
from tumortrack_lab.peers.base import Fit, OneWay, estimate_of, rigid_carry
from tumortrack_lab.study import tables, tumor_sites
from tumortrack_lab.study.document import (
    MeasuredTable,
    ReportWriter,
    rendered,
    share_words,
    spread_mm,
    spread_words,
    write_table,
)
from tumortrack_lab.study.measure import measured
from tumortrack_lab.study.methods import Method, StudyCase, peer, study_case
from tumortrack_lab.study.tables import tidy

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "lab" / "scripts" / "results.py"
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SPREAD = ["median", "90 %", "95 %", "worst"]
CAMERA_FROM_CT = rigid(TURN, np.array([3.0, -2, 130]))


def ball(radius_mm, center_mm=(0.0, 0.0, 0.0)):
    solid = trimesh.creation.icosphere(3, radius_mm)
    return Mesh(solid.vertices + np.array(center_mm), solid.faces)


def anatomy():
    """A deep tumor in the middle; one whose cap is the organ's own surface is not in this one."""
    return Anatomy((ball(30), ball(8), ball(6, (15, 0, 0))))


def moved(parts, camera_from_ct):
    carry = rigid_carry(camera_from_ct)
    return Anatomy(tuple(part.moved(carry(part.vertices_mm)) for part in parts.parts))


def sites():
    return {"balls": tumor_sites.tumor_sites_of(anatomy())}


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
    return StudyCase("balls", folder, tmp_path / "scenes", anatomy(), (0.0, -1.0, 0.0))


@dataclass
class Shifted:
    """Answers the truth, shifted along x; leaves out parts; dies or says nothing when told."""

    shift_mm: float = 2.0
    seed: int = 0
    without: tuple[str, ...] = ()
    nothing: bool = False
    dies_at: int | None = None
    calls: int = field(default=0)

    @property
    def method(self):
        return Method("rigid", {"shift_mm": self.shift_mm}, self._locate, self.seed)

    def _locate(self, scene, grid):
        self.calls += 1
        if self.dies_at == self.calls:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.nothing:
            raise NoEstimate("no organ was found")
        shifted = CAMERA_FROM_CT.copy()
        shifted[0, 3] += self.shift_mm
        fit = Fit(rigid_carry(shifted))
        estimate = estimate_of(fit, anatomy(), grid=grid)
        for part in self.without:
            del estimate.meshes[part]
        return replace(estimate, motion=OneWay(fit.carry))


def rows_of(case, shifted, folder, grid=24, **also):
    return measured(case, shifted.method, ("D1", "D2"), "clean", grid, folder, **also)


def test_a_killed_study_goes_on_and_measures_nothing_twice(case, tmp_path):
    kept = tmp_path / "rows"
    rows_of(case, Shifted(), kept)
    child = os.fork()
    if child == 0:  # dies in the middle of the second method
        rows_of(case, Shifted(seed=1, dies_at=2), kept)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    again, second = Shifted(), Shifted(seed=1)
    found = [rows_of(case, one, kept) for one in (again, second)]
    assert (again.calls, second.calls) == (0, 2)
    assert [rows_of(case, one, kept) for one in (again, second)] == found
    assert (again.calls, second.calls) == (0, 2)


def test_what_decides_a_measurement_makes_it_another_one(case, tmp_path):
    def anew(**other):
        one = Shifted()
        rows_of(case, one, tmp_path / "rows", **other)
        return one.calls

    assert [anew(), anew(), anew(grid=32), anew(grid=32, cutting=1)] == [2, 0, 2, 2]
    anew()
    scene = case.scene("D1", "clean")
    store.write_json(scene / "meta.json", {"note": "another", "organ_includes_tumors": True})
    assert [anew(), anew()] == [2, 0]
    store.write_json(case.folder / store.MANIFEST, {"kind": "case", "other": True})
    assert [anew(), anew()] == [2, 0]
    with pytest.raises(InputError, match="tumortrack twin"):
        measured(case, Shifted().method, ("D3",), "clean", 24, tmp_path / "rows")


def test_known_errors_reach_the_table(case, tmp_path):
    seeds = [Shifted(shift_mm=shift, seed=n) for n, shift in enumerate((1.0, 2.0, 3.0))]
    found = [row for one in seeds for row in rows_of(case, one, tmp_path)]
    turned = rows_of(case, Shifted(shift_mm=9.0, seed=9), tmp_path)
    found += [{**row, "variant": "Rot90"} for row in turned]
    rows = tables.accuracy(tidy(found), sites())
    assert set(rows.method) == {"rigid registration, many starts"}
    deep = rows[(rows.part == "tumor_1") & (rows.figure == tables.CENTER)]
    assert deep[["state", "kind", "scenes", "seeds", *SPREAD]].to_numpy().tolist() == [
        *(
            ["D1", "endophytic", 1, 3, "2.0", *["3.0"] * 3],
            ["D2", "endophytic", 1, 3, "2.0", *["3.0"] * 3],
        ),
        ["deformed", "endophytic", 2, 3, "2.0", "3.0", "3.0", "3.0"],  # nothing is averaged
        ["undeformed", "endophytic", 1, 1, "9.0", "9.0", "9.0", "9.0"],
    ]
    targets = rows[rows.figure == "target error, mm"]
    assert set(targets["median"]) == {""}  # no targets.csv
    assert tables.sample(found).startswith("7 measurements (view: clean), volumes of 24³")


def test_rigid_poses_stand_beside_clinic_where_they_were_measured(case, tmp_path):
    methods = {"clinic": 1.0, "rigid_bound": 2.0, "rigid_fit": 4.0}
    found = [
        {**row, "method": method}
        for n, (method, shift) in enumerate(methods.items())
        for row in rows_of(case, Shifted(shift_mm=shift, seed=n), tmp_path)
    ]
    for names in (list(methods), ["clinic", "rigid_bound"]):
        some = [row for row in found if row["method"] in names]
        short = tables.accuracy_summary(tables.accuracy(tidy(some), sites()))
        shown = short.filter(like=tables.CENTER).iloc[0].to_dict()
        fit = "4.0 / 4.0" if "rigid_fit" in names else tables.NOTHING
        assert {name.split(": ")[1]: value for name, value in shown.items()} == {
            "clinic": "1.0 / 1.0", "best rigid pose": "2.0 / 2.0", "rigid fit": fit,
        }  # fmt: skip


def test_shares_are_by_nearest_rank_and_never_in_our_favour():
    values = pd.Series([*range(1, 11), np.inf], dtype=float)
    assert [*tables.spread(values).values()] == ["6.0", "10.0", "not found", "not found"]
    lowest = tables.spread(values[:4] / 10, 2, high=True)
    assert [*lowest.values()] == ["0.25", "0.10", "0.10", "0.10"]


def test_targets_are_measured_where_a_scene_has_them(case, tmp_path):
    ct = np.random.default_rng(0).normal(size=(20, 3))
    camera = rigid_carry(CAMERA_FROM_CT)(ct)
    lines = [",".join(map(str, ["1", *a, *b])) for a, b in zip(ct, camera, strict=True)]
    head = "label,ct_x,ct_y,ct_z,camera_x,camera_y,camera_z"
    path = case.scene("D1", "clean") / "targets.csv"
    path.write_text("\n".join([head, *lines]) + "\n")
    found = rows_of(case, Shifted(shift_mm=3.5), tmp_path)
    assert [row["target_mm"] for row in found] == [pytest.approx(3.5)] * 3 + [None] * 3
    rows = tables.accuracy(tidy(found), sites())
    targets = rows[(rows.figure == "target error, mm") & (rows.state == "deformed")]
    assert targets[SPREAD].to_numpy().tolist() == [["3.5"] * 4]


def test_parts_that_were_not_found_follow_the_rule(case, tmp_path):
    stubs = [Shifted(), Shifted(seed=1, without=("tumor_2",)), Shifted(seed=2, nothing=True)]
    frame = tidy([row for one in stubs for row in rows_of(case, one, tmp_path)])
    rows = tables.accuracy(frame, sites())
    rows = rows[rows.state == "deformed"]
    assert set(rows["scenes with a part not found"]) == {4}
    figures = rows.set_index(["part", "figure"])[SPREAD].T
    assert set(figures["tumor_2", tables.HD]) == {"not found"}
    assert list(figures["tumor_1", tables.CENTER])[:2] == ["2.0", "not found"]
    assert figures["all", "mIoU"]["worst"] == "0.00"  # of what was not found


def test_how_a_tumor_lies():
    deep = tumor_sites.tumor_sites_of(anatomy())
    assert {site.kind for site in deep.values()} == {"endophytic"}
    assert deep["tumor_2"].cover_mm == pytest.approx(9, abs=0.2)
    # Half of this organ's surface is the tumor's: two caps of one ball.
    outer = tumor_sites.tumor_sites_of(Anatomy((ball(30), ball(30))))["tumor_1"]
    assert (outer.kind, outer.exposed_share) == ("exophytic", pytest.approx(1.0))


ABOUT = {"command": "make it", "fingerprint": "abc", "sample": "2 rows"}


def test_pages_show_tables_and_cells_and_the_rest_stays(tmp_path):
    rows = pd.DataFrame({"who": ["a", "b, c"], "off, mm: 95 %": [1.5, 2.0], "x": ["–", "p|q"]})
    write_table(tmp_path / "errors.csv", rows, ABOUT)
    table = MeasuredTable.read(tmp_path / "errors.csv")
    assert (table.about, table.header) == (ABOUT, list(rows))
    page = (
        "# Mine\n<!-- results:errors -->\nold\n<!-- /results:errors -->\ntext \\1 "
        "<!--=errors:a:off, mm: 95 %-->9<!--/--> and <!--=errors:b, c:x-->9<!--/-->\n"
    )
    once = rendered(page, tmp_path)
    assert once.startswith("# Mine\n<!-- results:errors -->\n")
    assert once.endswith(
        "text \\1 <!--=errors:a:off, mm: 95 %-->1.5<!--/--> and <!--=errors:b, c:x-->p|q<!--/-->\n"
    )
    assert "old" not in once
    assert "| who | off, mm: 95 % | x |\n| --- | ---: | --- |\n| a | 1.5 | – |" in once
    assert "p\\|q" in once
    assert "`make it`; fingerprint abc; sample 2 rows." in once
    assert rendered(once, tmp_path) == once
    for wrong in ("errors:a:y", "errors:c:x", "others:a:x"):
        with pytest.raises(InputError):
            rendered(f"<!--={wrong}-->1<!--/-->", tmp_path)
    write_table(tmp_path / "errors.csv", rows, {})
    with pytest.raises(InputError):  # of what?
        rendered(page, tmp_path)
    write_table(tmp_path / "errors.csv", pd.concat([rows, rows]), ABOUT)
    with pytest.raises(InputError):  # which of two rows?
        rendered(page, tmp_path)


def test_a_share_has_wilsons_interval():
    assert share_words(19, 1482) == "1.3 % (0.8 to 2.0)"  # R's binom::binom.wilson
    assert share_words(0, 10) == "0.0 % (0.0 to 27.8)"


def test_a_table_of_another_method_or_a_page_that_differs_is_found(tmp_path):
    faults = partial(runpy.run_path(str(ROOT / "tools" / "figures.py"))["faults"], tmp_path)
    page, rows = tmp_path / "docs" / "page.md", pd.DataFrame({"who": ["a"], "off": [1.5]})
    data = tmp_path / "docs" / "data" / "errors.csv"
    about = {"command": "make it", "fingerprint": fingerprint()}
    write_table(data, rows, about)
    (tmp_path / "README.md").write_text("nothing measured\n")
    page.write_text("It is <!--=errors:a:off-->1.4<!--/--> mm off.\n")
    assert len(faults(True)) == 1
    assert "1.4" in page.read_text()
    assert faults(False) == []
    assert "-->1.5<" in page.read_text()
    assert faults(True) == []
    write_table(data, rows, {**about, "fingerprint": "of another"})
    assert len(faults(True)) == 1
    write_table(data, rows, {"command": "make it", "weights": "abc"})  # of which version?
    assert len(faults(True)) == 1
    write_table(data, rows, {"command": "make it", "weights": "abc", "version": "0.2"})
    assert faults(True) == []


def test_the_table_of_sensors_is_that_of_the_data_file(tmp_path):
    differs = runpy.run_path(str(ROOT / "tools" / "figures.py"))["differs"]
    table = tmp_path / "sensors.csv"
    assert len(differs(table, True)) == 1
    assert differs(table, False) == []
    rows = MeasuredTable.read(table)
    assert rows.cell("l515,step_mm", "value") == "0.25"
    assert rows.cell("l515,step_mm", "grade") == "second-hand"
    table.write_text(table.read_text().replace("0.25", "0.2"))
    assert len(differs(table, True)) == 1


def test_a_population_shows_rigid_fits_or_says_that_a_run_lacks_them(tmp_path):
    script = runpy.run_path(str(ROOT / "lab" / "scripts" / "population.py"))
    people = {"patient": ["a"], "state": ["done"], "slice_mm": [1.0], "scenes": [1], "lost": [0]}
    pd.DataFrame(people | {"within_largest": [1.0], "holds_for": [0.5]}).to_parquet(
        tmp_path / "patients.parquet"
    )
    (tmp_path / "look.csv").write_text("patient,reason\n")
    row = {"patient": "a", "tumor": "tumor_1", "scene": "1-pull-0", "family": "pull"}
    row |= {"hidden_share": 0.0, "kind": "exophytic", "position": "lower", "ml": 5.0}
    row |= {"depth_mm": 8.0, "outer_share": 0.3, "verdict": "good"}
    row |= {"over_3_mm": False, "over_5_mm": False}
    row |= dict.fromkeys(script["_ERRORS"].values(), 1.5) | {"rigid_fit_middle_mm": 2.5}
    page = tmp_path / "page.md"
    page.write_text("<!-- results:population -->\n<!-- /results:population -->\n")
    writer = ReportWriter(page, "make population")
    for fit_mm, shown in ((2.5, " 2.5 / 2.5 / 2.5 |"), (None, "")):
        kept = {**row, "rigid_fit_middle_mm": fit_mm}
        pd.DataFrame([kept]).to_parquet(tmp_path / "scenes.parquet")
        script["fill"](tmp_path, writer)
        text, ours = page.read_text(), "1.5 / 1.5 / 1.5"
        assert f"| pull | 1 | 100 | {ours} | {ours} |{shown} 0 |" in text
        assert ("without rigid fits" in text) == (fit_mm is None)
    older = {name: value for name, value in row.items() if not name.startswith("rigid_fit")}
    pd.DataFrame([older]).to_parquet(tmp_path / "scenes.parquet")
    script["fill"](tmp_path, writer)
    assert page.read_text() == text


def test_a_table_goes_beside_the_document(tmp_path):
    errors = {"a": pd.Series([1.0, 2, 3, np.nan]), "b": pd.Series([], dtype=float)}
    rows = pd.DataFrame([{"who": k, **spread_mm("off", v)} for k, v in errors.items()])
    (tmp_path / "page.md").write_text("")
    ReportWriter(tmp_path / "page.md", "make it").tables({"errors": rows}, sample="3")
    table = MeasuredTable.read(tmp_path / "data" / "errors.csv")
    assert table.rows == [["a", "2.0", "2.8", "2.9", "3.0"], ["b", "", "", "", ""]]
    assert table.about.keys() == {"command", "fingerprint", "commit", "date", "machine", "sample"}
    assert (table.about["command"], table.about["fingerprint"]) == ("make it", fingerprint())
    assert list(spread_words(rows, "off")) == ["2.0 / 2.9 / 3.0", "–"]


@pytest.mark.parametrize("name", ["results", "soak", "real", "world", "sequences"])
def test_scripts_are_imported_and_say_what_they_do(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "lab" / "scripts" / f"{name}.py"), run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """The phantom with two simulated scenes under the twin's names."""
    root = tmp_path_factory.mktemp("study")
    case = write_phantom_case(root / "case")
    at_rest = SceneConfig(deform=(DragConfig(steps=()),))
    simulator = Simulator(case.anatomy, case.up_lps, at_rest)
    for number, variant in enumerate(("D0", "D1")):
        stage = simulator.render(SceneRecipe(3, "test", number))
        scene = Scene(stage.cloud, simulator.reference(stage), stage.frame)
        scene.write(root / "scenes" / f"{variant}-noise")
    return study_case("phantom", root / "case", root / "scenes")


@pytest.mark.slow
def test_end_to_end_twice_gives_the_same_document(phantom, clinic_model, tmp_path, monkeypatch):
    document = tmp_path / "results.md"
    document.write_text("mine\n<!-- results:accuracy -->\n<!-- /results:accuracy -->\nyours\n")
    script, made = runpy.run_path(str(RESULTS)), []

    def make(case, seed):
        made.append(seed)
        return load_model(clinic_model)

    monkeypatch.setattr("tumortrack_lab.study.methods.make_model", make)
    options = script["Options"](
        peers=("rigid_bound", "rigid_fit"), seeds=(7,), grid=24, variants=("D0", "D1"),
        document=document,
        out=tmp_path,
    )  # fmt: skip
    writer = ReportWriter(document, "make results")

    def run():
        rows = []
        for method in script["methods_of"](phantom, options):
            about = method, options.variants, "noise", options.grid, tmp_path / "rows"
            rows += measured(phantom, *about)
        script["fill"](rows, [phantom], writer)
        return document.read_text()

    first = run()
    assert made == [7]
    assert first.startswith("mine\n")
    assert first.endswith("yours\n")
    for words in (
        "models by seed 0, 7",
        "worst: best rigid pose",
        "worst: rigid fit",
    ):
        assert words in first
    assert run() == first
    assert made == [7]
    with pytest.raises(InputError, match="rigid_bound, rigid_fit, rigid"):
        peer("rigidly", phantom)
