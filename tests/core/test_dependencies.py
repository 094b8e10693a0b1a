"""What the package stands on: locked as pyproject.toml says, under licences that are allowed."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

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
