"""How this project's own packages are installed. None is on PyPI, where a stranger could take its
name: they come from a checkout, or as the wheels of a release, of the version that is here."""

from __future__ import annotations

from pathlib import Path

import tumortrack

CHECKOUT = Path(__file__).parents[3]


def to_install(package: str, checkout: Path = CHECKOUT) -> str:
    """The command that installs a package, also with an extra in brackets."""
    name, bracket, extra = package.partition("[")
    if not name.startswith("tumortrack"):
        return f"pip install '{package}'"
    folder = checkout / name.removeprefix("tumortrack").removeprefix("-")
    if (folder / "pyproject.toml").is_file():
        return f"pip install -e '{folder}{bracket}{extra}'"
    # With the version: of one version pip takes the file before an index's
    wanted = f"{package}=={tumortrack.__version__}"
    return f"pip install '{wanted}' --find-links WHEELS (a folder with the release's wheels)"
