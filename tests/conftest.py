"""Runs every test with array shapes checked: jaxtyping's annotations are executed by beartype."""

import pytest
from jaxtyping import install_import_hook

# Left out: modules with numba kernels (numba compiles the plain function), and core.types, whose
# constructors convert and check shapes themselves, always.
install_import_hook(
    [
        "tumortrack.core.geometry",
        "tumortrack.imaging",
        "tumortrack.phantom",
        "tumortrack.evaluate",
        "tumortrack.track",
    ],
    "beartype.beartype",
)


@pytest.fixture(scope="session")
def shared_data():
    """Real patients' anatomy beside the checkout; tests that need it skip where it is absent."""
    from pathlib import Path

    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}")
    return folder
