"""Artifact folders: written aside and renamed, with a JSON manifest that states kind, schema,
version, units, frame and the sha256 of every file. Nothing here loads pickles or runs code."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tumortrack
from tumortrack.core.errors import ArtifactError, InputError, StorageError
from tumortrack.core.remake import remaking

SCHEMA = 6  # raise it with every change of a folder's content or of what its numbers depend on
MANIFEST = "manifest.json"
_LARGEST_MANIFEST = 16 * 2**20  # bytes: refused before it is read


def sha256_of(path: Path) -> str:
    """Hex digest of a file, or of a folder's files (names and contents, sorted)."""
    if path.is_dir():
        digest = hashlib.sha256()
        for file in sorted(p for p in path.rglob("*") if p.is_file()):
            digest.update(os.fsencode(f"{file.relative_to(path)}\0{sha256_of(file)}\n"))
        return digest.hexdigest()
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def natural(path: Path) -> tuple[Any, ...]:
    """A key that sorts names as people number them: frame_2 before frame_10."""
    parts = re.split(r"([0-9]+)", path.name)
    keys = (("", int(part)) if n % 2 else (part, 0) for n, part in enumerate(parts))
    return tuple(keys), path


def read_file(
    path: Path, most_bytes: int, advice: str = "tumortrack writes no such file."
) -> bytes:
    """The content of a file. Raises InputError before anything is read: missing, not a regular file
    (a pipe or a device may have no end), larger than ``most_bytes``."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is not a regular file (but a folder, a pipe or a device).")
        if status.st_size > most_bytes:
            raise InputError(f"{path} is larger than {most_bytes >> 20} MiB. {advice}")
        with path.open("rb") as stream:
            return stream.read(status.st_size)
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """A context for writing ``path``: an OSError in it becomes a StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}.") from error


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that readers see either the old or the new content. Raises StorageError: the
    disk is full or not writable; the old file is then untouched."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with aside.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(aside, path)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise StorageError(
            f"cannot write {path}: {error.strerror}. Free some space or choose another place."
        ) from error
    except BaseException:  # Ctrl-C
        aside.unlink(missing_ok=True)
        raise


def write_json(path: Path, data: object) -> None:
    """Write JSON atomically, indented, with a final newline; NaN is refused."""
    write_atomically(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object. Raises ArtifactError: missing, too large, not one, or one with
    a key twice."""
    try:
        return json_object(read_file(path, _LARGEST_MANIFEST), path)
    except InputError as error:
        raise ArtifactError(str(error)) from error


def json_object(content: bytes, path: Path) -> dict[str, Any]:
    """The JSON object that a file holds. Raises ArtifactError: not one, or one with a key twice."""
    try:
        data = json.loads(content, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path} cannot be read as JSON: {error}.") from error
    if not isinstance(data, dict):
        raise ArtifactError(f"{path} must hold a JSON object.")
    return data


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object. Raises ValueError for a key that it has twice: which one is meant?"""
    data = dict(pairs)
    if len(data) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has {next(n for n in names if names.count(n) > 1)!r} twice")
    return data


def seal(folder: Path, kind: str, content: dict[str, Any], frame: str) -> None:
    """Write the manifest of a folder with the files that are in it now, without sub-folders."""
    files = {
        p.name: sha256_of(p)
        for p in sorted(folder.iterdir())
        if p.is_file() and p.name != MANIFEST and not p.name.startswith(".")
    }
    head = {"kind": kind, "schema": SCHEMA, "tumortrack": tumortrack.__version__, "units": "mm"}
    write_json(folder / MANIFEST, {**head, "frame": frame, **content, "files": files})


def check_place(path: Path, kind: str, overwrite: bool | None) -> None:
    """InputError if writing to ``path`` would lose something, as a mistyped path must not cost the
    user's files: ``overwrite`` only replaces an empty folder, or an artifact of the same kind with
    nothing else in it. None: the caller has no such option."""
    try:
        if not path.exists():
            return
    except OSError as error:  # a name that is too long
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error
    if not overwrite:
        advice = "." if overwrite is None else ", or give --overwrite."
        raise InputError(f"{path} exists already. Choose another path{advice}")
    if not path.is_dir():
        raise InputError(f"{path} is a file; only a {kind} folder is replaced.")
    if not (inside := [p.name for p in path.iterdir()]):
        return
    manifest = read_json(path / MANIFEST) if MANIFEST in inside else {}
    files = manifest.get("files")
    if manifest.get("kind") != kind or "tumortrack" not in manifest or not isinstance(files, dict):
        raise InputError(
            f"{path} is not a {kind} that tumortrack wrote, so it is not replaced. "
            "Choose another path, or move the folder away yourself."
        )
    if foreign := _foreign(path, manifest):
        raise InputError(
            f"{path} also holds {', '.join(foreign[:3])}, which would be lost. Move it away first, "
            "or choose another path."
        )


def _foreign(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """Files in an artifact, and in the artifacts inside it, that their manifests do not list."""
    files, folders = manifest.get("files", {}), manifest.get("folders", ())
    foreign = []
    for path in sorted(folder.iterdir()):
        if path.name in folders and (path / MANIFEST).is_file():
            inner = _foreign(path, read_json(path / MANIFEST))
            foreign += [f"{path.name}/{name}" for name in inner]
        elif path.name not in (MANIFEST, *files) and not path.name.startswith("."):
            foreign.append(path.name)
    return foreign


@contextmanager
def new_folder(path: Path, overwrite: bool | None = None) -> Iterator[Path]:
    """Fill a folder aside, then rename it to ``path``; on any error nothing appears there. What it
    replaces must be empty or of the new folder's kind. Raises InputError: see ``check_place``;
    StorageError: the disk is full or not writable."""
    try:
        _clean_up(path)
        if not overwrite:
            check_place(path, "", overwrite)
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent))
    except OSError as error:
        raise StorageError(f"cannot write beside {path}: {error.strerror}.") from error
    lock = _lock(aside)
    try:
        yield aside
        aside.chmod(0o755)
        if not path.exists():
            os.rename(aside, path)
            return
        sealed = (aside / MANIFEST).is_file()
        kind = str(read_json(aside / MANIFEST).get("kind")) if sealed else "unsealed folder"
        check_place(path, kind, overwrite)
        old = aside.with_suffix(".old")
        os.rename(path, old)
        try:
            os.rename(aside, path)
        except OSError:
            os.rename(old, path)
            raise
        remove(old)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}.") from error
    finally:
        remove(aside)
        if lock is not None:
            os.close(lock)


