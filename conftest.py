"""Runs tests with array shapes checked: jaxtyping's annotations are executed by beartype. Those
marked slow run as users run them: checked, each call costs as much again."""

import fcntl
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jaxtyping
import pytest

# Ray reads these once, when whatever test imports it first: its clusters of these tests ask for a
# token, which other users of the machine do not have.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0123456789abcdef" * 4}
ROOT = Path(__file__).parent
PACKAGES = (
    ROOT / "src" / "tumortrack",
    ROOT / "devices" / "src" / "tumortrack_devices",
    ROOT / "occupancy" / "src" / "tumortrack_occupancy",
    ROOT / "resection" / "src" / "tumortrack_resection",
    ROOT / "benchmarks" / "src" / "tumortrack_benchmarks",
    ROOT / "experiment" / "src" / "tumortrack_experiment",
)

# Left out: core.types, whose constructors convert and check shapes themselves, always; and the
# __init__.py of packages: with one of them all modules below would be hooked.
CHECKED = [
    ".".join(path.relative_to(package.parent).with_suffix("").parts)
    for package in PACKAGES
    for path in sorted(package.rglob("*.py"))
    if path.name not in ("__init__.py", "__main__.py") and path != PACKAGES[0] / "core" / "types.py"
]
jaxtyping.install_import_hook(CHECKED, "checking.check_annotations")


# What needs a model is slow: it may be the one that makes it.
MODELS = {"elastic_model", "quick_model", "learnt_model", "slim_model"}

# The longest files first: with few workers none is left alone with one at the end. Two of the
# first three make no `elastic` model: else each worker would compile its kernels for itself.
SLOWEST = (
    "test_all_figures.py",
    "test_soak.py",
    "test_locate.py",
    "test_demo.py",
    "test_training.py",
    "test_killed.py",
    "test_real_patients.py",
    "test_examples.py",
    "test_howto.py",
    "test_resect.py",
    "test_gauss_newton.py",
    "test_registration.py",
    "test_track.py",
    "test_track_devices.py",
    "test_wheel.py",
    "test_hostile_volumes.py",
    "test_margins.py",
    "test_twin_physics.py",
)


def pytest_addoption(parser):
    help_ = "also what takes long: hostile files, TIMES kills of each command, more damaged files"
    parser.addoption("--attack", type=int, default=0, metavar="TIMES", help=help_)


def pytest_configure(config):
    config.addinivalue_line("markers", "attack: is run with --attack alone")


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(config, items):
    if not config.getoption("--attack"):
        items[:] = [item for item in items if not item.get_closest_marker("attack")]
    for item in items:
        if MODELS.intersection(item.fixturenames):
            item.add_marker(pytest.mark.slow)
    order = {name: n for n, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.hookimpl(tryfirst=True)  # before fixtures are made
def pytest_runtest_setup(item):
    jaxtyping.config.jaxtyping_disable = item.get_closest_marker("slow") is not None


@pytest.fixture
def unchecked(monkeypatch):
    """As in use: annotations are not executed, so that a function's own refusal is met."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session")
def shared_data():
    """Real patients' anatomy beside the checkout; tests that need it skip where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}")
    return folder


# What several files need is made once in a run, whatever the number of workers. Not to be altered.

Once = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """``once(name, make)``: the folder that the first worker who asks has ``make`` write."""
    own = tmp_path_factory.getbasetemp()
    shared = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    shared.mkdir(exist_ok=True)

    def made(name: str, make: Callable[[Path], object]) -> Path:
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be making it
            if not (shared / f"{name}.made").exists():
                make(shared / name)
                (shared / f"{name}.made").touch()
        return shared / name

    return made


@pytest.fixture(scope="session")
def phantom_case(once) -> Path:
    """The built-in phantom on coarse voxels, as a case folder."""
    from stories import write_phantom_case

    return once("phantom_case", write_phantom_case)


@pytest.fixture(scope="session")
def elastic_model(once, phantom_case) -> Path:
    """A model folder of the phantom: the preset elastic."""
    from stories import write_elastic

    return once("elastic_model", lambda model: write_elastic(phantom_case, model))


@pytest.fixture(scope="session")
def ready_case(once, phantom_case, elastic_model) -> Path:
    """The phantom's case with its model in it."""

    def make(case: Path) -> None:
        shutil.copytree(phantom_case, case)
        shutil.copytree(elastic_model, case / "model")

    return once("ready_case", make)


@pytest.fixture
def models_at_once(monkeypatch, elastic_model) -> list[object]:
    """In this process every case's model is the phantom's: none has to be made. The list of cases
    whose model was asked for."""
    from tumortrack.tracking import model_files

    model, asked = model_files.load_model(elastic_model), []

    def make(case, config=None, seed=0, progress=None):
        asked.append(case)
        return replace(model, provenance={**model.provenance, "case_sha256": case.sha256})

    monkeypatch.setattr(model_files, "make_model", make)
    return asked


@pytest.fixture(scope="session")
def quick_model(once, phantom_case) -> Path:
    """A model folder of the phantom: the preset quick, trained for seconds."""
    from stories import trained

    return once("quick_model", lambda model: trained(phantom_case, model))


@pytest.fixture(scope="session")
def learnt_model(once, phantom_case) -> Path:
    """A model folder of the phantom: a ``quick`` that has learnt enough to be right by millimetres
    and sure of its labels."""
    from stories import train_learnt

    return once("learnt_model", lambda model: train_learnt(phantom_case, model))


@pytest.fixture(scope="session")
def slim_model(once) -> Path:
    """A model folder of the elastic objects' organ: a slim elastic."""
    from warp_objects import write_slim

    return once("slim_model", write_slim)


@pytest.fixture(scope="session")
def attack_base(request, once, phantom_case, elastic_model) -> Path:
    """What attacks and kills start from: a case, a model, a scene; with --attack also a network, a
    run and a plan."""
    from stories import answered, succeeded, tumortrack

    def make(base: Path) -> None:
        base.mkdir()
        (base / "model").symlink_to(elastic_model)
        shutil.copytree(phantom_case, base / "case")
        shutil.copytree(elastic_model, base / "case" / "model")
        succeeded(tumortrack("simulate", base / "case", base / "scenes", "--scenes", 1))
        if not request.config.getoption("--attack"):
            return
        (base / "network").symlink_to(request.getfixturevalue("quick_model"))
        cloud = base / "scenes" / "0000" / "cloud.ply"
        answered(tumortrack("locate", base / "model", cloud, "--out", base / "run"))
        accepted = ("--accept-poor", "--accept-budget")
        succeeded(tumortrack("plan", base / "run", base / "plan", *accepted))

    return once("attack_base", make)
