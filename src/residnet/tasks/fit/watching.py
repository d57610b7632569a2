"""Watching new logs with a model of a finished fit: has the vessel changed, or have its data?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.core.names import nearest
from residnet.data.drafting.reading import log_files
from residnet.data.parts import data_files
from residnet.data.prepare import Prepared, prepare
from residnet.identification.models import FittedModel
from residnet.identification.monitoring import (
    MonitorConfig,
    Piece,
    Verdict,
    Watch,
    Watcher,
    past_of,
    pieces,
)
from residnet.identification.prepared import prepare_logs
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.tasks.fit.config import FitTaskSettings
from residnet.tasks.fit.external import SPLIT, read_external, takes_folders
from residnet.tasks.fit.inputs import take_logs

_NAMED = 3
"""Causes that are named."""


@dataclass(frozen=True)
class WatchedLog:
    """What a monitor found in one log.

    Attributes:
        name: of the log.
        since: time in s from its start to the first alarm; None where there was none.
        last: the verdict at its end.
        windows: that it held.
    """

    name: str
    since: float | None
    last: Verdict
    windows: int

    def content(self) -> dict[str, Any]:
        """Return what was found as JSON takes it."""
        return {
            "log": self.name,
            "windows": self.windows,
            "alarm_after": self.since,
            "threshold": self.last.threshold,
            "innovation": self.last.innovation,
            "suspects": [
                {
                    "cause": suspect.change.name,
                    "score": suspect.score,
                    "size": suspect.size,
                    "standard_error": suspect.error,
                    "unit": suspect.change.unit,
                    "explains": suspect.explains,
                }
                for suspect in self.last.suspects
            ],
        }

    def text(self) -> list[str]:
        """Return what was found in words."""
        seconds = "" if self.since is None else f" after {self.since:.0f} s"
        state = "no alarm" if self.since is None else f"ALARM{seconds}"
        out = [f"{self.name}: {state} ({self.windows} windows)"]
        for suspect in self.last.suspects[: _NAMED if self.since is not None else 1]:
            out.append(
                f"  {suspect.change.name}: score {suspect.score:.1f} of {self.last.threshold:.1f},"
                f" size {suspect.size:+.3g} +- {suspect.error:.2g} {suspect.change.unit}"
                f" (the logs look as if {suspect.change.words})"
            )
        return out


@dataclass(frozen=True)
class Service:
    """A model in service, the watch over it, and the logs that are new.

    Attributes:
        fitted: the model with its notes.
        watch: over it.
        files: of the new logs, in the order of time.
        logs: the new logs, prepared as those of the fit.
    """

    fitted: FittedModel
    watch: Watch
    files: Sequence[Path]
    logs: Sequence[Prepared]

    def windows(self, log: Prepared) -> list[Piece]:
        """Return the windows of a new log.

        Raises:
            DataError: where it holds none.
        """
        steps = round(self.watch.config.window / self.fitted.spec.dt)
        found = pieces(log, steps, past_of(self.watch.model))
        if not found:
            raise DataError(
                f"log {log.log.name}: holds no window of {self.watch.config.window:g} s without a"
                " break; shorten --window or leave it out"
            )
        return found


def in_service(
    config: FitTaskSettings,
    run: RunFolder,
    paths: Sequence[Path],
    model: str,
    settings: Mapping[str, Any],
) -> Service:
    """Set up the watch over a model of a finished fit, and read the new logs.

    Args:
        config: of the finished fit.
        run: its folder.
        paths: logs, in the order of time.
        model: name of the model; `selected` for the one chosen on validation data.
        settings: of `MonitorConfig`.

    Raises:
        UsageError: where there is no such model or path.
        DataError: where a log cannot be used, or clean logs are too few.
    """
    chosen = validate(dict(settings), MonitorConfig, "monitor")
    store = FolderStore(run)
    name = str(run.read_metrics()["selected"]) if model == "selected" else model
    if name not in store.names():
        known = ["selected", *store.names()]
        raise UsageError(f"{run.path}: no model '{name}'{nearest(name, known)}")
    fitted = store.load(name)
    files = log_files(paths, takes_folders(config))
    new = [
        prepare(log, SPLIT, config.signals.columns, config.prepare)
        for log in read_external(files, config)
    ]
    past, steps = past_of(fitted.model), round(chosen.window / fitted.spec.dt)
    clean = [pieces(log, steps, past) for log in _clean(config)]
    watch = Watch(fitted.spec, fitted.model, clean, chosen)
    return Service(fitted, watch, data_files(files), new)


def watch_logs(service: Service) -> list[WatchedLog]:
    """Watch logs one after the other; the stretch that is looked back over goes on between them.

    Raises:
        DataError: where a log holds no window.
    """
    watcher = Watcher(service.watch, past_of(service.watch.model))
    return [_watched(watcher, log, service.windows(log)) for log in service.logs]


def _clean(config: FitTaskSettings) -> list[Prepared]:
    """Return the logs of the fit that are known to be of the unchanged vessel."""
    # over ground, as new logs are: a current is taken out of either in the same way
    logs = prepare_logs(take_logs(config), config)
    return [*logs["train"], *logs["validation"]]


def _watched(watcher: Watcher, log: Prepared, found: Sequence[Piece]) -> WatchedLog:
    watcher.restart()
    verdicts = [watcher.take(sums) for sums in watcher.watch.sums(found)]
    alarms = np.flatnonzero([verdict.alarm for verdict in verdicts])
    first = (int(alarms[0]) + 1) * watcher.watch.config.window if alarms.size else None
    return WatchedLog(log.log.name, first, verdicts[-1], len(found))
