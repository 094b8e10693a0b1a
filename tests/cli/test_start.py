"""Wrong arguments, closed pipes, broken packages: how commands end."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from extension_objects import distribution
from stories import COMMAND, cloud_by_rays, environment, looking_down, refusal, tumortrack
from tumortrack.cli import main
from tumortrack.io.case import load_case
from tumortrack.io.ply import write_cloud_ply


@pytest.fixture
def cloud(tmp_path, phantom_case):
    case = load_case(phantom_case)
    file = tmp_path / "cloud.ply"
    write_cloud_ply(file, cloud_by_rays(case, looking_down(case), 0.02).astype(np.float32))
    return file


@pytest.mark.parametrize(
    ("command", "wrong"),
    [
        ("locate NONE CLOUD --out OUT", "NONE"),
        ("locate MODEL NONE.ply --out OUT", "NONE.ply"),
        ("locate MODEL CLOUD --out CLOUD", "CLOUD"),
        ("track NONE virtual:CASE --report OUT", "NONE"),
        ("track MODEL virtual:NONE --report OUT", "NONE"),
        ("locate CLOUD MODEL --out OUT", "tumortrack locate MODEL CLOUD --out OUT"),
        ("locate MODEL CASE --out OUT", "CASE"),
        ("locate MODEL CLOUD", "--out"),
        ("evaluate MODEL NONE OUT", "NONE"),
        ("train NONE OUT", "NONE"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_written(
    command, wrong, slim_model, phantom_case, cloud, tmp_path
):
    places = {"NONE": tmp_path / "none", "MODEL": slim_model, "CASE": phantom_case}
    places |= {"CLOUD": cloud, "OUT": tmp_path / "out"}
    for name, place in places.items():
        command, wrong = (text.replace(name, str(place)) for text in (command, wrong))
    assert wrong in refusal(tumortrack(*command.split()))
    assert not (tmp_path / "out").exists()


def test_the_exit_status_is_the_commands_where_nobody_reads_on(phantom_case):
    """`inspect ... | head -1`."""
    command = [*COMMAND, "inspect", phantom_case]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment())
    process.stdout.close()
    assert process.wait(300) == 0


def test_a_broken_command_of_another_package_stops_no_other(monkeypatch, tmp_path, capsys):
    broken = {"tumortrack.commands": {"broken": "nowhere.at_all:Command"}}
    monkeypatch.syspath_prepend(str(distribution(tmp_path / "acme", "acme", broken)))
    assert main.run(["inspect", str(tmp_path)]) == 2
    assert "nowhere" not in capsys.readouterr().err
    assert main.run(["broken"]) == 2
    assert "'nowhere'" in capsys.readouterr().err
