"""The packages that this one stands on: locked by hash, their licences, what a wheel brings along.

tools/dependencies.py lock [--upgrade]   requirements/*.txt, of pyproject.toml's ranges
tools/dependencies.py wheels             refuses a pin without a wheel where it is wanted
tools/dependencies.py licences           refuses a licence that is not allowed
tools/dependencies.py table              docs/data/dependencies.csv
tools/dependencies.py sbom WHEEL         CycloneDX 1.6 beside a wheel: WHEEL.cdx.json
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCKS = ROOT / "requirements"
TABLE = ROOT / "docs" / "data" / "dependencies.csv"
OWN = [
    "tumortrack",
    *(f"tumortrack-{n}" for n in ("devices", "occupancy", "resection", "benchmarks", "experiment")),
]
_APART = {"ur-rtde": "ur"}  # in a file of its own: `make setup` leaves it out

# Licences that ask for no more than to be named, and those that bind only changes of the package
# itself (MPL, EPL) or its own exchange (LGPL): all of them are imported, none is copied.
ALLOWED = {
    "0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSD", "BSL-1.0", "CC0-1.0", "EPL-2.0",
    "ISC", "LGPL", "LLVM-exception", "MIT", "MIT-CMU", "MPL-2.0", "PSF-2.0", "Qhull", "Unlicense",
    "Zlib",
}  # fmt: skip
# What packages say that say it otherwise.
MESSAGES = {
    "apache software license": "Apache-2.0", "apache 2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0", "apache license, version 2.0": "Apache-2.0",
    "bsd license": "BSD", "3-clause bsd license": "BSD-3-Clause", "isc license (iscl)": "ISC",
    "mit license": "MIT", "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "python software foundation license": "PSF-2.0", "zlib license": "Zlib",
    "epl-2.0, bsd-3-clause": "EPL-2.0 OR BSD-3-Clause", "osi approved": "",
}  # fmt: skip
# With the reason, as found in their licence file.
STATED = {
    "apsw": "Zlib",  # "any-OSI" in its metadata; LICENSE: the zlib licence
    "cmeel-qhull": "Qhull",  # nothing in its metadata; COPYING.txt: free, with attribution
    "embreex": "BSD-2-Clause",  # its metadata holds the licence's text
    "ros-fastcdr": "Apache-2.0",  # nothing in its metadata; LICENSE
    "ros-fastrtps": "Apache-2.0",  # the same
}


def lock(upgrade: list[str]) -> None:
    """Resolve everything for every platform, and keep what is pinned unless told to upgrade."""
    folders = (ROOT, *(ROOT / name.removeprefix("tumortrack-") for name in OWN[1:]))
    everything = "".join(f"-e {folder}[{_extras(folder)}]\n" for folder in folders)
    about = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    build, clients = about["build-system"]["requires"], about["dependency-groups"]["clients"]
    both = _resolved("\n".join([everything, *clients]), "".join(_locks().values()), upgrade)
    resolved = _resolved(everything, both, [])  # as resolved with the clients
    core = pinned(_resolved("\n".join([f"-e {ROOT}", *build]), resolved, []))  # as resolved
    files: dict[str, list[str]] = {name: [] for name in _ABOUT}
    ours = pinned(resolved)
    for name, text in {**pinned(both), **ours}.items():
        rest = "core" if name in core else _APART.get(name, "rest" if name in ours else "clients")
        files["cuda" if re.match(r"nvidia-|cuda-|triton$", name) else rest].append(text)
    for name, texts in files.items():
        head = f"# {_ABOUT[name]} Made by `make lock`; ranges are in pyproject.toml.\n"
        (LOCKS / f"{name}.txt").write_text(head + "".join(texts), "utf-8")

    tools = LOCKS / "tools.txt"
    kept = tools.read_text("utf-8") if tools.exists() else ""
    tools.write_text(
        text := _resolved("uv\npip-audit\ntwine\nziglang\nauditwheel\n", kept, upgrade), "utf-8"
    )
    (LOCKS / "uv.txt").write_text(pinned(text)["uv"], "utf-8")  # what `make setup` installs with
    (LOCKS / "compiler.txt").write_text(pinned(text)["ziglang"], "utf-8")  # where there is none


# What is supported: each Python on each kind of Linux machine, from glibc 2.28 on.
_PYTHONS = ("3.11.0", "3.12.0", "3.13.0", "3.14.0")
_PLATFORMS = ("x86_64-manylinux_2_28", "aarch64-manylinux_2_28")
_NEEDS_NO_WHEEL = "crcmod"  # pure Python where there is no compiler


def without_wheels() -> list[str]:
    """What uv says where a pin has no wheel; nothing is installed, PyPI is asked."""
    wrong = []
    names = [name for name in _ABOUT if name not in ("ur", "clients")]
    files = [word for name in names for word in ("-r", str(LOCKS / f"{name}.txt"))]
    options = ["--dry-run", "--no-deps", "--only-binary", ":all:", "--no-binary", _NEEDS_NO_WHEEL]
    for python, platform in itertools.product(_PYTHONS, _PLATFORMS):
        where = ["--python-version", python, "--python-platform", platform, "--target", "build"]
        command = ["uv", "pip", "install", "--quiet", *options, *where, *files]
        run = subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)
        if run.returncode:
            wrong.append(f"Python {python}, {platform}: {run.stderr.strip()}")
    return wrong


def _extras(folder: Path) -> str:
    project = tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]
    return ",".join(project.get("optional-dependencies", ()))


def _resolved(wanted: str, kept: str, upgrade: list[str]) -> str:
    """A lock file of these requirements, its versions as in ``kept`` where that is possible."""
    own = [word for name in OWN for word in ("--no-emit-package", name)]
    options = ["--universal", "--python-version", "3.11.0", "--generate-hashes", "--no-header"]
    with tempfile.TemporaryDirectory() as folder:
        source, made = Path(folder) / "in.txt", Path(folder) / "out.txt"
        source.write_text(wanted, "utf-8")
        made.write_text(kept, "utf-8")
        command = ["uv", "pip", "compile", str(source), "-o", str(made), "--quiet", "--no-annotate"]
        subprocess.run([*command, *options, *own, *upgrade], check=True, cwd=ROOT)
        return made.read_text("utf-8")


_ABOUT = {
    "core": "The tracker alone, by hash: what `make demo` installs.",
    "rest": "All else that `make setup` installs: PyTorch, extras, benchmarks, tests, site.",
    "cuda": "What PyPI's PyTorch for Linux needs besides; its CPU build does not.",
    "clients": "What `make clients` installs besides: other makers' programs that tests talk to.",
    "ur": "For real arms: pip install --require-hashes --no-deps -r requirements/ur.txt",
}


def _locks() -> dict[str, str]:
    paths = {name: LOCKS / f"{name}.txt" for name in _ABOUT}
    return {name: path.read_text("utf-8") for name, path in paths.items() if path.exists()}


def pinned(text: str) -> dict[str, str]:
    """Each package's lines in a lock file, by its canonical name."""
    blocks: dict[str, str] = {}
    for block in re.findall(r"^[A-Za-z0-9].*\n(?:    .*\n)*", text, re.MULTILINE):
        requirement = Requirement(re.split(r"\s*\\?\n", block)[0].rstrip(" \\"))
        blocks[canonicalize_name(requirement.name)] = block
    return blocks


