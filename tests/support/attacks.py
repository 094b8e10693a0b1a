"""Hostile files and calls: each must end in one clear line, in bounded time and memory.

python tests/support/attacks.py FOLDER [NAME ...]    make them in FOLDER, run them, print a table

With --no-models `prepare` ends when the case is written: to make its model takes 13 s.
The attacks are in attack_*.py, by kind of input.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import attack_artifacts
import attack_clouds
import attack_evidence
import attack_series
import attack_volumes
import warm
from attack import Attack, Room
from harness import Child, Ending, Work, base_in, command

SECONDS, MEGABYTES = 20.0, 1024
_LOADED = 10  # times as long: what takes no time of the processor hangs, or waits for its turn
WITHOUT_BASE = attack_volumes.ATTACKS | attack_series.ATTACKS
ATTACKS = WITHOUT_BASE | attack_clouds.ATTACKS | attack_artifacts.ATTACKS | attack_evidence.ATTACKS


def run(attack: Attack, room: Room, models: bool) -> tuple[Ending, str]:
    """How it ended, and what was wrong with that."""
    room.folder.mkdir(parents=True)
    arguments = attack.make(room)
    before = _files_below(room.folder)
    # What may end well does the whole work, and compiles.
    allowed_s = (1 if attack.end == "refused" else 6) * SECONDS
    work = command(*arguments) if models else _without_models(command(*arguments))
    ending = Child(work, room.folder).end(_LOADED * allowed_s, 4 * MEGABYTES)
    if ending.fault:
        return ending, ending.fault
    if ending.cpu_s > allowed_s / 2:
        return ending, "slow"
    if ending.megabytes > MEGABYTES:
        return ending, "memory"
    # `locate` ends with 4 where an estimate is poor
    if ending.code == 0 or "\nwritten to" in ending.output:
        return ending, "accepted" if attack.end == "refused" else ""
    if attack.end == "read":
        return ending, "refused"
    if len(ending.refusals) != 1 or ending.code == 1:
        return ending, "no clear line"
    left = {os.path.basename(path): path for path in _files_below(room.folder) - before}
    whole = {"report.json"}
    if "index.html" in left:  # why there is no estimate
        whole |= {"index.html", "picture.png", "manifest.json"}
    strays = sorted(left.keys() - whole)
    return ending, f"left {left[strays[0]]}" if strays else ""


def _without_models(work: Work) -> Work:
    def changed() -> int:
        from tumortrack.tracking import model_files

        made = SimpleNamespace(provenance={"validation_far": 0.0})
        model_files.case_model = lambda *_, **__: made  # type: ignore[assignment]
        return work()

    return changed


def _files_below(folder: Path) -> set[str]:
    return {os.path.join(at, name) for at, _, names in os.walk(folder) for name in names}


def main(folder: Path, names: list[str]) -> int:
    models = "--no-models" not in names
    names = [name for name in names if name != "--no-models"] or list(ATTACKS)
    warm.preload()
    folder.mkdir(parents=True, exist_ok=True)
    base = folder / "base" if WITHOUT_BASE.keys() >= {*names} else base_in(folder)
    faults = 0
    with tempfile.TemporaryDirectory(dir=folder) as work:
        for name in names:
            ending, fault = run(ATTACKS[name], Room(Path(work, name), base), models)
            faults += bool(fault)
            print(
                f"{fault or 'ok':14} {name:40} {ending.code:4} {ending.cpu_s:6.2f} s "
                f"{ending.megabytes:6.0f} MB  {ending.line[:150]}",
                flush=True,
            )
    print(f"{len(names)} attacks, {faults} faults")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), sys.argv[2:]))
