"""What a command tells while it works: bars on a terminal, plain lines elsewhere, a run's log."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, final

from residnet.core.progress import Progress, ProgressCallback, listen

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

    from residnet.data.drafting.questions import Answer, Question


SILENCE = 5.0
"""Seconds without a line after which one says what is still being done."""
Keep = Callable[[str], None]
"""Is given one line after the other."""


@contextmanager
def drawn_progress(*, quiet: bool = False, kept: Keep | None = None) -> Iterator[None]:
    """Draw the progress of everything within the context on standard error.

    Args:
        quiet: draw nothing.
        kept: is given every line, whatever is drawn.
    """
    if quiet:
        with listen(_Kept(kept, None)):
            yield
        return
    if not sys.stderr.isatty():
        with _Lines() as lines, listen(_Kept(kept, lines)):
            yield
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bars

    console = Console(stderr=True, highlight=False, markup=False)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TimeElapsedColumn(),
    )
    with Bars(*columns, console=console, transient=True) as bars, listen(_Kept(kept, _Bars(bars))):
        yield


class _Kept:
    """Keeps the lines that are told, and hands everything on."""

    def __init__(self, kept: Keep | None, then: ProgressCallback | None) -> None:
        self._kept, self._then = kept, then

    def __call__(self, progress: Progress) -> None:
        if self._kept is not None and (progress.message or progress.done == progress.total):
            text = progress.message or f"{progress.stage}: done"
            if progress.message or progress.done is not None:
                self._kept(text)
        if self._then is not None:
            self._then(progress)


class _Lines:
    """One line for each message, and one for each counted stage that ends without a message.

    Where neither comes for a while, a line tells what is still being done, how far, and since when.
    """

    def __init__(self) -> None:
        self._complete: set[str] = set()
        self._ended = threading.Event()
        self._doing = self._begun = self._stage = ""
        self._since = self._told = time.monotonic()

    def __enter__(self) -> _Lines:
        threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(SILENCE / 5):
            now = time.monotonic()
            if self._doing and now - self._told >= SILENCE:
                self._print(f"  {self._doing}: {now - self._since:.0f} s so far")

    def _print(self, line: str) -> None:
        self._told = time.monotonic()
        print(line, file=sys.stderr, flush=True)

    def __call__(self, progress: Progress) -> None:
        if progress.message:
            self._print(progress.message)
        if progress.stage and progress.done is None:
            self._begun = self._doing = progress.stage
            self._since = self._told
        if progress.done is None or progress.total is None:
            return
        if progress.stage != self._stage:
            self._stage, self._since = progress.stage, time.monotonic()
        if progress.done < progress.total:
            self._complete.discard(progress.stage)
            self._doing = f"{progress.stage}, {progress.done:g} of {progress.total:g}"
        elif progress.stage not in self._complete:
            self._complete.add(progress.stage)
            self._doing = self._begun
            if not progress.message:
                self._print(f"  {progress.stage}: all {progress.total:g} done")


class _Bars:
    """One bar for each counted stage that is under way, and one for the stage that began last.

    Bars move, and tell the time that is gone, without a word of the work.
    """

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._stages: dict[str, TaskID] = {}

    def __call__(self, progress: Progress) -> None:
        if progress.message:
            self._bars.console.print(progress.message)
        if progress.done is None and progress.total is None:
            if progress.stage:
                if "" in self._stages:
                    self._bars.remove_task(self._stages.pop(""))
                self._stages[""] = self._bars.add_task(progress.stage, total=None)
            return
        if progress.stage not in self._stages:
            self._stages[progress.stage] = self._bars.add_task(progress.stage, total=None)
        bar = self._stages[progress.stage]
        self._bars.update(bar, completed=progress.done or 0, total=progress.total)
        if progress.total is not None and (progress.done or 0) >= progress.total:
            self._bars.remove_task(self._stages.pop(progress.stage))


def asked() -> Answer | None:
    """Return what asks the user; None where nobody sits at the terminal."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    return _ask


def _ask(question: Question) -> str:
    """Ask one question until its answer can be used; an empty answer takes the default."""
    options = f" ({', '.join(question.options)})" if question.options else ""
    print(f"{question.text}: {question.reason}", file=sys.stderr)
    asking = f"  {'.'.join(question.key)}{options} [{question.default}]: "
    while True:
        print(asking, end="", file=sys.stderr, flush=True)
        given = input().strip() or question.default
        if not question.options or given in question.options:
            return given
        print(f"  '{given}' is none of {', '.join(question.options)}", file=sys.stderr)


@final
class RunLog:
    """Lines with the time of day, written as they come once the run's folder stands.

    Args:
        folder: that the run will have; a run that ends before it stands has its log beside it.
        wanted: keep the lines; else nothing is written.
    """

    def __init__(self, folder: Path, *, wanted: bool = True) -> None:
        self._beside = folder.with_name(f"{folder.name}.log.txt")
        self._wanted, self._held = wanted, ""
        self._file: Path | None = None

    def line(self, text: str) -> None:
        """Add one line with the time of day."""
        self._add(f"{time.strftime('%H:%M:%S')} {text.strip()}\n")

    def open(self, folder: Path) -> None:
        """Write into a folder from now on, behind what an interrupted run left there."""
        self._file = folder / "log.txt"
        self._add("")

    @contextmanager
    def until_the_end(self) -> Iterator[None]:
        """Add the traceback where what is done within the context ends badly, Ctrl-C included."""
        try:
            yield
        except BaseException as error:
            if self._file is None and self._wanted:
                self._beside.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._beside
            self._add("".join(traceback.format_exception(error)))
            raise

    def _add(self, text: str) -> None:
        self._held += text
        if self._file is not None and self._wanted:
            with self._file.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(self._held)
            self._held = ""
