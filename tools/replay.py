"""Has any answer changed, by how many mm?

python tools/replay.py compare       with the 500 answers in runs/replay.json, which are recorded
                                     where that file is missing: the largest difference of a place,
                                     of a bound, of other figures, and verdicts that changed; exit
                                     status 1 where anything differs
python tools/replay.py fingerprint   the 30 answers that come with the package, whose hash is the
                                     method's version: kept while each place lies within 0.05 mm of
                                     what is recorded, else recorded again
python tools/replay.py check         the same, but exit status 1 instead of a new record
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # what imports it keeps its environment
    # Sums depend on the number of threads.
    names = "OMP", "OPENBLAS", "MKL", "TUMORTRACK"
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in names})
    os.environ.update(COLUMNS="100", NO_COLOR="1", TERM="dumb", CUDA_VISIBLE_DEVICES="")

import argparse
import json
import math
import platform
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from answers import Answer, Numbers, answers, network, plan

from tumortrack.cli.console import progress_bar

ROOT = Path(__file__).parents[1]
LATEST = ROOT / "runs/replay.json"
KEPT = ROOT / "src/tumortrack/assessment/answers.json"
SAME_MM = 0.05  # far above what processors differ by, far below what anybody measures
SAME_SHARE = 0.02  # of a figure of an answer's fit
SAME_INPUT_MM = 0.01
SHORT = (3, 4, 2, 1)  # 15 clouds, 4 images, 8 with evidence, 3 frames


def asked(some: Iterable[Answer]) -> dict[str, Numbers]:
    """Their numbers."""
    some, made, start = list(some), dict[str, Numbers](), time.perf_counter()
    with progress_bar("answers", len(some)) as advance:
        for name, ask in some:
            made[name] = ask()
            advance()
    print(f"{len(made)} answers in {time.perf_counter() - start:.0f} s", flush=True)
    return made


def everything() -> Iterable[Answer]:
    yield from answers(40, 100, 30, 4)
    yield "plan", plan
    yield "network", network


def farthest_mm(made: Numbers, known: Numbers) -> float:
    """Between corresponding places; infinite where one has another number of them."""
    places, before = (np.reshape(each.get("places_mm", ()), (-1, 3)) for each in (made, known))
    if places.shape != before.shape:
        return math.inf
    return float(np.linalg.norm(places - before, axis=1).max(initial=0.0))


def largest(made: Numbers, known: Numbers, key: str, share: bool) -> float:
    """Difference of values by name; ``share``: of the larger one."""
    here, there = made.get(key, {}), known.get(key, {})
    if here.keys() != there.keys():
        return math.inf
    pairs = ((here[name], there[name]) for name in here)
    off = (abs(a - b) / (max(abs(a), abs(b), 1e-6) if share else 1.0) for a, b in pairs)
    return max(off, default=0.0)


MEASURES: dict[str, Callable[[Numbers, Numbers], float]] = {
    "places, mm": farthest_mm,
    "bounds, mm": lambda made, known: largest(made, known, "bounds_mm", False),
    "other figures, share": lambda made, known: largest(made, known, "figures", True),
}


def compare(made: dict[str, Numbers], known: dict[str, Numbers]) -> bool:
    """Say what differs; whether nothing does."""
    both = [name for name in made if name in known]
    print(f"{len(both)} answers compared, {len(made.keys() ^ known.keys())} without a counterpart")
    moved = [n for n in both if largest(made[n], known[n], "input_mm", False) > SAME_INPUT_MM]
    if moved:
        print(f"the question of {len(moved)} differs, so their answers may: {moved[0]}, ...")
    worst = dict[tuple[str, str], float]()
    for kind in dict.fromkeys(name.partition("/")[0] for name in both):
        for what, measure in MEASURES.items():
            mine = (name for name in both if name.partition("/")[0] == kind)
            off = {name: measure(made[name], known[name]) for name in mine}
            where = max(off, key=lambda name: off[name])  # infinite: other places or figures
            worst[kind, what] = off[where]
            over = sum(value > SAME_MM for value in off.values())
            print(f"{kind}: {what} {worst[kind, what]:.3g} ({where}), over {SAME_MM:g} in {over}")
    pairs = Counter((known[n].get("verdict"), made[n].get("verdict")) for n in both)
    verdicts = {pair: count for pair, count in pairs.items() if pair[0] != pair[1]}
    for (before, now), count in sorted(verdicts.items(), key=lambda pair: -pair[1]):
        print(f"verdicts: {count} times {before} -> {now}")
    return not verdicts and not any(worst.values()) and made.keys() == known.keys()


def stands(made: dict[str, Numbers], known: dict[str, Numbers]) -> bool:
    """Whether the recorded answers are still the method's."""
    return made.keys() == known.keys() and all(
        farthest_mm(made[name], known[name]) <= SAME_MM
        and largest(made[name], known[name], "figures", True) <= SAME_SHARE
        for name in made
    )


def written(path: Path, answers: dict[str, Numbers], **about: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(each)}" for name, each in answers.items())
    head = "".join(f"{json.dumps(name)}: {json.dumps(value)},\n" for name, value in about.items())
    path.write_text(f'{{{head}"answers": {{\n{lines}\n}}}}\n')


def main() -> int:
    parser = argparse.ArgumentParser(description="Has any answer changed, by how many mm?")
    parser.add_argument("action", choices=("compare", "fingerprint", "check"))
    action = parser.parse_args().action
    short = action != "compare"
    file = KEPT if short else LATEST
    with tempfile.TemporaryDirectory() as work:
        os.chdir(work)  # what is written names folders: the same ones every time
        made = asked(answers(*SHORT) if short else everything())
        os.chdir("/")
    machine = f"{platform.machine()}, python {platform.python_version()}, numpy {np.__version__}"
    if not (short or file.exists()):
        written(file, made, machine=machine)
        print(f"recorded in {file}")
        return 0
    stored = json.loads(file.read_bytes())
    same = compare(made, stored["answers"])
    if not short:
        if stored["machine"] != machine:
            print(f"ANOTHER MACHINE OR LIBRARY: {stored['machine']}; this is {machine}")
        return 0 if same else 1
    if stands(made, stored["answers"]):
        print("the fingerprint stands")
        return 0
    if action == "check":
        print("another method: `make fingerprint` records it; tables of the former one must go")
        return 1
    written(file, made)
    print(f"recorded again in {file}: tables of the former method go, or are made again")
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # native libraries complain at length when they are taken down
