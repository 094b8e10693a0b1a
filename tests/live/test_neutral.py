"""The tracker knows nothing of what is moved by its results: a ``Controller`` does."""

import ast
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest

ARMS = {"arm", "arms", "cutter", "electrode", "halt", "halts", "holder", "resection", "workcell"}


def names_in(file: Path) -> Iterator[str]:
    """Of the module, its imports, definitions, arguments and attributes."""
    yield file.stem
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        for field in ("id", "attr", "name", "arg", "module"):
            if isinstance(name := getattr(node, field, None), str):
                yield name


def words_of(name: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def test_words_of_names_are_told_apart():
    assert words_of("tumortrack_resection.armsLength_ARMSHalt") >= {"resection", "arms", "halt"}
    assert not words_of("alarm_charms") & ARMS


@pytest.mark.parametrize("package", ["core", "live"])
def test_nothing_is_named_after_arms(package: str):
    paths = sorted(Path(str(files("tumortrack"))).joinpath(package).rglob("*.py"))
    assert paths
    found = {(path.name, name) for path in paths for name in names_in(path)}
    assert [(path, name) for path, name in found if words_of(name) & ARMS] == []
