"""No command replaces what it did not write, and no message advises what a command lacks."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from refused import refused
from stories import refusal, tumortrack
from tumortrack.cli.main import run
from tumortrack.core import store
from tumortrack.core.errors import InputError

ROOT = Path(__file__).parents[2]
PACKAGES = (
    "src/tumortrack",
    "devices/src/tumortrack_devices",
    "occupancy/src/tumortrack_occupancy",
    "resection/src/tumortrack_resection",
    "benchmarks/src/tumortrack_benchmarks",
    "experiment/src/tumortrack_experiment",
)
OPTION = re.compile(r"--[a-z][a-z-]+")
# Options of other programs that messages name.
OTHERS = {"--device-cgroup-rule", "--user", "--upgrade"}
OF_SCRIPTS = {"scripting.py"}  # of benchmarks/scripts
MINE = "of the user's own"
# Every command that writes, with what it needs before it looks at where it is to write.
COMMANDS = {
    "prepare": "CASE --out OUT",
    "export": "CASE OUT",
    "train": "CASE OUT",
    "locate": "NONE NONE --out OUT",
    "plan": "NONE OUT",
    "onnx": "NONE OUT.onnx",
    "demo": "--out OUT",
    "twin": "CASE OUT",
    "bench": "--out OUT.json",
    "fleet": "LIST OUT --serial",
    "phantom-kit": "CASE OUT",
    "calibrate board": "OUT.pdf",
    "calibrate camera": "NONE OUT",
    "calibrate hand-eye": "NONE OUT --lens NONE",
    "record": "virtual:CASE OUT --states rest --yes",
}


def options_of(command: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    with pytest.raises(SystemExit):
        run([*command.split(), "--help"])
    return set(OPTION.findall(capsys.readouterr().out))


@pytest.mark.parametrize("command", COMMANDS)
def test_what_a_user_has_there_stays_and_the_advice_can_be_followed(
    command, phantom_case, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "200")
    patients = tmp_path / "patients.csv"
    patients.write_text(f"name,input\nanna,{phantom_case}\n")
    place = tmp_path / "there"
    words = COMMANDS[command].replace("OUT", str(place)).replace("CASE", str(phantom_case))
    words = words.replace("NONE", str(tmp_path / "none")).replace("LIST", str(patients))
    out = next(Path(word) for word in words.split() if word.startswith(str(place)))
    file = out if out.suffix else out / "weights.safetensors"
    file.parent.mkdir(exist_ok=True)
    file.write_text(f'{{"mine": "{MINE}"}}')
    assert run([*command.split(), *words.split()]) == 2
    said = capsys.readouterr().err
    assert str(out) in said
    assert file.read_text() == f'{{"mine": "{MINE}"}}'
    assert [p.name for p in out.parent.iterdir() if p.name.startswith("there")] == [out.name]
    assert set(OPTION.findall(said)) <= options_of(command, capsys)
    assert ("--overwrite" in said) == ("--overwrite" in options_of(command, capsys))


def test_options_that_messages_name_are_options_of_some_command(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    known = set(OTHERS)
    for command in (*COMMANDS, "simulate", "evaluate", "margins", "compile", "inspect", "doctor",
                    "frames", "track", "resect", "reference", "calibrate register"):  # fmt: skip
        known |= options_of(command, capsys)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if OF_SCRIPTS.intersection(path.parts):
                continue
            tree = ast.parse(path.read_text())
            raised = [node for node in ast.walk(tree) if isinstance(node, ast.Raise)]
            for text in (n for one in raised for n in ast.walk(one) if isinstance(n, ast.Constant)):
                named = set(OPTION.findall(text.value)) if isinstance(text.value, str) else set()
                assert named <= known, f"{path}: {named - known}"


@pytest.mark.slow
def test_a_start_of_track_that_failed_leaves_nothing(elastic_model, tmp_path):
    """Its names are free for the corrected command."""
    empty = tmp_path / "empty"
    empty.mkdir()
    report, seen = tmp_path / "track.json", tmp_path / "seen"
    command = [
        "track",
        elastic_model,
        f"recording:{empty}",
        f"recording:{seen}",
        "--report",
        report,
    ]
    assert str(empty) in refusal(tumortrack(*command, "--device", "cpu"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty"]
    report.write_text(MINE)
    assert str(report) in refusal(tumortrack(*command))
    assert report.read_text() == MINE


def test_a_place_without_the_option_does_not_advise_it(tmp_path):
    with refused(InputError, tmp_path) as error:
        store.check_place(tmp_path, "case", None)
    assert not OPTION.search(str(error.value))
