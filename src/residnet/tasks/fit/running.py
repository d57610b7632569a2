"""Carrying out a fit, into a run folder."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from residnet.core.errors import DataError
from residnet.core.progress import say
from residnet.identification.fit import fit
from residnet.identification.identified import Identified, goodness_rows, residual_table, term_table
from residnet.identification.prepared import PreparedSplits, prepare_logs, through_currents
from residnet.judge.band import bands_content
from residnet.judge.goodness import content
from residnet.judge.rollout_files import write_rollouts
from residnet.judge.soundness import sanity_content
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.task import Outcome
from residnet.tasks.fit.booklet import write_booklet
from residnet.tasks.fit.config import FitTaskSettings
from residnet.tasks.fit.doctor import write_inspection
from residnet.tasks.fit.exporting import export_model
from residnet.tasks.fit.files import (
    fit_outcome,
    write_data_quality,
    write_limits,
    write_metrics,
)
from residnet.tasks.fit.inputs import take_logs


def run_fit(config: FitTaskSettings, folder: RunFolder) -> Outcome:
    """Fit all models, judge them in free run, and write what was found.

    Raises:
        ResidnetError: where the logs cannot be used, or do not determine a model.
    """
    logs = _prepared(config, folder)
    identified = fit(logs, config, store=FolderStore(folder))
    _judged(config, folder, identified, logs)
    failure = _booklet(config, folder, identified, logs)
    outcome = fit_outcome(
        folder,
        "test",
        {
            name: partial(export_model, folder, name, None, "torchscript")
            for name in config.export.models
        },
    )
    return replace(outcome, failure=failure)


def _prepared(config: FitTaskSettings, folder: RunFolder) -> PreparedSplits:
    """Read the logs, have the doctor look at them, and prepare them.

    Where they ran in currents, they are taken through the water.
    """
    say(f"{config.name}: reading logs")
    read = take_logs(config)
    write_inspection(folder, read, config)
    logs = prepare_logs(read, config)
    say("  " + ", ".join(f"{split} {len(members)} logs" for split, members in logs.items()))
    logs, currents = through_currents(logs, config)
    if config.current is not None:
        folder.write_json(folder.path / "currents.json", currents)
    write_data_quality(folder, logs)
    return logs


def _judged(
    config: FitTaskSettings, folder: RunFolder, identified: Identified, logs: PreparedSplits
) -> None:
    """Run all models freely, and write everything that is found of them."""
    say("  free runs")
    fitted, step = list(identified.values()), config.prepare.grid.step
    if config.bands is not None:
        bands = {entry.name: entry.bands for entry in fitted}
        folder.write_json(folder.bands, bands_content(config.name, bands))
    held = {str(split): logs[split] for split in config.evaluation.splits}
    judged = identified.evaluate_splits(held, config.data)
    for split, part in judged.items():
        write_rollouts(
            folder.rollouts / split, part.runs, part.logs, config.signals.columns, part.bands
        )
    chosen = identified.select(judged)
    say(f"  selected: {chosen.selected}")
    table = [row for part in judged.values() for row in part.rows]
    write_metrics(folder, config, table, chosen.selected, chosen.selected_ensemble)
    folder.write_json(folder.selection, chosen.content())
    folder.write_json(folder.sanity, sanity_content(identified.findings))
    limiting = {split: part.limits for split, part in judged.items()}
    write_limits(
        folder, config, limiting, [log for split in config.evaluation.splits for log in logs[split]]
    )
    for place, found in {
        folder.residuals: residual_table(fitted, logs["test"]),
        folder.path / "terms.parquet": term_table(fitted, logs["test"]),
    }.items():
        if len(found):
            folder.write_table(place, found)
    splits = goodness_rows(fitted, logs, step)
    folder.write_json(folder.goodness, content(config.name, splits, step))


def _booklet(
    config: FitTaskSettings, folder: RunFolder, identified: Identified, logs: PreparedSplits
) -> str:
    """Fly the booklet where one is asked for; return a line where the model cannot."""
    if config.booklet is None:
        return ""
    refitted = identified[config.booklet.model]
    try:
        say("  " + write_booklet(folder, config.booklet, refitted, logs, identified.limit))
    except DataError as error:
        # the fit itself is done, and its report is worth having
        return str(error)
    return ""
