"""By what a model's error bounds are to be multiplied: scenes of known truth -> a row per state ->
``BoundFactor``, by split conformal prediction (Vovk et al., Algorithmic Learning in a Random
StressScenes, 2005). The unit is the physical state: one scene of each counts. A row is on disk
before the next state is located.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import tumortrack
from tumortrack.assessment.bound_factor import BoundFactor
from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.core import store
from tumortrack.core.assessment import deciding
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.rigid_fit import matched_vertices
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.io.scene_folder import Scene, list_scenes
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks.physics.scenes import simplified

_CONFIDENCE = 0.95  # what the bounds mean
# The 95 % quantile exists from 19 answers on. Of 59 the largest ratio exceeds the true quantile
# with 95 % confidence (0.95^59 < 0.05): with fewer, the factor may be far too small by chance.
LEAST = 59
_ROUNDING = 1e-9  # (n + 1) * 0.95 may be a little more than the whole number that it is
_GRID = 8  # voxels: the labelled volume is not used


class Row(Config, frozen=True):
    """One state, located. ``ratio``: of a good answer, the farthest that a vertex of its tumors is
    off, over their bound; ``doubt``: why there is none."""

    scene: str
    sha256: str
    ratio: float | None = None
    doubt: str = ""


@contextmanager
def open_table(
    path: Path, head: dict[str, Any]
) -> Iterator[tuple[list[Row], Callable[[Row], None]]]:
    """The rows of a table, and a function that adds one, which is on disk when it returns. A line
    that a killed process left unfinished is dropped. Raises InputError: the table has another
    ``head``, or another process is filling it; StorageError: the disk refused."""
    with store.writing(path):
        stream = path.open("a+b")
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{path} is being filled by another process.") from error
        stream.seek(0)
        content = stream.read()
        whole = content[: content.rfind(b"\n") + 1]
        begun = json.dumps(head, allow_nan=False).encode().startswith(content)
        known_head, rows = (head, []) if begun else _parsed(whole, path)  # foreign: left as it is
        stream.truncate(len(whole))

        def add(data: object) -> None:
            with store.writing(path):
                stream.write(json.dumps(data, allow_nan=False).encode() + b"\n")
                stream.flush()
                os.fsync(stream.fileno())

        if not whole:
            add(head)
        if differ := [name for name in head if known_head.get(name) != head[name]]:
            raise InputError(
                f"{path} was begun with another {' and '.join(differ)}. Remove it, or give another "
                "--out."
            )
        yield rows, lambda row: add(to_builtins(row))


def _parsed(content: bytes, path: Path) -> tuple[dict[str, Any], list[Row]]:
    try:
        head, *lines = [json.loads(line) for line in content.splitlines()]
        return dict(head), [from_builtins(line, Row, str(path)) for line in lines]
    except (ValueError, TypeError) as error:
        raise InputError(f"{path} is not a table of `tumortrack margins`: {error}.") from error


def head_of(model_sha256: str, seed: int) -> dict[str, Any]:
    """What every row depends on besides its scene."""
    return {"model_sha256": model_sha256, "fingerprint": fingerprint(), "seed": seed}


def list_states(folders: Sequence[Path], seed: int) -> list[Path]:
    """One scene of every state, drawn by the seed. meta.json names ``family`` and ``state``;
    without a state a scene is a state of its own. Scenes of another organ (``model_organ`` false)
    are left out. Raises InputError: no scenes."""
    scenes = [scene for folder in folders for scene in list_scenes(folder)]
    first: dict[tuple[str, ...], Path] = {}
    for n in np.random.default_rng(seed).permutation(len(scenes)):
        path = scenes[n] / "meta.json"
        meta = store.read_json(path) if path.is_file() else {}
        if meta.get("model_organ") is False:
            continue  # no estimate of it can be right
        state = str(meta.get("state") or scenes[n].resolve())
        key = str(meta.get("family")), str(meta.get("case_sha256")), state
        first.setdefault(key, scenes[n])
    return sorted(first.values(), key=str)


class Locating:
    """Locates scenes with a model, without a factor. Raises InputError: it knows no bounds."""

    def __init__(self, tracker: Tracker, seed: int) -> None:
        if tracker.anatomy_ct is None:
            raise InputError(
                "models of the presets quick and paper know no error bounds: give the case itself."
            )
        self._case, self._seed = tracker.anatomy_ct, seed
        self._tracker = Tracker(replace(tracker.model, bound_factor=1.0))

    @cached_property
    def _simplified(self) -> Anatomy:
        """With the triangles of a wider world's scenes."""
        return simplified(self._case)

    def row(self, scene: Scene, folder: Path) -> Row:
        """Judged by its depth image, if any, as `locate` and `track` do. Raises InputError: its
        surfaces are not the case's."""
        row = Row(scene=str(folder.resolve()), sha256=store.sha256_of(folder))
        try:
            found = self._tracker.locate(
                scene.cloud, grid=_GRID, seed=self._seed, full_view=scene.depth
            )
        except NoEstimate as error:
            return Row(row.scene, row.sha256, doubt=str(error))
        bounds = deciding(found.assessment.bounds)
        if found.quality != "good" or not bounds:
            return Row(row.scene, row.sha256, doubt=found.reason or "no bound is known")
        assert found.motion is not None
        ratios = []
        for name, bound in bounds.items():
            rest, true_mm = self._matched(name, scene)
            off_mm = np.linalg.norm(found.motion.forward(rest.vertices_mm) - true_mm, axis=1)
            ratios.append(float(off_mm.max()) / bound.error_bound95_mm)
        return Row(row.scene, row.sha256, ratio=max(ratios))

    def _matched(self, name: str, scene: Scene) -> tuple[Mesh, np.ndarray]:
        """A part in the CT, and where the scene has each of its vertices."""
        number, true = self._case.names.index(name), scene.reference.parts
        try:
            return (rest := self._case.parts[number]), matched_vertices(rest, true[number])
        except InputError:
            return (rest := self._simplified.parts[number]), matched_vertices(rest, true[number])


def factor_of(rows: Iterable[Row]) -> tuple[float, int]:
    """The ceil((n + 1) 0.95)-th smallest of n good answers' ratios, and n: a further answer,
    exchangeable with them, has no larger one with at least that confidence. Raises InputError: too
    few of them."""
    ratios = sorted(row.ratio for row in rows if row.ratio is not None)
    if len(ratios) < LEAST:
        raise InputError(
            f"{len(ratios)} scenes, a state each, have a good answer; {LEAST} are needed. Give "
            "more scenes."
        )
    rank = math.ceil((len(ratios) + 1) * _CONFIDENCE - _ROUNDING)
    return ratios[rank - 1], len(ratios)


def found_factor(
    rows: Iterable[Row], model_sha256: str, table_sha256: str, seed: int
) -> BoundFactor:
    """``factor_of`` with what it belongs to."""
    factor, answers = factor_of(rows)
    return BoundFactor(
        factor=factor,
        answers=answers,
        seed=seed,
        model_sha256=model_sha256,
        table_sha256=table_sha256,
        fingerprint=fingerprint(),
        tumortrack=tumortrack.__version__,
    )
