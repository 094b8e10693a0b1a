"""The paper's table and its study of deformations, on the twin: how far off its method is here.

    make paper ARGS='runs/demo/case OUT --document docs/paper.md'   (half an hour, after make demo)

Makes the twin's scenes of CASE in OUT/scenes and evaluates both models and the default method in
them; then, on a random kidney in OUT/second, trains and evaluates a short network for each of the
paper's six configurations of deformation. The same command goes on where it was stopped.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import tyro

import tumortrack as tt
import tumortrack_occupancy
from tumortrack.cli.console import live_line, progress_bar
from tumortrack.core import store
from tumortrack.io.case import load_case
from tumortrack.io.scene_folder import read_scene
from tumortrack.report import drawing
from tumortrack.report.protocol import evaluate_scene
from tumortrack.simulation.deform import DragConfig
from tumortrack.simulation.deform.drag import CONFIGURATIONS
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.fleet.checks import described
from tumortrack_benchmarks.physics.kidneys import random_anatomy
from tumortrack_benchmarks.physics.scenes import random_case
from tumortrack_benchmarks.physics.twin import TURNED, VARIANTS, VIEWS, make_scenes
from tumortrack_benchmarks.scripting import cell
from tumortrack_occupancy import presets

_SHIPPED = Path(tumortrack_occupancy.__path__[0]) / "phantom"
_PRESSED, _TURNED = ("D1", "D2", "D3"), ("Rot90", "Rot180", "Rot270")
_ERRORS = ["hausdorff_mm", "hausdorff_one_sided_mm", "center_mm"]
_HISTORY = "training/history.jsonl"
_FINEST = 400  # voxels along the longest side, the paper's
_SECOND = 1  # the first random kidney with two tumors, from this number on
_STUDY_STEPS = 2000  # of 16 scenes, for each configuration: about the 31,000 of the paper
_WRONG_MM = 5.0
# Sections Results and Deformation Strength: Hausdorff distance, mm, as the text says it; mIoU.
_SAID: dict[tuple[str, str], dict[str, str]] = {
    ("D1", "exophytic"): {"limited": "about 4", "full": "about 4"},
    ("D1", "endophytic"): {"limited": "about 7", "full": "about 7"},
    ("D2", "exophytic"): {"limited": "about 6", "full": "about 6"},
    ("D2", "endophytic"): {"limited": "about 9", "full": "about 9"},
    ("D3", "exophytic"): {"limited": "11.3", "full": "15.4"},
    ("D3", "endophytic"): {"limited": "12.9", "full": "18.5"},
    **{(turn, kind): {"full": "at most 13.4"}
       for turn in _TURNED for kind in ("exophytic", "endophytic")},
}  # fmt: skip
_SAID_MIOU = {1: 0.70, 2: 0.65, 3: 0.71, 4: 0.71, 5: 0.68, 6: 0.66}
_NAMES = {"limited": "M_lim", "full": "M_full", "default": "default method"}
_COLOURS = {"limited": "#2166ac", "full": "#b2182b"}


@dataclass(frozen=True)
class Options:
    """Evaluate the paper's method as the paper does."""

    case: tyro.conf.Positional[Path]
    """Folder that `prepare` wrote."""
    out: tyro.conf.Positional[Path]
    """Folder of scenes, rows and short trainings."""
    limited: Path = _SHIPPED / "limited"
    """A model of limited rotations, M_lim, of the same case; default: the built-in phantom's."""
    full: Path = _SHIPPED / "full"
    """One of all rotations, M_full."""
    grid: int = _FINEST
    """Voxels along the longest side."""
    study_steps: int = _STUDY_STEPS
    """Of each short training; 0: no study."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


def main(options: Options) -> None:
    """Make and measure what is missing."""
    writer, out = scripting.begun("paper", options.document), options.out
    wanted = (*_PRESSED, *_TURNED, *TURNED)
    with live_line("starting ...") as report:
        scenes = make_scenes(options.case, out / "scenes", wanted, report=report)
    models = {"limited": options.limited, "full": options.full, "default": options.case}
    case = load_case(options.case)
    kinds = [tumor["kind"] for tumor in described(case)["tumors"]]
    rows = _frame(
        {"method": name, **row}
        for name, model in models.items()
        for row in _measured(out / f"{name}.json", model, scenes, options.grid)
    )
    rows["kind"] = rows.part.map(dict(zip(case.anatomy.names[1:], kinds, strict=True)))
    tables = {"paper": table(rows), "paper-overlap": overlap(rows)}
    curves = {
        name: history(models[name]) for name in _COLOURS if (models[name] / _HISTORY).exists()
    }
    if curves:  # weights that come with the package have none
        tables["paper-training"] = pd.concat(
            [some.assign(model=_NAMES[name])[["model", *some]] for name, some in curves.items()]
        )
    if options.study_steps:
        study = _frame(_study(out / "second", options.study_steps))
        tables["paper-deformations"] = strength(study)
    print(*(table_of(each) for each in tables.values()), sep="\n\n")
    writer.tables(tables, sample=f"{len(scenes)} scenes of one organ", weights=_weights(models))

    def image(name: str) -> Path:
        return out / f"{name}.png" if options.document is None else writer.image(name)

    if curves:
        draw_curves(curves, image("paper-training"))
    if options.study_steps:
        draw_strength(study, image("paper-deformations"))


def _frame(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """What was not found is infinitely far off."""
    frame = pd.DataFrame(list(rows))
    frame[_ERRORS] = frame[_ERRORS].astype(float).fillna(np.inf)
    return frame


def _measured(path: Path, model: Path, scenes: list[Path], grid: int) -> list[dict[str, Any]]:
    """A row for each scene and part."""
    manifest = model / store.MANIFEST
    about = {
        "model": store.sha256_of(manifest), "scenes": [each.name for each in scenes], "grid": grid,
        "twin": store.sha256_of(scenes[0].parent / store.MANIFEST),
    }  # fmt: skip
    return scripting.kept(path, about, lambda: _rows(model, scenes, grid))


def _rows(model: Path, scenes: list[Path], grid: int) -> Iterable[dict[str, Any]]:
    tracker = scripting.tracker_of(model)
    with progress_bar(f"scenes located by {model}", len(scenes)) as advance:
        for path in scenes:
            variant = VARIANTS[path.name.rsplit("-", 1)[0]]
            found, _ = evaluate_scene(
                partial(tracker.locate, grid=grid), read_scene(path), path.name
            )
            took_s = found.get("timings", {})
            pressed = variant.state in _PRESSED
            for part, errors in found["parts"].items():
                yield {
                    "scene": path.name, "part": part, "quality": found["quality"],
                    "miou": found["miou"],
                    "variant": variant.state if pressed else f"Rot{variant.turn_degrees}",
                    "labels_s": took_s["encode"] + took_s["fine"] if "encode" in took_s else None,
                    **{key: errors.get(key) for key in _ERRORS},  # None: it was not found
                }  # fmt: skip
            advance()


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each variant and tumor: medians, and the worst."""
    lines = []
    tumors = rows.dropna(subset="kind").groupby(["variant", "kind"], sort=False)
    for (variant, kind), some in tumors:
        line = {"variant": variant, "tumor": kind, "scenes": some.scene.nunique()}
        for name, of in some.groupby("method", sort=False):
            line |= _cells(name, of, _SAID.get((variant, kind), {}))
        lines.append(line)
    return pd.DataFrame(lines)


