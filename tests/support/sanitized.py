"""Runs tests on kernels that check every access: gcc's address and undefined-behaviour sanitizers.

python tests/support/sanitized.py TEST ...   what pytest takes; its exit status
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
FLAGS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]


def main(tests: list[str]) -> int:
    """Builds the library, and starts a Python with the sanitizer's own allocator before all."""
    sys.path.insert(0, str(ROOT / "tools"))
    import build_backend

    asan = subprocess.run(
        ["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True
    ).stdout.strip()
    with tempfile.TemporaryDirectory() as folder:
        build_backend.build(["gcc"], Path(folder) / "kernels.elf", ["-march=native", *FLAGS])
        code = "import sys, pathlib, pytest, tumortrack.native as native; "
        code += "native.LIBRARIES = pathlib.Path(sys.argv[1]); sys.exit(pytest.main(sys.argv[2:]))"
        environ = {**os.environ, "LD_PRELOAD": asan, "ASAN_OPTIONS": "detect_leaks=0"}
        environ["PYTHONMALLOC"] = "malloc"  # arrays are then the sanitizer's
        options = ["-q", "-s", "-p", "no:cacheprovider", "-p", "no:xdist"]
        command = [sys.executable, "-c", code, folder, *options, *tests]
        return subprocess.run(command, env=environ, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
