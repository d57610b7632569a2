"""The models of a finished fit on logs that they have never seen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from residnet.core.config import dump_config
from residnet.core.log import Log
from residnet.core.progress import say
from residnet.data.drafting.reading import log_files
from residnet.data.parts import data_files, log_names
from residnet.data.prepare import prepare
from residnet.data.readers.canonical import CanonicalConfig
from residnet.data.readers.compose import RecordingConfig
from residnet.data.simulated.trials import SimulatedTrials
from residnet.identification.identified import candidates, evaluate
from residnet.identification.prepared import require_window, velocity_limit
from residnet.judge.rollout_files import write_rollouts
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.provenance import Provenance
from residnet.runs.task import Outcome
from residnet.tasks.fit.config import FitTaskSettings
from residnet.tasks.fit.doctor import write_inspection
from residnet.tasks.fit.files import (
    fit_outcome,
    write_data_quality,
    write_limits,
    write_metrics,
)

SPLIT = "external"
"""Name of the split of these logs."""


class ExternalLogs:
    """Logs that are judged with a fit's reader, masks, protocols and scales.

    Attributes:
        provenance: what the evaluation is made from.
    """

    def __init__(self, config: FitTaskSettings, run: RunFolder, paths: Sequence[Path]) -> None:
        """Read and prepare the logs.

        Args:
            config: of the finished fit.
            run: its folder.
            paths: files and folders.

        Raises:
            DataError: where a log cannot be used or is too short.
            UsageError: where a path or a channel is missing.
        """
        self.config, self.run = config, run
        files = log_files(paths, takes_folders(config))
        self.provenance = Provenance(run.resolved, (), config.seed, data_files(files), time.time())
        self.read = read_external(files, config)
        self.logs = [
            prepare(log, SPLIT, config.signals.columns, config.prepare) for log in self.read
        ]
        for log in self.logs:
            require_window(log, config)

    def create_folder(self, out: Path | None) -> RunFolder:
        """Make the folder for the results; RUN/external-<time> where none is given.

        Raises:
            UsageError: where the folder exists and may not be used.
        """
        place = out or self.run.path / time.strftime("external-%Y%m%dT%H%M%S")
        return RunFolder.create(place, dump_config(self.config))

    def judge(self, folder: RunFolder) -> Outcome:
        """Free-run every model of the fit, and write what was found."""
        config, logs = self.config, self.logs
        store = FolderStore(self.run)
        fitted = [store.load(name) for name in store.names()]
        order = ["zero", *config.model_names]
        fitted.sort(key=lambda model: (*order, model.name).index(model.name))
        low, high = np.array(fitted[0].spec.low), np.array(fitted[0].spec.high)
        limit = velocity_limit(low, high, config.evaluation.divergence)
        say(f"{config.name}: {len(logs)} logs, {len(fitted)} models")
        write_inspection(folder, {SPLIT: self.read}, config)
        simulated = isinstance(config.data, SimulatedTrials) and all(
            "vessel" in log.log.meta for log in logs
        )
        models = [c for c in candidates(fitted, config.data) if c.kind != "truth" or simulated]
        judged = evaluate(models, logs, config.evaluation, config.prepare.grid.step, limit)
        write_rollouts(
            folder.rollouts / SPLIT, judged.runs, logs, config.signals.columns, judged.bands
        )
        if self.run.bands.is_file():
            # the bands are the fit's own; the report of these logs draws them
            folder.write(folder.bands, self.run.bands.read_text(encoding="utf-8"))
        write_data_quality(folder, {SPLIT: logs})
        chosen = self.run.read_metrics()
        write_metrics(
            folder, config, judged.rows, str(chosen["selected"]), chosen.get("selected_ensemble")
        )
        if self.run.selection.is_file():
            # why the model was selected, and whether it is sound, is the fit's own
            folder.write(folder.selection, self.run.selection.read_text(encoding="utf-8"))
        write_limits(folder, config, {SPLIT: judged.limits}, logs)
        return fit_outcome(folder, SPLIT)


def takes_folders(config: FitTaskSettings) -> bool:
    """Return whether a folder may be one log for the run's reader, as a ROS 2 bag is."""
    data = config.data
    return not isinstance(data, SimulatedTrials) and isinstance(data.reader, RecordingConfig)


def read_external(paths: Sequence[Path], config: FitTaskSettings) -> list[Log]:
    """Read logs as the run read its own; canonical files are recognised by their own mark.

    Raises:
        ResidnetError: where a file cannot be read.
    """
    data = config.data
    own = CanonicalConfig() if isinstance(data, SimulatedTrials) else data.reader
    return [
        (CanonicalConfig() if Log.recognises(path) else own).build().read(path).replace(name=name)
        for path, name in log_names(paths).items()
    ]
