"""Tables say what made them, pages show them and nothing else changes; rows are measured once; and
every script of the laboratory can be asked what it does."""

from __future__ import annotations

import runpy
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import population
import pytest

from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.core.errors import InputError
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import (
    MeasuredTable,
    ReportWriter,
    rendered,
    share_words,
    spread_mm,
    spread_words,
    table_of,
    write_table,
)

ROOT = Path(__file__).parents[2]
NAMES = (
    *("accuracy", "bounds", "demo", "evidence", "figures", "following", "noise", "population"),
    *("pull", "rehearsal", "soak", "stress", "ultrasound"),
)


def test_rows_are_measured_once_for_all_that_decides_them(tmp_path):
    path, made = tmp_path / "new" / "rows.json", []

    def rows(about):
        found = scripting.kept(path, about, lambda: made.append(about) or [{"off": len(made)}])
        return found[0]["off"]

    assert [rows({"seed": 1}), rows({"seed": 1}), rows({"seed": 2})] == [1, 1, 2]
    path.write_text(path.read_text().replace(fingerprint(), "another"))
    assert rows({"seed": 2}) == 3
    measured = {"off": np.float64("nan"), "good": np.bool_(True), "count": np.int64(3)}
    (row,) = scripting.kept(tmp_path / "more.json", {}, lambda: [measured])
    assert row == {"off": None, "good": True, "count": 3}


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


def test_a_table_says_what_is_not_known():
    rows = pd.DataFrame({"who": ["a", "b"], "off": [1.5, np.nan]})
    assert table_of(rows).splitlines()[1:] == ["| --- | ---: |", "| a | 1.5 |", "| b | nan |"]


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


def test_a_population_has_a_line_for_each_load(tmp_path):
    people = {"patient": ["a"], "state": ["done"], "slice_mm": [1.0], "scenes": [1], "lost": [0]}
    pd.DataFrame(people).to_parquet(tmp_path / "patients.parquet")
    (tmp_path / "look.csv").write_text("patient,reason\n")
    row = {"patient": "a", "tumor": "tumor_1", "scene": "1-pull-0", "family": "pull"}
    row |= {"hidden_share": 0.0, "kind": "exophytic", "position": "lower", "ml": 5.0}
    row |= {"depth_mm": 8.0, "outer_share": 0.3, "verdict": "good", "radius_mm": 2.0}
    row |= {"over_3_mm": False, "over_5_mm": False}
    row |= dict.fromkeys(population.ERRORS.values(), 1.5) | {"rigid_fit_middle_mm": 2.5}
    pd.DataFrame([row]).to_parquet(tmp_path / "scenes.parquet")
    page = tmp_path / "page.md"
    page.write_text("<!-- results:population -->\n<!-- /results:population -->\n")
    population.fill(tmp_path, ReportWriter(page, "make population"))
    ours, fit = "1.5 / 1.5 / 1.5", "2.5 / 2.5 / 2.5"
    assert f"| pull | 1 | 100 | {ours} | {ours} | {fit} | 0 | 100 |" in page.read_text()


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


@pytest.mark.parametrize("name", NAMES)
def test_scripts_are_imported_and_say_what_they_do(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "benchmarks" / "scripts" / f"{name}.py"), run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out
