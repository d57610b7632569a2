"""Carrying out a fit into a run folder, judging its models on other logs, and exporting them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.config import dump_config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, END_UNITS, nearest, si_unit
from residnet.core.progress import begin, say
from residnet.data.doctor import inspect, inspect_together, inspection, summary
from residnet.data.drafting.reading import log_files
from residnet.data.masks import Spike
from residnet.data.prepare import Prepared, prepare
from residnet.data.readers.base import CanonicalConfig
from residnet.data.simulated import SimulatedTrials
from residnet.data.split import log_names
from residnet.dynamics.store import ModelSpec, load_model, model_names
from residnet.export.vessel import ExportedVessel
from residnet.identification.fit import fit
from residnet.identification.identified import (
    Evaluation,
    candidates,
    evaluate,
    goodness_rows,
    residual_table,
    term_table,
)
from residnet.identification.prepared import (
    prepare_logs,
    require_window,
    through_currents,
    velocity_limit,
)
from residnet.judge.band import bands_content
from residnet.judge.goodness import content, repeatability
from residnet.judge.metrics import LIMITS_SCHEMA, metrics_content, write_rollouts
from residnet.judge.soundness import sanity_content
from residnet.judge.verdict import objections
from residnet.report.run_reader import RunFiles
from residnet.report.sections.free_runs import errors_table
from residnet.report.sections.verdict import evidence, level, verdict
from residnet.runs.folder import Provenance, RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.task import ExportRequest, Exports, Finished, MainFigure, Outcome
from residnet.tasks.booklet import write_booklet

if TYPE_CHECKING:
    from residnet.tasks.fit import FitConfig

_CHOSEN = ("predictor", "selected")
"""What stands for a model's name: the one reported first, and the single one chosen."""
SPLIT = "external"
"""Name of the split of logs that no fit has seen."""


def run_fit(config: FitConfig, folder: RunFolder) -> Outcome:
    """Fit all models, judge them in free run, and write what was found.

    Logs that ran in currents are taken through the water.

    Raises:
        ResidnetError: where the logs cannot be used, or do not determine a model.
    """
    begin(f"{config.name}: reading logs")
    read = config.logs()
    _write_inspection(folder, read, config)
    logs = prepare_logs(read, config)
    say("  " + ", ".join(f"{split} {len(members)} logs" for split, members in logs.items()))
    logs, currents = through_currents(logs, config)
    if config.current is not None:
        folder.write_json(folder.path / "currents.json", currents)
    identified = fit(logs, config, store=FolderStore(folder))
    begin("free runs")
    fitted, step = list(identified.values()), config.prepare.grid.step
    if config.bands is not None:
        bands = {entry.name: entry.bands for entry in fitted}
        folder.write_json(folder.bands, bands_content(config.name, bands))
    held = {str(split): logs[split] for split in config.evaluation.splits}
    judged = identified.evaluate(held, config.data)
    chosen = identified.select(judged)
    told = "" if chosen.leading is None else f"; predictor: {chosen.leading}"
    say(f"  selected: {chosen.selected}{told}")
    folder.write_json(folder.selection, chosen.content())
    folder.write_json(folder.sanity, sanity_content(identified.findings))
    names = (chosen.selected, chosen.selected_ensemble, chosen.predictor)
    write_judged(folder, config, judged, names, logs)
    for place, found in {
        folder.residuals: residual_table(fitted, logs["test"]),
        folder.path / "terms.parquet": term_table(fitted, logs["test"]),
    }.items():
        if len(found):
            folder.write_table(place, found)
    splits = goodness_rows(fitted, logs, step)
    folder.write_json(folder.goodness, content(config.name, splits, step))
    failure = ""
    if config.booklet is not None:
        refitted = identified[config.booklet.model]
        try:
            say("  " + write_booklet(folder, config.booklet, refitted, logs, identified.limit))
        except DataError as error:
            # the fit itself is done, and its report is worth having
            failure = str(error)
    exports = {
        name: partial(export_model, ExportRequest(folder, name)) for name in config.export.models
    }
    return fit_outcome(folder, "test", exports, failure)


