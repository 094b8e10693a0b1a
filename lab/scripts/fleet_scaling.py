"""What the fleet's engine costs: measured with small tasks, and on paper for many patients.

    make scaling ARGS="[--list LIST --store OUT/store] [--patients 1000 1000000]"

Tasks that only wait show what the engine adds on 1, 2, 4 and 8 workers, on few cores too; tasks
that compute show the cores. A driver alone, whose tasks are nobody's, shows its own time and
memory. With --list and --store, what a finished fleet's patients cost is averaged and laid out on
paper. Both fill their blocks in docs/fleet.md, and write tables beside it.
"""

from __future__ import annotations

import hashlib
import os
import resource
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from tumortrack.cli.console import say
from tumortrack.core.errors import InputError
from tumortrack_lab.fleet.engine import run
from tumortrack_lab.fleet.executors import OnRay, Serial
from tumortrack_lab.fleet.list import Patient, read_list
from tumortrack_lab.fleet.steps import chain
from tumortrack_lab.fleet.store import Store
from tumortrack_lab.fleet.task import Needs, Task
from tumortrack_lab.fleet.worker import Job, Report
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import ReportWriter, table_of
from tumortrack_lab.study.scripts import KeptOptions

TASK_S, EACH, DRIVEN = 0.5, 12, 10_000  # a task's length; tasks a worker; tasks of the lone driver
# Amazon's list prices as remembered, us-east-1, on demand: c7i (0.0446 USD a vCPU and hour; two
# vCPUs share a core), S3 Standard (a GB and month, 1,000 writes, 1,000 reads):
# aws.amazon.com/ec2/pricing and /s3/pricing.
CORE_HOUR, GB_MONTH, WRITES, READS = 2 * 0.0446, 0.023, 0.005, 0.0004
CORES = (8, 64, 1024)  # to state hours for
MEASURED, PAPER = "scaling", "paper"  # blocks of the document


@dataclass(frozen=True, kw_only=True)
class Scaling(KeptOptions):
    list: Path | None = None
    """Of a fleet that is done: what its patients cost."""
    store: str | None = None
    """Where that fleet's results are."""
    patients: tuple[int, ...] = (1000, 1_000_000)
    out: Path = Path("runs/scaling")
    document: Path = Path("docs/fleet.md")


def wait(inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path, cores: int) -> None:
    time.sleep(options["seconds"])
    (out / "number").write_text(str(options["number"]))


def compute(inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path, cores: int) -> None:
    digest = hashlib.pbkdf2_hmac("sha256", b"fleet", b"", options["rounds"])
    (out / "number").write_text(f"{options['number']} {digest.hex()}")


class Nobody(Serial):
    """Takes tasks and does nothing: what is left is the driver's own work."""

    def room(self) -> int:
        return 64

    def start(self, job: Job) -> None:
        self._done.append((job.key, Report("done")))


def tasks(work: Any, count: int, options: dict[str, Any], steps: int = 1) -> Iterator[Task]:
    for number in range(count):
        one: Task | None = None
        for step in range(steps):
            given = {**options, "number": number, "step": step}
            before = {} if one is None else {"before": one}
            one = Task(f"P{number}", f"step{step}", 1, work, given, before, Needs(1, 50))
        assert one is not None
        yield one


