"""Where a fleet's results lie: folders by key, in a plain folder or in any of fsspec's storages.

    KK/KEY/files/...      what a task wrote (KK: the first two letters of its key)
    KK/KEY/manifest.json  their sha256, written last: without it there is no result; or the reason
                          why the task can't be done
    costs/KK/KEY.json     what it cost: apart, since results are equal bit for bit and costs are not
    claims/KEY.json       which run is doing it: only a hint, so that two runs don't do the same

Results in a plain folder are used in place; others are fetched into a cache on this machine. A
reader notices an unfinished result: its manifest is missing, or a checksum is wrong.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
import tempfile
import time
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

from tumortrack.core.errors import InputError
from tumortrack.core.store import MANIFEST, sha256_of
from tumortrack_lab.fleet.task import File

_CLAIMED_S = 60.0  # older claims are void unless renewed
_KEPT_S = 24 * 3600  # unused cache entries are removed after this


class DamagedError(Exception):
    """What lies under ``key`` is not what was put there."""

    def __init__(self, key: str, what: str) -> None:
        super().__init__(key, what)
        self.key, self.what = key, what

    def __str__(self) -> str:
        return f"the result {self.key[:12]} in the store is damaged: {self.what}"


class Store:
    """Results by key. ``url``: a folder, or what fsspec understands (``s3://bucket/folder``), with
    whatever credentials its storage finds by itself.

    Raises InputError: an unknown storage, or one whose package is missing. All methods raise
    OSError where the storage does.
    """

    def __init__(self, url: str, cache: Path | None = None) -> None:
        import fsspec

        is_plain = fsspec.core.split_protocol(url)[0] in (None, "file", "local")
        options = {"auto_mkdir": True} if is_plain else {}
        try:
            self._files, self.root = fsspec.core.url_to_fs(url, use_listings_cache=False, **options)
        except (ImportError, ValueError) as error:
            raise InputError(f"the store {url} cannot be opened: {error}") from error
        self.url = self.root if self.is_local else url
        self._cache = cache

    @property
    def is_local(self) -> bool:
        protocol = self._files.protocol
        return "file" in ((protocol,) if isinstance(protocol, str) else protocol)

    def open(self) -> None:
        """Raises InputError: it can't be written."""
        try:
            self._files.pipe_file(
                f"{self.root}/store.txt", b"Results of tumortrack fleet, by key.\n"
            )
        except OSError as error:
            raise InputError(f"the store {self.url} cannot be written: {error}") from error

    def has(self, key: str) -> bool:
        """Whether there is a whole result."""
        return self.found(key) == (True, None)

    def found(self, key: str) -> tuple[bool, str | None]:
        """Whether there is an entry; and if the task can't be done, why."""
        manifest = self._manifest(key)
        return bool(manifest), manifest.get("failure")

    def get(self, key: str) -> Path:
        """A folder on this machine with the result, not to be altered; every file's sha256 is
        checked. Raises DamagedError: it is not whole, or gone."""
        files = self._manifest(key).get("files")
        if files is None:
            raise DamagedError(key, "it has no manifest")
        place = f"{self._place(key)}/files"
        if self.is_local:
            _check(Path(place), key, files)
            return Path(place)
        folder = self._kept / key
        try:
            _check(folder, key, files)
        except DamagedError:  # not fetched yet, or altered
            for name in files:
                try:
                    _fetch(self._files, f"{place}/{name}", folder / name)
                except FileNotFoundError as error:
                    raise DamagedError(key, f"it lacks {name}") from error
            _check(folder, key, files)
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        return folder

    def put(self, key: str, folder: Path) -> None:
        """Keep the files of ``folder``, unless ``key`` is there already."""
        if self.has(key):
            return
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        names = {path.relative_to(folder).as_posix(): path for path in paths}
        digests = {name: sha256_of(path) for name, path in names.items()}
        for name, path in names.items():
            self._files.put_file(str(path), f"{self._place(key)}/files/{name}")
        self._seal(key, digests, None)

    def put_failure(self, key: str, reason: str) -> None:
        """Keep that this task can't be done."""
        self._seal(key, {}, reason)

    def remove(self, key: str) -> None:
        """Take a result away, its manifest first."""
        place = self._place(key)
        if self._files.exists(f"{place}/{MANIFEST}"):
            self._files.rm_file(f"{place}/{MANIFEST}")
        if self._files.exists(place):
            self._files.rm(place, recursive=True)
        if not self.is_local:
            shutil.rmtree(self._kept / key, ignore_errors=True)

    def claim(self, key: str, run: str) -> bool:
        """Claim a task for ``run``, or renew the claim; False: another run holds it. Two runs that
        ask at the same moment may both get True, and then both do it, with the same bits."""
        now, here = time.time(), socket.gethostname()
        try:
            holder = json.loads(self._files.cat_file(self._claim(key)))
            gone = holder["host"] == here and not is_running(holder["process"])
            if holder["run"] != run and abs(now - holder["time"]) < _CLAIMED_S and not gone:
                return False
        except (FileNotFoundError, ValueError):
            pass
        mine = {"run": run, "host": here, "process": os.getpid(), "time": now}
        self._files.pipe_file(self._claim(key), json.dumps(mine).encode())
        return True

    def release(self, key: str) -> None:
        """Give up a claim."""
        with suppress(FileNotFoundError):
            self._files.rm_file(self._claim(key))

    def cost(self, key: str) -> dict[str, Any]:
        """What a task cost, as the engine wrote it; empty: unknown."""
        try:
            cost: dict[str, Any] = json.loads(self._files.cat_file(self._cost(key)))
        except (FileNotFoundError, ValueError):
            return {}
        return cost

    def put_cost(self, key: str, cost: dict[str, Any]) -> None:
        self._files.pipe_file(self._cost(key), json.dumps(cost, indent=1).encode())

    def user_file(self, file: File) -> Path:
        """A user's file on this machine. Raises InputError: it is another by now."""
        path = Path(file.path)
        if not path.exists():
            raise FileNotFoundError(f"{file.path} is not there (on this machine)")
        if sha256_of(path) != file.key:
            raise InputError(f"{file.path} was changed after the list was read; start again.")
        return path

    def _seal(self, key: str, files: dict[str, str], failure: str | None) -> None:
        manifest = {"key": key, "failure": failure, "files": files}
        text = json.dumps(manifest, indent=1) + "\n"
        self._files.pipe_file(f"{self._place(key)}/{MANIFEST}", text.encode())

    def _manifest(self, key: str) -> dict[str, Any]:
        """Empty: there is none that can be read."""
        try:
            manifest = json.loads(self._files.cat_file(f"{self._place(key)}/{MANIFEST}"))
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return {}
        if not isinstance(manifest, dict) or not isinstance(manifest.get("files"), dict):
            return {}
        inside = all(".." not in name.split("/") and name[:1] != "/" for name in manifest["files"])
        return manifest if manifest.get("key") == key and inside else {}

    def _claim(self, key: str) -> str:
        return f"{self.root}/claims/{key}.json"

    def _place(self, key: str) -> str:
        return f"{self.root}/{key[:2]}/{key}"

    def _cost(self, key: str) -> str:
        return f"{self.root}/costs/{key[:2]}/{key}.json"

    @cached_property
    def _kept(self) -> Path:
        """This machine's cache of this store; old entries are removed."""
        name = hashlib.sha256(self.url.encode()).hexdigest()[:12]
        kept = self._cache or scratch() / name
        _clear_old(kept)
        return kept


def is_running(process: int) -> bool:
    """Whether a process is running on this machine; zombies do not count."""
    with suppress(OSError, IndexError):  # Linux
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _fetch(files: Any, source: str, target: Path) -> None:
    """Copy a file from any storage in one step."""
    part = scratch() / f"{os.getpid()}.part"
    files.get_file(source, str(part))
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(part, target)


def scratch() -> Path:
    """A folder on this machine for temporary files; old ones are removed."""
    folder = Path(tempfile.gettempdir()) / f"tumortrack-fleet-{os.getuid()}"
    _clear_old(folder)
    return folder


def _clear_old(folder: Path) -> None:
    """Make the folder, or remove what was not touched for a day."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        if time.time() - old.stat().st_mtime > _KEPT_S:
            shutil.rmtree(old, ignore_errors=True) if old.is_dir() else old.unlink()


def _check(folder: Path, key: str, files: dict[str, str]) -> None:
    """Raises DamagedError unless all files are there with these sha256."""
    for name, digest in files.items():
        if not (folder / name).is_file():
            raise DamagedError(key, f"it lacks {name}")
        if sha256_of(folder / name) != digest:
            raise DamagedError(key, f"{name} was changed (sha256 differs)")
