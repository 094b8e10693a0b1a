"""From wanted tasks to results in the store: what is missing is done, in the order of its inputs,
as many at once as an executor takes. What fails is tried again, and never stops the others.

Wanted tasks are taken one after the other as there is room, so that the memory needed does not grow
with their number; of those under way the first is preferred, so that patients are finished.
"""

from __future__ import annotations

import heapq
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Literal, Protocol, runtime_checkable

from tumortrack_lab.fleet.store import Store
from tumortrack_lab.fleet.task import File, Needs, Task
from tumortrack_lab.fleet.worker import Job, Report, job_of

_LOOKED_AHEAD = 64  # wanted tasks that the store is asked about before their turn
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 60.0  # between attempts
_ELSEWHERE_S = 2.0  # between looks at what another run is doing


Wanted = Task | Callable[[], Task]
Found = tuple[bool, str | None]  # what the store has of a task (``Store.found``)


@runtime_checkable
class Executor(Protocol):
    """Who does the tasks."""

    def room(self) -> int:
        """How many tasks may be handed over at once, those under way included."""

    def start(self, job: Job) -> None: ...

    def finished(self, wait_s: float) -> list[tuple[str, Report]]:
        """Keys and reports of what has ended; waits for one for so long at most."""

    def close(self) -> None:
        """Stop what is under way."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a wanted task. there: it was done before. cannot: its patient's data do not
    allow it (kept in the store); failed: after all attempts, or since the patient's file was
    changed; the next run tries again. ``step``: where."""

    task: Task
    state: Literal["there", "done", "cannot", "failed"]
    step: str = ""
    reason: str = ""


@dataclass
class Status:
    """How far a run is. Counts are of tasks, but for ``wanted`` ones."""

    total: int | None = None  # wanted
    wanted: int = 0  # settled
    there: int = 0  # of them, before this run
    failed: int = 0  # of them
    done: int = 0
    running: int = 0  # handed over
    retried: int = 0
    note: str = ""  # the last retry
    started_s: float = field(default_factory=time.monotonic)

    @property
    def per_hour(self) -> float:
        """Wanted tasks settled in this run, an hour."""
        return 3600 * (self.wanted - self.there) / max(time.monotonic() - self.started_s, 1e-3)

    @property
    def seconds_left(self) -> float | None:
        if self.total is None or self.wanted == self.there:
            return None
        return 3600 * (self.total - self.wanted) / self.per_hour


@dataclass(eq=False)
class _Node:
    """A task that is not settled yet."""

    task: Task
    place: int  # in the order of the wanted ones
    needs: Needs
    missing: set[str] = field(default_factory=set)  # keys of inputs
    waited_for_by: list[_Node] = field(default_factory=list)
    wanted: list[Task] = field(default_factory=list)  # itself, and others of the same key
    reasons: tuple[str, ...] = ()


def run(
    wanted: Iterable[Wanted],
    store: Store,
    executor: Executor,
    tries: int = 4,
    again: bool = False,
    show: Callable[[Status], None] = lambda status: None,
) -> Iterator[Outcome]:
    """Do the wanted tasks, and what they need that the store lacks; yields each when it is settled.

    A wanted task may also be a function that makes it, which is called when its turn is near, on
    another thread: reading a patient's files for their hash takes its time.
    ``tries``: how often a task may fail for reasons that are not its own. ``again``: try also what
    the store says can't be done. ``show`` is called about twice a second.
    """
    store.open()
    fleet = _Fleet(store, executor, tries, again)
    fleet.status.total = len(wanted) if isinstance(wanted, Sized) else None
    try:
        with ThreadPoolExecutor(8, "store") as pool:
            coming = _looked_up(wanted, store, pool)
            is_last = False
            while not is_last or fleet.nodes:
                while not is_last and fleet.has_room() and not fleet.settled:
                    if (one := next(coming, None)) is None:
                        is_last = True
                    else:
                        fleet.take(*one)
                if fleet.nodes and not fleet.settled:
                    fleet.turn()
                show(fleet.status)
                yield from fleet.settled
                fleet.settled.clear()
    finally:
        executor.close()


def _looked_up(
    wanted: Iterable[Wanted], store: Store, pool: ThreadPoolExecutor
) -> Iterator[tuple[Task, Found]]:
    """Wanted tasks with what the store has of them, asked ahead: object storage takes its time."""

    def look_up(one: Wanted) -> tuple[Task, Found]:
        task = one if isinstance(one, Task) else one()
        return task, store.found(task.key)

    asked: deque[Future[tuple[Task, Found]]] = deque()
    for one in wanted:
        asked.append(pool.submit(look_up, one))
        if len(asked) >= _LOOKED_AHEAD:
            yield asked.popleft().result()
    while asked:
        yield asked.popleft().result()


