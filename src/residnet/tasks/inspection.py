"""`residnet inspect`: the data doctor over files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core import progress
from residnet.core.errors import ConfigError, DataError, ResidnetError, UsageError
from residnet.core.files import whole
from residnet.core.log import Log
from residnet.data.doctor import (
    Finding,
    Level,
    Report,
    conditioning,
    date_findings,
    inspect,
    inspect_together,
    inspection,
    summary,
)
from residnet.data.drafting.reading import DraftedLogs, log_files, read_each
from residnet.data.masks import Mask
from residnet.data.readers.base import LogReader
from residnet.data.readers.compose import RecordingConfig
from residnet.data.sources import MeasuredLogs
from residnet.data.split import log_names
from residnet.tasks.drafting import commented
from residnet.tasks.fit import FitConfig
from residnet.tasks.import_logs import ImportConfig
from residnet.tasks.registry import load_task

_ILL_CONDITIONED = 1e6
"""Condition number from which regressors leave their coefficients to the noise."""


@dataclass(frozen=True)
class Reading:
    """What a config says about logs: reader, inputs, masks, and the split of each file."""

    reader: LogReader | None = None
    folders: bool = False
    inputs: tuple[str, ...] | None = None
    masks: tuple[Mask, ...] = ()
    splits: Mapping[Path, str] | None = None
    task: Any = None


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
        with whole(file) as place:
            place.write_text(json.dumps(self.content, indent=1) + "\n")


def inspect_logs(paths: Sequence[Path], config: Path | None) -> Inspection:
    """Return what the doctor finds in each log and between them.

    Args:
        paths: files and folders.
        config: a run or import whose channel map reads them; None where they describe themselves,
            or to have a map drafted.

    Raises:
        ResidnetError: where a path does not exist, the config cannot be used, or the only log
            cannot be read.
    """
    setup = Reading() if config is None else reading(config)
    files = log_files(paths, setup.folders or config is None)
    names = log_names(files)
    logs: list[Log] = []
    reports: list[Report] = []
    lines: list[str] = []
    read, drafts = _read(files, setup.reader)
    for number, path in enumerate(files):
        progress.report("inspecting logs", number, len(files))
        log = read[path]
        try:
            if isinstance(log, ResidnetError):
                raise DataError(str(log)) if len(files) > 1 else log
            log = log.replace(name=names[path])
            found = inspect(log, setup.inputs, setup.masks).joined(date_findings(log, path))
        except DataError as error:
            if len(files) == 1:
                raise
            unreadable = Finding("fatal", "unreadable", str(error))
            reports.append(Report(names[path], (unreadable,), str(path)))
        else:
            logs.append(log)
            reports.append(found)
        lines += reports[-1].lines()
    known = setup.splits or {}
    splits = {
        name: known[real] for path, name in names.items() if (real := path.resolve()) in known
    }
    together = inspect_together(logs, setup.inputs, splits) if logs else Report("together", ())
    if setup.task is not None and logs:
        together = Report("together", (*together.findings, *_regressors(logs, setup.task)))
    progress.report("inspecting logs", len(files), len(files))
    lines += together.lines()
    for draft in drafts:
        if "channels" in draft.reader:
            drafted = {"data": {"kind": "measured", "reader": draft.reader}}
            lines += ["channel map as guessed, to check and paste into a config:"]
            lines += commented(drafted, draft.marks.comments, ()).splitlines()
    content = inspection(reports, together)
    return Inspection("\n".join((*summary(content).lines, *lines)), content)


def reading(config: Path) -> Reading:
    """Return what a config says about the logs that it reads.

    Raises:
        ConfigError: where it is no config of logs.
    """
    task = load_task(config, [])
    if isinstance(task, ImportConfig):
        return Reading(task.reader.build(), isinstance(task.reader, RecordingConfig))
    if not isinstance(task, FitConfig) or not isinstance(task.data, MeasuredLogs):
        raise ConfigError(
            f"{config}: has no channel map (data.kind is not 'measured'); leave --config out for"
            " logs that describe themselves"
        )
    try:
        splits = {
            path.resolve(): split
            for split, paths in task.data.split.resolve().items()
            for path in paths
        }
    except ConfigError:
        # the split's own files need not be here to look at others
        splits = {}
    reader = task.data.reader
    return Reading(
        reader.build(),
        isinstance(reader, RecordingConfig),
        task.signals.columns,
        task.prepare.masks,
        splits,
        task,
    )


def _read(
    files: Sequence[Path], reader: LogReader | None
) -> tuple[dict[Path, Log | ResidnetError], list[DraftedLogs]]:
    """Return file -> its log, or why there is none; and the readers that were drafted for them."""
    out: dict[Path, Log | ResidnetError] = {}
    if reader is None:
        drafts = read_each(files)
        for draft in drafts:
            out |= {**draft.logs, **draft.left_out}
        return out, drafts
    for file in files:
        try:
            out[file] = reader.read(file)
        except DataError as error:
            out[file] = error
    return out, []


def _regressors(logs: Sequence[Log], task: Any) -> list[Finding]:
    """Return how well the prepared logs condition the regressors of each baseline."""
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.data.prepare import prepare, samples

    try:
        prepared = [prepare(log, "train", task.signals.columns, task.prepare) for log in logs]
        data = samples([log for log in prepared if log.good.any()], task.signals.build())
    except (DataError, UsageError) as error:
        return [
            Finding(
                "will mislead", "not_prepared", f"the config cannot prepare these logs: {error}"
            )
        ]
    out = []
    for name, config in {"baseline": task.baseline, **task.baselines}.items():
        baseline = config.build(data.names)
        if not isinstance(baseline, RegressorBaseline):
            continue
        phi = baseline.library(data.z).numpy()
        moving = [
            j
            for j in range(phi.shape[1])
            if float(np.ptp(phi[:, j])) > 1e-12 * float(np.abs(phi[:, j]).max(initial=0.0))
        ]
        terms = [baseline.library.terms[j] for j in range(phi.shape[1])]
        if len(moving) > 1 and phi.shape[0] > 2 * len(moving):
            condition, worst = conditioning(phi[:, moving], [terms[j] for j in moving])
            still = [term for j, term in enumerate(terms) if j not in moving and term != "1"]
            text = (
                f"regressors of {name} over these logs: {len(moving)} move, condition number"
                f" {condition:.3g} (centred, scaled)"
            )
            text += f"; constant: {', '.join(still)}" if still else ""
            ill = condition > _ILL_CONDITIONED
            text += f"; {', '.join(worst)} move together" if condition > 30.0 else ""
            action = (
                "leave regressors out, give the baseline a ridge, or add manoeuvres" if ill else ""
            )
            # a log or two are looked at, not fitted: what they lack others have
            level: Level = "will mislead" if ill and len(logs) > 2 else "note"
            out.append(
                Finding(
                    level,
                    "regressors",
                    text,
                    {"condition": condition, "regressors": len(moving)},
                    action,
                )
            )
    return out
