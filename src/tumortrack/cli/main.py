"""The command line: each command is a frozen dataclass of its options, with a method ``run``."""

from __future__ import annotations

import errno
import gc
import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Protocol, runtime_checkable

import tumortrack
from tumortrack.core.errors import InputError, PackageError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack.core.process import interrupt_between_imports
from tumortrack.core.renamed import in_command
from tumortrack.core.wording import command_line


@runtime_checkable
class Command(Protocol):
    """The parsed options of a command."""

    def run(self) -> int | None:
        """None, or an exit status."""
        ...


_MODULES = {  # in the order of --help; only the chosen command's is imported
    "demo": "demo", "prepare": "cases", "export": "cases", "train": "training",
    "locate": "locate", "track": "track", "simulate": "cases",
    "evaluate": "cases", "compile": "doctor",
    "frames": "frames", "inspect": "cases", "doctor": "doctor",
}  # fmt: skip
# Commands of other distributions: if one is missing, the message names its distribution.
_DISTRIBUTIONS = {
    "onnx": "tumortrack-occupancy",
    **dict.fromkeys(("plan", "resect"), "tumortrack-resection"),
    **dict.fromkeys(("twin", "bench", "fleet", "margins"), "tumortrack-benchmarks"),
    **dict.fromkeys(("phantom-kit", "calibrate", "record", "reference"), "tumortrack-experiment"),
}
_OBJECTS_PER_COLLECTION = 20_000
_STOPPED = 130  # by Ctrl-C


def main() -> None:
    # Let waiting OpenMP threads yield early. Spinning is several times slower where other programs
    # want the cores, and no faster where they don't.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # Matrices are small here: more threads gain little, and lose as much on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # PyTorch and the like create hundreds of thousands of objects that live to the end. Searching
    # them for garbage takes a tenth of their import's time.
    gc.set_threshold(_OBJECTS_PER_COLLECTION)
    interrupt_between_imports()
    code = run(sys.argv[1:])
    if code == _STOPPED:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C changes nothing
    if code:
        sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run one command; its exit code. A known error is one line, never a traceback."""
    if arguments == ["--version"]:
        print(f"tumortrack {tumortrack.__version__}")
        return 0
    with command_line():
        return _run(arguments)


def _run(arguments: list[str]) -> int:
    code = 1
    try:
        code = _parse(arguments).run() or 0
        sys.stdout.flush()
    except TumortrackError as error:
        print(f"tumortrack: {error}", file=sys.stderr)
        return error.exit_code
    except SystemExit as ended:  # of --help, or options that are none
        for line in in_command(arguments) if ended.code else ():
            print(f"tumortrack: {line}", file=sys.stderr)
        raise
    except KeyboardInterrupt:
        print("tumortrack: stopped.", file=sys.stderr)
        return _STOPPED
    except BrokenPipeError:  # `tumortrack inspect X | head`
        sys.stderr.close()
    except OSError as error:  # of the file system: a name too long, no permission
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        if full := error.filename is None:  # discard what is still buffered
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        where = "standard output or the disk" if full else error.filename
        print(f"tumortrack: {where}: {error.strerror}.", file=sys.stderr)
        return InputError.exit_code
    return code


def command(name: str) -> Callable[..., Command]:
    """A command of ours or of an installed package. Raises InputError: its package is missing."""
    if name not in (commands := _commands(name)):
        package = _DISTRIBUTIONS[name]
        raise InputError(
            f"the command {name} belongs to {package}, which is not installed here: "
            f"{to_install(package)}."
        )
    return commands[name]


def _commands(chosen: str) -> dict[str, Callable[..., Command]]:
    """The chosen command; if there is none of that name all: ours, then those of installed packages
    (entry points ``tumortrack.commands``)."""
    if chosen in _MODULES:
        return {chosen: _ours(chosen)}
    from tumortrack.core.plugins import plugins

    commands: dict[str, Callable[..., Command]] = {}
    others = list(plugins("commands", name=chosen))
    if not others:
        commands = {name: _ours(name) for name in _MODULES}
        others = list(plugins("commands", built_in=_MODULES))
    for each in others:
        if not each.fault:
            commands[each.name] = each.loaded
        elif each.name == chosen:
            raise PackageError(each.refusal)
        else:
            print(f"note: {each.refusal}", file=sys.stderr)
    return commands


def _ours(name: str) -> Callable[..., Command]:
    command: Callable[..., Command] = getattr(
        import_module(f"tumortrack.cli.{_MODULES[name]}"), name.capitalize()
    )
    return command


def _parse(arguments: list[str]) -> Command:
    """Builds only the chosen command's options: all of them take several times as long."""
    import tyro  # in here, Ctrl-C ends in one line

    commands = _commands(arguments[0] if arguments else "")
    if arguments and arguments[0] in (*commands, *_DISTRIBUTIONS):
        named = (tyro.conf.PositionalMetavarFromFieldName,)  # MODEL CLOUD OUT, not PATH PATH PATH
        prog = f"tumortrack {arguments[0]}"
        return tyro.cli(command(arguments[0]), prog=prog, args=arguments[1:], config=named)
    return tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="tumortrack",
        description="Locate an organ and its tumors under deformation from one depth image. "
        "Research software, not a medical device.",
        args=arguments,
    )


if __name__ == "__main__":
    main()
