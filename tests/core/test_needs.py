"""What is not installed is skipped by name, and fails where nothing may be missing, as in CI."""

import pytest

import clients
import needs


@pytest.mark.parametrize(
    ("everything", "ends"), [("", pytest.skip.Exception), ("1", pytest.fail.Exception)]
)
def test_programs_that_are_not_there_are_named(everything, ends, monkeypatch, tmp_path):
    monkeypatch.setattr(clients, "FOLDER", tmp_path)
    monkeypatch.setenv(needs.EVERYTHING, everything)
    with pytest.raises(ends, match=r"slicer-core: make clients"):
        clients.environment("slicer-core")