class _Fleet:
    """What is under way: unsettled tasks by key, those ready to run by their patient's turn."""

    def __init__(self, store: Store, executor: Executor, tries: int, again: bool) -> None:
        self.store, self.executor, self.tries, self.again = store, executor, tries, again
        self.nodes: dict[str, _Node] = {}
        self.settled: list[Outcome] = []
        self.status = Status()
        self._ready: list[tuple[int, int, _Node]] = []
        self._later: list[tuple[float, int, _Node]] = []  # when; attempts that wait
        self._running = 0
        self._numbers = count()
        self._run = secrets.token_hex(8)

    def has_room(self) -> bool:
        return self._running + len(self._ready) + len(self._later) < self.executor.room()

    def take(self, task: Task, found: Found) -> None:
        """The next of the wanted tasks."""
        node = self.nodes.get(task.key) or self._plan(task, next(self._numbers), found)
        if isinstance(node, Outcome):
            self._settle(node)
        else:
            node.wanted.append(task)

    def turn(self) -> None:
        """Hand over what may run, wait a moment for what ends, and act on it."""
        while self._later and self._later[0][0] <= time.monotonic():
            self._push(heapq.heappop(self._later)[2])
        while self._ready and self._running < self.executor.room():
            node = heapq.heappop(self._ready)[2]
            self._running += 1
            job = job_of(node.task, node.needs, self.store.url, self._run, node.reasons)
            self.executor.start(job)
        for key, report in self.executor.finished(0.5):
            self._running -= 1
            self._react(self.nodes[key], report)
        self.status.running = self._running

    def _plan(self, task: Task, place: int, found: Found) -> _Node | Outcome:
        """The task and all that it waits for; or, where the store has it, what is known of it."""
        there, failure = found
        if failure is not None and self.again:
            self.store.remove(task.key)
        elif failure is not None:
            return Outcome(task, "cannot", task.step, failure)
        elif there:
            return Outcome(task, "there")
        node = _Node(task, place, task.needs)
        for one in task.inputs.values():
            if isinstance(one, File) or one.key in node.missing:
                continue
            before = self.nodes.get(one.key) or self._plan(one, place, self.store.found(one.key))
            if isinstance(before, _Node):
                node.missing.add(one.key)
                before.waited_for_by.append(node)
            elif before.state == "cannot":
                return Outcome(task, "cannot", before.step, before.reason)
        self.nodes[task.key] = node
        if not node.missing:
            self._push(node)
        return node

    def _push(self, node: _Node) -> None:
        heapq.heappush(self._ready, (node.place, next(self._numbers), node))

    def _react(self, node: _Node, report: Report) -> None:
        if report.state in ("there", "done"):
            self.status.done += report.state == "done"
            del self.nodes[node.task.key]
            for one in node.wanted:
                self._settle(Outcome(one, "done"))
            for waiting in node.waited_for_by:
                waiting.missing.discard(node.task.key)
                if not waiting.missing and self.nodes.get(waiting.task.key) is waiting:
                    self._push(waiting)
        elif report.state == "elsewhere":
            self._wait(node, _ELSEWHERE_S)
        elif report.state == "cannot":
            self._give_up(node, "cannot", node.task.step, report.reason)
        elif report.state == "changed":
            self._give_up(node, "failed", node.task.step, report.reason)
        else:
            self._again(node, report)

    def _again(self, node: _Node, report: Report) -> None:
        """Another attempt, after a pause and with what the last one lacked; or none."""
        node.reasons += (report.reason,)
        if len(node.reasons) >= self.tries:
            self.store.put_cost(node.task.key, {"attempts": node.reasons})
            reason = f"{report.reason} (attempt {len(node.reasons)} of {self.tries})"
            return self._give_up(node, "failed", node.task.step, reason)
        self.status.retried += 1
        self.status.note = f"{node.task.patient} {node.task.step} again: {report.reason}"
        if report.state == "memory":
            node.needs = replace(node.needs, memory_mb=2 * node.needs.memory_mb)
        if report.state == "damaged":
            return self._make_again(node, report.damaged)
        pause_s = min(_FIRST_PAUSE_S * 2 ** (len(node.reasons) - 1), _LONGEST_PAUSE_S)
        self._wait(node, pause_s)

    def _wait(self, node: _Node, pause_s: float) -> None:
        heapq.heappush(self._later, (time.monotonic() + pause_s, next(self._numbers), node))

    def _make_again(self, node: _Node, key: str) -> None:
        """An input lies in the store damaged: the node waits until it has been made anew."""
        [task] = {one.key: one for one in node.task.inputs.values() if one.key == key}.values()
        assert isinstance(task, Task)
        before: _Node | Outcome | None = self.nodes.get(key)
        if before is None:
            self.store.remove(key)
            before = self._plan(task, node.place, (False, None))
        if isinstance(before, Outcome):
            return self._give_up(node, "cannot", before.step, before.reason)
        node.missing.add(key)
        before.waited_for_by.append(node)

    def _give_up(
        self, node: _Node, state: Literal["cannot", "failed"], step: str, reason: str
    ) -> None:
        """Settle a task that has no result, and all that wait for it."""
        if self.nodes.pop(node.task.key, None) is None:
            return  # two of its inputs failed
        for one in node.wanted:
            self._settle(Outcome(one, state, step, reason))
        for waiting in node.waited_for_by:
            self._give_up(waiting, state, step, reason)

    def _settle(self, outcome: Outcome) -> None:
        self.status.wanted += 1
        self.status.there += outcome.state == "there"
        self.status.failed += outcome.state in ("cannot", "failed")
        self.settled.append(outcome)
