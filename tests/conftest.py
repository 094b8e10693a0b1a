"""Runs every test with array shapes checked: jaxtyping's annotations are executed by beartype."""

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

SOURCE = Path(__file__).parents[1] / "src"
CHECKED = ("core/geometry.py", "imaging/*.py", "phantom/*.py", "evaluate/**/*.py", "track/*.py")

# Left out: modules with numba kernels (numba compiles the plain function), and core.types, whose
# constructors convert and check shapes themselves, always.
install_import_hook(
    [
        ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        for pattern in CHECKED
        for path in (SOURCE / "tumortrack").glob(pattern)
        if path.name != "__init__.py" and "import numba" not in path.read_text(encoding="utf-8")
    ],
    "beartype.beartype",
)


# The longest files first: with two workers none is left alone with one at the end.
SLOWEST = (
    "test_training.py",
    "test_track.py",
    "test_locate.py",
    "test_real_patients.py",
    "test_demo.py",
    "test_examples.py",
)


def pytest_collection_modifyitems(items):
    order = {name: n for n, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(scope="session")
def shared_data():
    """Real patients' anatomy beside the checkout; tests that need it skip where it is absent."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}")
    return folder
