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
_NAMES = [name for name in attacks.WITHOUT_BASE if not name.startswith(_LONG)]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    folder = str(tmp_path_factory.mktemp("attacks"))
    command = [sys.executable, attacks.__file__, folder, "--no-models", *_NAMES]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = {line[15:].split()[0]: line for line in done.stdout.splitlines()}
    assert lines, done.stderr
    return lines


@pytest.mark.parametrize("name", _NAMES)
def test_an_attack_ends_in_one_clear_line(name, outcomes):
    assert outcomes[name].startswith("ok"), outcomes[name]
