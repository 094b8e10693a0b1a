"""Ctrl-C while modules are imported, some of which catch whatever is raised in them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from importlib import import_module

import pytest

from clock import until
from tumortrack.core.process import interrupt_between_imports, undisturbed

GREEDY = """
import signal
try:
    signal.raise_signal(signal.SIGINT)
    whole = True
except BaseException:  # as in trimesh
    whole = False
"""


@pytest.fixture
def greedy(tmp_path, monkeypatch) -> Iterator[str]:
    """The name of a module during whose import Ctrl-C is pressed."""
    numbers = signal.SIGINT, signal.SIGALRM
    before = [signal.getsignal(number) for number in numbers]
    name = f"greedy_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(GREEDY)
    monkeypatch.syspath_prepend(tmp_path)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield name
    signal.setitimer(signal.ITIMER_REAL, 0)
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def test_an_import_may_end_and_the_interrupt_is_not_lost(greedy):
    interrupt_between_imports()
    with pytest.raises(KeyboardInterrupt):
        until(lambda: not import_module(greedy).whole, "the interrupt")
    assert import_module(greedy).whole


def test_what_imports_for_long_is_interrupted_after_all(greedy):
    interrupt_between_imports(retries=0)
    assert not import_module(greedy).whole
    sys.modules.pop(greedy)


def test_it_waits_for_work_that_must_not_be_disturbed(greedy):
    interrupt_between_imports()
    done = []

    def work() -> None:
        with undisturbed():
            import_module(greedy)
            done.append(1)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done


def test_outside_imports_it_comes_at_once_or_stays_ignored(greedy):
    interrupt_between_imports()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    interrupt_between_imports()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
