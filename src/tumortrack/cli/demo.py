"""The whole story on the built-in phantom: CT, case, ten scenes, table and page."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tumortrack
from tumortrack.cli.cases import Evaluate, Prepare
from tumortrack.cli.console import say, say_table
from tumortrack.cli.main import command
from tumortrack.cli.training import Train
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate, NoPlan

_MARKER = "demo.json"  # the files beside it are a demo's and may be replaced
_MADE = (
    "ct_dicom", "case", "model", "dataset", "scenes", "report.json", "index.html", "paper",
)  # fmt: skip
_MINUTES = 3.0  # of training, where no weights come with the package
_VOLUME = 400  # voxels along each axis, as the paper has


@dataclass(frozen=True, kw_only=True)
class Demo:
    """The whole story on the built-in phantom, in half a minute: its CT, its model, and its tumors
    in ten scenes of independent physics.

    Attributes:
        out: folder for everything the demo makes; what an earlier demo left there is replaced.
        scenes: the first so many of the ten.
        preset: quick and paper show the paper's network beside it, on the same CT and scenes
            (OUT/paper), and plan a resection on its labelled volume of 400 x 400 x 400.
        minutes: train that network first, for so long once kernels are compiled (default: quick has
            weights that come with it; paper 3).
    """

    out: Path = Path("runs/demo")
    scenes: int = 10
    preset: Literal["elastic", "quick", "paper"] = "elastic"
    minutes: float | None = None

    def run(self) -> None:
        from tumortrack import api
        from tumortrack.report.summary import conclusions, scene_table
        from tumortrack.simulation import datasets

        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise InputError(f"--minutes {self.minutes:g} must be more than 0.")
        if self.preset != "elastic":
            from tumortrack.registration.method import method_of_preset

            method_of_preset(self.preset)  # what is missing is said first
            command("plan")
        if not 1 <= self.scenes <= datasets.SCENES:
            raise InputError(f"--scenes {self.scenes}; allowed: 1 to {datasets.SCENES}.")
        out = self.out
        _clear(out)
        say("1/3 scanning the built-in kidney phantom (virtual CT, DICOM)")
        api.scan_phantom(out / "ct_dicom", spacing_mm=datasets.SPACING_MM)
        say("2/3 segmenting the CT, making surfaces and an elastic body")
        began = time.perf_counter()
        Prepare(input=out / "ct_dicom", out=out / "case").run()
        made_s = time.perf_counter() - began
        say("3/3 locating kidney and tumors, each time from one depth image, after other physics")
        for name, scene in datasets.phantom_scenes(self.scenes).items():
            scene.write(out / "dataset" / name)
        evaluate = Evaluate(model=out / "case", variants=out / "dataset", report=out, grid=128)
        report = evaluate.write()  # beside the case and the scenes
        first = report["scenes"][0]
        if "seconds" in first:  # located
            to_first_s = made_s + first["seconds"]
            say(f"labels to first estimate: {to_first_s:.0f} s, from the CT.")
        if self.preset != "elastic":
            self._show_paper(report)
        say_table(scene_table(report["scenes"]))
        for line in conclusions(report["scenes"]):
            say(line)
        say(f"open {out / 'index.html'} in a browser: estimate over truth, in 3-D, scene by scene.")

    def _show_paper(self, ours: dict[str, Any]) -> None:
        """The paper's method on the same CT and scenes, compared with the default method."""
        from tumortrack.cli.locate import Locate
        from tumortrack.io.model_folder import read_model_manifest, training_words
        from tumortrack.io.scene_folder import list_scenes
        from tumortrack.registration.method import method_of_preset
        from tumortrack.report.summary import conclusions, headlines, side_by_side

        out, paper = self.out, self.out / "paper"
        shipped = None if self.minutes else method_of_preset(self.preset).phantom_model(self.preset)
        if shipped is None:
            minutes = self.minutes or _MINUTES
            say(f"the paper's method, preset {self.preset}: training for {minutes:g} minutes")
            Train(case=out / "case", model=out / "model", preset=self.preset, minutes=minutes).run()
        else:
            shutil.copytree(shipped, out / "model")
        about = training_words(read_model_manifest(out / "model")["provenance"])
        say(f"the paper's method, an occupancy network, preset {self.preset}: {about}")
        report = Evaluate(
            model=out / "model", variants=out / "dataset", report=paper, grid=128
        ).write()
        scene = list_scenes(out / "dataset")[0]
        say(f"labelled volume of {_VOLUME} voxels along each axis of {scene.name}, and a plan")
        run = paper / "run"
        try:
            Locate(model=out / "model", cloud=scene / "cloud.ply", out=run, grid=_VOLUME).run()
            command("plan")(
                run_folder=run, plan=paper / "plan", method="published", arms=False,
                accept_poor=True, accept_budget=True,
            ).run()  # fmt: skip
        except (NoEstimate, NoPlan) as error:  # after so short a training
            say(f"no plan: {error}")
        for name, result in (("default method", ours), (f"the paper's, {self.preset}", report)):
            say(f"{name}:")
            for line in (conclusions(result["scenes"])[0], *headlines(result["summary"])):
                say(f"  {line}")
        say_table(side_by_side({"default": ours["scenes"], self.preset: report["scenes"]}))


def _clear(out: Path) -> None:
    """Make ``out``, or remove what an earlier demo, recognised by its marker, left there."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; --out must be a folder.")
    with store.writing(out):
        out.mkdir(parents=True, exist_ok=True)
        names = sorted(p.name for p in out.iterdir())
    foreign = [name for name in names if name not in (*_MADE, _MARKER)]
    if names and (foreign or _MARKER not in names):
        raise InputError(
            f"{out} holds files that no demo wrote ({', '.join((foreign or names)[:3])}); choose "
            "another --out folder."
        )
    store.write_json(out / _MARKER, {"kind": "demo", "tumortrack": tumortrack.__version__})
    for path in (out / name for name in _MADE):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
