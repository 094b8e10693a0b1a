"""Damaged input for every reader of files and of bytes from the wire.

python tests/support/fuzz.py [--inputs N] [--target NAME] [--seed N] [--artifacts]

Valid inputs are changed at random places; a reader may read what comes of it or refuse it with a
``TumortrackError``. Any other exception, a crash of the process, 5 s for one input, or memory over
1 GB is a fault; the input that did it is written to runs/fuzz/. The same seed gives the same
inputs; fast readers get more of them. What was done is kept in runs/fuzz/done.json: the same
command goes on there. With --artifacts also folders of models, runs and plans, which are made
first.
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
import time
import traceback
from pathlib import Path

import numpy as np

from fuzz_targets import Target, targets
from harness import Child, base_in

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


def input_of(seeds: list[bytes], name: str, seed: int, index: int) -> bytes:
    start = int.from_bytes(hashlib.sha256(f"{name} {seed} {index}".encode()).digest()[:8], "big")
    rng = np.random.default_rng(start)
    return changed(seeds[index % len(seeds)], rng)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _read_all(name: str, target: Target, seed: int, indices: range, at: mmap.mmap) -> int:
    """One input after the other; ``at`` tells the parent which. Faults are printed, as JSON."""
    from tumortrack.core.errors import TumortrackError

    def late(*_: object) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    faults = os.fdopen(os.dup(1), "w", buffering=1)
    for stream in (1, 2):  # what readers print
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    signal.signal(signal.SIGALRM, late)
    most_mb = _peak_mb() + MEGABYTES
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
            what = f"{type(error).__name__}: {error}"
            print(json.dumps([index, what, f"{where.filename}:{where.lineno}"]), file=faults)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        if _peak_mb() > most_mb:
            print(json.dumps([index, f"{_peak_mb():.0f} MB of memory", ""]), file=faults)
            return 3
    return 0


def fuzz(name: str, target: Target, indices: range, seed: int, keep: Path) -> list[tuple[str, str]]:
    """Faults as (what, where), each kind once; the input that did it is kept."""
    at, start, faults = mmap.mmap(-1, 8), indices.start, {}

    def reached() -> int:
        return int(struct.unpack_from("<q", at)[0])

    def work() -> int:
        return _read_all(name, target, seed, range(start, indices.stop), at)

    while start < indices.stop:
        # Code that never comes back to Python sees no alarm.
        ending = Child(work).end(2 * SECONDS, progress=reached)
        printed = [json.loads(line) for line in ending.output.splitlines()]
        start = indices.stop
        if ending.code:
            start = reached() + 1
            if ending.code < 0:
                what = f"the process ended with {signal.Signals(-ending.code).name}"
                printed.append([reached(), what, ""])
        for index, what, where in printed:
            kind = (what.split(":")[0], where)
            if kind not in faults:
                faults[kind] = (what, where)
                keep.mkdir(parents=True, exist_ok=True)
                content = input_of(target[0], name, seed, index)
                (keep / f"{name.replace(' ', '-')}-{index}").write_bytes(content)
    return list(faults.values())


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
    path, run = keep / "done.json", f"{inputs} inputs, seed {seed}, of {', '.join(chosen)}"
    state = json.loads(path.read_text()) if path.is_file() else {}
    if state.get("run") != run:
        counts = shares(chosen, inputs, seed, keep)
        done = {name: {"of": n, "inputs": 0, "faults": []} for name, n in counts.items()}
        state = {"run": run, "targets": done}
    for name, target in state["targets"].items():
        started, before = time.perf_counter(), target["inputs"]
        while target["inputs"] < target["of"]:
            indices = range(target["inputs"], min(target["inputs"] + _BLOCK, target["of"]))
            faults = map(list, fuzz(name, chosen[name], indices, seed, keep))
            target["faults"] += [fault for fault in faults if fault not in target["faults"]]
            target["inputs"] = indices.stop
            path.write_text(json.dumps(state, indent=1))
        rate = (target["inputs"] - before) / (time.perf_counter() - started)
        print(f"{name:24} {target['inputs']:9,} inputs {rate:8,.0f} a second", flush=True)
        for what, where in target["faults"]:
            print(f"    {what[:110]}  {where}", flush=True)
    total = sum(target["inputs"] for target in state["targets"].values())
    wrong = sum(len(target["faults"]) for target in state["targets"].values())
    print(f"{total:,} inputs, {len(chosen)} targets, {wrong} faults")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description="damaged input for every reader")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="over all targets")
    parser.add_argument("--target", default="", help="this one alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--artifacts", action="store_true", help="those that need a model, too")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"))
    given = parser.parse_args()
    base = base_in(given.keep) if given.artifacts else None
    chosen = {k: v for k, v in targets(base).items() if given.target in ("", k)}
    return bool(go_on(chosen, given.inputs, given.seed, given.keep))


if __name__ == "__main__":
    sys.exit(main())
