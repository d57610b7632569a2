"""Where a run's logs come from: measured files through a reader, or simulated sea trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from residnet.core.config import Config
from residnet.core.log import Log
from residnet.data.readers import ReaderConfig
from residnet.data.simulated.trials import SimulatedTrials, simulate
from residnet.data.split import SplitConfig, check_leaks

Splits = dict[str, list[Log]]


class MeasuredLogs(Config):
    """Logs on disk, read through one channel map and split by file.

    Attributes:
        reader: format of the files and the channel map.
        split: which files are for training, validation and test.
    """

    kind: Literal["measured"] = "measured"
    reader: ReaderConfig
    split: SplitConfig


DataConfig = Annotated[MeasuredLogs | SimulatedTrials, Field(discriminator="kind")]


def read_logs(config: MeasuredLogs | SimulatedTrials) -> Splits:
    """Return the logs of a run by split (train, validation, test).

    Raises:
        ResidnetError: where a file is missing or its contents cannot be used, or two splits share
            measurements.
    """
    if isinstance(config, SimulatedTrials):
        manoeuvres = config.draw()
        splits: Splits = {"train": [], "validation": [], "test": []}
        for log, split in zip(simulate(manoeuvres, config), config.splits(manoeuvres), strict=True):
            splits[split].append(log)
        return splits
    reader = config.reader.build()
    splits = {
        split: [reader.read(path) for path in paths]
        for split, paths in config.split.resolve().items()
    }
    check_leaks(splits)
    return splits


def input_files(config: MeasuredLogs | SimulatedTrials) -> list[Path]:
    """Return files whose contents the run depends on."""
    if isinstance(config, SimulatedTrials):
        return []
    return [path for paths in config.split.resolve().values() for path in paths]
