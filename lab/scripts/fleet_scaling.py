"""What the fleet's engine costs: measured with small tasks, and on paper for many patients.

    make scaling ARGS="[--out runs/scaling.json] [--store STORE] [--patients 1000 1000000]"

Tasks that only wait show what the engine adds on 1, 2, 4 and 8 workers, on few cores too; tasks
that compute show the cores. A driver alone, whose tasks are nobody's, shows its own time and
memory. With --store, a fleet's own store, its costs are averaged and laid out on paper.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tumortrack.core.store import write_json
from tumortrack_lab.fleet.engine import run
from tumortrack_lab.fleet.executors import OnRay, Serial
from tumortrack_lab.fleet.store import Store
from tumortrack_lab.fleet.task import Needs, Task
from tumortrack_lab.fleet.worker import Job, Report
from tumortrack_lab.study.trainings import run as command

TASK_S, EACH, DRIVEN = 0.5, 12, 10_000  # a task's length; tasks a worker; tasks of the lone driver
# Amazon's list prices, us-east-1, on demand: c7i (0.0446 USD a vCPU and hour; two vCPUs share a
# core), S3 Standard (a GB and month, 1,000 writes, 1,000 reads): aws.amazon.com/ec2/pricing and
# /s3/pricing.
CORE_HOUR, GB_MONTH, WRITES, READS = 2 * 0.0446, 0.023, 0.005, 0.0004


@dataclass(frozen=True)
class Scaling:
    out: Path = Path("runs/scaling.json")
    store: Path | None = None
    patients: tuple[int, ...] = (1000, 1_000_000)


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


def costs_of(store: Path) -> dict[str, dict[str, float]]:
    """Mean costs of a patient by step, of the patients whose tasks all left theirs."""
    sums: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    patients = set()
    for path in store.glob("costs/??/*.json"):
        cost = json.loads(path.read_text())
        if "seconds" in cost:
            patient, step = cost["task"].split(" ")
            patients.add(patient)
            for name in ("seconds", "cpu_s", "bytes"):
                sums[step][name] += cost[name]
            sums[step]["tasks"] += 1
            sums[step]["peak_mb"] = max(sums[step]["peak_mb"], cost["peak_mb"] * len(patients))
    return {
        step: {name: value / len(patients) for name, value in one.items()}
        for step, one in sums.items()
    }


def on_paper(costs: dict[str, dict[str, float]], patients: int, efficiency: float) -> dict:
    """What so many patients take, at these costs of one. CPU seconds: a busy machine's waiting is
    not the tasks'."""
    core_hours = patients * sum(one["cpu_s"] for one in costs.values()) / 3600 / efficiency
    count = patients * sum(one["tasks"] for one in costs.values())
    gigabytes = patients * sum(one["bytes"] for one in costs.values()) / 1e9
    requests = count * (7 * WRITES + 12 * READS) / 1000  # 3 files, manifest, cost, claim twice
    return {
        "patients": patients, "tasks": count, "core_hours": core_hours, "gigabytes": gigabytes,
        "hours_on": {cores: core_hours / cores for cores in (8, 64, 1024)},
        "usd": {"cores": core_hours * CORE_HOUR, "requests": requests,
                "a_month": gigabytes * GB_MONTH},
    }  # fmt: skip


def main(config: Scaling) -> None:
    # Ray's workers give way to all others of a machine (nice 15), which here would be measured.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112
    rounds = 200_000
    start_s = time.process_time()
    hashlib.pbkdf2_hmac("sha256", b"fleet", b"", rounds)
    rounds = int(rounds * TASK_S / (time.process_time() - start_s))
    found: dict[str, Any] = {"load": os.getloadavg(), "cores": os.cpu_count(), "rows": []}
    with tempfile.TemporaryDirectory() as name:
        found["driver"] = driven(Path(name))
        print("driver: {ms_a_task:.2f} ms a task, {grown_mb:.0f} MB".format(**found["driver"]))
        plan = [(wait, w, {"seconds": TASK_S}) for w in (1, 2, 4, 8)]
        plan += [(compute, w, {"rounds": rounds}) for w in (1, 2)]
        for work, workers, options in plan:
            row = measured(workers, work, options, Path(name))
            row["load"] = os.getloadavg()[0]
            row["efficiency"] = EACH * TASK_S / row["seconds"]
            row["overhead_ms"] = 1000 * (row["seconds"] - EACH * TASK_S) / EACH
            found["rows"].append(row)
            print(
                "{work:8} {workers} workers: {tasks} tasks in {seconds:.1f} s, efficiency "
                "{efficiency:.1%}, {overhead_ms:.0f} ms a task and worker".format(**row),
                flush=True,
            )
    if config.store:
        found["costs"] = costs_of(config.store)
        worst = min(row["efficiency"] for row in found["rows"])
        found["paper"] = [on_paper(found["costs"], n, worst) for n in config.patients]
        print(json.dumps({"costs": found["costs"], "paper": found["paper"]}, indent=1))
    config.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(config.out, found)
    print(f"written to {config.out}", file=sys.stderr)


if __name__ == "__main__":
    import fleet_scaling  # this file, by a name that workers know

    command(fleet_scaling.main, fleet_scaling.Scaling)
