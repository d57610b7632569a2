"""The logs of a fit: read once, checked before any work, and handed on to the run."""

from __future__ import annotations

from typing import NamedTuple

from residnet.data.simulated.trials import SimulatedTrials, stand_ins
from residnet.data.sources import MeasuredLogs, Splits, input_files, read_logs
from residnet.identification.fitter import require_fit
from residnet.identification.models import FittedModel
from residnet.identification.prepared import PreparedSplits, prepare_logs
from residnet.tasks.fit.booklet import require_flyable
from residnet.tasks.fit.config import FitTaskSettings


class _Read(NamedTuple):
    """Logs that a check has read, by what they were read from."""

    data: MeasuredLogs | SimulatedTrials
    stamps: tuple[tuple[str, int, int], ...]
    logs: Splits


_read: list[_Read] = []
"""The logs of the last check, until its run takes them."""


def check_logs(config: FitTaskSettings) -> None:
    """Check that the logs can be read, and hold what every part of the fit asks for.

    Measured logs are read. In the place of simulated ones, which take long to fly, stand logs of
    the same channels, lengths and kinds.

    Raises:
        ResidnetError: what the run itself would refuse before it fits anything.
    """
    if isinstance(config.data, SimulatedTrials):
        logs = _simulated(config.data)
        # what masks leave of a motion is not known before it is flown
        prepare = config.prepare.model_copy(update={"masks": ()})
        _require(prepare_logs(logs, config.model_copy(update={"prepare": prepare})), config)
        return
    stamps = _stamps(config.data)
    logs = take_logs(config)
    _require(prepare_logs(logs, config), config)
    _read.append(_Read(config.data, stamps, logs))


def _require(logs: PreparedSplits, config: FitTaskSettings) -> None:
    fitter = require_fit(logs, config)
    if config.booklet is not None:
        name = config.booklet.model
        spec = fitter.spec(name, "baseline", config.all_baselines[name])
        require_flyable(config.booklet, FittedModel(spec, spec.build(), {}))


def take_logs(config: FitTaskSettings) -> Splits:
    """Return the logs by split; those that the check has just read are not read again.

    Raises:
        ResidnetError: where a file is missing or its contents cannot be used.
    """
    known = _read.pop() if _read else None
    if known is not None and known.data == config.data and known.stamps == _stamps(config.data):
        return known.logs
    return read_logs(config.data)


def _simulated(data: SimulatedTrials) -> Splits:
    splits: Splits = {"train": [], "validation": [], "test": []}
    for log, split in zip(stand_ins(data), data.splits(data.draw()), strict=True):
        splits[split].append(log)
    return splits


def _stamps(data: MeasuredLogs | SimulatedTrials) -> tuple[tuple[str, int, int], ...]:
    """Return path, time of change and size of each file."""
    found = [(path, path.stat()) for path in input_files(data)]
    return tuple((str(path), stat.st_mtime_ns, stat.st_size) for path, stat in found)
