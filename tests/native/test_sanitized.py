"""The kernels' tests once more, on kernels in which every access to an array is checked; and
kernels for older processors."""

import ctypes
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tumortrack import native
from tumortrack.native import F32, F64, I32, kernel

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
TESTS = (
    "tests/native/test_native.py",
    "tests/core/test_mesh_kernels.py",
    "tests/core/test_render.py",
    "tests/core/test_sense_kernels.py",
    "tests/report/test_renderer_kernels.py",
    "tests/registration/test_compliance.py",
    "occupancy/tests/test_lattice_kernels.py",
    "benchmarks/tests/test_cut.py"
    "::test_the_margin_of_electrodes_anywhere_is_that_reckoned_for_a_ball",
    "benchmarks/tests/test_stress.py::test_the_bed_is_a_cubic_spline_of_its_grid_with_its_slope",
)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc's sanitizers")
def test_no_kernel_reads_or_writes_beyond_its_arrays():
    command = [sys.executable, ROOT / "tests" / "support" / "sanitized.py", *TESTS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc's sanitizers")
def test_an_access_beyond_an_array_is_seen(tmp_path):
    """The check checks: a declaration that hands over too short an array ends the process."""
    (tmp_path / "test_beyond.py").write_text(
        "import numpy as np\n"
        "from tumortrack.native import F32, F64, I32, kernel\n"
        "def test_beyond():\n"
        "    chances = kernel('probabilities', F32['n'], F64['s'], I32['m'], F32['n'].out)\n"
        "    ones, which = np.ones(5000, np.float32), np.zeros(3, np.int32)\n"
        "    chances(ones, np.ones(1), which, np.empty(5000, np.float32))\n"
    )
    command = [sys.executable, ROOT / "tests" / "support" / "sanitized.py", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "AddressSanitizer" in done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc's flags")
def test_an_older_processor_gets_the_library_that_it_can_run(tmp_path):
    """As in wheels: one library for newer processors, one for all. They give the same bits."""
    sys.path.insert(0, str(ROOT / "tools"))
    import build_backend

    arrays = np.linspace(0, 5, 999, dtype=np.float32), np.full(1, 0.7), np.zeros(999, np.int32)
    answers = []
    for name, target in (("kernels", "x86-64"), ("kernels_v3", "x86-64-v3")):
        build_backend.build(["gcc"], tmp_path / f"{name}.elf", [f"-march={target}"])
    for features in (frozenset(), native.processor_features()):
        chosen = native.library_in(tmp_path, features)
        needed = ctypes.c_char_p.in_dll(chosen, "processor_features").value
        takes = F32["n"], F64["s"], I32["n"], F32["n"].out
        answers.append(np.empty(999, np.float32))
        kernel("probabilities", *takes, within=chosen)(*arrays, answers[-1])
        assert (b"avx2" in needed) == ("avx2" in features)
    np.testing.assert_array_equal(*answers)
