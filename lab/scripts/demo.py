"""The ten scenes that the package brings and the demo shows (tumortrack_lab.world.demo).

    make demo-scenes ARGS='OUT'        (some two minutes)

Writes src/tumortrack/simulate/phantom_scenes.safetensors. OUT keeps the phantom's CT and case, the
tetrahedra and the twin's states, with which the same command gives the same file; without them
places differ by some hundredths of a millimetre, as tetrahedra cannot be made again alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

import tumortrack as tt
from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.simulate import datasets
from tumortrack_lab.study import scripts
from tumortrack_lab.world.demo import demo_scenes


@dataclass(frozen=True)
class Options:
    """Make the scenes and pack them."""

    out: tyro.conf.Positional[Path]
    """What takes long is kept here."""


def main(options: Options) -> None:
    """The case of the demo, its scenes, one file."""
    case = options.out / "case"
    if not case.exists():
        tt.prepare(tt.scan_phantom(options.out / "ct", spacing_mm=datasets.SPACING_MM), case)
    content = datasets.packed(demo_scenes(case, options.out, say), tt.load_case(case).anatomy)
    file = Path(datasets.__file__).with_name(datasets.FILE)
    store.write_atomically(file, content)
    say(f"{len(content) / 1e6:.1f} MB written to {file}.")


if __name__ == "__main__":
    scripts.run(main, Options)
