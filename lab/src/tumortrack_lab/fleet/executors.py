"""Who does a fleet's tasks: this process, one after the other, or Ray on any number of machines."""

from __future__ import annotations

import os
import queue
import secrets
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tumortrack.core.errors import InputError
from tumortrack.core.process import available_cores
from tumortrack_lab.fleet.worker import Job, Report, perform

if TYPE_CHECKING:
    from concurrent.futures import Future

_AHEAD = 2.0  # tasks handed over per core: the next ones are at hand when one ends
_LOOK_S = 5.0  # between looks at which machines there are
_LARGE_MB = 2000
_STORE_BYTES = 80 * 2**20  # Ray's least for its object store, which carries no data of ours


class Serial:
    """One task at a time, in this process."""

    def __init__(self) -> None:
        self._done: list[tuple[str, Report]] = []

    def room(self) -> int:
        return 1

    def start(self, job: Job) -> None:
        self._done.append((job.key, perform(job)))

    def finished(self, wait_s: float) -> list[tuple[str, Report]]:
        if not self._done:
            time.sleep(wait_s)
        done, self._done = self._done, []
        return done

    def close(self) -> None:
        pass


class OnRay:
    """Tasks as Ray's: on this machine with ``cores`` (default: all), or on the cluster at
    ``address``.

    Raises InputError: no cluster there.
    """

    def __init__(self, address: str | None = None, cores: int | None = None) -> None:
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        if address is None:  # ours alone, on a machine with other users; not kept in their home
            os.environ["RAY_AUTH_MODE"] = "token"
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        import ray

        self._ray, self._folder = ray, None if address else _own_folder()
        common: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        try:
            if self._folder is None:
                ray.init(address=address, **common)
            else:
                ray.init(
                    num_cpus=cores or available_cores(), object_store_memory=_STORE_BYTES,
                    _temp_dir=str(self._folder), **common,
                )  # fmt: skip
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            self.close()
            words = str(error).strip().splitlines()[0]
            where = f"the Ray cluster at {address}" if address else "Ray on this machine"
            raise InputError(f"{where} cannot be used: {words}") from error
        # A large task has a process of its own, whose memory is free again when it ends.
        self._small = ray.remote(max_calls=100, max_retries=0)(perform)
        self._large = ray.remote(max_calls=1, max_retries=0)(perform)
        self._ended: queue.SimpleQueue[tuple[str, Future[Report]]] = queue.SimpleQueue()
        self._refs: dict[str, Any] = {}
        self._looked_s, self._machines = -_LOOK_S, [dict[str, float]()]

    def room(self) -> int:
        return int(_AHEAD * sum(one.get("CPU", 0) for one in self._largest())) + 4

    def start(self, job: Job) -> None:
        """Its needs are held to what the largest machine has: there it runs alone, and slower."""
        machines = self._largest()
        most = {name: max(one.get(name, 0) for one in machines) for name in ("CPU", "memory")}
        function = self._large if job.needs.memory_mb >= _LARGE_MB else self._small
        ref = self._refs[job.key] = function.options(
            name=job.name,
            num_cpus=min(job.needs.cores, most["CPU"]),
            memory=min(job.needs.memory_mb * 2**20, int(0.95 * most["memory"])),
            num_gpus=job.needs.gpus,
        ).remote(job)
        ref.future().add_done_callback(lambda future: self._ended.put((job.key, future)))

    def finished(self, wait_s: float) -> list[tuple[str, Report]]:
        found = []
        with suppress(queue.Empty):
            found.append(self._ended.get(timeout=wait_s))
            while True:
                found.append(self._ended.get_nowait())
        for key, _ in found:
            del self._refs[key]
        return [(key, self._report(future)) for key, future in found]

    def close(self) -> None:
        self._ray.shutdown()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _report(self, future: Future[Report]) -> Report:
        """What the task says; or, where it can't, what Ray says of its end."""
        errors = self._ray.exceptions
        try:
            return future.result()
        except errors.OutOfMemoryError:
            return Report("memory", "ended by Ray: its machine ran out of memory")
        except errors.WorkerCrashedError:  # as after the kernel's own choice when memory runs out
            return Report("memory", "its process ended unexpectedly (killed, or out of memory)")
        except errors.NodeDiedError:
            return Report("failed", "its machine was lost")
        except errors.RayError as error:
            words = (str(error).strip().splitlines() or [""])[-1]
            return Report("failed", f"{type(error).__name__}: {words}")

    def _largest(self) -> list[dict[str, float]]:
        """What each machine has, as of a few seconds ago. TumortrackError: the cluster is gone."""
        if time.monotonic() - self._looked_s > _LOOK_S:
            nodes = self._ray.nodes()
            self._machines = [one["Resources"] for one in nodes if one["Alive"]] or [{}]
            self._looked_s = time.monotonic()
        return self._machines


def _own_folder() -> Path:
    """For the sockets and logs of a Ray of our own; those of processes that were killed go."""
    place = Path(tempfile.gettempdir())
    for old in place.glob("tumortrack-ray-*-*"):
        with suppress(OSError, ValueError):
            if old.stat().st_uid == os.getuid() and not _is_running(int(old.name.split("-")[2])):
                shutil.rmtree(old, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=f"tumortrack-ray-{os.getpid()}-", dir=place))


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
