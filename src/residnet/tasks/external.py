"""`residnet evaluate`: the models of a finished run on logs that they have never seen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from residnet.core.config import dump_config, load_config, load_mapping
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.progress import say
from residnet.data.prepare import prepare
from residnet.data.readers import CanonicalConfig
from residnet.data.simulated.trials import SimulatedTrials
from residnet.identification.evaluation import candidates, evaluate
from residnet.identification.prepared import require_window, velocity_limit
from residnet.judge.rollout_files import write_rollouts
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.tasks.fit import FitConfig
from residnet.tasks.inspection import log_files
from residnet.tasks.reporting import report_run
from residnet.tasks.run import print_table, write_data_quality, write_limits, write_metrics


def evaluate_external(run: Path, paths: Sequence[Path], out: Path | None) -> RunFolder:
    """Free-run every model of a run on other logs, with the run's reader, masks, protocols and
    scales; the split is called `external`.

    Raises:
        ResidnetError: where the run, a log or a channel is missing, or a log is too short.
    """
    started = time.time()
    source = RunFolder.open(run)
    task = load_mapping(source.resolved).get("task")
    if task != "fit":
        raise UsageError(
            f"{run}: a run of task '{task}' has no models to free-run on logs; give a run of task"
            " 'fit'"
        )
    config = load_config(source.resolved, [], FitConfig)
    torch.set_num_threads(config.threads)
    files = log_files(paths)
    logs = [
        prepare(read_external(path, config), "external", config.signals.columns, config.prepare)
        for path in files
    ]
    names = [log.log.name for log in logs]
    for name in names:
        if names.count(name) > 1:
            raise DataError(f"two logs are named '{name}'; rename one file")
    for log in logs:
        require_window(log, config)
    folder = RunFolder.create(
        out or run / time.strftime("external-%Y%m%dT%H%M%S"), dump_config(config), resume=False
    )
    store = FolderStore(source)
    fitted = [store.load(name) for name in store.names()]
    order = ["zero", *config.model_names]
    fitted.sort(key=lambda entry: order.index(entry.name) if entry.name in order else len(order))
    low, high = np.array(fitted[0].spec.low), np.array(fitted[0].spec.high)
    limit = velocity_limit(low, high, config.evaluation.divergence)
    say(f"{config.name}: {len(logs)} logs, {len(fitted)} models")
    simulated = isinstance(config.data, SimulatedTrials) and all(
        "vessel" in log.log.meta for log in logs
    )
    models = [c for c in candidates(fitted, config.data) if c.kind != "truth" or simulated]
    judged = evaluate(models, logs, config.evaluation, config.prepare.grid.step, limit)
    write_rollouts(folder.rollouts / "external", judged.runs, logs)
    write_data_quality(folder, {"external": logs})
    write_metrics(folder, config, judged.rows, str(source.read_metrics()["selected"]))
    write_limits(folder, config, {"external": judged.limits}, logs)
    folder.write_provenance(
        config=source.resolved, overrides=[], seed=config.seed, files=files, started=started
    )
    report = report_run(folder.path)
    print_table(folder.read_metrics()["rows"], "external")
    print(f"report: {report}")
    return folder


def read_external(path: Path, config: FitConfig) -> Log:
    """A log read as the run read its own; canonical files are recognised by their own mark.

    Raises:
        ResidnetError: where the file cannot be read.
    """
    if isinstance(config.data, SimulatedTrials) or Log.recognises(path):
        return CanonicalConfig().build().read(path)
    return config.data.reader.build().read(path)
