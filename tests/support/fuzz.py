"""Damaged input for every reader of files and of bytes from the wire.

python tests/support/fuzz.py [--inputs N] [--target NAME] [--seed N] [--artifacts] [--atheris]

Valid inputs are changed at random places; a reader may read what comes of it or refuse it with a
``TumortrackError``. Any other exception, a crash of the process, 5 s for one input, or memory over
1 GB is a fault; the input that did it is written to runs/fuzz/. The same seed gives the same
inputs; fast readers get more of them. What was done is kept in runs/fuzz/done.json: the same
command goes on there. With --artifacts also folders of models, runs and plans, which are made
first. With --atheris (a package of its own) the inputs are led by the code that they reach.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from fuzz_targets import Target, targets

SECONDS, MEGABYTES = 5, 1024
_BLOCK = 20_000  # inputs between two notes of what was done
_NUMBERS = [0, 1, -1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, -(2**31), 2**32 - 1]
_WORDS = [b"nan", b"inf", b"-1", b"1e308", b"99999999999999999999", b"\n", b" ", b"\0", b"{", b'"']


def changed(seed: bytes, rng: np.random.Generator) -> bytes:
    """The seed with one to eight changes: bits, bytes, numbers, words, pieces moved or missing."""
    data = bytearray(seed)
    for _ in range(int(rng.integers(1, 9))):
        # Headers are where readers decide: every second change is among the first 400 bytes.
        end = max(min(len(data), 400 if rng.random() < 0.5 else len(data)), 1)
        at, kind = int(rng.integers(end)), int(rng.integers(8))
        if kind == 0 and data:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1 and data:
            data[at] = int(rng.integers(256))
        elif kind == 2:
            size, order = int(rng.choice([1, 2, 4, 8])), "<" if rng.random() < 0.7 else ">"
            number = int(rng.choice(_NUMBERS)) & (2 ** (8 * size) - 1)
            code = {1: "B", 2: "H", 4: "I", 8: "Q"}[size]
            data[at : at + size] = struct.pack(order + code, number)
        elif kind == 3:
            value = rng.choice([np.nan, np.inf, -np.inf, 1e30, -1e-30, 0.0])
            data[at : at + 4] = struct.pack("<f", value)
        elif kind == 4:
            data[at:at] = _WORDS[int(rng.integers(len(_WORDS)))]
        elif kind == 5:
            del data[at : at + int(rng.integers(1, 64))]
        elif kind == 6:
            piece = data[at : at + int(rng.integers(1, 64))]
            to = int(rng.integers(len(data) + 1))
            data[to:to] = piece
        elif rng.random() < 0.2:
            del data[at:]
    return bytes(data)


# How they are attacked ------------------------------------------------------------------------


def input_of(seeds: list[bytes], name: str, seed: int, index: int) -> bytes:
    start = int.from_bytes(hashlib.sha256(f"{name} {seed} {index}".encode()).digest()[:8], "big")
    rng = np.random.default_rng(start)
    return changed(seeds[index % len(seeds)], rng)


def _attack(
    name: str, target: Target, seed: int, indices: range, at: mmap.mmap, faults: Any
) -> None:
    """In a fork: one input after the other; ``at`` tells the parent which."""
    from tumortrack.core.errors import TumortrackError

    def late(*_: object) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    for index in indices:
        struct.pack_into("<q", at, 0, index)
        content = input_of(target[0], name, seed, index)
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            target[1](content)
        except TumortrackError:
            pass
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            faults.write(
                json.dumps(
                    [index, f"{type(error).__name__}: {error}", f"{where.filename}:{where.lineno}"]
                )
                + "\n"
            )
            faults.flush()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        if peak > MEGABYTES + struct.unpack_from("<d", at, 8)[0]:
            faults.write(json.dumps([index, f"{peak:.0f} MB of memory", ""]) + "\n")
            faults.flush()
            os._exit(3)


def fuzz(name: str, target: Target, indices: range, seed: int, keep: Path) -> list[tuple[str, str]]:
    """Faults as (what, where), each kind once; the input that did it is kept."""
    at, start, found = mmap.mmap(-1, 16), indices.start, {}
    devnull = os.open(os.devnull, os.O_WRONLY)
    while start < indices.stop:
        with tempfile.TemporaryFile("w+") as faults:
            child = os.fork()
            if not child:
                os.dup2(devnull, 1)
                os.dup2(devnull, 2)
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                struct.pack_into("<d", at, 8, peak)
                code = 2
                try:
                    _attack(name, target, seed, range(start, indices.stop), at, faults)
                    code = 0
                finally:
                    os._exit(code)
            last, since = -1, time.monotonic()
            while True:  # code that never comes back to Python sees no alarm
                ended, status = os.waitpid(child, os.WNOHANG)
                if ended:
                    break
                index = struct.unpack_from("<q", at, 0)[0]
                if index != last:
                    last, since = index, time.monotonic()
                elif time.monotonic() - since > 2 * SECONDS:
                    os.kill(child, signal.SIGKILL)
                time.sleep(0.02)
            faults.seek(0)
            told = [json.loads(line) for line in faults]
        start = indices.stop
        if status:
            last = struct.unpack_from("<q", at, 0)[0]
            code = os.waitstatus_to_exitcode(status)
            if code < 0:
                told.append([last, f"the process ended with {signal.Signals(-code).name}", ""])
            start = last + 1
        for index, what, where in told:
            kind = (what.split(":")[0], where)
            if kind not in found:
                found[kind] = (what, where)
                keep.mkdir(parents=True, exist_ok=True)
                content = input_of(target[0], name, seed, index)
                (keep / f"{name.replace(' ', '-')}-{index}").write_bytes(content)
    return list(found.values())


def _led_by_coverage(name: str, inputs: int) -> None:
    import atheris

    import tumortrack
    from tumortrack.core.errors import TumortrackError

    root = Path(tumortrack.__file__).parent
    kernels = [  # numba compiles these as they are written
        ".".join(("tumortrack", *path.relative_to(root).with_suffix("").parts))
        for path in root.rglob("*.py")
        if "import njit" in path.read_text()
    ]
    with atheris.instrument_imports(include=["tumortrack"], exclude=kernels):
        seeds, read = targets()[name]
    corpus = Path(tempfile.mkdtemp())
    for n, seed in enumerate(seeds):
        (corpus / str(n)).write_bytes(seed)

    def one(content: bytes) -> None:
        with suppress(TumortrackError):
            read(content)

    options = [f"-runs={inputs}", f"-timeout={SECONDS}", f"-rss_limit_mb={4 * MEGABYTES}"]
    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atheris.Fuzz()


def shares(chosen: dict[str, Target], inputs: int, seed: int, keep: Path) -> dict[str, int]:
    """Inputs for each, by the square root of its speed: slow readers get fewer, but no few."""
    weights = {}
    for name, target in chosen.items():
        fuzz(name, target, range(1), seed, keep)  # compiles what is compiled
        started = time.perf_counter()
        fuzz(name, target, range(50), seed, keep)
        weights[name] = (time.perf_counter() - started) ** -0.5
    whole = sum(weights.values())
    return {name: math.ceil(inputs * weight / whole) for name, weight in weights.items()}


def go_on(chosen: dict[str, Target], inputs: int, seed: int, keep: Path) -> int:
    """Up to so many inputs over all targets, from where the last call ended; the faults."""
    keep.mkdir(parents=True, exist_ok=True)
    path, run = keep / "done.json", f"{inputs} inputs, seed {seed}, {len(chosen)} targets"
    state = json.loads(path.read_text()) if path.is_file() else {}
    if state.get("run") != run:
        counts = shares(chosen, inputs, seed, keep)
        done = {name: {"of": n, "inputs": 0, "faults": []} for name, n in counts.items()}
        state = {"run": run, "targets": done}
    for name, one in state["targets"].items():
        started, before = time.perf_counter(), one["inputs"]
        while one["inputs"] < one["of"]:
            indices = range(one["inputs"], min(one["inputs"] + _BLOCK, one["of"]))
            found = fuzz(name, chosen[name], indices, seed, keep)
            one["faults"] += [list(fault) for fault in found if list(fault) not in one["faults"]]
            one["inputs"] = indices.stop
            path.write_text(json.dumps(state, indent=1))
        rate = (one["inputs"] - before) / (time.perf_counter() - started)
        print(f"{name:24} {one['inputs']:9,} inputs {rate:8,.0f} a second", flush=True)
        for what, where in one["faults"]:
            print(f"    {what[:110]}  {where}", flush=True)
    total = sum(one["inputs"] for one in state["targets"].values())
    wrong = sum(len(one["faults"]) for one in state["targets"].values())
    print(f"{total:,} inputs, {len(chosen)} targets, {wrong} faults")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description="damaged input for every reader")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="over all targets")
    parser.add_argument("--target", default="", help="this one alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--artifacts", action="store_true", help="those that need a model, too")
    parser.add_argument("--atheris", action="store_true", help="led by coverage; needs --target")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"))
    given = parser.parse_args()
    if given.atheris:
        _led_by_coverage(given.target, given.inputs)
    base = given.keep.resolve() / "base" if given.artifacts else None
    if base is not None and not base.exists():
        from attacks import make_base

        base.mkdir(parents=True)
        make_base(base)
    chosen = {k: v for k, v in targets(base).items() if given.target in ("", k)}
    return bool(go_on(chosen, given.inputs, given.seed, given.keep))


if __name__ == "__main__":
    sys.exit(main())
