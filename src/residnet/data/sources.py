"""Where a run's logs come from: measured files through a reader, or simulated sea trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from residnet.core.arrays import paged
from residnet.core.config import Config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.progress import report
from residnet.data.readers import ReaderConfig
from residnet.data.simulated import SimulatedTrials, simulate
from residnet.data.split import SplitConfig, check_leaks, divided, log_names

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
    reader, files = config.reader.build(), config.split.files()
    names = log_names(files)
    read: dict[Path, Log] = {}
    samples = 0
    for number, path in enumerate(files):
        report("reading logs", number, len(files))
        one = reader.read(path).replace(name=names[path])
        samples += len(one)
        read[path] = one if samples <= paged.LARGE else one.on_disk()
    report("reading logs", len(files), len(files))
    if config.split.auto:
        splits = divided(list(read.values()))
    else:
        splits = {
            split: [found for part in parts if (found := part.of(read[part.path])) is not None]
            for split, parts in config.split.parts().items()
        }
        for split, members in splits.items():
            if not members:
                kinds = ", ".join(sorted({log.manoeuvre for log in read.values()}))
                raise DataError(f"split: no log of {split} is of its manoeuvre (there are {kinds})")
    check_leaks(splits)
    return splits


def input_files(config: MeasuredLogs | SimulatedTrials) -> list[Path]:
    """Return files whose contents the run depends on."""
    if isinstance(config, SimulatedTrials):
        return []
    reader = config.reader.build()
    return [file for path in dict.fromkeys(config.split.files()) for file in reader.files(path)]
