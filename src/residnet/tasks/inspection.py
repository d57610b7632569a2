"""`residnet inspect`: the data doctor over files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import ConfigError, DataError, ResidnetError, UsageError
from residnet.core.files import write_owned
from residnet.core.log import Log
from residnet.core.progress import report
from residnet.data.doctor import (
    Finding,
    Report,
    conditioning,
    date_findings,
    inspect,
    inspect_together,
    inspection,
    summary,
)
from residnet.data.drafting.questions import commented
from residnet.data.drafting.reading import log_files, read_each
from residnet.data.split import log_names

if TYPE_CHECKING:
    from residnet.tasks.fit import FitConfig

_ILL_CONDITIONED = 1e6
"""Condition number from which regressors leave their coefficients to the noise."""


@dataclass(frozen=True)
class Inspection:
    """What the doctor found.

    Attributes:
        text: for the terminal.
        content: the same for JSON (schema residnet.inspection/1).
    """

    text: str
    content: Mapping[str, Any]

    @property
    def misled(self) -> bool:
        """Whether a fit to these logs would be misled."""
        return bool(self.content["misled"])

    def write(self, file: Path) -> None:
        """Write the findings as JSON.

        Raises:
            UsageError: where the file cannot be written.
        """
        with write_owned(file) as place:
            place.write_text(json.dumps(self.content, indent=1) + "\n")


def inspect_logs(paths: Sequence[Path], config: Path | None) -> Inspection:
    """Return what the doctor finds in each log and between them.

    Args:
        config: a run or import whose channel map reads them; None where they describe themselves,
            or to have a map drafted.

    Raises:
        ResidnetError: where a path does not exist, the config cannot be used, or the only log
            cannot be read.
    """
    task, fit = (None, None) if config is None else _logs_task(config)
    inputs, masks = (fit.signals.columns, fit.prepare.masks) if fit is not None else (None, ())
    own = None if task is None else getattr(task, "reader", None) or task.data.reader
    files = log_files(paths)
    read, maps = dict[Path, Log | ResidnetError](), list[str]()
    if own is None:
        for draft in read_each(files):
            read |= {**draft.logs, **draft.left_out}
            if {"channels", "parts"} & set(draft.reader):
                drafted = {"data": {"kind": "measured", "reader": draft.reader}}
                maps += ["channel map as guessed, to check and paste into a config:"]
                maps += commented(drafted, draft.marks.comments).splitlines()
    else:
        reader = own.build()
        for file in reader.logs_among(files):
            try:
                read[file] = reader.read(file)
            except DataError as error:
                read[file] = error
    # files that only belong to others are no logs
    files = [file for file in files if file in read]
    names = log_names(files)
    logs: list[Log] = []
    reports: list[Report] = []
    for number, path in enumerate(files):
        report("inspecting logs", number, len(files))
        log = read[path]
        try:
            if isinstance(log, ResidnetError):
                raise DataError(str(log)) if len(files) > 1 else log
            log = log.replace(name=names[path])
            found = inspect(log, inputs, masks).joined(date_findings(log, path))
            logs.append(log)
        except DataError as error:
            if len(files) == 1:
                raise
            unreadable = Finding("fatal", "unreadable", str(error))
            found = Report(names[path], (unreadable,), str(path))
        reports.append(found)
    splits = {} if fit is None else _splits(fit, names)
    together = inspect_together(logs, inputs, splits) if logs else Report("together", ())
    if fit is not None and logs:
        together = Report("together", (*together.findings, *_regressors(logs, fit)))
    report("inspecting logs", len(files), len(files))
    lines = [line for one in (*reports, together) for line in one.lines()]
    content = inspection(reports, together)
    return Inspection("\n".join((*summary(content).lines, *lines, *maps)), content)


def _logs_task(config: Path) -> tuple[Any, FitConfig | None]:
    """Return the task of a config that says how its logs are read, and the same if it is a fit.

    Raises:
        ConfigError: where it is no config of logs.
    """
    # logs that need no config need neither models nor torch
    from residnet.data.sources import MeasuredLogs
    from residnet.tasks.fit import FitConfig
    from residnet.tasks.import_logs import ImportConfig
    from residnet.tasks.registry import load_task

    task = load_task(config)
    measured = isinstance(task, FitConfig) and isinstance(task.data, MeasuredLogs)
    if not measured and not isinstance(task, ImportConfig):
        raise ConfigError(
            f"{config}: has no channel map (data.kind is not 'measured'); leave --config out for"
            " logs that describe themselves"
        )
    return task, task if isinstance(task, FitConfig) else None


def _splits(fit: FitConfig, names: Mapping[Path, str]) -> dict[str, str]:
    """Return the split of each log that the config names."""
    from residnet.data.sources import MeasuredLogs

    assert isinstance(fit.data, MeasuredLogs)
    try:
        resolved = fit.data.split.resolve()
    except ConfigError:
        # the split's own files need not be here to look at others
        return {}
    known = {path.resolve(): split for split, paths in resolved.items() for path in paths}
    return {n: known[real] for path, n in names.items() if (real := path.resolve()) in known}


def _regressors(logs: Sequence[Log], fit: FitConfig) -> list[Finding]:
    """Return how well the prepared logs condition the regressors of each baseline."""
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.data.prepare import prepare, samples

    try:
        signals = fit.signals
        prepared = [
            prepare(log, "train", signals.columns, fit.prepare, signals.live) for log in logs
        ]
        data = samples([log for log in prepared if log.good.any()], fit.signals.build())
    except (DataError, UsageError) as error:
        text = f"the config cannot prepare these logs: {error}"
        return [Finding("will mislead", "not_prepared", text)]
    out = []
    for name, config in fit.all_baselines.items():
        baseline = config.build(data.names)
        if not isinstance(baseline, RegressorBaseline):
            continue
        phi, terms = baseline.library(data.z).numpy(), list(baseline.library.terms)
        moves = np.ptp(phi, axis=0) > 1e-12 * np.abs(phi).max(axis=0, initial=0.0)
        moving = np.flatnonzero(moves)
        if len(moving) < 2 or len(phi) <= 2 * len(moving):
            continue
        condition, worst = conditioning(phi[:, moving], [terms[j] for j in moving])
        still = [term for term, free in zip(terms, moves, strict=True) if not free and term != "1"]
        text = (
            f"regressors of {name} over these logs: {len(moving)} move, condition number"
            f" {condition:.3g} (centred, scaled)"
        )
        text += f"; constant: {', '.join(still)}" if still else ""
        text += f"; {', '.join(worst)} move together" if condition > 30.0 else ""
        ill = condition > _ILL_CONDITIONED
        action = "leave regressors out, give the baseline a ridge, or add manoeuvres" if ill else ""
        found = {"condition": condition, "regressors": len(moving)}
        # a log or two are looked at, not fitted: what they lack others have
        level: Any = "will mislead" if ill and len(logs) > 2 else "note"
        out.append(Finding(level, "regressors", text, found, action))
    return out