def versions() -> dict[str, tuple[str, list[str]]]:
    """Version and SHA-256 digests of everything locked, by canonical name."""
    locked = {}
    for text in _locks().values():
        for name, block in pinned(text).items():
            requirement = Requirement(block.splitlines()[0].rstrip(" \\"))
            version = next(iter(requirement.specifier)).version
            locked[name] = version, re.findall(r"--hash=sha256:([0-9a-f]{64})", block)
    return locked


def needed(
    name: str, extras: set[str], seen: dict[str, Distribution] | None = None
) -> dict[str, Distribution]:
    """What is installed of all that a package needs here, directly or not, by canonical name."""
    seen = {} if seen is None else seen
    try:
        package = distribution(name)
    except PackageNotFoundError:
        return seen  # for another platform, or of an extra that is not installed
    key = canonicalize_name(name)
    if key in seen and not extras:
        return seen
    seen[key] = package
    for requirement in map(Requirement, package.requires or ()):
        marker = requirement.marker
        holds = marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras))
        if holds and (canonicalize_name(requirement.name) not in seen or requirement.extras):
            needed(requirement.name, set(requirement.extras), seen)
    return seen


def everything() -> dict[str, Distribution]:
    """All that is installed of what is locked, but CUDA's packages: NVIDIA's own licence allows
    their use, PyPI's PyTorch asks for them, and nothing here imports them."""
    packages = {}
    ours = [pinned(text) for file, text in _locks().items() if file != "cuda"]
    for name in (name for pins in ours for name in pins):
        try:
            packages[name] = distribution(name)
        except PackageNotFoundError:
            continue  # for another platform, or not part of `make setup`
    return packages


