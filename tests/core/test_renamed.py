"""Old names of core/renamed.toml are gone; the error of using one names a new one, which exists."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import types
import typing
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import msgspec
import pytest

import tumortrack
from tumortrack.cli import doctor
from tumortrack.cli.main import run
from tumortrack.core import store
from tumortrack.core.assessment import Assessment
from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Evidence
from tumortrack.core.renamed import NOTHING, attributes_of, hint, in_report, table
from tumortrack.core.report import Check, FitReport
from tumortrack.io.evidence_files import EvidenceFile
from tumortrack.live.spec import SINKS
from tumortrack.tracking.presets import PRESETS
from tumortrack_resection import files
from tumortrack_resection.values import ResectionConfig, ResectionPlan

ROOT = Path(__file__).parents[2]
ENTRIES = [(section, old) for section, entries in table().items() for old in entries]


def of(*sections: str) -> pytest.MarkDecorator:
    some = [entry for entry in ENTRIES if entry[0] in sections]
    return pytest.mark.parametrize(("section", "old"), some)


def code(section: str, old: str) -> list[str]:
    """What is written as code in the replacement; nothing replaces some."""
    new = table()[section][old]
    found = re.findall(r"`([^`]+)`", new)
    assert found or new.startswith(f"{NOTHING}: ")
    return found


def resolved(name: str) -> Any:
    """A module, or what a module has by that name. Raises what says that there is none."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        owner, _, last = name.rpartition(".")
        if not owner:
            raise
        return getattr(resolved(owner), last)


def has(owner: object, name: str) -> bool:
    """Also a field of a class, which has no default."""
    return hasattr(owner, name) or any(
        name in vars(kind).get("__annotations__", {}) for kind in getattr(owner, "__mro__", ())
    )


def empty(kind: type) -> object:
    """A value of a class, without its fields."""
    if not issubclass(kind, msgspec.Struct):
        return object.__new__(kind)
    return kind(**{field.name: None for field in msgspec.structs.fields(kind) if field.required})


@of("modules")
def test_a_module(section, old):
    with pytest.raises(ModuleNotFoundError) as told:
        importlib.import_module(old)
    assert told.value.name == old
    assert table()[section][old] in str(told.value)
    for new in code(section, old):
        assert isinstance(resolved(new), types.ModuleType)


@of("names")
def test_a_name(section, old):
    owner, _, name = old.rpartition(".")
    holder = resolved(owner)
    value = empty(holder) if isinstance(holder, type) else holder
    with pytest.raises(AttributeError) as told:
        getattr(value, name)
    assert (told.value.name, hasattr(value, name)) == (name, False)
    for new in code(section, old):
        assert f"`{new}`" in str(told.value)
        new_owner, _, new_name = new.rpartition(".")
        assert has(resolved(new_owner) if new_owner else holder, new_name)


@pytest.mark.parametrize(
    "use",
    [
        lambda: attributes_of("here")("there"),
        lambda: tumortrack.there,
        lambda: FitReport().there,
        lambda: importlib.import_module("tumortrack.there"),
    ],
)
def test_of_what_never_was_nothing_is_told(use):
    with pytest.raises((AttributeError, ModuleNotFoundError)) as told:
        use()
    assert told.value.name in ("there", "tumortrack.there")
    assert "`" not in str(told.value)


def test_a_property_that_fails_says_itself_why():
    class Failing(FitReport, frozen=True):
        @property
        def answer(self) -> object:
            return (1.0).nothing  # type: ignore[attr-defined]

    with pytest.raises(AttributeError) as told:
        Failing().answer  # noqa: B018
    assert told.value.name == "nothing"


@of("commands", "options", "choices")
def test_a_command_line(section, old, capsys):
    command = ["train", "CASE", "MODEL", *old.split()] if section == "choices" else old.split()
    with pytest.raises(SystemExit) as ended:
        run(command)
    assert ended.value.code == 2
    assert hint(section, old) in capsys.readouterr().err.splitlines()[-1]
    for new in code(section, old):
        if section == "choices":
            assert new.split()[1] in PRESETS
            continue
        with pytest.raises(SystemExit):
            run([command[0], "--help"])
        assert new in capsys.readouterr().out


def test_an_option_with_its_value_in_one_word(capsys):
    with pytest.raises(SystemExit):
        run(["plan", "RUN", "PLAN", "--sigmas=3"])
    assert capsys.readouterr().err.endswith(f"{hint('options', 'plan --sigmas')}.\n")


def test_an_old_preset_in_python(phantom_case, tmp_path, unchecked):
    for old in table()["choices"]:
        with pytest.raises(InputError) as told:
            tumortrack.train(phantom_case, tmp_path / "model", preset=old.split()[1])
        assert hint("choices", old) in str(told.value)


def sink(kind: str) -> Callable[[str], object]:
    return lambda key: SINKS.parse(f"{kind}:0?{key}=1")


