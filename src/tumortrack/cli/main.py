"""The command line: one function a command, its types are its options.

Most commands are in ``cli_cases``, ``cli_models`` and ``cli_use``.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import tyro
from tyro.conf import Positional

from tumortrack.cli.cli_cases import export, prepare, simulate
from tumortrack.cli.cli_models import compile, evaluate, onnx, pretrain, train
from tumortrack.cli.cli_use import locate, plan, resect, track
from tumortrack.cli.loading import leave
from tumortrack.core.errors import TumortrackError


def demo(*, out: Path = Path("runs/demo"), minutes: float = 2.0, scenes: int = 20) -> None:
    """The whole story on the built-in phantom, in a few minutes.

    Args:
        out: folder for everything the demo makes; what an earlier demo left there is replaced.
        minutes: of training.
        scenes: unseen deformed scenes to locate tumors in.
    """
    from tumortrack.cli.demo import run_demo

    run_demo(out, minutes, scenes)


def inspect(path: Positional[Path], /) -> None:
    """Say what a case, model, run, scene or report is.

    Args:
        path: folder or file.
    """
    from tumortrack.cli import commands

    commands.inspect(path)


def doctor() -> None:
    """Say what works on this machine."""
    from tumortrack.cli.doctor import examine

    examine()


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "prepare": prepare,
    "export": export,
    "train": train,
    "pretrain": pretrain,
    "locate": locate,
    "track": track,
    "plan": plan,
    "resect": resect,
    "simulate": simulate,
    "evaluate": evaluate,
    "compile": compile,
    "onnx": onnx,
    "inspect": inspect,
    "doctor": doctor,
}


_ORDER = (
    *("demo", "prepare", "export", "train", "pretrain", "locate", "track", "plan", "resect"),
    *("simulate", "twin", "evaluate", "bench", "compile", "onnx", "inspect", "doctor"),
)
_OBJECTS_A_COLLECTION = 20_000
_LEFT_AT_ONCE = ["locate"]  # holds nothing open in the end, and is waited for


def main() -> None:
    """Entry point."""
    # OpenMP's threads wait by spinning; where other programs want the cores that is several times
    # slower than giving them back soon, and no faster where they don't.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # NumPy's and SciPy's matrices here are small: more threads gain little, and lose much likewise.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # PyTorch and its kin make objects by the hundred thousand that live to the end: to look through
    # them for garbage again and again is a tenth of the time of their import.
    gc.set_threshold(_OBJECTS_A_COLLECTION)
    if code := run(sys.argv[1:]):
        sys.exit(code)
    if sys.argv[1:2] == _LEFT_AT_ONCE:
        leave()


def run(arguments: list[str]) -> int:
    """One command: its exit code. A known error is one line, never a traceback."""
    try:
        _call(arguments)
        sys.stdout.flush()
    except TumortrackError as error:
        print(f"tumortrack: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("tumortrack: stopped.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `tumortrack inspect X | head`
        sys.stderr.close()
        return 1
    return 0


def _commands() -> dict[str, Callable[..., None]]:
    """Ours, and those of other installed packages: entry points of the group
    ``tumortrack.commands``."""
    others = {point.name: point for point in entry_points(group="tumortrack.commands")}
    found = COMMANDS | {name: point.load() for name, point in sorted(others.items())}
    return {name: found[name] for name in sorted(found, key=_place)}


def _place(name: str) -> int:
    return _ORDER.index(name) if name in _ORDER else len(_ORDER)


def _call(arguments: list[str]) -> None:
    """Only the chosen command's options are made; all of them take several times as long."""
    commands = _commands()
    if arguments and (command := commands.get(arguments[0])) is not None:
        tyro.cli(command, prog=f"tumortrack {arguments[0]}", args=arguments[1:])
        return
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="tumortrack",
        description="Locate kidney and tumors under deformation from one depth image. "
        "Research software, not a medical device.",
        args=arguments,
    )


if __name__ == "__main__":
    main()
