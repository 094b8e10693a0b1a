"""Keywords of public functions: as the options that commands have, and checked like them."""

from typing import get_type_hints

import pytest

import tumortrack as tt
from tumortrack.case.options import PrepareOptions
from tumortrack.cli.main import run
from tumortrack.core.wording import command_line, for_caller
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
        (keywords.SessionKeywords, TrackOptions),
    ],
)
def test_what_an_editor_offers_is_what_the_function_takes(typed, options):
    assert get_type_hints(typed).keys() == get_type_hints(options).keys()


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("give --unit m.", 'give unit="m".'),
        ("--at COLUMN ROW, --box or --mask", "at=(COLUMN, ROW), box= or mask="),
        ("--depth-error 0.5 and --grid 999 are", "depth_error=0.5 and grid=999 are"),
        ("--workers -2 and --steps nan must", "workers=-2 and steps=nan must"),
        ("or give --overwrite.", "or give overwrite=True."),
        ("--segment 'my tool' is", "segment='my tool' is"),
        ("Give --name liver, or --name of another.", 'Give name="liver", or name= of another.'),
        ("as `track --moving`, or pip install --user x.", None),
        ("tumortrack export CASE OUT --located RUN.", None),
        ("10 --- 20 -- 30", None),
    ],
)
def test_a_message_names_options_as_its_reader_writes_them(said, meant):
    assert str(tt.errors.InputError(said)) == (meant or said)
    with command_line():
        assert str(tt.errors.InputError(said)) == said
    assert for_caller(said) == (meant or said)


def test_train_speaks_to_python_of_keywords_and_to_a_shell_of_options(
    phantom_case, tmp_path, capsys
):
    for wrong in ({"minutes": 1.0, "steps": 10}, {"steps": -1}, {"workers": -2}):
        with pytest.raises(tt.errors.InputError) as refused:
            tt.train(phantom_case, tmp_path / "model", **wrong)
        assert "--" not in str(refused.value)
        assert all(f"{name}=" in str(refused.value) for name in wrong)
        options = (word for name, value in wrong.items() for word in (f"--{name}", str(value)))
        assert run(["train", str(phantom_case), str(tmp_path / "model"), *options]) == 2
        told = capsys.readouterr().err
        assert all(f"--{name}" in told for name in wrong)


@pytest.mark.parametrize("call", [tt.prepare, tt.write_scenes, tt.export, tt.locate_files])
def test_an_unknown_keyword_is_named_with_the_known_ones(call, tmp_path):
    with pytest.raises(tt.errors.InputError, match=r"'gird'.*(seed|series)"):
        call(tmp_path, tmp_path / "out", gird=3)
    assert not (tmp_path / "out").exists()
