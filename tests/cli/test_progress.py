"""What long commands say while they work, where there is no terminal."""

from __future__ import annotations

from clock import Clock
from tumortrack.cli import console


def test_a_line_is_there_at_once_and_tells_rate_and_time_left(monkeypatch, capsys):
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    with console.progress_bar("simulate", 40) as advance:
        assert capsys.readouterr().out == "simulate: 0 of 40 ...\n"
        for _ in range(7):
            clock.sleep(2.0)
            advance()
        assert capsys.readouterr().out == ""  # a line now and then
        clock.sleep(2.0)
        advance()
        assert capsys.readouterr().out == "simulate: 8 of 40 | 2.0 s each | 1:04 left\n"


def test_fast_work_is_told_by_its_rate(monkeypatch, capsys):
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    with console.progress_bar("drawing", 1000) as advance:
        for _ in range(200):
            clock.sleep(0.1)
            advance()
    assert "drawing: 150 of 1000 | 10.0 a second | 1:25 left" in capsys.readouterr().out


def test_a_slow_first_step_tells_no_rate(monkeypatch, capsys):
    """It may have compiled: 38 s for one of ten scenes are no reason to say six minutes."""
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    with console.progress_bar("simulate", 10) as advance:
        clock.sleep(38.0)
        advance()
        assert capsys.readouterr().out.splitlines()[-1] == "simulate: 1 of 10"
        for _ in range(8):
            clock.sleep(2.0)
            advance()
    assert "9 of 10 | 2.0 s each | 0:02 left" in capsys.readouterr().out
