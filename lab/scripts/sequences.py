"""Sequences of a moving organ, with truth at every frame; and how followers do in them.

    make sequences ARGS='CASE OUT --count 3 --views 3 --model MODEL'

Writes a folder a sequence into OUT (``tumortrack_lab.world.films``; about 30 s each, and 0.1 s a
frame and camera). The same command goes on where it was stopped, and --count may grow. With --model
every method locates the organ in every frame; the tables OUT/*.csv also count what --others hold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import pandas as pd
import tyro

from tumortrack import api
from tumortrack.cli.console import model_folder, progress_bar, say
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.tracking.tracker import Tracker, region_for
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import ReportWriter
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.twin.dataset import claim, known
from tumortrack_lab.world import following, pictures, tables
from tumortrack_lab.world.films import ALL_KINDS, Film, FilmConfig, read_film, write_film
from tumortrack_lab.world.paths import KINDS
from tumortrack_lab.world.scenes import TETS, World, WorldConfig
from tumortrack_lab.world.states import STATE_KINDS, State, read_states, world_of


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
    """Which kinds; jump, hidden and random need --states."""
    states: Path | None = None
    """Undisturbed scenes of this case that `make world` made: their states are gone through."""
    views: int = 1
    """Cameras: 1, or 3 (above the organ, and 45 degrees to either side)."""
    seed: int = 0
    """Of everything."""
    model: Path | None = None
    """Follow with it (a case has one)."""
    methods: tuple[str, ...] = ("track", "first-look")
    """How; see tumortrack_lab.world.following."""
    others: tuple[Path, ...] = ()
    """Folders of other organs, followed before, that the table counts in."""
    document: Path | None = None
    """A page beside which go tables, a plot and a film of this organ's strongest press; the
    other tables go to data/ beside it."""


def main(options: Options) -> None:
    """Make what is missing, then follow what there is."""
    known(options.kinds, ALL_KINDS)
    known(options.methods, following.METHODS)
    writer = scripts.begun("sequences", options.document)
    if options.states is None and set(options.kinds) & set(STATE_KINDS):
        raise InputError("jump, hidden and random go through solved states; name some: --states.")
    if options.views not in (1, 3):
        raise InputError(f"--views is {options.views}; allowed: 1, 3.")
    config = FilmConfig(seed=options.seed, views=options.views)
    world, states = _opened(options, config)
    wanted = [(kind, number) for number in range(options.count) for kind in options.kinds]
    todo = [(k, n) for k, n in wanted if not (options.out / f"{k}-{n:03d}").exists()]
    with progress_bar("sequences", len(todo)) as advance:
        for kind, number in todo:
            place = options.out / f"{kind}-{number:03d}"
            try:
                write_film(world, config, kind, number, place, states)
            except TumortrackError as error:
                say(f"{place.name} failed: {error}")
            advance()
    folders = [options.out / f"{kind}-{number:03d}" for kind, number in wanted]
    films = [read_film(folder) for folder in folders if folder.exists()]
    if options.model is not None:
        _follow(options, model_folder(options.model), films, writer)


def _opened(options: Options, config: FilmConfig) -> tuple[World, Callable[[], list[State]]]:
    """The folder's world, whose inputs are written there, and the solved states to go through."""
    identity = {
        "case_sha256": store.sha256_of(options.case / store.MANIFEST),
        "config": to_builtins(config),
    }
    claim(options.out, "sequences.json", identity)
    source = options.states or options.out
    world = World.opened(options.case, WorldConfig(), source / TETS)
    if options.states is not None:
        world = world_of(world, source)
    return world, cache(lambda: read_states(world, source))


def _follow(options: Options, model: Path, films: list[Film], writer: ReportWriter) -> None:
    tracker, sha256 = Tracker(api.load_model(model)), store.sha256_of(model / store.MANIFEST)
    about = {"model_sha256": sha256, "version": ""}
    sites, region = tumor_sites_of(films[0].rest), region_for(tracker.model)
    for done, film in enumerate(films, start=1):
        for method in options.methods:
            locate = following.METHODS[method](tracker, film)
            judge = partial(following.judge, locate, film, sites, region)
            rows = scripts.kept(film.folder / f"{method}.json", about, judge)
            errors = pd.DataFrame(rows).reindex(columns=["center_mm"])["center_mm"]
            say(f"{done}/{len(films)} {film.folder.name}, {method}: {errors.median():.1f} mm off")
    rows = [row for out in (options.out, *options.others) for row in tables.rows_in(out)]
    frame = pd.DataFrame(rows)
    made = tables.tables(frame)
    for name, table in made.items():
        store.write_atomically(options.out / f"{name}.csv", table.to_csv(index=False).encode())
        print(f"{tables.WORDS[name]}\n{table.to_string(index=False)}\n")
    if options.document is not None:
        plot, moving = writer.image("sequences_press"), writer.image("sequences_film")
        moving = moving.with_suffix(".gif")
        pictures.draw(frame, plot)
        presses = (film for film in films if film.meta["kind"] == "press")
        press = max(presses, key=lambda film: film.bend_mm.max())
        pictures.show(following.track(tracker), press, moving)
        writer.tables({f"sequences_{name}": table for name, table in made.items()})


if __name__ == "__main__":
    scripts.run(main, Options)
