"""Whatever ends a command, it is told in one line with the exit code that belongs to it."""

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
from residnet.exits import remove_secrets, run_cli


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
    ("error", "code", "told"),
    [
        (UsageError("a.yaml: no such file"), 2, "residnet: a.yaml: no such file"),
        (DataError("two\nlines"), 1, "residnet: two lines"),
        (OSError(errno.ENOSPC, "No space left on device", "/full/x"), 2, "/full/x: No space left"),
        (MemoryError(), 1, "memory"),
        (ModuleNotFoundError("no", name="typer"), 2, "has no package 'typer'; install residnet"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_are_one_line(
    error: BaseException, code: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found, lines = ended(raising(error), capsys)
    assert found == code
    assert len(lines) == 1
    assert told in lines[0]


@pytest.mark.parametrize(
    ("number", "code", "made_of_it"),
    [
        (signal.SIGINT, 130, SystemExit),
        (signal.SIGINT, 130, ImportError),
        (signal.SIGTERM, 143, KeyboardInterrupt),
    ],
)
def test_signals_are_told_with_the_hint(
    number: signal.Signals,
    code: int,
    made_of_it: type[BaseException],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lightning makes an exit of an interruption, and an import an error of its own."""
    monkeypatch.setattr(sys, "argv", ["residnet", "run", "x.yaml"])
    before = signal.getsignal(number)

    def command() -> None:
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt as interruption:
            raise made_of_it from interruption

    found, lines = ended(command, capsys)
    assert found == code
    assert len(lines) == 1
    assert "--resume" in lines[0]
    assert signal.getsignal(number) == before


def test_a_defect_leaves_a_crash_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "mine.yaml"
    config.write_text("name: mine\nstorage: postgres://me:hidden@host/db\napi_key: sesame\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "argv", ["residnet", "run", str(config)])
    found, lines = ended(raising(IndexError("list index\nout of range")), capsys)
    assert found == 1
    assert len(lines) == 1
    (file,) = tmp_path.glob("residnet-crash-*.txt")
    assert str(file) in lines[0]
    text = file.read_text()
    for wanted in ("torch 2.", "Python 3.", f"residnet run {config}", "Traceback", "IndexError"):
        assert wanted in text
    assert "name: mine" in text
    assert "hidden" not in text
    assert "sesame" not in text


def test_a_crash_file_finds_another_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere() -> Path:
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(Path, "cwd", nowhere)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    _, lines = ended(raising(ZeroDivisionError()), capsys)
    (file,) = tmp_path.glob("residnet-crash-*.txt")
    assert str(file) in lines[0]
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "missing"))
    _, lines = ended(raising(ZeroDivisionError()), capsys)
    said = "it could not be described in a file"
    assert lines == [f"residnet: this is a defect of residnet, ZeroDivisionError: ; {said}"]


def test_secrets_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/eve")
    text = "at /home/eve/x.py\nAPI_TOKEN = 'abc'\npassword: def\nmqtt://u:p@host/x\nn: 3\n"
    left = "at ~/x.py\nAPI_TOKEN = ***\npassword: ***\nmqtt://***@host/x\nn: 3\n"
    assert remove_secrets(text) == left


@pytest.mark.parametrize("closed", ["1>&-", "2>&-"])
def test_closed_streams_do_not_end_a_command(closed: str, tmp_path: Path) -> None:
    told = "import sys; from residnet.exits import run_cli; run_cli(lambda: sys.stderr.write('x'))"
    command = f'{sys.executable} -c "{told}" {closed}'
    assert subprocess.run(command, shell=True, check=False, cwd=tmp_path).returncode == 0