def _lock(folder: Path) -> int | None:
    """Lock a folder until the returned descriptor is closed or the process ends. None: another
    process has it, or the file system has no locks."""
    descriptor = None
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        if descriptor is not None:
            os.close(descriptor)
        return None
    return descriptor


def _clean_up(path: Path) -> None:
    """Remove what killed processes left beside ``path``; move back what they did not replace."""
    name = glob.escape(path.name)
    for stale in path.parent.glob(f".{name}.????????.part"):
        if (descriptor := _lock(stale)) is not None:
            remove(stale)
            os.close(descriptor)
    for old in path.parent.glob(f".{name}.????????.old"):
        if not old.with_suffix(".part").exists():
            os.rename(old, path) if not path.exists() else remove(old)


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def read_manifest(folder: Path, kind: str) -> dict[str, Any]:
    """The manifest of an artifact, with every file's sha256 checked. Raises ArtifactError: no such
    folder, another kind or schema, a missing or changed file."""
    if not (folder / MANIFEST).is_file():
        raise ArtifactError(
            f"{folder} is not a tumortrack {kind}: it has no {MANIFEST}. "
            "Give the folder that the command before this one wrote."
        )
    manifest = read_json(folder / MANIFEST)
    if manifest.get("kind") != kind:
        raise ArtifactError(f"{folder} is a {manifest.get('kind')!r}; a {kind!r} is needed here.")
    if manifest.get("schema") != SCHEMA:
        parent = folder.absolute().parent / MANIFEST
        command = remaking(folder, manifest, read_json(parent) if parent.is_file() else {})
        raise ArtifactError(
            f"{folder} has schema {manifest.get('schema')!r}; this tumortrack reads schema "
            f"{SCHEMA}. Make it again with this version{': ' * bool(command)}{command}"
        )
    files = manifest.get("files")
    if not isinstance(files, dict):
        raise ArtifactError(f"{folder / MANIFEST} lists no files; make the {kind} again.")
    for name, digest in files.items():
        file = folder / name
        if Path(name).name != name or not file.is_file():
            raise ArtifactError(f"{folder} lacks its file {name!r}; make the {kind} again.")
        if sha256_of(file) != digest:
            raise ArtifactError(
                f"{file} was changed after it was written (sha256 differs); make the {kind} again."
            )
    return manifest