def measured(workers: int, work: Any, options: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Workers are warm: each has done a task before. ``ideal_s``: no engine at all."""
    executor, closed = OnRay(cores=workers), []
    executor.close, close = lambda: closed.append(1), executor.close  # type: ignore[method-assign]
    store = Store(str(folder / f"{work.__name__}{workers}"))
    [*_] = run(tasks(work, 2 * workers, {**options, "warm": True}), store, executor)
    start_s = time.monotonic()
    count = EACH * workers
    [*_] = run(tasks(work, count, options), store, executor)
    seconds = time.monotonic() - start_s
    close()
    return {"work": work.__name__, "workers": workers, "tasks": count, "seconds": seconds}


def driven(folder: Path) -> dict[str, Any]:
    """The driver alone: tasks planned, looked up in a plain store, handed over, settled."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start_s = time.process_time()
    wanted = tasks(wait, DRIVEN // 5, {"seconds": 0}, steps=5)
    settled = sum(1 for _ in run(wanted, Store(str(folder / "driven")), Nobody()))
    assert settled == DRIVEN // 5
    used_s = time.process_time() - start_s
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    return {"tasks": DRIVEN, "ms_a_task": 1000 * used_s / DRIVEN, "grown_mb": grown / 1024}


def costs_of(patients: list[Patient], store: Store) -> tuple[int, pd.DataFrame]:
    """How many patients left the costs of all their tasks, and these costs by step: of a patient
    ``tasks`` and means of ``cpu_s`` and ``mb``, of all ``most_s`` and ``peak_mb``."""
    rows = []
    for patient in patients:
        steps = chain(patient)
        costs = {name: store.cost(task.key) for name, task in steps.items()}
        if all("cpu_s" in cost for cost in costs.values()):
            rows += [
                {"patient": patient.name, "step": name.rstrip("0123456789-"), **costs[name]}
                for name in steps
            ]
    if not rows:
        raise InputError("no patient of the list has left the costs of all its tasks there.")
    frame = pd.DataFrame(rows)
    people = frame.patient.nunique()
    by = frame.groupby("step", sort=False)
    found = {
        "tasks": by.size() / people, "cpu_s": by.cpu_s.sum() / people,
        "most_s": by.cpu_s.max(), "peak_mb": by.peak_mb.max(), "mb": by.bytes.sum() / people / 1e6,
    }  # fmt: skip
    return people, pd.DataFrame(found)


def on_paper(costs: pd.DataFrame, patients: int, efficiency: float) -> dict[str, str]:
    """What so many patients take, at these costs of one. CPU seconds: a busy machine's waiting is
    not the tasks'."""
    core_hours = patients * costs.cpu_s.sum() / 3600 / efficiency
    count, gigabytes = patients * costs.tasks.sum(), patients * costs.mb.sum() / 1000
    requests = count * (7 * WRITES + 12 * READS) / 1000  # 3 files, manifest, cost, claim twice
    hours = ", ".join(f"{core_hours / cores:,.2g}" for cores in CORES)
    usd = (core_hours * CORE_HOUR, requests, gigabytes * GB_MONTH)
    return {
        "tasks": f"{count:,.0f}",
        "core-hours, the engine's included": f"{core_hours:,.0f}",
        f"hours on {', '.join(map(str, CORES))} cores": hours,
        "stored, GB": f"{gigabytes:,.0f}",
        "USD: cores; requests; storage a month": "; ".join(f"{one:,.1f}" for one in usd),
    }


def measured_block(rows: list[dict[str, Any]], driver: dict[str, Any], writer: ReportWriter) -> str:
    frame = pd.DataFrame(rows)[["work", "workers", "efficiency", "overhead_ms", "load"]]
    said = "The driver alone: {ms_a_task:.2f} ms of CPU a task, {grown_mb:.0f} MB more after "
    link = writer.data("fleet-scaling", frame.round(3), "Efficiency by workers")
    return f"{said.format(**driver)}{DRIVEN:,} tasks.\n\n{link}\n\n`{writer.command}`"


def paper_block(
    people: int, costs: pd.DataFrame, papers: pd.DataFrame, writer: ReportWriter
) -> str:
    total, rows = costs.sum(), costs.rename_axis("step").reset_index().round(1)
    said = f"A patient: {total.tasks:.3g} tasks, {total.cpu_s:.0f} CPU seconds, {total.mb:.0f} MB."
    link = writer.data("fleet-costs", rows, f"Its steps, means over {people} patients")
    paper = table_of(papers.rename_axis("").reset_index())
    return f"{said}\n\n{paper}\n\n{link}\n\n`{writer.command}`"


def main(config: Scaling) -> None:
    if (config.list is None) != (config.store is None):
        raise InputError("--list and --store belong together: a fleet's, that is done.")
    writer = config.begin("scaling", MEASURED, *([] if config.list is None else [PAPER]))
    rows: list[dict[str, Any]] = []
    # Ray's workers give way to all others of a machine (nice 15), which here would be measured.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112
    rounds = 200_000
    start_s = time.process_time()
    hashlib.pbkdf2_hmac("sha256", b"fleet", b"", rounds)
    rounds = int(rounds * TASK_S / (time.process_time() - start_s))
    with tempfile.TemporaryDirectory() as name:
        driver = driven(Path(name))
        plan = [(wait, w, {"seconds": TASK_S}) for w in (1, 2, 4, 8)]
        plan += [(compute, w, {"rounds": rounds}) for w in (1, 2)]
        for work, workers, options in plan:
            load = os.getloadavg()[0]
            row = measured(workers, work, options, Path(name))
            row["efficiency"] = EACH * TASK_S / row["seconds"]
            row["overhead_ms"] = 1000 * (row["seconds"] - EACH * TASK_S) / EACH
            rows.append({**row, "load": load})
            say(f"{work.__name__}, {workers} workers: efficiency {row['efficiency']:.1%}")
    blocks = {MEASURED: measured_block(rows, driver, writer)}
    if config.list is not None:
        # Tasks that compute share cores with whatever else runs; the engine's share shows in those
        # that wait.
        worst = min(row["efficiency"] for row in rows if row["work"] == "wait")
        people, costs = costs_of(read_list(config.list), Store(str(config.store)))
        sizes = {f"{size:,} patients": on_paper(costs, size, worst) for size in config.patients}
        blocks[PAPER] = paper_block(people, costs, pd.DataFrame(sizes), writer)
    writer.write(blocks)
    say(f"written to {config.document}")


if __name__ == "__main__":
    import fleet_scaling  # this file, by a name that workers know

    scripts.run(fleet_scaling.main, fleet_scaling.Scaling)
