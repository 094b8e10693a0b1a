"""Names are the field's: none has a word of the list in pyproject.toml."""

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LISTED = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["tumortrack"]
SOURCES = sorted(
    path
    for package in (
        "src/tumortrack",
        "devices/src/tumortrack_devices",
        "occupancy/src/tumortrack_occupancy",
        "resection/src/tumortrack_resection",
    )
    for path in (ROOT / package).rglob("*.py")
)


def names_in(path: Path) -> set[str]:
    """Of classes, functions and their parameters."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        if isinstance(node, ast.arg):
            found.add(node.arg)
    return found


def private_words(names: set[str]) -> set[str]:
    words = {word for name in names for word in name.lower().strip("_").split("_")}
    return words & set(LISTED["private_words"])


def test_it_finds_such_a_name():
    assert private_words({"_settle_pose", "camera_from_ct"}) == {"settle"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_name_has_a_private_word(path: Path):
    assert not private_words(names_in(path))
