"""The whole story on the built-in phantom: CT, case, training, unseen scenes, table and page."""

from __future__ import annotations

import shutil
from pathlib import Path

from tumortrack.app import commands
from tumortrack.app.console import say
from tumortrack.core.errors import InputError

CT_SEED, SCENE_SEED = 1, 2
# Two of the paper's deformation configurations: the one that training uses, and a stronger one.
CONFIGURATIONS = (2, 3)
_MINE = ("ct_dicom", "case", "model", "dataset", "scenes", "report.json", "index.html")


def run_demo(out: Path, minutes: float, scenes: int) -> None:
    """Write everything below ``out``; the report is OUT/report.json, the page OUT/index.html.

    Raises:
        InputError: ``out`` holds files that no demo made.
    """
    from tumortrack.imaging.case import load_case
    from tumortrack.imaging.prepare import PrepareOptions
    from tumortrack.phantom.dicom import write_dicom_series
    from tumortrack.phantom.digital import PhantomParameters, phantom_labels
    from tumortrack.phantom.scanner import ScannerParameters, scan

    _clear(out)
    say("1/5 scanning the built-in kidney phantom (virtual CT, DICOM)")
    ct = scan(phantom_labels(PhantomParameters()), ScannerParameters(), CT_SEED)
    write_dicom_series(ct, out / "ct_dicom")
    say("2/5 segmenting the CT, making surfaces")
    commands.prepare(out / "ct_dicom", out / "case", PrepareOptions(), overwrite=False)
    say(f"3/5 training for {minutes:g} minutes")
    commands.train(out / "case", out / "model", commands.TrainOptions(minutes=minutes))
    say(f"4/5 simulating {scenes} unseen deformed scenes")
    commands.write_scenes(
        load_case(out / "case"),
        out / "dataset",
        commands.SimulateOptions(scenes, SCENE_SEED, CONFIGURATIONS),
    )
    say("5/5 locating kidney and tumors in each from one depth image")
    commands.evaluate(out / "model", out / "dataset", out, grid=128, seed=0, device="auto")
    say(f"open {out / 'index.html'} in a browser: estimate over truth, in 3-D, scene by scene.")


def _clear(out: Path) -> None:
    if not out.exists():
        out.mkdir(parents=True)
    foreign = sorted(p.name for p in out.iterdir() if p.name not in _MINE)
    if foreign:
        raise InputError(
            f"{out} holds files that are not a demo's ({', '.join(foreign[:3])}); choose another "
            "--out folder."
        )
    for name in _MINE:
        path = out / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
