"""Logs of a fit, prepared by split, and the checks that they can be learned from and judged on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.arrays import paged
from residnet.core.errors import DataError
from residnet.core.layout import Live
from residnet.core.log import Log
from residnet.core.progress import say
from residnet.data.masks import DEAD_COMMANDS
from residnet.data.prepare import Prepared, prepare
from residnet.identification.settings import FitSettings
from residnet.judge.protocol import longest_stretch
from residnet.training.current import estimate_currents, through_water

_LONGEST = 500_000
"""Samples of a log that are prepared at once."""
PreparedSplits = dict[str, paged.OneByOne[Prepared]]


def prepare_logs(splits: Mapping[str, Sequence[Log]], settings: FitSettings) -> PreparedSplits:
    """Prepare every log of every split.

    Args:
        splits: canonical logs by split (train, validation, test).
        settings: whose grid, masks, derivatives and inputs are used.

    Raises:
        DataError: where a log has nothing to learn from or to predict.
    """
    signals = settings.signals
    if settings.prepare.dead_commands == "mask":
        # what explains motion is learned from training and validation logs
        # a config is checked without what only data need
        from residnet.data.doctor.others import dead_commands
        from residnet.data.doctor.statistics import Record

        seen = {
            split: [Record(log, signals.columns) for log in logs] for split, logs in splits.items()
        }
        learned = [log for split in ("train", "validation") for log in seen.get(split, ())]
        further = [log for split in seen.keys() - {"train", "validation"} for log in seen[split]]
        found = dead_commands(learned, further, signals.columns)

        def masked(log: Log) -> Log:
            bad = np.zeros(len(log), dtype=bool)
            for start, stop in found.get(log.name, ()):
                bad[start : stop + 1] = True
                say(
                    f"  {log.name}: t = {log.t[start]:.1f} to {log.t[stop]:.1f} s is left out: all"
                    " inputs rest, and the other logs do not explain the motion"
                    " (prepare.dead_commands: keep would keep it)"
                )
            return log.replace(masks={**log.masks, DEAD_COMMANDS: bad}) if bad.any() else log

        splits = {split: [masked(log) for log in logs] for split, logs in splits.items()}
    prepared = {
        split: paged.OneByOne(
            prepare(part, split, signals.columns, settings.prepare, signals.live)
            for log in logs
            for part in shortened(log)
        )
        for split, logs in splits.items()
    }
    for logs in prepared.values():
        for log in logs:
            if not log.good.any():
                seconds = len(log) * settings.prepare.grid.step
                raise DataError(
                    f"log {log.log.name}: its {seconds:.1f} s hold no stretch as long as the"
                    " derivative's window; leave it out or shorten prepare.derivative.window"
                )
            if log.split != "train":
                require_window(log, settings)
    every = [log for logs in prepared.values() for log in logs]
    for key, source in (
        ("smoothed", "come from a smoother of the measured motion"),
        ("integrated", "are integrated from the velocities: their errors are those of no place"),
    ):
        made = [", ".join(log.log.meta[key]) for log in every if key in log.log.meta]
        for names in dict.fromkeys(made):
            say(f"  {names} of {made.count(names)} logs {source}")
    for log in every:
        spikes = log.log.meta.get("spikes", {})
        if spikes:
            counts = ", ".join(f"{name} {count}" for name, count in spikes.items())
            say(f"  {log.log.name}: spikes are bridged and left out (samples: {counts})")
    return prepared


def shortened(log: Log) -> list[Log]:
    """Return a log as it is, or its parts one after the other where it is very long."""
    if len(log) <= _LONGEST:
        return [log]
    count = -(-len(log) // _LONGEST)
    bounds = np.linspace(0, len(log), count + 1).astype(int)
    return [
        log.rows(slice(begin, end)).replace(name=f"{log.name}_{number + 1}_of_{count}")
        for number, (begin, end) in enumerate(pairwise(bounds))
    ]


def require_window(log: Prepared, settings: FitSettings) -> None:
    """Check that a log holds at least one window of some protocol.

    Raises:
        DataError: where it does not.
    """
    step, protocols = settings.prepare.grid.step, settings.evaluation.protocols
    if not any(protocol.windows(log, 0, step) for protocol in protocols.values()):
        raise DataError(
            f"log {log.log.name}: lasts {len(log) * step:.1f} s, its longest stretch without a gap"
            f" {longest_stretch(log) * step:.1f} s: no window of a protocol"
            f" ({', '.join(protocols)}) fits; fill gaps that may be interpolated, leave it out or"
            " shorten evaluation.protocols"
        )


def velocity_limit(low: np.ndarray, high: np.ndarray, divergence: float, live: Live) -> np.ndarray:
    """Return the size [n] of what moves beyond which a free run has diverged.

    Args:
        low: smallest training velocities (and inputs, which are not used), [n + m], from robust
            quantiles (`residnet.data.prepare.envelope`).
        high: largest ones, [n + m].
        divergence: the multiple of the largest training value.
    """
    return divergence * live.largest(low, high)


def through_currents(
    logs: Mapping[str, Sequence[Prepared]], settings: FitSettings
) -> tuple[PreparedSplits, list[dict[str, Any]]]:
    """Return logs by split as motion through the water, and the table of their currents.

    Training and validation logs are moved by the currents that are fitted with the coefficients,
    others by those that these coefficients see in them. Where the settings name no current, nothing
    changes and the table is empty.

    Args:
        logs: prepared logs by split.
        settings: of the fit; `current` says how currents are estimated.

    Raises:
        FitError: where the logs do not determine their currents.
    """
    splits = {split: paged.OneByOne(members) for split, members in logs.items()}
    if settings.current is None:
        return splits, []
    signals = settings.signals.build()
    baseline = settings.all_baselines[settings.current.baseline].build(signals.names)
    assert isinstance(baseline, RegressorBaseline), "the settings were validated"
    order = sorted(splits, key=lambda split: split not in ("train", "validation"))
    every = [log for split in order for log in logs[split]]
    fitted = sum(len(logs[split]) for split in ("train", "validation"))
    values, table = estimate_currents(
        baseline, signals, every[:fitted], settings.current, every[fitted:]
    )
    north, east = (
        np.array([row[f"current_{axis}"] for row in table]) for axis in ("north", "east")
    )
    speed = np.hypot(north, east)
    say(
        f"  currents of {len(table)} logs: {speed.mean():.3f} m/s on average, at most"
        f" {speed.max():.3f} m/s"
    )
    moved = iter(
        [through_water(log, value, signals) for log, value in zip(every, values, strict=True)]
    )
    return {split: paged.OneByOne([next(moved) for _ in logs[split]]) for split in order}, table