def licence(package: Distribution) -> str:
    """An SPDX expression, or whatever the package says; empty: it says nothing."""
    about = package.metadata
    name = canonicalize_name(about["Name"])
    if name in STATED:
        return STATED[name]
    if expression := about.get("License-Expression"):
        return str(expression)
    classifiers = about.get_all("Classifier") or []
    classes = [text.split(" :: ")[-1] for text in classifiers if text.startswith("License :: ")]
    words = classes or [str(about.get("License") or "").strip().partition("\n")[0]]
    names = [MESSAGES.get(word.lower(), word) for word in words]
    return " AND ".join(dict.fromkeys(filter(None, names)))


def is_allowed(expression: str) -> bool:
    """Whether each licence of an expression is allowed, or one of each OR; all of them where there
    are brackets, which are not taken apart."""
    ways = [
        all(part.strip("() ") in ALLOWED for part in re.split(r"\bAND\b|\bWITH\b", way))
        for way in re.split(r"\bOR\b", expression)
    ]
    return all(ways) if "(" in expression else any(ways)


def table() -> str:
    """CSV: package, version, licence."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("package", "version", "licence"))
    for _, package in sorted(everything().items()):
        rows.writerow((package.metadata["Name"], version_of(package), licence(package)))
    return text.getvalue()


def version_of(package: Distribution) -> str:
    return package.version.split("+")[0]


def sbom(wheel: Path) -> dict[str, Any]:
    """A software bill of materials of a built wheel: what it needs, with all extras (CycloneDX
    1.6, https://cyclonedx.org/docs/1.6/json/)."""
    name, version = wheel.name.split("-")[:2]
    name, locked = canonicalize_name(name), versions()
    extras = set(distribution(name).metadata.get_all("Provides-Extra") or ()) - {"dev", "docs"}
    packages = needed(name, extras)
    packages.pop(name)

    def part(key: str, title: str, version: str, licence: dict[str, Any]) -> dict[str, Any]:
        about = {"type": "library", "name": title, "version": version, "bom-ref": key}
        return {**about, "purl": f"pkg:pypi/{key}@{version}", "licenses": [licence]}

    components = []
    for key, package in sorted(packages.items()):
        stated, version_needed = {"name": licence(package)}, version_of(package)
        made = part(key, package.metadata["Name"], version_needed, {"license": stated})
        digests = locked[key][1] if key in locked else []
        made["externalReferences"] = [{
            "type": "distribution", "url": f"https://pypi.org/project/{key}/{version_needed}/",
            "hashes": [{"alg": "SHA-256", "content": digest} for digest in digests],
        }]  # fmt: skip
        components.append(made)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": part(name, name, version, {"expression": "Apache-2.0"})},
        "components": components,
        "dependencies": [{"ref": name, "dependsOn": sorted(packages)}],
    }


def main(arguments: list[str]) -> int:
    match arguments:
        case ["lock", *upgrade]:
            lock(upgrade)
        case ["wheels"]:
            wrong = without_wheels()
            print("\n".join(wrong) or "every pin has a wheel for every Python and machine")
            return len(wrong) > 0
        case ["licences"]:
            said = {name: licence(package) for name, package in everything().items()}
            refused = {name: words for name, words in said.items() if not is_allowed(words)}
            for name, words in refused.items():
                print(f"{name}: the licence {words or 'is not stated, which'!r} is not allowed")
            return len(refused) > 0
        case ["table"]:
            TABLE.write_text(table(), "utf-8")
        case ["sbom", *wheels] if wheels:
            for wheel in map(Path, wheels):
                made = wheel.with_suffix(".cdx.json")
                made.write_text(json.dumps(sbom(wheel), indent=1) + "\n", "utf-8")
                print(made)
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