def _write_inspection(
    folder: RunFolder, splits: Mapping[str, Sequence[Log]], config: FitConfig
) -> None:
    """Write doctor.json: what the doctor finds in all logs as the run's masks leave them."""
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
            "log": log.log.name,
            "split": split,
            "manoeuvre": log.log.manoeuvre,
            "seconds": float(log.log.t[-1] - log.log.t[0]),
            "samples": len(log),
            "usable": float(log.usable.mean()),
            "learned_from": float(log.good.mean()),
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


def export_model(asked: ExportRequest) -> Path:
    """Export one model of a fit, and return the file.

    `predictor` stands for the one that is reported first, `selected` for the single one chosen on
    validation data.

    Raises:
        UsageError: where there is no such model.
        WithheldError: where it is worse than doing without it, but for `asked.anyway`.
        ExportError: where the exported model does not agree with the one that it came from.
    """
    run, name, metrics = asked.run, asked.model, asked.run.read_metrics()
    chosen = str(metrics.get(name, metrics["selected"])) if name in _CHOSEN else name
    known = model_names(run.models)
    if chosen not in known:
        raise UsageError(f"{run.path}: no model '{name}'{nearest(name, [*_CHOSEN, *known])}")
    spec, model = load_model(run.models / chosen)
    rows = [row for row in metrics["rows"] if row["model"] == chosen and row["manoeuvre"] == "all"]
    against = objections(evidence(RunFiles(run.path), chosen))
    return asked.write(ExportedVessel(spec, model, rows), against, chosen)


def evaluate_on(
    config: FitConfig, run: RunFolder, paths: Sequence[Path], out: Path | None
) -> Finished:
    """Free-run every model of a fit on logs that it has never seen.

    Its reader, masks, protocols and scales are used; `zero` comes first, then the config's order.

    Args:
        out: folder of the results; RUN/external-<time> where none is given.

    Raises:
        DataError: where a log cannot be used or is too short.
        UsageError: where a path or a channel is missing, or the folder may not be used.
    """
    files, read, logs = external_logs(config, paths)
    for log in logs:
        require_window(log, config)
    made_from = Provenance(run.resolved, (), config.seed, files, time.time())
    place = out or run.path / time.strftime("external-%Y%m%dT%H%M%S")
    folder = RunFolder.create(place, dump_config(config))

    def judge(folder: RunFolder) -> Outcome:
        store, order = FolderStore(run), ["zero", *config.model_names]
        fitted = [store.load(name) for name in store.names()]
        fitted.sort(key=lambda model: (*order, model.name).index(model.name))
        say(f"{config.name}: {len(logs)} logs, {len(fitted)} models")
        _write_inspection(folder, {SPLIT: read}, config)
        simulated = isinstance(config.data, SimulatedTrials) and all(
            "vessel" in log.meta for log in read
        )
        models = [c for c in candidates(fitted, config.data) if c.kind != "truth" or simulated]
        limit = limit_of(fitted[0].spec, config)
        judged = evaluate(models, {SPLIT: logs}, config.evaluation, config.prepare.grid.step, limit)
        # bands, and why the model was selected, are the fit's own; the report shows them
        for own, copy in ((run.bands, folder.bands), (run.selection, folder.selection)):
            if own.is_file():
                folder.write(copy, own.read_text(encoding="utf-8"))
        chosen = run.read_metrics()
        selected = str(chosen["selected"])
        predictor = str(chosen.get("predictor", selected))
        names = (selected, chosen.get("selected_ensemble"), predictor)
        write_judged(folder, config, judged, names, {SPLIT: logs})
        return fit_outcome(folder, SPLIT)

    return config.conduct(folder, made_from, judge)


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
