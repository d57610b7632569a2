"""`residnet inspect`: the data doctor over files."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.core.log import Log
from residnet.data.doctor import Finding, Level, Report, inspect, inspect_together, inspection
from residnet.data.doctor.draft import draft_map
from residnet.data.doctor.excitation import conditioning
from residnet.data.masks import Mask
from residnet.data.readers.base import LogReader
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.detect import format_of, reader_for
from residnet.runs.folder import RunFolder

if TYPE_CHECKING:
    from residnet.tasks.fit import FitConfig

# regressors that move together so closely leave their coefficients to the noise
_ILL = 1e6


@dataclass(frozen=True)
class _Setup:
    """What a config says about logs: how they are read, what drives the vessel, what is masked, and
    which split a file is in.
    """

    reader: LogReader | None = None
    folders: bool = False
    inputs: tuple[str, ...] | None = None
    masks: tuple[Mask, ...] = ()
    splits: Mapping[str, str] | None = None
    task: Any = None


def inspect_logs(paths: Sequence[Path], config: Path | None, file: Path | None = None) -> bool:
    """Print what the doctor finds in each log and between them; True where a fit would be misled.

    Args:
        paths: files and folders.
        config: a run or import whose channel map reads them; None where they describe themselves,
            or to have a map drafted.
        file: where the same goes as JSON (schema residnet.inspection/1).

    Raises:
        ResidnetError: where a path does not exist, the config cannot be used, or the only log
            cannot be read.
    """
    setup = _Setup() if config is None else _setup(config)
    files = log_files(paths, setup.folders or config is None)
    logs: list[Log] = []
    reports: list[Report] = []
    drafts: dict[str, list[str]] = {}
    for path in files:
        try:
            log, draft = _read(path, setup)
            report = inspect(log, setup.inputs, setup.masks)
        except DataError as error:
            if len(files) == 1:
                raise
            reports.append(
                Report(path.stem, (Finding("fatal", "unreadable", str(error)),), str(path))
            )
        else:
            logs.append(log)
            reports.append(report)
            drafts |= {"\n".join(draft): draft} if draft else {}
        print("\n".join(reports[-1].lines()), flush=True)
    together = (
        inspect_together(logs, setup.inputs, setup.splits) if logs else Report("together", ())
    )
    if setup.task is not None and logs:
        together = Report("together", (*together.findings, *_regressors(logs, setup.task)))
    print("\n".join(together.lines()), flush=True)
    for draft in drafts.values():
        print(
            "\n".join(
                ("channel map as guessed, to check and paste under `data:` of a config:", *draft)
            )
        )
    content = inspection(reports, together)
    if file is not None:
        _write(file, content)
    return bool(content["misled"])


def write_inspection(
    folder: RunFolder, splits: Mapping[str, Sequence[Log]], config: FitConfig
) -> None:
    """doctor.json of a fit: what the doctor finds in the logs of all splits as the run's masks
    leave them.
    """
    logs = [log for members in splits.values() for log in members]
    reports = [inspect(log, config.signals.columns, config.prepare.masks) for log in logs]
    names = {log.name: split for split, members in splits.items() for log in members}
    content = inspection(reports, inspect_together(logs, config.signals.columns, names))
    folder.write_json(folder.path / "doctor.json", content)
    loud = sum(report.misled for report in reports)
    if loud:
        print(
            f"  the data doctor says of {loud} of {len(logs)} logs that they would mislead a fit:"
            " see the report",
            file=sys.stderr,
        )


def _write(file: Path, content: dict[str, Any]) -> None:
    try:
        file.write_text(json.dumps(content, indent=1) + "\n")
    except OSError as error:
        raise UsageError(f"--json {file}: cannot be written ({error.strerror})") from error


def _setup(config: Path) -> _Setup:
    from residnet.data.sources import MeasuredLogs
    from residnet.tasks import load_task
    from residnet.tasks.fit import FitConfig
    from residnet.tasks.import_logs import ImportConfig

    task = load_task(config, [])
    if isinstance(task, ImportConfig):
        return _Setup(task.reader.build(), isinstance(task.reader, RecordingConfig))
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
    named = {path.stem: split for path, split in splits.items()}
    reader = task.data.reader
    return _Setup(
        reader.build(),
        isinstance(reader, RecordingConfig),
        task.signals.columns,
        task.prepare.masks,
        named,
        task,
    )


def _read(path: Path, setup: _Setup) -> tuple[Log, list[str]]:
    """The log in a file, and the lines of the channel map that was guessed for it, if any."""
    if setup.reader is not None:
        return setup.reader.read(path), []
    if Log.recognises(path) or format_of(path) is not None:
        return reader_for(path).read(path), []
    draft = draft_map(path)
    log = draft.reader().read(path)
    known = [*draft.remarks, *log.meta.get("findings", ())]
    return log.replace(meta={**log.meta, "findings": known}), draft.lines()


def _regressors(logs: Sequence[Log], task: Any) -> list[Finding]:
    """Condition number of the baselines' regressors over all logs, as the config prepares them."""
    from residnet.baselines import RegressorBaseline
    from residnet.data.prepare import prepare, samples

    try:
        prepared = [prepare(log, "train", task.signals.columns, task.prepare) for log in logs]
        data = samples([one for one in prepared if one.good.any()], task.signals.build())
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
            ill = condition > _ILL
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


def log_files(paths: Sequence[Path], folders: bool = False) -> list[Path]:
    """Files, and the csv and Parquet files below folders, in order; a folder that is itself a
    recording stays one where `folders`.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    out: list[Path] = []
    for path in paths:
        if path.is_dir() and folders and format_of(path) is not None:
            out.append(path)
        elif path.is_dir():
            found = sorted(p for p in path.rglob("*") if p.suffix in {".csv", ".parquet"})
            if not found:
                raise UsageError(f"{path}: holds no csv or Parquet file")
            out += found
        elif path.is_file():
            out.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    return out
