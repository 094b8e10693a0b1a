"""Builds the kernels (C) and, as pip's build backend, the package with them.

python tools/build_backend.py              makes the library, beside its sources
python tools/build_backend.py --compiler   says with what; fails where there is no compiler

$CC, else gcc or clang where there is one, else ziglang: a compiler as a wheel of PyPI. A library
is for this machine's processor. With ``--config-settings portable=1`` a wheel holds two, made by
ziglang: for processors with AVX2 and for all others, with glibc 2.28 or newer.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  the hooks that need no change

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src" / "tumortrack" / "native"
ZIGLANG = "ziglang==0.17.1"  # as in requirements/compiler.txt, there with its hash
FLAGS = ["-std=c11", "-O3", "-fPIC", "-fvisibility=hidden", "-Wall", "-Wextra", "-Werror"]
FLAGS += ["-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math", "-fno-sanitize=undefined"]
EXACT = ["-ffp-contract=off"]
# Without -ffinite-math-only, so that what is no number stays so and comparisons see it
FAST = ["-ffp-contract=fast", "-fassociative-math", "-fno-signed-zeros", "-freciprocal-math"]
_NONE = f"there is no C compiler: install gcc or clang, or `pip install {ZIGLANG}`."
# What a compiler may have used, by its macro, and as /proc/cpuinfo names it
FEATURES = {
    "SSE4_2": "sse4_2", "POPCNT": "popcnt", "LZCNT": "abm", "MOVBE": "movbe", "F16C": "f16c",
    "AVX": "avx", "AVX2": "avx2", "FMA": "fma", "BMI": "bmi1", "BMI2": "bmi2", "GFNI": "gfni",
    "AVXVNNI": "avx_vnni", "AVX512F": "avx512f", "AVX512VL": "avx512vl", "AVX512BW": "avx512bw",
    "AVX512DQ": "avx512dq", "AVX512CD": "avx512cd", "AVX512IFMA": "avx512ifma",
    "AVX512VBMI": "avx512vbmi", "AVX512VBMI2": "avx512_vbmi2", "AVX512VNNI": "avx512_vnni",
    "AVX512BITALG": "avx512_bitalg", "AVX512VPOPCNTDQ": "avx512_vpopcntdq",
    "AVX512BF16": "avx512_bf16", "AVX512FP16": "avx512_fp16",
}  # fmt: skip


def compiler() -> list[str] | None:
    """The command of a C compiler; None: there is none."""
    if given := os.environ.get("CC"):
        return shlex.split(given)
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return [found]
    return [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") else None


def build(command: list[str], library: Path, target: list[str]) -> None:
    """Compiles all sources and replaces the library in one step."""
    with tempfile.TemporaryDirectory() as folder:
        here, jobs = Path(folder), []
        macros = _run([*command, *target, "-dM", "-E", "-x", "c", os.devnull])
        has = [name for macro, name in FEATURES.items() if f"#define __{macro}__ 1" in macros]
        visible = '__attribute__((visibility("default")))'
        stated = f'{visible} const char *const processor_features = "{" ".join(has)}";\n'
        (here / "features.c").write_text(stated)
        for source in [here / "features.c", *sorted(SOURCES.rglob("*.c"))]:
            sums = FAST if source.parent.name == "fast" else EXACT
            flags = [*FLAGS, *sums, *target, f"-I{SOURCES}"]
            made = here / f"{source.parent.name}_{source.stem}.o"
            jobs.append((made, [*command, *flags, "-c", str(source), "-o", str(made)]))
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda job: _run(job[1]), jobs))
        linked = here / library.name
        link = [flag for flag in target if not flag.startswith("-m")]
        objects = [str(made) for made, _ in jobs]
        _run([*command, *link, "-shared", "-s", "-o", str(linked), *objects, "-lm"])
        part = library.with_suffix(f".{os.getpid()}")
        shutil.copyfile(linked, part)
        part.replace(library)


def build_local() -> None:
    """For the processor of this machine."""
    command = compiler()
    if command is None:
        sys.exit(_NONE)
    (SOURCES / "kernels_v3.elf").unlink(missing_ok=True)  # of wheels: it would be preferred
    native = "-mcpu=native" if "ziglang" in command else "-march=native"
    build(command, SOURCES / "kernels.elf", [native])


def build_portable() -> None:
    """For wheels."""
    command = compiler() or []
    if "ziglang" not in command:
        sys.exit(f"only ziglang makes portable libraries; CC='python -m ziglang cc' ({ZIGLANG}).")
    where = ["-target", f"{platform.machine()}-linux-gnu.2.28"]
    build(command, SOURCES / "kernels.elf", where)
    if platform.machine() == "x86_64":
        build(command, SOURCES / "kernels_v3.elf", [*where, "-mcpu=x86_64_v3"])


def _run(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        sys.exit(f"the compiler {command[0]} cannot be run ({error.strerror}). $CC names another.")
    if done.returncode:
        sys.exit(f"{shlex.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """ziglang where there is no other compiler."""
    return [] if compiler() else [ZIGLANG]


get_requires_for_build_editable = get_requires_for_build_wheel


def build_wheel(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """A wheel for this kind of machine and any Python 3."""
    tag = f"linux_{platform.machine()}"
    if _is_portable(config_settings):
        build_portable()
        tag = f"manylinux_2_28_{platform.machine()}"
    else:
        build_local()
    options = {"--build-option": ["--python-tag", "py3", "--plat-name", tag]}
    return build_meta.build_wheel(wheel_directory, options, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """The library beside its sources."""
    build_local()
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


def _is_portable(config_settings: Any) -> bool:
    return bool(config_settings) and "portable" in config_settings


if __name__ == "__main__":
    match sys.argv[1:]:
        case []:
            build_local()
        case ["--compiler"]:
            sys.exit(print(shlex.join(compiler() or [])) if compiler() else _NONE)
        case _:
            sys.exit(__doc__)
