"""Progress on the command line: lines where there is no terminal, bars where there is one."""

from __future__ import annotations

import io
import sys
import time

import pytest

from residnet import terminal
from residnet.core.progress import begin_stage, log_message, report_progress
from residnet.terminal import show_progress


def test_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """A message stands for the end of its stage, and one that begins again is told again."""
    with show_progress():
        log_message("reading logs")
        for done in range(4):
            report_progress("training lstm", done, 3)
        report_progress("training lstm", 3, 3)
        report_progress("searching")
        report_progress("training mlp", 2, 2, "mlp: epoch 2/2")
        for _ in range(2):
            report_progress("free runs", 1, 2)
            report_progress("free runs", 2, 2)
    ran = "  free runs: all 2 done\n" * 2
    told = f"reading logs\n  training lstm: all 3 done\nmlp: epoch 2/2\n{ran}"
    assert capsys.readouterr() == ("", told)
    log_message("nobody listens")
    assert capsys.readouterr() == ("", "")


class Terminal(io.StringIO):
    """A terminal that keeps what is drawn."""

    def isatty(self) -> bool:
        return True


def test_bars_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with show_progress():
        log_message("reading [logs]")
        report_progress("training lstm", 1, 4)
        begin_stage("searching")
        report_progress("training lstm", 4, 4)
    text = screen.getvalue()
    assert "reading [logs]" in text
    assert "searching" in text


def test_long_work_is_never_silent(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "SILENCE_SECONDS", 0.05)
    with show_progress():
        begin_stage("calibrating bands")
        log_message("  First fix this: a clock")
        time.sleep(0.3)
        report_progress("free runs", 3, 8)
        time.sleep(0.3)
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "  calibrating bands"
    assert "  calibrating bands: 0 s so far" in told
    assert "  free runs, 3 of 8: 0 s so far" in told
    time.sleep(0.1)
    assert capsys.readouterr().err == ""
