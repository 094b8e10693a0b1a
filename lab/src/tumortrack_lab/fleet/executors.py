"""Executors of a fleet's tasks: this process, one at a time, or Ray on any number of machines."""

from __future__ import annotations

import asyncio
import atexit
import logging
import os
import secrets
import shutil
import socket
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.process import available_cores
from tumortrack_lab.fleet.store import is_running
from tumortrack_lab.fleet.worker import Job, Report, perform

_LOOK_S = 5.0  # between looks at which machines there are
_SILENT_S = 8.0  # without an answer from the cluster's head, which then counts as gone
_LARGE_MB = 2000
_STORE_BYTES = 80 * 2**20  # the smallest object store that Ray allows; we put nothing in it


class Serial:
    """One task at a time, in this process."""

    def room(self) -> int:
        return 1

    async def do(self, job: Job) -> Report:
        return perform(job)

    def close(self) -> None:
        pass


class OnRay:
    """Tasks as Ray's: on this machine with ``cores`` (default: all), or on the cluster at
    ``address``.

    Raises InputError: no cluster there.
    """

    def __init__(self, address: str | None = None, cores: int | None = None) -> None:
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        if address is None:  # protect it from other users of the machine
            os.environ["RAY_AUTH_MODE"] = "token"
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        import ray

        self._ray, self._folder, self._is_lost = ray, None if address else _own_folder(), False
        options: dict[str, Any] = {"address": address}
        if self._folder is not None:
            options = {"num_cpus": cores or available_cores(), "_temp_dir": str(self._folder)}
            options["object_store_memory"] = _STORE_BYTES
        # Silences pages about lost machines, which no option does; we report them in one line.
        ray._private.worker.print_to_stdstream = lambda *data, **how: None
        try:
            context: Any = ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            self.close()
            words = str(error).strip().splitlines()[0]
            where = f"the Ray cluster at {address}" if address else "Ray on this machine"
            raise InputError(f"{where} cannot be used: {words}") from error
        self.dashboard = context.dashboard_url
        self._head = context.address_info["gcs_address"].rsplit(":", 1)
        self._heard_s = time.monotonic()
        # A large task has a process of its own, whose memory is free again when it ends.
        self._small = ray.remote(max_calls=100, max_retries=0)(perform)
        self._large = ray.remote(max_calls=1, max_retries=0)(perform)
        self._looked_s, self._machines = -_LOOK_S, [dict[str, float]()]

    def room(self) -> int:
        """How many patients may be under way. Raises TumortrackError: no machine is left."""
        if time.monotonic() - self._heard_s > 1.0:
            self._look_for_head()
        return int(sum(machine.get("CPU", 0) for machine in self._largest())) + 4

    async def do(self, job: Job) -> Report:
        """A task that needs more than the largest machine has runs there alone. If a task ends
        without a report, one is made of Ray's error."""
        machines, errors = self._largest(), self._ray.exceptions
        most = {key: max(each.get(key, 0) for each in machines) for key in ("CPU", "memory")}
        function = self._large if job.memory_mb >= _LARGE_MB else self._small
        options = function.options(
            name=job.name,
            num_cpus=min(1, most["CPU"]),
            memory=min(job.memory_mb * 2**20, int(0.95 * most["memory"])),
        )
        try:
            report: Report = await asyncio.wrap_future(options.remote(job).future())
        except errors.OutOfMemoryError:
            return Report("memory", "ended by Ray: its machine ran out of memory")
        except errors.WorkerCrashedError:  # as when the kernel runs out of memory
            return Report("memory", "its process ended unexpectedly (killed, or out of memory)")
        except errors.NodeDiedError:
            return Report("failed", "its machine was lost")
        except errors.RayError as error:
            words = (str(error).strip().splitlines() or [""])[-1]
            return Report("failed", f"{type(error).__name__}: {words}")
        return report

    def close(self) -> None:
        if self._is_lost:  # a shutdown would wait for the head, or crash
            atexit.register(_leave)
        else:
            self._ray.shutdown()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _look_for_head(self) -> bool:
        """Whether the cluster's head answers. Raises TumortrackError: it has not for a while (Ray
        itself would wait a minute and then end this process)."""
        try:
            socket.create_connection((self._head[0], int(self._head[1])), 2.0).close()
        except OSError as error:
            if time.monotonic() - self._heard_s < _SILENT_S:
                return False
            self._is_lost = True
            raise TumortrackError(
                f"the head of the Ray cluster at {':'.join(self._head)} is gone ({error}). "
                "Start the cluster again; the same command then resumes."
            ) from error
        self._heard_s = time.monotonic()
        return True

    def _largest(self) -> list[dict[str, float]]:
        """Each machine's resources, seconds ago. Raises TumortrackError: the cluster is gone."""
        if time.monotonic() - self._looked_s > _LOOK_S and self._look_for_head():
            nodes = self._ray.nodes()
            self._machines = [node["Resources"] for node in nodes if node["Alive"]] or [{}]
            self._looked_s = time.monotonic()
        return self._machines


def _leave() -> None:
    """End this process at once, without Ray's exit handlers."""
    sys.stdout.flush()
    os._exit(TumortrackError.exit_code)


def _own_folder() -> Path:
    """A folder for the sockets and logs of a local Ray; removes those of killed processes."""
    place = Path(tempfile.gettempdir())
    for old in place.glob("tumortrack-ray-*-*"):
        with suppress(OSError, ValueError):
            if old.stat().st_uid == os.getuid() and not is_running(int(old.name.split("-")[2])):
                shutil.rmtree(old, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=f"tumortrack-ray-{os.getpid()}-", dir=place))
