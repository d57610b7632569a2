"""The log of a run: every line of its progress in a file, and how it ended."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import final

from residnet.runs.folder import LOG


@final
class RunLog:
    """Lines with the time of day, written as they come once the run's folder stands.

    Args:
        folder: that the run will have; a run that ends before it stands has its log beside it.
    """

    def __init__(self, folder: Path) -> None:
        self._beside = folder.with_name(f"{folder.name}.{LOG}")
        self._held: list[str] = []
        self._file: Path | None = None

    def line(self, text: str) -> None:
        """Add one line with the time of day."""
        self._add(f"{time.strftime('%H:%M:%S')} {text.strip()}\n")

    def open(self, folder: Path) -> None:
        """Write into a folder from now on, behind what an interrupted run left there."""
        self._file, held = folder / LOG, self._held
        self._held = []
        self._add("".join(held))

    @contextmanager
    def until_the_end(self) -> Iterator[None]:
        """Add the traceback where what is done within the context ends badly, Ctrl-C included."""
        try:
            yield
        except BaseException as error:
            self._add("".join(traceback.format_exception(error)))
            if self._file is None:
                self._beside.parent.mkdir(parents=True, exist_ok=True)
                self._beside.write_text("".join(self._held), encoding="utf-8")
            raise

    def _add(self, text: str) -> None:
        if self._file is None:
            self._held.append(text)
            return
        with self._file.open("a", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write(text)
