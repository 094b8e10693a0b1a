"""How packages are installed: ours are on no index that strangers can write to."""

from __future__ import annotations

from pathlib import Path

import pytest

from tumortrack.core import packages
from tumortrack.core.packages import to_install

ROOT = Path(packages.__file__).parents[3]


@pytest.mark.parametrize(
    ("package", "folder"),
    [
        ("tumortrack[dicom]", f"{ROOT}/[dicom]"),
        ("tumortrack-devices", f"{ROOT}/devices"),
        ("tumortrack-resection[ur]", f"{ROOT}/resection[ur]"),
    ],
)
def test_a_checkout_installs_its_own_folders_and_wheels_come_from_a_release(
    package, folder, monkeypatch, tmp_path
):
    assert Path(to_install(package).split("'")[1]) == Path(folder.replace("/[", "["))
    monkeypatch.setattr(packages, "_CHECKOUT", tmp_path)
    assert to_install(package).startswith(f"pip install '{package}' --find-links ")


def test_foreign_packages_come_from_the_index():
    assert to_install("acme[far]") == "pip install 'acme[far]'"
