"""From wanted tasks to results in the store: an executor makes what is missing, inputs first. A
failed task is tried again and never stops the others.

A patient's chain is a coroutine. Only as many are under way as the executor has room for, so memory
does not grow with their number.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sized
from dataclasses import dataclass, field, replace
from typing import Literal

from tumortrack_lab.fleet.executors import OnRay, Serial
from tumortrack_lab.fleet.store import Store
from tumortrack_lab.fleet.task import Task
from tumortrack_lab.fleet.worker import job_of

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 60.0  # between attempts
_ELSEWHERE_S = 2.0  # between looks at a task that another run is doing
_SHOWN_S = 0.5

# Reports after which a task is not tried again in this run, and what becomes of it.
_FINAL: dict[str, Literal["done", "cannot", "failed"]] = {
    "there": "done", "done": "done", "cannot": "cannot", "changed": "failed",
}  # fmt: skip

Wanted = Task | Callable[[], Task]


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a task ended. there: it was done before. cannot: the patient's data rule it out (kept in
    the store). failed: after all attempts, or because the patient's file was changed; the next run
    tries again. ``step``: where it failed."""

    task: Task
    state: Literal["there", "done", "cannot", "failed"]
    step: str = ""
    reason: str = ""


@dataclass
class Status:
    """Progress of a run. Counts are of tasks, but for ``wanted`` ones."""

    total: int | None = None  # wanted
    wanted: int = 0  # that have ended
    there: int = 0  # of them, before this run
    failed: int = 0  # of them
    done: int = 0
    running: int = 0  # handed over
    retried: int = 0
    note: str = ""  # the last retry, until it is shown
    started_s: float = field(default_factory=time.monotonic)

    @property
    def per_hour(self) -> float:
        """Wanted tasks that have ended in this run, an hour."""
        return 3600 * (self.wanted - self.there) / max(time.monotonic() - self.started_s, 1e-3)

    @property
    def seconds_left(self) -> float | None:
        if self.total is None or self.wanted == self.there:
            return None
        return 3600 * (self.total - self.wanted) / self.per_hour


def run(
    wanted: Iterable[Wanted],
    store: Store,
    executor: Serial | OnRay,
    tries: int = 4,
    again: bool = False,
    show: Callable[[Status], None] = lambda status: None,
) -> Iterator[Outcome]:
    """Do the wanted tasks, and those that they depend on and the store lacks; yields an outcome of
    each wanted one when it has ended.

    A wanted task may also be a function that makes it, on another thread: hashing a patient's files
    takes a while. ``tries``: how often a task may fail for reasons that are not its own.
    ``again``: also try what the store says can't be done.
    ``show`` is called about twice a second.
    """
    store.open()
    fleet = _Fleet(store, executor, tries, again)
    fleet.status.total = len(wanted) if isinstance(wanted, Sized) else None
    outcomes = fleet.outcomes(iter(wanted), show)

    with asyncio.Runner() as runner:
        loop = runner.get_loop()
        loop.set_exception_handler(lambda *_: None)  # the error is raised where it is awaited
        try:
            while (outcome := loop.run_until_complete(anext(outcomes, None))) is not None:
                yield outcome
        finally:
            executor.close()


class _Fleet:
    """``under_way``: the coroutine of every task that is being made, by key, so that all tasks that
    need its result wait for the same one."""

    def __init__(self, store: Store, executor: Serial | OnRay, tries: int, again: bool) -> None:
        self.store, self.executor, self.tries, self.again = store, executor, tries, again
        self.status = Status()
        self.under_way: dict[str, asyncio.Task[Outcome]] = {}
        self._tried_again: set[str] = set()
        self._run = secrets.token_hex(8)

    async def outcomes(
        self, wanted: Iterator[Wanted], show: Callable[[Status], None]
    ) -> AsyncIterator[Outcome]:
        """Outcomes of the wanted tasks, as they end."""
        pending: set[asyncio.Task[Outcome]] = set()
        while True:
            room = self.executor.room()
            while len(pending) < room and (item := next(wanted, None)) is not None:
                pending.add(asyncio.create_task(self._wanted(item)))
            if not (waited_for := pending | {*self.under_way.values()}):
                return
            first = asyncio.FIRST_COMPLETED
            await asyncio.wait(waited_for, timeout=_SHOWN_S, return_when=first)
            show(self.status)
            for task in [task for task in pending if task.done()]:
                pending.remove(task)
                yield task.result()

    async def _wanted(self, wanted: Wanted) -> Outcome:
        task = wanted if isinstance(wanted, Task) else await asyncio.to_thread(wanted)
        outcome = replace(await self._begin(task), task=task)
        self.status.wanted += 1
        self.status.there += outcome.state == "there"
        self.status.failed += outcome.state in ("cannot", "failed")
        return outcome

    def _begin(self, task: Task) -> asyncio.Task[Outcome]:
        """Make a task's result, unless that is under way."""
        making = self.under_way.get(task.key)
        if making is None:
            making = self.under_way[task.key] = asyncio.create_task(self._make(task))
            making.add_done_callback(lambda _: self.under_way.pop(task.key))
        return making

    async def _make(self, task: Task) -> Outcome:
        """A task's result, and before it those of its inputs, where the store lacks them."""
        if (known := await self._known(task)) is not None:
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

    async def _known(self, task: Task) -> Outcome | None:
        """The outcome according to the store; None: the task is still to be done."""
        there, failure = await asyncio.to_thread(self.store.found, task.key)
        if failure is None:
            return Outcome(task, "there") if there else None
        if not self.again or task.key in self._tried_again:
            return Outcome(task, "cannot", task.step, failure)
        self._tried_again.add(task.key)
        self.store.remove(task.key)
        return None

    async def _lacking_input(self, task: Task) -> Outcome | None:
        """Make all inputs; returns the first that can't be made."""
        inputs = [item for item in task.inputs.values() if isinstance(item, Task)]
        outcomes = await asyncio.gather(*map(self._begin, inputs))
        return next((item for item in outcomes if item.state in ("cannot", "failed")), None)
