"""The attacks that need no model, run by tests/support/attacks.py; `make attack` runs all."""

from __future__ import annotations

import subprocess
import sys

import pytest

import attacks

# These take seconds, to be made or to be refused.
_LONG = (
    "gzip_bomb",
    "gzip_goes_on",
    "gzip_unpacks",
    "gzip_extension",
    "labels_of_",
    "mesh_254",
    "dicom_deflated",
)
_NAMES = [
    name
    for name in attacks.ATTACKS
    if name.startswith(attacks.WITHOUT_BASE) and not name.startswith(_LONG)
]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    command = [sys.executable, attacks.__file__, str(tmp_path_factory.mktemp("attacks")), *_NAMES]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    found = {line[15:].split()[0]: line for line in said.stdout.splitlines()}
    assert found, said.stderr
    return found


@pytest.mark.parametrize("name", _NAMES)
def test_an_attack_ends_in_one_clear_line(name, outcomes):
    assert outcomes[name].startswith("ok"), outcomes[name]
