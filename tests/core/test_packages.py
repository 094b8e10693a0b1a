"""How packages are installed: ours are on no index that strangers can write to."""

from __future__ import annotations

import pytest

import tumortrack
from tumortrack.core.packages import CHECKOUT, to_install


@pytest.mark.parametrize(
    ("package", "folder"),
    [("tumortrack[dicom]", "[dicom]"), ("tumortrack-resection[ur]", "/resection[ur]")],
)
def test_a_checkout_installs_its_own_folders_and_wheels_come_from_a_release(
    package, folder, tmp_path
):
    assert to_install(package) == f"pip install -e '{CHECKOUT}{folder}'"
    wheel = f"pip install '{package}=={tumortrack.__version__}' --find-links "
    assert to_install(package, tmp_path).startswith(wheel)
    assert to_install("acme[far]") == "pip install 'acme[far]'"
