"""Sequences of an organ on the move, with truth at every frame; and how followers do in them.

    make sequences ARGS='CASE OUT --count 3 --views 3 --model MODEL'

Writes a folder a sequence into OUT (``tumortrack_lab.world.films``; about 30 s each, and 0.1 s a
frame and camera). The same command goes on where it was stopped, and --count may grow. With --model
every method judges every frame; OUT/table.md and press.png also count what --others hold.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pandas as pd
import tyro

from tumortrack import api
from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.study import trainings
from tumortrack_lab.world import following
from tumortrack_lab.world.films import FilmConfig, read_film, write_film
from tumortrack_lab.world.paths import KINDS
from tumortrack_lab.world.scenes import World


@dataclass(frozen=True)
class Options:
    """Make sequences and follow them with a model."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    out: tyro.conf.Positional[Path]
    """Folder of the sequences."""
    count: int = 3
    """Sequences of each kind."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """Which kinds."""
    views: int = 1
    """Cameras: 1, or 3 (above the organ, and 45 degrees to either side)."""
    fps: float = 10.0
    """Frames a second."""
    seed: int = 0
    """Of everything."""
    model: Path | None = None
    """Follow with it (folder that `tumortrack train` wrote)."""
    methods: tuple[str, ...] = ("track", "first look")
    """How; see tumortrack_lab.world.following."""
    version: str = ""
    """Of the program, if several are to be compared: kept apart, and named in the table."""
    others: tuple[Path, ...] = ()
    """Folders of other organs, followed before, that the table counts in."""


def main(options: Options) -> None:
    """Make what is missing, then follow what there is."""
    chosen = (options.kinds, KINDS), (options.methods, following.METHODS)
    for names, known in chosen:
        if unknown := sorted(set(names) - set(known)):
            raise InputError(f"{unknown[0]!r} is not known; allowed: {', '.join(known)}.")
    if options.views not in (1, 3):
        raise InputError(f"--views is {options.views}; allowed: 1, 3.")
    config = FilmConfig(seed=options.seed, fps=options.fps, views=options.views)
    world = World.kept(options.case, options.out, "sequences.json", config)
    wanted = [(kind, number) for number in range(options.count) for kind in options.kinds]
    todo = [(k, n) for k, n in wanted if not (options.out / f"{k}-{n:03d}").exists()]
    start = time.monotonic()
    for done, (kind, number) in enumerate(todo, start=1):
        try:
            write_film(world, config, kind, number, options.out / f"{kind}-{number:03d}")
            what = "made"
        except TumortrackError as error:
            what = f"failed: {error}"
        left_min = (time.monotonic() - start) / done * (len(todo) - done) / 60
        say(f"{done}/{len(todo)} {kind}-{number:03d} {what}; {left_min:.0f} min left")
    if options.model is not None:
        _follow(options, [f"{kind}-{number:03d}" for kind, number in wanted])


def _follow(options: Options, names: list[str]) -> None:
    assert options.model is not None
    tracker = Tracker(api.load_model(options.model, "cpu"))
    about = {
        "model_sha256": store.sha256_of(options.model / store.MANIFEST),
        "version": options.version,
    }
    made = [name for name in names if (options.out / name).exists()]
    for done, name in enumerate(made, start=1):
        film = read_film(options.out / name)
        for method in options.methods:
            called = f"{method} {options.version}".strip()
            path = film.folder / f"{called.replace(' ', '-')}.json"
            locate = following.METHODS[method](tracker)
            rows = trainings.kept(path, about, partial(following.judge, locate, film))
            errors = pd.DataFrame(rows)["center_mm"]
            say(f"{done}/{len(made)} {name}, {called}: centre {errors.median():.1f} mm off")
    rows = [row for out in (options.out, *options.others) for row in following.rows_in(out)]
    found = pd.DataFrame(rows)
    text = following.summary(found)
    store.write_atomically(options.out / "table.md", text.encode())
    following.draw(found, options.out / "press.png")
    print(text)


if __name__ == "__main__":
    trainings.run(main, Options)
