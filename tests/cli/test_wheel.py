"""The wheel, installed as a user does: its command line and its API, without the benchmarks."""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]


def run(*command, **options):
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, timeout=600, **options
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder]
    run(*build, "--no-build-isolation", ROOT)
    return next(folder.glob("tumortrack-*.whl"))


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """A new environment that holds the wheel and, by links, what it depends on."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, with_pip=False, symlinks=True)
    (packages,) = place.glob("lib/python3*/site-packages")
    (linked := place / "dependencies").mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if "tumortrack" not in path.name:
            (linked / path.name).symlink_to(path)
    here = f"import site; site.addsitedir({str(linked)!r})\n"  # reads the .pth files there, too
    (packages / "dependencies.pth").write_text(here)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    return place


def test_commands_and_an_example_run_from_the_wheel(environment, tmp_path):
    python = environment / "bin" / "python"
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    code = "import tumortrack; print(tumortrack.__file__)"
    assert str(environment) in run(python, "-c", code, env=clean)
    command = [python, "-m", "tumortrack"]
    assert "--minutes" in run(*command, "demo", "--help", env=clean)
    assert run(*command, "--version", env=clean) == f"tumortrack {version('tumortrack')}\n"
    said = run(*command, "doctor", env=clean)
    assert re.search(r"ok       tumortrack: .* numpy \d", said)
    assert re.search(r"absent   tumortrack-occupancy: the paper's method", said)
    assert "BROKEN" not in said
    listed = run(*command, "--help", env=clean)
    assert "locate" in listed
    assert "twin" not in listed  # the benchmarks'
    for name, package in (
        ("onnx", "tumortrack-occupancy"),
        ("plan", "tumortrack-resection"),
        ("twin", "tumortrack-benchmarks"),
        ("margins", "tumortrack-benchmarks"),
        ("record", "tumortrack-experiment"),
    ):
        without = subprocess.run([*command, name], capture_output=True, text=True, env=clean)
        assert without.returncode == 2
        assert f"tumortrack: the command {name} belongs to {package}" in without.stderr
    (bag := tmp_path / "seen.mcap").touch()
    without = subprocess.run([*command, "inspect", bag], capture_output=True, text=True, env=clean)
    assert without.returncode == 2
    assert f"pip install 'tumortrack-devices=={version('tumortrack')}'" in without.stderr
    example = ROOT / "examples" / "01_prepare_and_look.py"
    assert "kidney: 1" in run(python, example, tmp_path, env=clean, cwd=tmp_path)
    assert (tmp_path / "case" / "qc.png").stat().st_size > 10_000


def test_the_wheel_holds_the_package_alone(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top.split("-")[0] for top in tops} == {"tumortrack"}
    assert "tumortrack/py.typed" in names
    assert "tumortrack/native/kernels.elf" in names
    assert not any(name.endswith((".c", ".h")) for name in names)
    assert re.search(
        r"-py3-none-linux_\w+\.whl", wheel.name
    )  # for any Python, this kind of machine
    (scenes,) = (name for name in names if name.endswith(".safetensors"))  # nothing is learnt
    assert scenes == "tumortrack/simulation/phantom_scenes.safetensors"
    assert zipfile.ZipFile(wheel).getinfo(scenes).compress_size < 5_000_000
    assert any(name.endswith("LICENSE") for name in names)


@pytest.mark.parametrize(
    "folder", [".", "devices", "occupancy", "resection", "experiment", "benchmarks"]
)
def test_a_description_holds_on_pypi_where_links_into_the_repository_lead_nowhere(folder):
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
    text = (ROOT / folder / project["readme"]).read_text()
    assert re.findall(r"\]\((?!https://)", text) == []
    for extra in re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE):
        assert extra in project["optional-dependencies"]
    assert (ROOT / folder / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
