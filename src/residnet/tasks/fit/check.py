"""Check the task `fit`: that its logs contain all that the parts of the fit need."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from residnet.core.arrays import paged
from residnet.identification.check import check_fit
from residnet.identification.prepared import PreparedSplits, prepare_splits
from residnet.io.sources import LogsBySplit
from residnet.manoeuvres.trials_config import SimulatedTrials, make_dummy_logs
from residnet.preprocessing.prepare import PreparedLog

if TYPE_CHECKING:
    from residnet.identification.settings import FitSettings
    from residnet.tasks.fit.config import FitConfig


def check(config: FitConfig) -> None:
    """Check that the logs contain all that the parts of the fit need, without fitting.

    Measured logs are read. Simulated trials, whose simulation takes long, are replaced by logs of
    the same channels, lengths and manoeuvres.

    Raises:
        ResidnetError: if the run would refuse the config or its logs.
    """
    settings: FitSettings = config
    if isinstance(config.data, SimulatedTrials):
        logs: LogsBySplit = {"train": [], "validation": [], "test": []}
        split_names = config.data.assign_splits(config.data.draw_manoeuvres())
        for log, split in zip(make_dummy_logs(config.data), split_names, strict=True):
            logs[split].append(log)
        # the effect of masks is unknown before the trials are simulated
        prepare = config.prepare.model_copy(update={"masks": ()})
        settings = config.model_copy(update={"prepare": prepare})
        prepared = _prepare_one_log_per_length(logs, settings)
    else:
        logs = config.load_logs()
        config.cache_logs(logs)
        prepared = prepare_splits(logs, settings)
    checked_settings = check_fit(prepared, config)
    if config.booklet is not None:
        # the manoeuvring booklet is simulated by a model, which only PyTorch can build
        from residnet.tasks.fit.booklet import require_flyable

        require_flyable(config.booklet, prepared, checked_settings)


def _prepare_one_log_per_length(logs: LogsBySplit, settings: FitSettings) -> PreparedSplits:
    """Prepare dummy logs, of which only lengths, names and manoeuvres differ.

    Logs of one length share the arrays of the first: for the 70 trials of `quickstart` this takes
    a tenth of the time.
    """
    prepared: PreparedSplits = {}
    for split, members in logs.items():
        parts_by_length: dict[int, list[PreparedLog]] = {}
        for log in members:
            if len(log) not in parts_by_length:
                parts_by_length[len(log)] = prepare_splits({split: [log]}, settings)[split]
        prepared[split] = paged.PageReleasingList(
            replace(part, log=part.log.replace(name=log.name, manoeuvre=log.manoeuvre))
            for log in members
            for part in parts_by_length[len(log)]
        )
    return prepared
