"""What free runs of a fit's models leave in a folder, be it of the run or of another evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, END_UNITS, si_unit
from residnet.core.progress import begin, say
from residnet.data.drafting.reading import log_files
from residnet.data.masks import Spike
from residnet.data.prepare import Prepared, prepare
from residnet.data.readers.base import CanonicalConfig
from residnet.data.simulated import SimulatedTrials
from residnet.data.split import log_names
from residnet.dynamics.store import ModelSpec
from residnet.identification.identified import Evaluation
from residnet.identification.prepared import velocity_limit
from residnet.judge.goodness import repeatability
from residnet.judge.metrics import LIMITS_SCHEMA, metrics_content, write_rollouts
from residnet.report.run_reader import RunFiles
from residnet.report.sections.free_runs import errors_table
from residnet.report.sections.verdict import level, verdict
from residnet.runs.folder import RunFolder
from residnet.runs.task import Exports, MainFigure, Outcome

if TYPE_CHECKING:
    from residnet.tasks.fit import FitConfig

SPLIT = "external"
"""Name of the split of logs that no fit has seen."""


def write_inspection(
    folder: RunFolder, splits: Mapping[str, Sequence[Log]], config: FitConfig
) -> None:
    """Write doctor.json: what the doctor finds in all logs as the run's masks leave them."""
    # a check does not wait for the doctor
    from residnet.data.doctor import inspect, inspect_together, inspection, summary

    begin("examining logs")
    inputs, masks = config.signals.columns, (*config.prepare.masks, Spike())
    logs = [log for members in splits.values() for log in members]
    split_of = {log.name: split for split, members in splits.items() for log in members}
    reports = [inspect(log, inputs, masks) for log in logs]
    together = inspect_together(logs, inputs, split_of)
    for report in reports:
        for finding in report.find("fill_values"):
            say(f"  {report.name}: {finding.text}")
    found = inspection(reports, together)
    folder.write_json(folder.path / "doctor.json", found)
    # the tally stands in the verdict; what may be corrected is told before the fit takes its time
    if first := summary(found).first:
        say(f"  {first}")


def write_judged(
    folder: RunFolder,
    config: FitConfig,
    judged: Mapping[str, Evaluation],
    names: tuple[str, str | None, str],
    logs: Mapping[str, Sequence[Prepared]],
) -> None:
    """Write what free runs show: rollouts, metrics.json, limits.json and data_quality.json.

    Args:
        folder: of the run, or of an evaluation.
        judged: free runs by split.
        names: of the selected model, of the selected mean of models, and of the predictor.
        logs: by split, those that were not judged too.
    """
    for split, part in judged.items():
        write_rollouts(
            folder.rollouts / split, part.runs, part.logs, config.signals.columns, part.bands
        )
    scales = config.evaluation.scales.named()
    states = config.signals.live.states
    units = {name: si_unit(unit) for name, unit in config.signals.units().items() if name in states}
    rows = [row for part in judged.values() for row in part.rows]
    folder.write_json(folder.metrics, metrics_content(config.name, units, scales, *names, rows))
    commands, step = len(config.signals.inputs), config.prepare.grid.step
    seen = [log for part in judged.values() for log in part.logs]
    limits = {
        "schema": LIMITS_SCHEMA,
        "run": config.name,
        "splits": {split: part.limits for split, part in judged.items()},
        "repeatability": {
            name: repeatability(protocol, seen, commands, scales, step)
            for name, protocol in config.evaluation.protocols.items()
        },
    }
    folder.write_json(folder.limits, limits)
    quality = [
        {
            **log.described(split),
            "masked": {
                reason: float(np.mean(mask)) for reason, mask in log.log.masks.items() if mask.any()
            },
            "largest": {
                name: float(np.abs(log.y[log.usable, log.live.states.index(name)]).max())
                for name in log.live.channels
            },
            **({"integrated": made} if (made := log.log.meta.get("integrated")) else {}),
        }
        for split, members in logs.items()
        for log in members
    ]
    folder.write_json(folder.data_quality, quality)


def fit_outcome(
    folder: RunFolder, split: str, exports: Exports | None = None, failure: str = ""
) -> Outcome:
    """Return the verdict of a fit or an evaluation, and the errors of its selected model.

    Args:
        folder: where the results stand.
        split: that is shown.
        exports: what writes each export when the run ends; None for none.
        failure: a line where a result fails a check.
    """
    files = RunFiles(folder.path)
    row = files.row(files.lead, split, files.protocols[0])
    figures: dict[str, MainFigure] = {}
    if row is not None:
        figures = {
            "nrmse": MainFigure(row["nrmse"]["mean"]),
            **{
                f"rmse_{name}": MainFigure(row["rmse"][name], CHANNEL_UNITS[name])
                for name in files.channels
            },
            **{
                f"{end}_error_end": MainFigure(row[f"{end}_error_end"], END_UNITS[end])
                for end in files.ends
            },
        }
    sentences = [sentence for sentence in verdict(files) if sentence]
    return Outcome(
        sentences, figures, errors_table(files, split).text(), failure, exports or {}, level(files)
    )


def external_logs(
    config: FitConfig, paths: Sequence[Path]
) -> tuple[list[Path], list[Log], list[Prepared]]:
    """Return the files of other logs, the logs, and the logs prepared as those of the fit.

    They are read as the fit read its own; canonical files are recognised by their own mark.

    Raises:
        ResidnetError: where a file cannot be read.
    """
    data = config.data
    own = CanonicalConfig() if isinstance(data, SimulatedTrials) else data.reader
    # a folder may be one log, as a ROS 2 bag is, or hold sheets and lines of JSON
    files = own.build().logs_among(log_files(paths))
    readers = {path: (CanonicalConfig() if Log.recognises(path) else own).build() for path in files}
    read = [readers[path].read(path).replace(name=name) for path, name in log_names(files).items()]
    signals = config.signals
    logs = [prepare(log, SPLIT, signals.columns, config.prepare, signals.live) for log in read]
    return [part for path in files for part in readers[path].files(path)], read, logs


def limit_of(spec: ModelSpec, config: FitConfig) -> np.ndarray:
    """Return the |u, v, r| [3] beyond which a free run of a model has diverged."""
    return velocity_limit(
        np.array(spec.low), np.array(spec.high), config.evaluation.divergence, spec.signals.live
    )
