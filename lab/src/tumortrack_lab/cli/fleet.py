"""`tumortrack fleet`: a list of patients -> a case, margins and an evaluation of each."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import console, live_line, say
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack.core.store import check_place

if TYPE_CHECKING:
    from tumortrack_lab.fleet.engine import Outcome, Status
    from tumortrack_lab.fleet.list import Patient
    from tumortrack_lab.fleet.task import Task


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """Prepare and evaluate many patients, on this machine or many; the same command resumes.

    Attributes:
        list: CSV table of patients (docs/fleet.md).
        out: folder to write.
        address: of a Ray cluster (HOST:PORT, or auto on one of its machines); default: this
            machine alone.
        store: where results are kept, a folder or a URL such as s3://bucket/folder, which all
            machines see; several runs may share it (default: OUT/store).
        cores: of this machine, to use (default: all).
        tries: attempts at a task whose machine, not whose patient, is at fault.
        again: try also what was found to be impossible.
        serial: one task after the other in this process, without Ray.
    """

    list: Positional[Path]
    out: Positional[Path]
    address: str | None = None
    store: str | None = None
    cores: int | None = None
    tries: int = 4
    again: bool = False
    serial: bool = False

    def run(self) -> None:
        """Raises InputError: options that exclude each other, or an unusable list, store or
        cluster; TumortrackError: patients failed for reasons that may pass."""
        self._check()
        say("starting ...")
        from tumortrack_lab.fleet.engine import run
        from tumortrack_lab.fleet.executors import OnRay, Serial
        from tumortrack_lab.fleet.list import read_list
        from tumortrack_lab.fleet.results import PATIENTS, write_results
        from tumortrack_lab.fleet.store import Store

        patients = read_list(self.list)
        inside = {p.name for p in self.out.iterdir()} if self.out.is_dir() else {""}
        if inside - {self.list.name} and not inside & {"store", PATIENTS}:
            check_place(self.out, "", None)  # files there that no fleet wrote
        self.out.mkdir(parents=True, exist_ok=True)
        store = Store(self.store or str(self.out / "store"))
        store.open()
        outcomes: dict[str, Outcome] = {}
        wanted = [partial(_wanted, patient) for patient in patients]
        executor = Serial() if self.serial else OnRay(self.address, self.cores)
        _say_dashboard(getattr(executor, "dashboard", ""))
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # Ray's handler ends the process
        with live_line("starting ...") as line:

            def show(status: Status) -> None:
                if status.note:
                    say(status.note)
                    status.note = ""
                line(progress_words(status))

            try:
                for outcome in run(wanted, store, executor, self.tries, self.again, show):
                    outcomes[outcome.task.patient] = outcome
                    if outcome.reason:
                        say(f"{outcome.task.patient}: {outcome.step}: {outcome.reason}")
            finally:  # after Ctrl-C, too
                write_results(self.out, patients, outcomes, store)
        states = [outcome.state for outcome in outcomes.values()]
        say(
            f"{len(patients)} patients in {self.out}: {states.count('done')} done, "
            f"{states.count('there')} before, {states.count('cannot')} impossible."
        )
        if failed := states.count("failed"):
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
        if self.cores is not None and self.cores < 1:
            raise InputError(f"--cores {self.cores} must be at least 1.")
        if self.tries < 1:
            raise InputError(f"--tries {self.tries} must be at least 1.")
        if self.address and not self.store:
            raise InputError("--address needs --store: a folder or URL that all machines see.")
        needed = [name for name in ("fsspec", "pyarrow", "ray") if not self.serial or name != "ray"]
        if lacking := [name for name in needed if find_spec(name) is None]:
            raise InputError(
                f"fleet needs {' and '.join(lacking)}: {to_install('tumortrack-lab[fleet]')}."
            )


def _say_dashboard(address: str) -> None:
    """Say where Ray's dashboard is, if it has one. Its token lets others start programs here, so it
    is shown only on a terminal."""
    if not address or find_spec("aiohttp_cors") is None:  # of ray[default]
        return
    token = os.environ.get("RAY_AUTH_TOKEN", "")
    asked = f"; it asks for this token: {token}" if token and console.is_terminal else ""
    say(f"Ray's dashboard: http://{address}{asked}")


def _wanted(patient: Patient) -> Task:
    from tumortrack_lab.fleet.steps import chain

    return chain(patient)["summary"]


def progress_words(status: Status) -> str:
    rate = "time left unknown until the first patient is through"
    if (seconds := status.seconds_left) is not None:
        minutes, rest = divmod(int(seconds), 60)
        rate = f"{status.per_hour:.1f} an hour | {minutes // 60}:{minutes % 60:02d}:{rest:02d} left"
    words = [
        f"patients {status.wanted}/{status.total} ({status.there} before)",
        rate,
        f"{status.running} tasks under way",
        f"{status.done} done",
    ]
    if status.failed or status.retried:
        words.append(f"{status.failed} failed, {status.retried} tried again")
    return " | ".join(words)
