"""Progress, questions and log files of commands in a terminal."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, final

from residnet.core.errors import ResidnetError
from residnet.core.ownership import find_manifest
from residnet.core.progress import Progress, ProgressCallback, on_progress

if TYPE_CHECKING:
    from residnet.io.drafting.questions import AnswerCallback, Question

SILENCE_SECONDS = 4.0
"""Seconds without output after which the current work is printed."""
LineSink = Callable[[str], None]
"""Function that receives lines of text."""


@contextmanager
def show_progress(*, quiet: bool = False, sink: LineSink | None = None) -> Iterator[None]:
    """Show the progress of the context's work on standard error.

    Args:
        quiet: show nothing.
        sink: receives every line, even if `quiet` is set.
    """
    progress_display: AbstractContextManager[ProgressCallback | None] = nullcontext()
    if not quiet:
        progress_display = _progress_bars() if sys.stderr.isatty() else _PlainProgress()
    with progress_display as display_callback:

        def show_and_log(progress: Progress) -> None:
            is_complete = progress.done is not None and progress.done == progress.total
            if sink is not None and (progress.message or is_complete):
                sink(progress.message or f"{progress.stage}: done")
            if display_callback is not None:
                display_callback(progress)

        with on_progress(show_and_log):
            yield


class _PlainProgress:
    """Progress display with one line for each message and each completed stage.

    After a while without output, the current work, its progress and its duration are printed.
    """

    def __init__(self) -> None:
        self._completed_stages: set[str] = set()
        self._stop_event = threading.Event()
        self._current_work = self._started_stage = self._stage = ""
        self._stage_start = self._last_print_time = time.monotonic()

    def __enter__(self) -> _PlainProgress:
        threading.Thread(target=self._print_if_silent, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_event.set()

    def _print_if_silent(self) -> None:
        while not self._stop_event.wait(SILENCE_SECONDS / 5):
            current_time = time.monotonic()
            if self._current_work and current_time - self._last_print_time >= SILENCE_SECONDS:
                self._print(
                    f"  {self._current_work}: {current_time - self._stage_start:.0f} s so far"
                )

    def _print(self, line: str) -> None:
        self._last_print_time = time.monotonic()
        print(line, file=sys.stderr, flush=True)

    def __call__(self, progress: Progress) -> None:
        if progress.message:
            self._print(progress.message)
        if progress.stage and progress.done is None:
            self._started_stage = self._current_work = progress.stage
            self._stage_start = self._last_print_time
        if progress.done is None or progress.total is None:
            return
        if progress.stage != self._stage:
            self._stage = progress.stage
            self._stage_start = time.monotonic()
        if progress.done < progress.total:
            self._completed_stages.discard(progress.stage)
            self._current_work = f"{progress.stage}, {progress.done:g} of {progress.total:g}"
        elif progress.stage not in self._completed_stages:
            self._completed_stages.add(progress.stage)
            self._current_work = self._started_stage
            if not progress.message:
                self._print(f"  {progress.stage}: all {progress.total:g} done")


@contextmanager
def _progress_bars() -> Iterator[ProgressCallback]:
    """Progress display with one bar for each counted stage, and one for the current stage.

    Bars show the elapsed time even if the work reports no progress.
    """
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TimeRemainingColumn(elapsed_when_finished=True),
        rich.TimeElapsedColumn(),
    )
    console = Console(stderr=True, highlight=False, markup=False)
    task_of_stage: dict[str, rich.TaskID] = {}

    def update_bars(progress: Progress) -> None:
        if progress.message:
            console.print(progress.message)
        if progress.done is None and progress.total is None:
            if progress.stage:
                if "" in task_of_stage:
                    bars.remove_task(task_of_stage.pop(""))
                task_of_stage[""] = bars.add_task(progress.stage, total=None)
            return
        if progress.stage not in task_of_stage:
            task_of_stage[progress.stage] = bars.add_task(progress.stage, total=None)
        bars.update(
            task_of_stage[progress.stage], completed=progress.done or 0, total=progress.total
        )
        if progress.total is not None and (progress.done or 0) >= progress.total:
            bars.remove_task(task_of_stage.pop(progress.stage))

    with rich.Progress(*columns, console=console, transient=True) as bars:
        yield update_bars


def interactive_prompt() -> AnswerCallback | None:
    """Return the function that asks the user; None without an interactive terminal."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    return _prompt_for_answer


def _prompt_for_answer(question: Question) -> str:
    """Ask one question until the answer is valid; an empty answer selects the default."""
    options = f" ({', '.join(question.options)})" if question.options else ""
    print(f"{question.text}: {question.reason}", file=sys.stderr)
    prompt = f"  {'.'.join(question.key)}{options} [{question.default}]: "
    while True:
        print(prompt, end="", file=sys.stderr, flush=True)
        answer = input().strip() or question.default
        if not question.options or answer in question.options:
            return answer
        print(f"  '{answer}' is not one of {', '.join(question.options)}", file=sys.stderr)


@final
class ProgressLogFile:
    """Log file of a run with the time of day of each line.

    Lines are buffered until the run folder exists.

    Args:
        folder: future run folder; if the run ends before it exists, the log file is written next to
            it.
        is_enabled: write the log file.
    """

    def __init__(self, folder: Path, *, is_enabled: bool = True) -> None:
        self._fallback_path = folder.with_name(f"{folder.name}.log.txt")
        self._is_enabled = is_enabled
        self._buffer = ""
        self._file: Path | None = None

    def add_line(self, text: str) -> None:
        """Add one line with the time of day."""
        self._append(f"{time.strftime('%H:%M:%S')} {text.strip()}\n")

    def start_file(self, folder: Path) -> None:
        """Write to the log file in a folder from now on; an existing log file is continued."""
        self._file = folder / "log.txt"
        if self._is_enabled:
            self._record_in_manifest(self._file)
        self._append("")

    @contextmanager
    def log_traceback(self) -> Iterator[None]:
        """Add the traceback of an exception of the context, including Ctrl-C."""
        try:
            yield
        except BaseException as error:
            if self._file is None and self._is_enabled:
                # an unwritable log file must not hide the original error
                with suppress(ResidnetError):
                    self._record_in_manifest(self._fallback_path)
                    self._file = self._fallback_path
            self._append("".join(traceback.format_exception(error)))
            raise

    @staticmethod
    def _record_in_manifest(file: Path) -> None:
        """Record the log file in the manifest before its first line.

        Raises:
            UsageError: if the file was not written by residnet.
        """
        manifest = find_manifest(file)
        manifest.require_replaceable(file)
        manifest.record(file, None)

    def _append(self, text: str) -> None:
        self._buffer += text
        if self._file is not None and self._is_enabled:
            with self._file.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(self._buffer)
            self._buffer = ""
