"""Preparation of the logs of a fit by split, and checks that they suffice for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from residnet.core.arrays import paged
from residnet.core.errors import DataError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.progress import log_message
from residnet.evaluation.protocol import longest_segment_length
from residnet.identification.settings import FitSettings
from residnet.preprocessing.prepare import PreparedLog, prepare_log
from residnet.training.records import CurrentRow

_MAX_SAMPLES = 500_000
"""Largest number of samples of a log that are prepared at once, which bounds the memory used."""
PreparedSplits = dict[str, paged.PageReleasingList[PreparedLog]]


def prepare_splits(splits: Mapping[str, Sequence[Log]], settings: FitSettings) -> PreparedSplits:
    """Prepare every log of every split.

    Args:
        splits: canonical logs by split (train, validation, test).
        settings: settings of the fit: grid, masks, derivatives and inputs.

    Raises:
        DataError: if a training log has no usable sample, or another log no window of a protocol.
    """
    signals = settings.signals
    prepared = {
        split: paged.PageReleasingList(
            prepare_log(log_part, split, signals.input_columns, settings.prepare, signals.dof)
            for log in logs
            for log_part in split_long_log(log)
        )
        for split, logs in splits.items()
    }
    for logs in prepared.values():
        for log in logs:
            if not log.trainable.any():
                duration = len(log) * settings.prepare.grid.step
                raise DataError(
                    f"log {log.log.name}: no part of its {duration:.1f} s without a gap is as"
                    " long as the window of the derivative; remove the log from the splits or"
                    " shorten prepare.derivative.window"
                )
            # training logs need no window: least squares uses single samples
            if log.split != "train":
                check_window_fits(log, settings)
    _report_sources([log for logs in prepared.values() for log in logs])
    return prepared


def _report_sources(logs: Sequence[PreparedLog]) -> None:
    """Report which channels were not measured, and where spikes were removed."""
    for key, source_text in (
        ("smoothed", "are estimated by a smoother from the measured motion"),
        (
            "integrated",
            "are integrated from the velocities: their errors are not relative to a measured"
            " position",
        ),
    ):
        derived_channel_texts = [
            ", ".join(log.log.meta[key]) for log in logs if key in log.log.meta
        ]
        for names in dict.fromkeys(derived_channel_texts):
            # a split may divide a log: these are parts of logs
            count = derived_channel_texts.count(names)
            parts_text = "1 part" if count == 1 else f"{count} parts"
            log_message(f"  {names} of {parts_text} of the logs {source_text}")
    for log in logs:
        spike_counts = log.log.meta.get("spikes", {})
        if spike_counts:
            counts_text = ", ".join(f"{name} {count}" for name, count in spike_counts.items())
            log_message(
                f"  {log.log.name}: spikes are interpolated and masked (samples: {counts_text})"
            )


def split_long_log(log: Log) -> list[Log]:
    """Return a log, divided into consecutive parts if it is very long."""
    if len(log) <= _MAX_SAMPLES:
        return [log]
    n_parts = -(-len(log) // _MAX_SAMPLES)
    bounds = np.linspace(0, len(log), n_parts + 1).astype(int)
    return [
        log.select_rows(slice(part_start, part_stop)).replace(
            name=f"{log.name}_{part_index + 1}_of_{n_parts}"
        )
        for part_index, (part_start, part_stop) in enumerate(pairwise(bounds))
    ]


def check_window_fits(log: PreparedLog, settings: FitSettings) -> None:
    """Check that a log holds at least one window of any protocol.

    Args:
        log: prepared log.
        settings: settings of the fit with its protocols and grid.

    Raises:
        DataError: if the log holds no window.
    """
    dt = settings.prepare.grid.step
    protocols = settings.evaluation.protocols
    if not any(protocol.make_windows(log, 0, dt) for protocol in protocols.values()):
        raise DataError(
            f"log {log.log.name}: lasts {len(log) * dt:.1f} s, its longest stretch without a gap"
            f" {longest_segment_length(log) * dt:.1f} s: too short for a window of any protocol"
            f" ({', '.join(protocols)}); fill gaps that may be interpolated, remove the log from"
            " the splits or shorten evaluation.protocols"
        )


def compute_velocity_limits(
    lower: np.ndarray, upper: np.ndarray, divergence_factor: float, dof: DegreesOfFreedom
) -> np.ndarray:
    """Return the magnitude of the velocities [n] above which a free run has diverged.

    Args:
        lower: lower ends of the training ranges of velocities and inputs [n + m], from robust
            quantiles (`residnet.preprocessing.prepare.compute_training_ranges`); those of the
            inputs are not used.
        upper: upper ends of the training ranges [n + m].
        divergence_factor: factor on the largest training value.
        dof: degrees of freedom of the model.
    """
    return divergence_factor * dof.range_limits(lower, upper)


def convert_to_motion_through_water(
    logs: Mapping[str, Sequence[PreparedLog]], settings: FitSettings
) -> tuple[PreparedSplits, list[CurrentRow]]:
    """Convert logs by split to motion through the water; return them with a table of currents.

    The currents of training and validation logs are fitted together with the coefficients of a
    baseline. Those of the other logs are then estimated with these coefficients held fixed, so that
    test logs do not influence the model. Without `current` in the settings the logs are returned
    unchanged and the table is empty.

    Args:
        logs: prepared logs by split.
        settings: settings of the fit; `current` says how currents are estimated.

    Raises:
        FitError: if the logs do not determine their currents.
    """
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.training.current import estimate_currents, through_water

    splits = {split: paged.PageReleasingList(split_logs) for split, split_logs in logs.items()}
    if settings.current is None:
        return splits, []
    signals = settings.signals.build()
    baseline = settings.all_baselines[settings.current.baseline].build(signals.names)
    assert isinstance(baseline, RegressorBaseline), "the settings were validated"
    # logs of the fit first: estimate_currents takes them and the other logs separately
    split_order = sorted(splits, key=lambda split: split not in ("train", "validation"))
    all_logs = [log for split in split_order for log in logs[split]]
    n_fitted = sum(len(logs[split]) for split in ("train", "validation"))
    currents, current_rows = estimate_currents(
        baseline, signals, all_logs[:n_fitted], settings.current, all_logs[n_fitted:]
    )
    current_speeds = np.array([row.speed for row in current_rows])
    log_message(
        f"  currents of {len(current_rows)} logs: {current_speeds.mean():.3f} m/s on average,"
        f" at most {current_speeds.max():.3f} m/s"
    )
    converted_logs = iter(
        [
            through_water(log, current, signals)
            for log, current in zip(all_logs, currents, strict=True)
        ]
    )
    return {
        split: paged.PageReleasingList([next(converted_logs) for _ in logs[split]])
        for split in split_order
    }, current_rows
