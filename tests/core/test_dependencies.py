"""What the package stands on: locked as pyproject.toml says, under licences that are allowed."""

from __future__ import annotations

import importlib.util
import json
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


def asked_for() -> list[Requirement]:
    lines: list[str] = []
    for folder in (".", "devices", "occupancy", "resection", "benchmarks", "experiment"):
        about = tomllib.loads((ROOT / folder / "pyproject.toml").read_text("utf-8"))
        lines += about["project"]["dependencies"]
        for extra in about["project"].get("optional-dependencies", {}).values():
            lines += extra
        lines += about.get("dependency-groups", {}).get("clients", [])
    return [Requirement(line) for line in lines if not line.startswith("tumortrack")]


def test_every_range_is_locked_to_a_version_in_it_by_hash(tool):
    locked = tool.versions()
    assert len(asked_for()) > 45
    for requirement in asked_for():
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
