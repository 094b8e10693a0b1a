"""Installed distributions with entry points, without installing anything."""

from __future__ import annotations

import tomllib
from pathlib import Path

EXAMPLE = Path(__file__).parent / "example_extension"


def distribution(folder: Path, name: str, entry_points: dict[str, dict[str, str]]) -> Path:
    """A folder for ``sys.path`` in which Python finds this distribution's metadata."""
    info = folder / f"{name.replace('-', '_')}-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    lines = [
        line
        for group, points in entry_points.items()
        for line in (f"[{group}]", *(f"{kind} = {value}" for kind, value in points.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


def installed_example(folder: Path) -> list[Path]:
    """What ``pip install tests/support/example_extension`` puts on ``sys.path``."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    return [distribution(folder, project["name"], project["entry-points"]), EXAMPLE]