def _cells(name: Any, some: pd.DataFrame, said: dict[str, str]) -> dict[str, str]:
    shown = {"HD": some.hausdorff_one_sided_mm, "both ways": some.hausdorff_mm,
             "centre": some.center_mm}  # fmt: skip
    stated = {} if name == "default" else {f"{_NAMES[name]} in the paper": said.get(name, "–")}
    return stated | {
        f"{_NAMES[name]} {title}": f"{cell(mm.median())} ({cell(mm.max())})"
        for title, mm in shown.items()
    }


def overlap(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each variant: medians of mIoU, and what the verdicts were worth."""
    lines = []
    for variant, some in rows.groupby("variant", sort=False):
        line: dict[str, Any] = {"variant": variant}
        for name, of in some.groupby("method", sort=False):
            scenes = of.drop_duplicates("scene")
            wrong = of[of.kind.notna() & (of.center_mm > _WRONG_MM) & (of.quality == "good")]
            line |= {
                f"{_NAMES[name]} mIoU": cell(scenes.miou.median(), 3),
                f"{_NAMES[name]} good": f"{(scenes.quality == 'good').sum()} of {len(scenes)}",
                f"{_NAMES[name]} good and over 5 mm off": wrong.scene.nunique(),
            }
            if name != "default":
                line[f"{_NAMES[name]} labels, ms"] = cell(1000 * scenes.labels_s.median(), 0)
        lines.append(line)
    return pd.DataFrame(lines)


def history(model: Path) -> pd.DataFrame:
    """Of a training: its validations."""
    text = (model / _HISTORY).read_text(encoding="utf-8")
    rows = pd.DataFrame(map(json.loads, text.splitlines()))
    return pd.DataFrame({
        "step": rows.step, "minutes": (rows.elapsed_s / 60).round(1),
        "learning rate": rows.learning_rate, "validation loss": rows.validation_loss.round(4),
        "validation mIoU": rows.validation_miou.round(3),
    })  # fmt: skip


def _weights(models: dict[str, Path]) -> str:
    found = (f"{_NAMES[name]} {store.sha256_of(models[name] / store.MANIFEST)[:12]}"
             for name in _COLOURS)  # fmt: skip
    return ", ".join(found)


def _study(folder: Path, steps: int) -> Iterable[dict[str, Any]]:
    """Rows of short trainings, one for each of the paper's configurations, on another kidney."""
    number = _SECOND
    while len(random_anatomy(number)[0].tumors) != 2:
        number += 1
    case = load_case(random_case(folder, number))
    wanted = (*_PRESSED, *TURNED)
    with live_line("starting ...") as report:
        scenes = make_scenes(folder / "case", folder / "scenes", wanted, VIEWS[:2], report=report)
        config = presets.quick(case.anatomy)
        for number, pulls in CONFIGURATIONS.items():
            scene = msgspec.structs.replace(config.scene, deform=(DragConfig(steps=pulls),))
            model = folder / f"configuration{number}"
            tt.train(
                case, model, config=msgspec.structs.replace(config, scene=scene), steps=steps,
                on_status=lambda now, at=number: report(f"network {at} of 6: step {now.step}"),
            )  # fmt: skip
    for number in CONFIGURATIONS:
        path = folder / f"configuration{number}"
        for row in _measured(folder / f"{number}.json", path, scenes, 160):
            yield {"configuration": number, **row}


def strength(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each configuration."""
    lines = []
    for number, some in rows.groupby("configuration"):
        scenes, tumors = some.drop_duplicates("scene"), some[some.part.str.startswith("tumor")]
        of = [scenes[scenes.variant == name].miou for name in _PRESSED]
        lines.append({
            "configuration": number,
            "distance, falloff, times": str(CONFIGURATIONS[int(str(number))]),
            "the paper's mIoU": f"{_SAID_MIOU[int(str(number))]:.2f}",
            "mIoU": cell(scenes.miou.mean(), 3),
            **{f"{name} mIoU": cell(miou.mean(), 3)
               for name, miou in zip(_PRESSED, of, strict=True)},
            "tumors' HD":
                f"{cell(tumors.hausdorff_one_sided_mm.median())} "
                f"({cell(tumors.hausdorff_one_sided_mm.max())})",
        })  # fmt: skip
    return pd.DataFrame(lines)


def draw_curves(curves: dict[str, pd.DataFrame], path: Path) -> None:
    """Validation loss and mIoU over steps."""
    figure = drawing.new_figure(8.0, 3.4, left=0.1, right=0.98, top=0.95, bottom=0.16, wspace=0.25)
    for place, column in enumerate(("validation loss", "validation mIoU"), start=1):
        axes = figure.add_subplot(1, 2, place)
        for name, some in curves.items():
            axes.plot(some.step, some[column], color=_COLOURS[name], label=_NAMES[name])
        axes.set(xlabel="steps of 16 scenes", ylabel=column)
        axes.legend(frameon=False)
    drawing.save(figure, path)


def draw_strength(rows: pd.DataFrame, path: Path) -> None:
    """mIoU by configuration, beside the paper's."""
    scenes = rows.drop_duplicates(["configuration", "scene"])
    figure = drawing.new_figure(7.0, 3.4, left=0.1, right=0.98, top=0.95, bottom=0.16)
    axes, numbers = figure.add_subplot(), np.array(list(CONFIGURATIONS))
    for shift, state in zip((-0.15, 0.0, 0.15), _PRESSED, strict=True):
        of = scenes[scenes.variant == state].groupby("configuration").miou
        axes.errorbar(
            numbers + shift, of.mean(), yerr=[of.mean() - of.min(), of.max() - of.mean()],
            fmt="o", ms=4, label=f"{state}: mean and range",
        )  # fmt: skip
    axes.plot(numbers, list(_SAID_MIOU.values()), "k_", ms=18, label="the paper, on its gel")
    axes.set(xlabel="configuration", ylabel="mIoU")
    axes.set_ylim(top=axes.get_ylim()[1] + 0.06)  # room for the legend
    axes.legend(frameon=False, ncols=2, fontsize="small", loc="upper center")
    drawing.save(figure, path)


if __name__ == "__main__":
    scripting.run(main, Options)
