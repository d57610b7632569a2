"""Sources of the logs of a run: measured files, or simulated sea trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from residnet.core.arrays import paged
from residnet.core.config import Config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.progress import report_progress
from residnet.io.readers import ReaderConfig
from residnet.io.split import SplitConfig, assign_log_names, check_leaks, split_logs
from residnet.manoeuvres.trials_config import SimulatedTrials

LogsBySplit = dict[str, list[Log]]


class MeasuredLogs(Config):
    """Measured logs in files, read by one reader and assigned to splits.

    Attributes:
        reader: format of the files and the channel map.
        split: files for training, validation and test.
    """

    kind: Literal["measured"] = "measured"
    reader: ReaderConfig
    split: SplitConfig


DataConfig = Annotated[MeasuredLogs | SimulatedTrials, Field(discriminator="kind")]


def read_split_logs(config: MeasuredLogs | SimulatedTrials) -> LogsBySplit:
    """Return the logs of each split (train, validation, test).

    Raises:
        ResidnetError: if a file is missing or cannot be used, or two splits share measurements.
    """
    if isinstance(config, SimulatedTrials):
        from residnet.manoeuvres.trials import simulate_trial_logs

        manoeuvres = config.draw_manoeuvres()
        logs_by_split: LogsBySplit = {"train": [], "validation": [], "test": []}
        for log, split in zip(
            simulate_trial_logs(manoeuvres, config), config.assign_splits(manoeuvres), strict=True
        ):
            logs_by_split[split].append(log)
        return logs_by_split
    reader = config.reader.build()
    listed_paths = config.split.list_files()
    # a reader of one sheet reads a file once, whatever tests the other sheets have
    path_to_read = {path: next(iter(reader.select_logs([path])), path) for path in listed_paths}
    paths = list(dict.fromkeys(path_to_read.values()))
    names_by_path = assign_log_names(paths)
    logs_by_path: dict[Path, Log] = {}
    n_samples = 0
    for file_index, path in enumerate(paths):
        report_progress("reading logs", file_index, len(paths))
        loaded_log = reader.read(path).replace(name=names_by_path[path])
        n_samples += len(loaded_log)
        # from this number of samples on, logs are memory-mapped
        logs_by_path[path] = (
            loaded_log if n_samples <= paged.MAX_SAMPLES_IN_MEMORY else loaded_log.move_to_disk()
        )
    report_progress("reading logs", len(paths), len(paths))
    if config.split.auto:
        logs_by_split = split_logs(list(logs_by_path.values()))
    else:
        logs_by_split = {
            split: [
                part_log
                for log_part in log_parts
                if (part_log := log_part.extract(logs_by_path[path_to_read[log_part.path]]))
                is not None
            ]
            for split, log_parts in config.split.resolve_parts().items()
        }
        for split, logs_of_split in logs_by_split.items():
            if not logs_of_split:
                kinds_text = ", ".join(sorted({log.manoeuvre for log in logs_by_path.values()}))
                raise DataError(
                    f"split: {split} has no log of the requested manoeuvre (the logs have"
                    f" {kinds_text}); correct `manoeuvre`"
                )
    check_leaks(logs_by_split)
    return logs_by_split


def list_input_files(config: MeasuredLogs | SimulatedTrials) -> list[Path]:
    """Return all files whose contents a run depends on; none if it is simulated."""
    if isinstance(config, SimulatedTrials):
        return []
    reader = config.reader.build()
    # several tests have one file
    return list(
        dict.fromkeys(
            input_file
            for path in config.split.list_files()
            for input_file in reader.list_member_files(path)
        )
    )
