"""Every outcome of a command is one line on standard error with its exit code."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

from residnet.core.errors import DataError, UsageError
from residnet.exits import run_cli


def ended(
    command: Callable[[], object], capsys: pytest.CaptureFixture[str]
) -> tuple[object, list[str]]:
    """Return the exit code and the lines on standard error."""
    with pytest.raises(SystemExit) as caught:
        run_cli(command)
    return caught.value.code, capsys.readouterr().err.splitlines()


def raising(error: BaseException) -> Callable[[], NoReturn]:
    def command() -> NoReturn:
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (UsageError("a.yaml: no such file"), 2, "residnet: a.yaml: no such file"),
        (DataError("two\nlines"), 1, "residnet: two lines"),
        (OSError(errno.ENOSPC, "No space left on device", "/full/x"), 2, "/full/x: No space left"),
        (MemoryError(), 1, "memory"),
        (ModuleNotFoundError("no", name="typer"), 2, "has no package 'typer'; install residnet"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_run_cli_reports_errors_in_one_line(
    error: BaseException, code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    exit_code, lines = ended(raising(error), capsys)
    assert exit_code == code
    assert len(lines) == 1
    assert message in lines[0]


@pytest.mark.parametrize(
    ("number", "code", "replacement"),
    [
        (signal.SIGINT, 130, SystemExit),
        (signal.SIGINT, 130, ImportError),
        (signal.SIGTERM, 143, KeyboardInterrupt),
    ],
)
def test_run_cli_on_a_signal_hints_at_resume(
    number: signal.Signals,
    code: int,
    replacement: type[BaseException],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lightning replaces an interruption by SystemExit, and an import by ImportError."""
    monkeypatch.setattr(sys, "argv", ["residnet", "run", "x.yaml"])
    before = signal.getsignal(number)

    def command() -> None:
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt as interruption:
            raise replacement from interruption

    exit_code, lines = ended(command, capsys)
    assert exit_code == code
    assert len(lines) == 1
    assert "--resume" in lines[0]
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("is_traceback_wanted", [False, True])
def test_defect_prints_its_traceback_on_demand(
    is_traceback_wanted: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RESIDNET_TRACEBACK", "1" if is_traceback_wanted else "")
    code, lines = ended(raising(IndexError("list index\nout of range")), capsys)
    assert code == 1
    assert lines[-1].startswith("residnet: this is a defect of residnet, IndexError: list index;")
    assert any(line.startswith("Traceback") for line in lines) == is_traceback_wanted
    assert (len(lines) == 1) != is_traceback_wanted
    assert ("RESIDNET_TRACEBACK=1" in lines[-1]) != is_traceback_wanted
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("closed", ["1>&-", "2>&-"])
def test_run_cli_with_closed_streams_succeeds(closed: str, tmp_path: Path) -> None:
    program = (
        "import sys; from residnet.exits import run_cli; run_cli(lambda: sys.stderr.write('x'))"
    )
    command = f'{sys.executable} -c "{program}" {closed}'
    assert subprocess.run(command, shell=True, check=False, cwd=tmp_path).returncode == 0
