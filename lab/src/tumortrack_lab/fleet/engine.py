"""From wanted tasks to results in the store: what is missing is made, inputs first, by an executor.
What fails is tried again and never stops the others.

A patient's chain is a coroutine; as many are under way as the executor has room for, so that the
memory needed does not grow with their number.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, runtime_checkable

from tumortrack_lab.fleet.store import Store
from tumortrack_lab.fleet.task import Task
from tumortrack_lab.fleet.worker import Job, Report, job_of

_LOOKED_AHEAD = 64  # wanted tasks that the store is asked about before their turn
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 60.0  # between attempts
_ELSEWHERE_S = 2.0  # between looks at what another run is doing
_SHOWN_S = 0.5

# Reports after which a task is not tried again in this run, and what becomes of it.
_FINAL: dict[str, Literal["done", "cannot", "failed"]] = {
    "there": "done", "done": "done", "cannot": "cannot", "changed": "failed",
}  # fmt: skip

Wanted = Task | Callable[[], Task]
Found = tuple[bool, str | None]  # what the store has of a task (``Store.found``)


@runtime_checkable
class Executor(Protocol):
    """Who does the tasks."""

    def room(self) -> int:
        """How many patients may be under way. Called often; TumortrackError: nobody is left who
        could do anything."""

    async def do(self, job: Job) -> Report: ...

    def close(self) -> None:
        """Stop what is under way."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a task. there: it was done before. cannot: its patient's data do not allow it
    (kept in the store); failed: after all attempts, or since the patient's file was changed; the
    next run tries again. ``step``: where."""

    task: Task
    state: Literal["there", "done", "cannot", "failed"]
    step: str = ""
    reason: str = ""


@dataclass
class Status:
    """Progress of a run. Counts are of tasks, but for ``wanted`` ones."""

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
    loop = asyncio.new_event_loop()
    loop.set_exception_handler(lambda *_: None)  # whoever waits for a task gets its error
    try:
        with ThreadPoolExecutor(8, "store") as pool:
            settled = fleet.settled(_looked_up(wanted, store, pool), show)
            while (outcome := loop.run_until_complete(anext(settled, None))) is not None:
                yield outcome
    finally:
        executor.close()
        if left := asyncio.all_tasks(loop):
            for task in left:
                task.cancel()
            loop.run_until_complete(asyncio.wait(left))
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.close()


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
    """``under_way``: of every task that is being made the coroutine that makes it, by key, so that
    all who need it wait for the same one."""

    def __init__(self, store: Store, executor: Executor, tries: int, again: bool) -> None:
        self.store, self.executor, self.tries, self.again = store, executor, tries, again
        self.status = Status()
        self.under_way: dict[str, asyncio.Task[Outcome]] = {}
        self._tried_again: set[str] = set()
        self._run = secrets.token_hex(8)

    async def settled(
        self, wanted: Iterator[tuple[Task, Found]], show: Callable[[Status], None]
    ) -> AsyncIterator[Outcome]:
        """Each of the wanted tasks, once nothing more is to be done for it."""
        pending: set[asyncio.Task[Outcome]] = set()
        is_last = False
        while not is_last or pending or self.under_way:
            room = self.executor.room()
            while not is_last and len(pending) < room:
                if (one := next(wanted, None)) is None:
                    is_last = True
                else:
                    pending.add(asyncio.create_task(self._settle(*one)))
            if waited_for := pending | {*self.under_way.values()}:
                first = asyncio.FIRST_COMPLETED
                await asyncio.wait(waited_for, timeout=_SHOWN_S, return_when=first)
            show(self.status)
            for task in [task for task in pending if task.done()]:
                pending.remove(task)
                yield task.result()

    async def _settle(self, task: Task, found: Found) -> Outcome:
        outcome = replace(await self._begin(task, found), task=task)
        self.status.wanted += 1
        self.status.there += outcome.state == "there"
        self.status.failed += outcome.state in ("cannot", "failed")
        return outcome

    def _begin(self, task: Task, found: Found | None = None) -> asyncio.Task[Outcome]:
        """Make a task's result, unless that is under way."""
        making = self.under_way.get(task.key)
        if making is None:
            making = self.under_way[task.key] = asyncio.create_task(self._make(task, found))
            making.add_done_callback(lambda _: self.under_way.pop(task.key))
        return making

    async def _make(self, task: Task, found: Found | None) -> Outcome:
        """A task's result, and before it those of its inputs, where the store lacks them."""
        if (known := await self._known(task, found)) is not None:
            return known
        memory_mb, reasons = task.memory_mb, tuple[str, ...]()
        lacking = await self._lacking_input(task)
        while lacking is None:
            job = job_of(task, memory_mb, self.store.url, self._run, reasons)
            self.status.running += 1
            report = await self.executor.do(job)
            self.status.running -= 1
            if report.state in _FINAL:
                self.status.done += report.state == "done"
                step = task.step if report.reason else ""
                return Outcome(task, _FINAL[report.state], step, report.reason)
            if report.state == "elsewhere":
                await asyncio.sleep(_ELSEWHERE_S)
                continue
            reasons += (report.reason,)
            if len(reasons) >= self.tries:
                self.store.put_cost(task.key, {"attempts": reasons})
                reason = f"{report.reason} (attempt {len(reasons)} of {self.tries})"
                return Outcome(task, "failed", task.step, reason)
            self.status.retried += 1
            self.status.note = f"{task.patient} {task.step} again: {report.reason}"
            if report.state == "damaged":
                if report.damaged not in self.under_way:
                    self.store.remove(report.damaged)
                lacking = await self._lacking_input(task)
                continue
            if report.state == "memory":
                memory_mb *= 2
            await asyncio.sleep(min(_FIRST_PAUSE_S * 2 ** (len(reasons) - 1), _LONGEST_PAUSE_S))
        return replace(lacking, task=task)

    async def _known(self, task: Task, found: Found | None) -> Outcome | None:
        """What the store says of a task; None: it is to be done."""
        if found is None:
            found = await asyncio.to_thread(self.store.found, task.key)
        there, failure = found
        if failure is None:
            return Outcome(task, "there") if there else None
        if not self.again or task.key in self._tried_again:
            return Outcome(task, "cannot", task.step, failure)
        self._tried_again.add(task.key)
        self.store.remove(task.key)
        return None

    async def _lacking_input(self, task: Task) -> Outcome | None:
        """Make all inputs; the first that can't be made."""
        inputs = [one for one in task.inputs.values() if isinstance(one, Task)]
        outcomes = await asyncio.gather(*map(self._begin, inputs))
        return next((one for one in outcomes if one.state in ("cannot", "failed")), None)
