"""Keywords of public functions: as the options that commands have, and checked like them."""

from typing import get_type_hints

import pytest

import tumortrack as tt
from refused import refused
from tumortrack.case.options import PrepareOptions
from tumortrack.io.ultrasound_files import RecordingOptions
from tumortrack.tracking import keywords
from tumortrack.tracking.options import (
    ExportOptions,
    LocateOptions,
    SimulateOptions,
    TrackOptions,
)


@pytest.mark.parametrize(
    ("typed", "options"),
    [
        (keywords.PrepareKeywords, PrepareOptions),
        (keywords.SimulateKeywords, SimulateOptions),
        (keywords.ExportKeywords, ExportOptions),
        (keywords.LocateKeywords, LocateOptions),
        (keywords.RecordingKeywords, RecordingOptions),
        (keywords.SessionKeywords, TrackOptions),
    ],
)
def test_what_an_editor_offers_is_what_the_function_takes(typed, options):
    assert get_type_hints(typed).keys() == get_type_hints(options).keys()


@pytest.mark.parametrize(
    ("call", "known"),
    [
        (tt.prepare, "series"),
        (tt.write_scenes, "seed"),
        (tt.export, "series"),
        (tt.locate_files, "seed"),
    ],
)  # fmt: skip
def test_an_unknown_keyword_is_named_with_the_known_ones(call, known, tmp_path):
    with refused(tt.errors.InputError, "'gird'", known):
        call(tmp_path, tmp_path / "out", gird=3)
    assert not (tmp_path / "out").exists()
