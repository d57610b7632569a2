"""Running a fit from start to end, into a run folder."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from residnet.core.config import dump_config
from residnet.core.names import STATE, si_unit
from residnet.core.progress import say
from residnet.data.prepare import Prepared
from residnet.data.sources import input_files, read_logs
from residnet.documents import draw_study
from residnet.identification.currents import through_currents
from residnet.identification.fit import Identified, fit
from residnet.identification.goodness import goodness_rows
from residnet.identification.prepared import PreparedSplits, prepare_logs
from residnet.identification.teacher_forced import residual_table, term_table
from residnet.judge.goodness import content
from residnet.judge.limits import SCHEMA as LIMITS
from residnet.judge.repeats import repeatability
from residnet.judge.rollout_files import write_rollouts
from residnet.judge.tables import metrics_content
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.tasks.booklet import write_booklet
from residnet.tasks.exporting import export_model
from residnet.tasks.fit import FitConfig
from residnet.tasks.inspection import write_inspection
from residnet.tasks.reporting import report_run

if TYPE_CHECKING:
    import pandas as pd


def run_fit(
    config: FitConfig,
    *,
    source: Path,
    overrides: Sequence[str],
    out: Path | None,
    resume: bool,
    report: bool = True,
) -> RunFolder:
    """Fit, evaluate, report and export.

    Args:
        config: the complete configuration.
        source: the file that it came from, for the record.
        overrides: likewise.
        out: run folder; None for runs/<name>.
        resume: continue an unfinished run in that folder.
        report: draw figures, write the report and export; else stop at the metrics.

    Raises:
        ResidnetError: where the input does not allow it.
    """
    started = time.time()
    torch.set_num_threads(config.threads)
    files = input_files(config.data)
    folder = RunFolder.create(out or Path("runs") / config.name, dump_config(config), resume=resume)
    folder.write_provenance(
        config=source, overrides=overrides, seed=config.seed, files=files, started=started
    )
    logs = _prepared(config, folder)
    identified = fit(logs, config, store=FolderStore(folder))
    _judged(config, folder, identified, logs)
    if report:
        finish(folder, config)
    folder.write_provenance(
        config=source, overrides=overrides, seed=config.seed, files=files, started=started
    )
    return folder


def _prepared(config: FitConfig, folder: RunFolder) -> PreparedSplits:
    """Logs read, looked at by the doctor and prepared, through the water where they ran in
    currents.
    """
    say(f"{config.name}: reading logs")
    read = read_logs(config.data)
    write_inspection(folder, read, config)
    logs = prepare_logs(read, config)
    say("  " + ", ".join(f"{split} {len(members)} logs" for split, members in logs.items()))
    logs, currents = through_currents(logs, config)
    if config.current is not None:
        folder.write_json(folder.path / "currents.json", currents)
    write_data_quality(folder, logs)
    return logs


def _judged(
    config: FitConfig, folder: RunFolder, identified: Identified, logs: PreparedSplits
) -> None:
    """Free runs of all models, and everything that is written of them."""
    say("  free runs")
    fitted, step = list(identified.values()), config.prepare.grid.step
    table: list[dict[str, Any]] = []
    limiting: dict[str, Any] = {}
    for split in config.evaluation.splits:
        judged = identified.evaluate(logs[split], config.data)
        write_rollouts(folder.rollouts / split, judged.runs, judged.logs)
        limiting[split] = judged.limits
        table += judged.rows
    write_metrics(folder, config, table, identified.select(table))
    write_limits(
        folder, config, limiting, [log for split in config.evaluation.splits for log in logs[split]]
    )
    _write_table(folder.residuals, residual_table(fitted, logs["test"]))
    _write_table(folder.path / "terms.parquet", term_table(fitted, logs["test"]))
    splits = goodness_rows(fitted, logs, step)
    folder.write_json(folder.goodness, content(config.name, splits, step))
    if config.booklet is not None:
        refitted = identified[config.booklet.model]
        say("  " + write_booklet(folder, config.booklet, refitted, logs, identified.limit))


def _write_table(file: Path, table: pd.DataFrame) -> None:
    """A table that has rows, as parquet."""
    if len(table):
        table.to_parquet(file, index=False)


def write_metrics(
    folder: RunFolder, config: FitConfig, table: Sequence[dict[str, Any]], selected: str
) -> None:
    """metrics.json with schema, units, scales and rows."""
    units = {name: si_unit(unit) for name, unit in config.signals.units().items() if name in STATE}
    scales = config.evaluation.scales.named()
    folder.write_json(folder.metrics, metrics_content(config.name, units, scales, selected, table))


def write_limits(
    folder: RunFolder, config: FitConfig, limiting: Mapping[str, Any], logs: Sequence[Prepared]
) -> None:
    """limits.json: where models fail and what limits them, by split and protocol, and how well the
    vessel repeats itself over all logs.
    """
    scales = config.evaluation.scales.named()
    commands, step = len(config.signals.inputs), config.prepare.grid.step
    repeats = {
        name: repeatability(protocol, logs, commands, scales, step)
        for name, protocol in config.evaluation.protocols.items()
    }
    folder.write_json(
        folder.limits,
        {"schema": LIMITS, "run": config.name, "splits": limiting, "repeatability": repeats},
    )


def write_data_quality(folder: RunFolder, logs: dict[str, list[Any]]) -> None:
    """What each log contributes, for the report: data_quality.json."""
    out = []
    for split, members in logs.items():
        for p in members:
            masked = {
                reason: float(np.mean(mask)) for reason, mask in p.log.masks.items() if mask.any()
            }
            out.append(
                {
                    "log": p.log.name,
                    "split": split,
                    "manoeuvre": p.log.manoeuvre,
                    "seconds": float(p.log.t[-1] - p.log.t[0]),
                    "samples": len(p),
                    "usable": float(p.usable.mean()),
                    "learned_from": float(p.good.mean()),
                    "masked": masked,
                    "largest": {
                        name: float(np.abs(p.y[p.usable, 3 + i]).max())
                        for i, name in enumerate(("u", "v", "r"))
                    },
                }
            )
    folder.write_json(folder.data_quality, out)


def finish(folder: RunFolder, config: FitConfig) -> None:
    """Exports, figures and report, then the table and where things are."""
    for name in config.export.models:
        print(f"exported: {export_model(folder.path, name, None)}")
    report = report_run(folder.path)
    print_table(folder.read_metrics()["rows"], "test")
    for path in draw_study(config.study, folder.path) if config.study else ():
        print(f"study figure: {path}")
    print(f"report: {report}")


def print_table(table: Sequence[Mapping[str, Any]], split: str) -> None:
    """The free-run table of one split on standard output."""
    titles = (
        f"{'protocol':12s} {'model':14s} {'u m/s':>8s} {'v m/s':>8s} {'r deg/s':>8s} {'nrmse':>7s}"
    )
    print(f"{titles} {'position m':>11s} {'heading deg':>12s} {'diverged':>9s}")
    for row in table:
        if row["split"] != split or row["manoeuvre"] != "all":
            continue
        rmse, mark = row["rmse"], " *" if row["selected"] else ""
        print(
            f"{row['protocol']:12s} {row['model'] + mark:14s} {rmse['u']:8.4f} {rmse['v']:8.4f}"
            f" {math.degrees(rmse['r']):8.3f} {row['nrmse']['mean']:7.4f}"
            f" {row['position_error_end']:11.2f} {math.degrees(row['heading_error_end']):12.2f}"
            f" {row['diverged']:5d}/{row['windows']}"
        )
    print("free-run errors, mean over windows; * = selected on validation data")
