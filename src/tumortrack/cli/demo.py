"""The whole story on the built-in phantom: CT, case, training, unseen scenes, table and page."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import tumortrack
from tumortrack.cli import commands
from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError, StorageError

CT_SEED, SCENE_SEED = 1, 2
# Deformations of a kind that training does not show: two of the paper's configurations of drags,
# the one that the paper trains with and the one with the most drags, and squeezed and bent as a
# whole. And elastic ones, of a library of states that training did not draw from.
DRAGGED = commands.SimulateOptions(seed=SCENE_SEED, configurations=(3, 6), squeeze=True)
ELASTIC = commands.SimulateOptions(seed=SCENE_SEED, elastic=True)
_MARKER = "demo.json"  # says that what lies beside it is a demo's and may be replaced
_MINE = ("ct_dicom", "case", "model", "dataset", "scenes", "report.json", "index.html")


def run_demo(out: Path, minutes: float, scenes: int) -> None:
    """Write everything below ``out``; the report is OUT/report.json, the page OUT/index.html.

    Raises:
        InputError: ``out`` is a file or holds what no demo made; no minutes or scenes.
    """
    from tumortrack.imaging.prepare import PrepareOptions
    from tumortrack.phantom.dicom import write_dicom_series
    from tumortrack.phantom.digital import PhantomParameters, phantom_labels
    from tumortrack.phantom.scanner import ScannerParameters, scan

    if not 0 < minutes < float("inf"):
        raise InputError(f"--minutes {minutes:g} must be more than 0.")
    if scenes < 1:
        raise InputError(f"--scenes {scenes} must be at least 1.")
    _clear(out)
    say("1/5 scanning the built-in kidney phantom (virtual CT, DICOM)")
    ct = scan(phantom_labels(PhantomParameters()), ScannerParameters(), CT_SEED)
    write_dicom_series(ct, out / "ct_dicom")
    say("2/5 segmenting the CT, making surfaces")
    commands.prepare(out / "ct_dicom", out / "case", PrepareOptions(), overwrite=False)
    say(f"3/5 training for {minutes:g} minutes")
    commands.train(out / "case", out / "model", commands.TrainOptions(minutes=minutes))
    dragged, elastic = scenes // 2, scenes - scenes // 2
    say(
        f"4/5 simulating {scenes} unseen scenes: {elastic} deformed as an elastic body, {dragged} "
        "dragged, squeezed and bent as no training scene is"
    )
    for kind, count, options in (("elastic", elastic, ELASTIC), ("dragged", dragged, DRAGGED)):
        if count > 0:
            made = replace(options, scenes=count)
            commands.write_scenes(out / "case", out / "dataset", made, f"{kind}-")
    say("5/5 locating kidney and tumors in each from one depth image")
    commands.evaluate(out / "model", out / "dataset", out, grid=128, seed=0, device="auto")
    say(f"open {out / 'index.html'} in a browser: estimate over truth, in 3-D, scene by scene.")


def _clear(out: Path) -> None:
    """Make ``out``, or empty it of an earlier demo, known by its marker."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; --out must be a folder.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        names = sorted(p.name for p in out.iterdir())
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}.") from error
    foreign = [name for name in names if name not in (*_MINE, _MARKER)]
    if names and (foreign or _MARKER not in names):
        raise InputError(
            f"{out} holds files that no demo wrote ({', '.join((foreign or names)[:3])}); choose "
            "another --out folder."
        )
    store.write_json(out / _MARKER, {"kind": "demo", "tumortrack": tumortrack.__version__})
    for path in (out / name for name in _MINE):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
