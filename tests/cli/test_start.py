"""What a command loads before it answers: PyTorch takes a second, and some others tenths."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from stories import cloud_by_rays, looking_down, with_imports
from tumortrack.cli import main
from tumortrack.cli.console import inputs_and_out
from tumortrack.core import plugins
from tumortrack.core.errors import InputError
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
        ("locate MODEL NONE.ply OUT", "NONE.ply"),  # as it was once
        ("evaluate MODEL NONE OUT", "NONE"),
        ("train NONE OUT", "NONE"),
    ],
)
def test_what_is_wrong_is_said_before_pytorch_is_loaded(
    command, wrong, slim_model, phantom_case, cloud, tmp_path
):
    places = {"NONE": tmp_path / "none", "MODEL": slim_model, "CASE": phantom_case}
    places |= {"CLOUD": cloud, "OUT": tmp_path / "out"}
    for name, place in places.items():
        command, wrong = (text.replace(name, str(place)) for text in (command, wrong))
    done, imported = with_imports(*command.split())
    assert done.returncode == 2, done.stderr
    assert wrong in done.stderr
    assert "torch" not in imported
    assert not (tmp_path / "out").exists()


def test_the_last_of_several_paths_was_once_the_folder_to_write(tmp_path, capsys):
    first, second, out = (tmp_path / name for name in ("a.ply", "b.ply", "run"))
    assert inputs_and_out((first, second), out, "") == ((first, second), out)
    assert capsys.readouterr().err == ""
    assert inputs_and_out((first, second, out), None, "") == ([first, second], out)
    (note,) = capsys.readouterr().err.splitlines()
    assert note.startswith("note: ")
    assert str(out) in note
    with pytest.raises(InputError):
        inputs_and_out((first,), None, "")


def test_an_answer_needs_none_of_the_slow_libraries(slim_model, tmp_path):
    from warp_objects import placed

    surface = placed(3).carry(placed(3).shape.anatomy_ct.organ.vertices_mm)
    file = tmp_path / "cloud.ply"
    write_cloud_ply(file, surface[surface[:, 2] < np.median(surface[:, 2])].astype(np.float32))
    done, imported = with_imports(
        "locate", slim_model, file, "--out", tmp_path / "out", "--grid", 32
    )
    assert done.returncode in (0, 4), done.stderr[-2000:]
    assert (tmp_path / "out" / "labels.nii.gz").exists()
    assert "written to" in done.stdout.splitlines()[-1]  # though the process ends at once
    slow = {"torch", "nibabel", "pydicom", "trimesh", "matplotlib", "gdcm", "skimage"}
    slow |= {"scipy.ndimage"} | ({"scipy.spatial"} if done.returncode == 0 else set())
    assert not slow & imported


@pytest.mark.parametrize("status", [0, 4])
def test_the_exit_status_is_the_commands_where_nobody_reads_on(status):
    """`locate ... | head -1` ended with 1, whatever the verdict."""
    program = f"""if True:
        import sys
        from tumortrack.cli import console, main
        class Command:
            def run(self):
                for _ in range(3):
                    console.say("a line")
                    sys.stdout.flush()
                return {status}
        main._parse = lambda arguments: Command()
        sys.exit(main.run(["any"]))
    """
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    process.stdout.close()
    assert process.wait(300) == status


def test_a_broken_command_of_another_package_stops_no_other(monkeypatch, tmp_path, capsys):
    broken = EntryPoint("broken", "nowhere.at_all:Command", "tumortrack.commands")
    found = plugins.entry_points  # other groups are what they are, and remembered
    monkeypatch.setattr(
        plugins,
        "entry_points",
        lambda group: (broken,) if group == broken.group else found(group=group),
    )
    assert main.run(["inspect", str(tmp_path)]) == 2
    assert "nothing that inspect knows" in capsys.readouterr().err
    assert main.run(["broken"]) == 2
    said = capsys.readouterr().err
    assert "No module named 'nowhere'" in said


def test_the_commands_are_known_without_numpy():
    """It would be a third of the time of --help, and of every refusal."""
    program = "import sys; import tumortrack.cli.main; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=300).returncode == 0