CONFIGURED = {
    "ResectionConfig": lambda key: from_builtins({key: 1}, ResectionConfig, "FILE"),
    "RecordingSinkConfig": sink("recording"),
    "ViewerSinkConfig": sink("viewer"),
    "EvidenceFile": lambda kind: from_builtins(
        {"frame": "camera", "unit": "mm", "evidence": [{"kind": kind}]}, EvidenceFile, "FILE"
    ),
}
KNOWN = {
    *ResectionConfig.__struct_fields__,
    *(kind.__struct_config__.tag for kind in typing.get_args(Evidence)),
}


@of("keys")
def test_a_key_of_a_configuration(section, old):
    kind, key = old.split(".")
    with pytest.raises(InputError) as told:
        CONFIGURED[kind](key)
    assert hint(section, old) in str(told.value)
    assert {*code(section, old)} <= KNOWN


def inner(kind: object, keys: list[str]) -> object:
    """The type that a key with dots has in JSON; NAME: any. Raises KeyError: there is none."""
    while typing.get_origin(kind) in (typing.Union, types.UnionType, tuple):
        kind = next(one for one in typing.get_args(kind) if one not in (type(None), ...))
    if not keys:
        return kind
    if keys[0] == "NAME":
        return inner(typing.get_args(kind)[-1], keys[1:])
    return inner(typing.get_type_hints(kind)[keys[0]], keys[1:])


class Report(FitReport, frozen=True):
    assessment: Assessment = Assessment()


@of("report")
def test_a_key_of_a_report(section, old):
    with pytest.raises((KeyError, AttributeError, TypeError)):
        inner(Report, old.split("."))
    for new in code(section, old):
        assert inner(Report, new.split(".")) is not None
    content: object = 1.0
    for name in reversed(old.split(".")):
        content = {name: content if name == "NAME" else [content]}
    assert f"{old}{hint(section, old)}" in in_report(content)


def test_inspect_says_the_new_keys_of_an_old_report(tmp_path, capsys):
    content = {"quality": {"verdict": "good"}, "parts": {}, "fit_cost": {"strays": 0.1}}
    store.write_json(tmp_path / "report.json", content)
    assert run(["inspect", str(tmp_path / "report.json")]) == 0
    assert hint("report", "fit_cost.strays") in capsys.readouterr().out
    assert not in_report(json.loads(msgspec.json.encode(FitReport())))


@of("values")
def test_a_value_in_a_report(section, old):
    key, _, value = old.partition(" = ")
    kind = Check if key == "quality.check" else inner(Report, key.split("."))
    assert value not in typing.get_args(kind)
    assert {*code(section, old)} <= {*typing.get_args(kind)}


@of("plan")
def test_a_key_of_a_plan(section, old):
    def known(key: str) -> object:
        in_plan = key.startswith("plan.")
        kind = ResectionPlan if in_plan else files._Stored
        return inner(kind, key.removeprefix("plan.").split("."))

    with pytest.raises(KeyError):
        known(old)
    for new in code(section, old):
        assert known(new) is not None


@of("manifest")
def test_a_key_of_a_models_manifest(section, old, elastic_model):
    manifest = store.read_json(elastic_model / store.MANIFEST)
    assert old not in manifest
    assert all(new in manifest for new in code(section, old))


@of("variables")
def test_a_variable(section, old, monkeypatch, capsys):
    monkeypatch.setenv(old, "1")
    assert f"{old}{hint(section, old)}" in "\n".join(doctor.old_names())
    sources = "".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    assert old not in sources
    assert all(new in sources for new in code(section, old))


@of("entry_points")
def test_a_group_of_entry_points(section, old, monkeypatch):
    point = EntryPoint("shifted", "acme.peers:PEER", old)
    monkeypatch.setattr(doctor, "entry_points", lambda group: (point,) if group == old else ())
    assert any("acme.peers:PEER" in line and hint(section, old) in line
               for line in doctor.old_names())  # fmt: skip


@of("distributions")
def test_a_distribution(section, old):
    names = re.findall(r'^name = "(.*)"$', "\n".join(
        path.read_text() for path in ROOT.glob("*/pyproject.toml")), re.MULTILINE)  # fmt: skip
    assert old not in names
    assert {*code(section, old)} <= {*names}


@of("targets")
def test_a_target_of_make(section, old):
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert old not in targets
    for new in code(section, old):
        if new.startswith("make "):
            assert new.split()[1] in targets


def test_every_section_has_a_test():
    tests = [test for name, test in globals().items() if name.startswith("test_")]
    marks = [mark for test in tests for mark in getattr(test, "pytestmark", ())]
    tested = {str(entry[0]) for mark in marks for entry in mark.args[1] if len(mark.args) == 2
              and mark.args[0] == ("section", "old")}  # fmt: skip
    assert tested == {*table()}


def test_importing_the_package_reads_no_table():
    code = "import sys, tumortrack; print('msgspec' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          env=os.environ, check=True)  # fmt: skip
    assert done.stdout == "False\n"
