"""What the package stands on: locked as pyproject.toml says, under licences that are allowed."""

from __future__ import annotations

import importlib.util
import json
import re
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import tumortrack

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("dependencies", ROOT / "tools/dependencies.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("expression", "allowed"),
    [
        ("MIT", True),
        ("Apache-2.0 WITH LLVM-exception AND MIT", True),
        ("GPL-3.0-only OR MIT", True),
        ("(Apache-2.0 OR GPL-2.0) AND MIT", False),  # not taken apart: a person looks
        ("GPL-3.0-only", False),
        ("MIT AND GPL-2.0-only", False),
        ("", False),
        ("whatever", False),
    ],
)
def test_which_licences_are_allowed(tool, expression, allowed):
    assert tool.is_allowed(expression) == allowed


def test_a_wheel_comes_with_what_it_needs(tool, tmp_path):
    assert tool.main(["sbom", str(tmp_path / "tumortrack-0.2.0-py3-none-any.whl")]) == 0
    bom = json.loads((tmp_path / "tumortrack-0.2.0-py3-none-any.cdx.json").read_text("utf-8"))
    parts = {part["bom-ref"]: part for part in bom["components"]}
    version, digests = tool.versions()["websockets"]  # not asked for itself: viser brings it
    assert parts["websockets"]["purl"] == f"pkg:pypi/websockets@{version}"
    (reference,) = parts["websockets"]["externalReferences"]
    assert {one["content"] for one in reference["hashes"]} == set(digests)
    assert not {"ruff", "tumortrack"} & parts.keys()  # developers' own, and itself


def projects() -> list[dict[str, Any]]:
    folders = (".", "devices", "occupancy", "resection", "benchmarks", "experiment")
    texts = ((ROOT / folder / "pyproject.toml").read_text("utf-8") for folder in folders)
    return [tomllib.loads(text) for text in texts]


def asked_for() -> list[Requirement]:
    lines: list[str] = []
    for about in projects():
        lines += about["project"]["dependencies"]
        for extra in about["project"].get("optional-dependencies", {}).values():
            lines += extra
        lines += about.get("dependency-groups", {}).get("clients", [])
    return [Requirement(line) for line in lines]


def test_every_range_is_locked_to_a_version_in_it_by_hash(tool):
    locked = tool.versions()
    others = [asked for asked in asked_for() if not asked.name.startswith("tumortrack")]
    assert len(others) > 45
    for requirement in others:
        assert locked[canonicalize_name(requirement.name)][0] in requirement.specifier
    assert all(digests for _, digests in locked.values())
    cpu = tool.pinned((ROOT / "requirements/torch-cpu.txt").read_text("utf-8"))["torch"]
    assert cpu.startswith(f"torch=={locked['torch'][0]}+cpu")


def test_what_is_installed_is_what_is_locked_and_its_licences_are_listed(tool):
    locked = tool.versions()
    for name, package in tool.everything().items():
        assert tool.version_of(package) == locked[name][0], f"{name}: run make setup"
    assert tool.main(["licences"]) == 0
    rows, made = (set(text.splitlines()) for text in (tool.TABLE.read_text("utf-8"), tool.table()))
    assert len(made) > 50
    assert made <= rows, "run make licences"  # some are for one Python or machine alone


def test_one_version_is_stated_everywhere_with_the_date_that_the_changelog_gives_it():
    stated = tumortrack.__version__
    assert [about["project"]["version"] for about in projects()] == [stated] * 6
    ours = {str(asked.specifier) for asked in asked_for() if asked.name.startswith("tumortrack")}
    assert ours == {f"=={stated}", ""}  # none: tumortrack[live] has an extra of its own
    assert f'"tumortrack[live]=={stated}"' in (ROOT / "docs/package.md").read_text("utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    newest, date = re.findall(r"^## ([0-9.]+) \((.+)\)$", changes, re.MULTILINE)[0]
    cited = (ROOT / "CITATION.cff").read_text("utf-8").splitlines()
    assert newest == stated
    assert {f"version: {stated}", f"date-released: {date}"} <= set(cited)
