"""Progress on the command line: lines where there is no terminal, bars where there is one."""

from __future__ import annotations

import io
import sys
import time

import pytest

from residnet import cli
from residnet.cli import drawn_progress
from residnet.core.progress import begin, report, say


def test_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with drawn_progress():
        say("reading logs")
        for done in range(4):
            report("training lstm", done, 3)
        report("training lstm", 3, 3)
        report("searching")
    assert capsys.readouterr() == ("", "reading logs\n  training lstm: all 3 done\n")


def test_a_message_stands_for_the_end_of_its_stage(capsys: pytest.CaptureFixture[str]) -> None:
    with drawn_progress():
        report("training mlp", 2, 2, "mlp: epoch 2/2")
    assert capsys.readouterr().err == "mlp: epoch 2/2\n"


def test_a_stage_that_begins_again_is_told_again(capsys: pytest.CaptureFixture[str]) -> None:
    with drawn_progress():
        for _ in range(2):
            report("free runs", 1, 2)
            report("free runs", 2, 2)
    assert capsys.readouterr().err == "  free runs: all 2 done\n" * 2


class Terminal(io.StringIO):
    """A terminal that keeps what is drawn."""

    def isatty(self) -> bool:
        return True


def test_bars_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with drawn_progress():
        say("reading [logs]")
        report("training lstm", 1, 4)
        begin("searching")
        report("training lstm", 4, 4)
    text = screen.getvalue()
    assert "reading [logs]" in text
    assert "searching" in text


def test_long_work_is_never_silent(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "SILENCE", 0.05)
    with drawn_progress():
        begin("calibrating bands")
        say("  First fix this: a clock")
        time.sleep(0.3)
        report("free runs", 3, 8)
        time.sleep(0.3)
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "  calibrating bands"
    assert "  calibrating bands: 0 s so far" in told
    assert "  free runs, 3 of 8: 0 s so far" in told
    time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_nothing_is_drawn_outside(capsys: pytest.CaptureFixture[str]) -> None:
    with drawn_progress():
        pass
    say("nobody listens")
    assert capsys.readouterr() == ("", "")
