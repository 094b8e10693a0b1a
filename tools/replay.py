# ruff: noqa: E402
"""Has any number changed? Digests of scenes, weights, estimates, plans and help texts.

python tools/replay.py record FILE.json     before a change of the code
python tools/replay.py compare FILE.json    after it, on the same machine; exit status 1 where any
                                            digest differs

Timings are left out, as are versions and the hashes of files that hold timings. The tetrahedra that
the twin's solver needs are never twice alike: one solved state is kept in replay-state/ beside
FILE.json, and its scenes are made from that. Remove it where the phantom's surfaces have changed.
"""

from __future__ import annotations

import os

# Sums depend on the number of threads, help texts on the terminal.
THREADS = ("OMP", "OPENBLAS", "MKL", "NUMBA")
os.environ.update({f"{name}_NUM_THREADS": "1" for name in THREADS})
os.environ.update(COLUMNS="100", NO_COLOR="1", TERM="dumb", CUDA_VISIBLE_DEVICES="")

import argparse
import hashlib
import json
import platform
import sys
import tempfile
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from replay_entries import SECTIONS, twin, under  # imports the package: after the settings

TRAINED = {"quick", "paper"}
# Of JSON: timings, and hashes of files that hold timings.
VOLATILE = {"timings", "training_s", "seconds", "tumortrack", "model_sha256", "inputs"}


def digest(value: object) -> str:
    """Of an array with its type and shape, of bytes, or of what JSON can say."""
    if isinstance(value, torch.Tensor):
        value = value.numpy(force=True)
    if isinstance(value, np.ndarray):
        value = f"{value.dtype} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes()
    if not isinstance(value, bytes):
        value = json.dumps(steady(value), sort_keys=True).encode()
    return hashlib.sha256(value).hexdigest()


def steady(value: Any) -> Any:
    """JSON without what changes from run to run; a manifest's table of files without hashes."""
    if isinstance(value, dict):
        kept = {key: steady(inner) for key, inner in value.items() if key not in VOLATILE}
        return {**kept, "files": sorted(kept["files"])} if "files" in kept else kept
    return [steady(inner) for inner in value] if isinstance(value, list | tuple) else value


def digests(sections: Iterable[str], states: Path, recording: bool) -> dict[str, str]:
    entries: dict[str, str] = {}
    made_by = {**SECTIONS, "twin": partial(twin, states, recording)}
    with tempfile.TemporaryDirectory() as work:
        os.chdir(work)  # what is written names folders: the same ones every time
        for name in sections:
            start = time.perf_counter()
            made = {key: digest(value) for key, value in under(name, made_by[name]())}
            entries |= made
            print(f"{name}: {len(made)} in {time.perf_counter() - start:.0f} s", flush=True)
        os.chdir("/")
    return entries


def compare(entries: dict[str, str], recorded: dict[str, str]) -> int:
    """Exit status; only sections that ran are compared."""
    ran = {key.split("/")[0] for key in entries}
    known = {key: value for key, value in recorded.items() if key.split("/")[0] in ran}
    differing = sorted(key for key in entries | known if entries.get(key) != known.get(key))
    for key in differing:
        print(f"{'new' if key not in known else 'differs' if key in entries else 'missing'}: {key}")
    equal = len(entries | known) - len(differing)
    print(f"{equal} entries equal, {len(differing)} differ")
    return 1 if differing else 0


def main() -> int:
    parser = argparse.ArgumentParser(description="Has any number changed?")
    parser.add_argument("action", choices=("record", "compare", "either"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--quick", action="store_true", help="without the presets quick and paper")
    names = [*SECTIONS, "twin"]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    given = parser.parse_args()
    file, action = given.file.absolute(), given.action
    recording = action == "record" or (action == "either" and not file.exists())
    print(f"{'recording' if recording else 'comparing with'} {file}", flush=True)
    recorded = {} if recording else json.loads(file.read_bytes())
    versions = f"{platform.python_version()}, torch {torch.__version__}, numpy {np.__version__}"
    machine = f"{platform.node()}, {platform.machine()}, python {versions}"
    if not recording and recorded["machine"] != machine:
        print(f"ANOTHER MACHINE OR LIBRARY: {recorded['machine']}; this is {machine}", flush=True)
    chosen = [name for name in given.only if not (given.quick and name in TRAINED)]
    entries = digests(chosen, file.parent / "replay-state", recording)
    if not recording:
        return compare(entries, recorded["entries"])
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"machine": machine, "entries": entries}, indent=1))
    print(f"{len(entries)} entries recorded")
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # native libraries complain at length when they are taken down
