"""What a fleet survives, on Ray's own test cluster: machines are processes on this one. Whatever
happens, results are those of the serial executor to the last bit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from fleet_objects import executions, patients, results, stored
from tumortrack_lab.fleet.engine import run
from tumortrack_lab.fleet.executors import Serial
from tumortrack_lab.fleet.store import Store

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("ray") is None, reason="the extra `fleet` is not installed"),
]
PATIENTS, CORES = 16, 2
FAULTS = {"P2-1": "killed", "P3-1": "memory", "P4-0": "disk", "P5-1": "defect"}


@pytest.fixture(scope="module")
def machines(tmp_path_factory) -> Iterator[Machines]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")
        patch.setenv("RAY_raylet_start_wait_time_s", "300")
        patch.setenv("FLEET_FOLDER", str(tmp_path_factory.mktemp("fleet")))
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
        machines = Machines()
        yield machines
        machines.stop()


class Machines:
    """A cluster of a head that does no tasks, and two machines of two cores that do."""

    def __init__(self) -> None:
        self.folder = Path(os.environ["FLEET_FOLDER"])
        self.clusters: list = []
        self.start(machines=2)

    def start(self, machines: int) -> None:
        from ray.cluster_utils import Cluster  # reads the environment when it is imported

        small = {"object_store_memory": 80 << 20}
        # A machine that is only slow, since others share its cores, must not count as lost.
        checks = {"initial_delay_ms": 5000, "period_ms": 1000, "failure_threshold": 8}
        system = {f"health_check_{name}": value for name, value in checks.items()}
        head = {**small, "num_cpus": 0, "include_dashboard": False, "_system_config": system}
        self.clusters.append(Cluster(initialize_head=True, head_node_args=head))
        self.nodes = [
            self.clusters[-1].add_node(wait=False, num_cpus=CORES, **small) for _ in range(machines)
        ]
        self.clusters[-1].wait_for_nodes()

    def begun_on_last(self) -> list[str]:
        """Names of tasks begun on the machine that ``kill_machine`` would take."""
        (raylet,) = self.nodes[-1].all_processes["raylet"]
        return executions(self.folder, raylet.process.pid)

    def kill_machine(self) -> None:
        self.clusters[-1].remove_node(self.nodes.pop(), allow_graceful=False)

    def kill_head(self) -> None:
        self.clusters[-1].head_node.kill_all_processes(check_alive=False, allow_graceful=False)

    def drive(self, store: Path) -> subprocess.Popen[str]:
        words = f"{self.clusters[-1].address!r}, {str(store)!r}, {PATIENTS}"
        code = f"import fleet_objects; fleet_objects.drive({words})"
        return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)

    def begin(self, wait_s: float, faults: dict[str, str]) -> None:
        """A new log, and what is to go wrong."""
        (self.folder / "log").unlink(missing_ok=True)
        self.pace(wait_s, faults)

    def pace(self, wait_s: float, faults: dict[str, str]) -> None:
        """How long tasks wait that are begun from now on."""
        (self.folder / "aside").write_text(json.dumps({"wait_s": wait_s, **faults}))
        (self.folder / "aside").rename(self.folder / "faults.json")

    def stop(self) -> None:
        for cluster in self.clusters:
            cluster.shutdown()


@pytest.fixture
def serial(machines, tmp_path) -> dict[str, bytes]:
    """What the serial executor writes."""
    machines.begin(0.0, {})
    states = [one.state for one in run(patients(PATIENTS), Store(str(tmp_path / "s")), Serial())]
    assert states == ["done", "cannot"] + ["done"] * (PATIENTS - 2)
    return results(tmp_path / "s")


def wait_for(driver: subprocess.Popen[str], condition: Callable[[], object]) -> None:
    while not condition():
        assert driver.poll() is None, "it ended too early"
        time.sleep(0.05)


def test_a_lost_machine_costs_what_ran_there_and_faults_are_tried_again(machines, serial, tmp_path):
    machines.begin(0.3, FAULTS)
    store = tmp_path / "store"
    driver = machines.drive(store)
    seen = machines.folder
    wait_for(driver, lambda: all(executions(seen).count(name) > 1 for name in FAULTS))
    machines.pace(6.0, FAULTS)  # what begins there now is running when its machine is killed
    before = len(machines.begun_on_last())
    impossible = "P1-1"  # ends at once
    wait_for(driver, lambda: {*machines.begun_on_last()[before:]} - {*FAULTS, impossible})
    machines.kill_machine()
    machines.pace(0.3, FAULTS)
    kept = stored(store)
    begun = len(executions(machines.folder))
    lines = [json.loads(line) for line in driver.communicate(timeout=300)[0].splitlines()]
    assert driver.returncode == 0

    by_patient = {line["patient"]: line for line in lines}
    assert len(lines) == len(by_patient) == PATIENTS
    assert by_patient.pop("P1")["state"] == "cannot"
    failed = by_patient.pop("P5")
    assert (failed["state"], failed["step"]) == ("failed", "step1")
    assert {line["state"] for line in by_patient.values()} == {"done"}

    times = Counter(executions(machines.folder))
    assert not kept & set(executions(machines.folder)[begun:])
    assert {name: times.pop(name) for name in FAULTS if times[name] > 1}.keys() == FAULTS.keys()
    assert sum(times.values()) - len(times) <= CORES
    costs = [json.loads(path.read_text()) for path in store.glob("costs/??/*")]
    assert any("KeyError: 'defect'" in " ".join(one["attempts"]) for one in costs)
    said = {one["task"]: [*filter(None, one["attempts"])] for one in costs if "task" in one}
    faulty = {"P2 step1": "ended unexpectedly", "P3 step1": "MemoryError", "P4 step0": "too large"}
    for name, words in faulty.items():
        assert words in " ".join(said.pop(name))
    lost = [reason for reasons in said.values() for reason in reasons]
    assert lost  # what ran there; Ray tells the machine's end or its processes'
    assert all("was lost" in reason or "ended unexpectedly" in reason for reason in lost)

    lacking = {name for name in serial if name not in results(store)}
    machines.begin(0.0, {})  # the defect is mended
    [*_] = run(patients(PATIENTS), Store(str(store)), Serial())
    assert set(executions(machines.folder)) == {"P5-1", "P5-2"}
    assert lacking
    assert results(store) == serial


def test_the_same_command_resumes_after_its_own_end_and_the_heads(machines, serial, tmp_path):
    machines.begin(0.8, {})  # what is left takes longer than the head is missed for
    store = tmp_path / "store"
    first = machines.drive(store)
    wait_for(first, lambda: len(stored(store)) >= 5)
    first.kill()
    first.communicate()
    kept, begun = stored(store), len(executions(machines.folder))

    second = machines.drive(store)
    wait_for(second, lambda: len(stored(store)) >= len(kept) + 8)
    machines.kill_head()
    output, _ = second.communicate(timeout=300)
    assert second.returncode == 1
    assert "is gone" in json.loads(output.splitlines()[-1])["error"]
    assert not kept & set(executions(machines.folder)[begun:])
    kept, begun = stored(store), len(executions(machines.folder))

    machines.start(machines=1)
    third = machines.drive(store)
    third.communicate(timeout=300)
    assert third.returncode == 0
    assert not kept & set(executions(machines.folder)[begun:])
    assert results(store) == serial
