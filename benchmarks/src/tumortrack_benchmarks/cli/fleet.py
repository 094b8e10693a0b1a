"""`tumortrack fleet`: a list of patients -> a case, margins and an evaluation of each."""

from __future__ import annotations

import signal
import time
from collections import Counter
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from tyro.conf import Positional

from tumortrack.cli.console import live_line, say
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack.core.store import check_place, writing


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """Prepare and evaluate many patients, on this machine or many; the same command resumes.

    Attributes:
        list: CSV table of patients (docs/fleet.md).
        out: folder to write.
        address: of a Ray cluster (HOST:PORT, or auto on one of its machines); default: this
            machine alone.
        store: folder where results are kept, which all machines see; several runs may share it
            (default: OUT/store).
        cores: of this machine, to use (default: all).
        tries: attempts at a patient whose machine, not whose data, is at fault.
        again: try also what was found to be impossible.
        serial: one patient after the other in this process, without Ray.
    """

    list: Positional[Path]
    out: Positional[Path]
    address: str | None = None
    store: Path | None = None
    cores: int | None = None
    tries: int = 4
    again: bool = False
    serial: bool = False

    def run(self) -> None:
        """Raises InputError: options that exclude each other, or an unusable list, store or
        cluster; TumortrackError: patients failed for reasons that may pass."""
        self._check()
        say("starting ...")
        from tumortrack_benchmarks.fleet.patients import read_list
        from tumortrack_benchmarks.fleet.results import PATIENTS, write_results
        from tumortrack_benchmarks.fleet.run import Outcome, in_turn, on_ray
        from tumortrack_benchmarks.fleet.steps import summary_of

        patients = read_list(self.list)
        inside = {p.name for p in self.out.iterdir()} if self.out.is_dir() else {""}
        if inside - {self.list.name} and not inside & {"store", PATIENTS}:
            check_place(self.out, "", None)  # files there that no fleet wrote
        held = (self.store or self.out / "store").absolute()
        for folder in (self.out, held):
            with writing(folder):
                folder.mkdir(parents=True, exist_ok=True)
        outcomes: dict[str, Outcome] = {}
        about = (
            {one.name: partial(summary_of, one) for one in patients},
            held,
            self.again,
            self.tries,
        )
        made = in_turn(*about) if self.serial else on_ray(*about, self.address, self.cores)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        began_s = time.monotonic()
        with live_line("starting ...") as line:
            try:
                for ended in made:
                    if ended is not None:
                        name, outcome = ended
                        outcomes[name] = outcome
                        if outcome.reason:
                            say(f"{name}: {outcome.step or outcome.state}: {outcome.reason}")
                    states: Counter[str] = Counter(outcome.state for outcome in outcomes.values())
                    line(progress_words(len(patients), states, time.monotonic() - began_s))
            finally:  # after Ctrl-C, too
                write_results(self.out, patients, outcomes, held)
        say(
            f"{len(patients)} patients in {self.out}: {states['done']} done, "
            f"{states['there']} before, {states['cannot']} impossible."
        )
        if failed := states["failed"]:
            raise TumortrackError(
                f"{failed} of {len(patients)} patients failed for reasons that may pass (see "
                "above); the same command tries them again."
            )

    def _check(self) -> None:
        if self.serial and (self.address or self.cores):
            raise InputError("--serial uses this process alone: no --address, no --cores.")
        if self.address and self.cores:
            raise InputError(
                "--cores is of this machine alone; a cluster at --address has its own."
            )
        for name, value in (("cores", self.cores), ("tries", self.tries)):
            if value is not None and value < 1:
                raise InputError(f"--{name} {value} must be at least 1.")
        if self.address and not self.store:
            raise InputError("--address needs --store: a folder that all machines see.")
        if self.store and ":/" in str(self.store):  # a path joins slashes
            raise InputError(
                f"--store {self.store} is no folder; mount the storage, and name that."
            )
        needed = [name for name in ("pyarrow", "ray") if not self.serial or name != "ray"]
        if lacking := [name for name in needed if find_spec(name) is None]:
            raise InputError(
                f"fleet needs {' and '.join(lacking)}: "
                f"{to_install('tumortrack-benchmarks[fleet]')}."
            )


def progress_words(total: int, states: Counter[str], seconds: float) -> str:
    """So many patients, rate and time left."""
    ended, now = states.total(), states.total() - states["there"]
    rate = "time left unknown until the first patient is through"
    if now:
        left = timedelta(seconds=int(seconds / now * (total - ended)))
        rate = f"{3600 * now / seconds:.1f} an hour | {left} left"
    failed = states["cannot"] + states["failed"]
    words = [f"patients {ended}/{total} ({states['there']} before)", rate]
    return " | ".join([*words, f"{failed} failed"] if failed else words)
