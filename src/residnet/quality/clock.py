"""Checks of the clock of a log: order, rate, jitter and gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from residnet.quality.findings import Check, Finding, Level, check, format_share
from residnet.quality.statistics import SMOOTHING_SAMPLES, LogStatistics

# largest velocity error due to timestamp jitter, as a share of the velocity's standard deviation
_MAX_JITTER_SHARE = 0.05
# longest time step across which the grid interpolates, in sampling intervals, with rounding
_MAX_BRIDGED_STEPS = 3.0 * (1.0 + 1e-6)

_CLOCK_RESTART_FIX = "sort the rows, or split the log where its clock restarts"


@check("order", "time_missing", "fatal", "delete them or restore their time")
def check_time_order(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report samples without a time, and times that decrease or repeat."""
    n_missing = int((~np.isfinite(log.t)).sum())
    increments = np.diff(log.t)
    if n_missing:
        yield make_finding(f"{n_missing} of {len(log)} samples have no time", {"count": n_missing})
        return
    for code, is_bad, text, fix in (
        (
            "time_backwards",
            increments < 0.0,
            "time runs backwards {} times, first after",
            _CLOCK_RESTART_FIX,
        ),
        (
            "duplicate_rows",
            increments == 0.0,
            "{} time stamps repeat, first",
            "delete the repeated rows",
        ),
    ):
        bad_indices = np.flatnonzero(is_bad)
        if bad_indices.size:
            text = f"{text.format(bad_indices.size)} t = {log.t[bad_indices[0]]:.6g} s"
            yield make_finding(text, {"count": bad_indices.size}, code=code, fix=fix)


@check("clock", "clock")
def check_sampling_rate(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the sampling rate and the jitter of the time stamps.

    Jitter matters only as far as the vessel's velocity changes during it, therefore the level
    depends on the resulting velocity error.
    """
    dt = np.diff(log.t)
    step = log.sampling_interval
    duration = float(log.t[-1] - log.t[0])
    jitter = float(dt[dt <= 1.5 * step].std() / step)
    velocities = log.velocities if len(log) > SMOOTHING_SAMPLES else []
    relative_changes = [
        log.std(n) and np.diff(log.smoothed(n)).std() / log.std(n) for n in velocities
    ]
    text = (
        f"{1.0 / step:.4g} Hz over {duration:.1f} s from t = {log.t[0]:.1f} s, steps vary by"
        f" {format_share(jitter)} (standard deviation)"
    )
    fix = (
        "use the sender's stamps, or a coarser grid (prepare.grid.step), so that averaging replaces"
        " interpolation"
    )
    velocity_error = jitter / np.sqrt(2.0) * max(relative_changes, default=0.0)
    level: Level = "will mislead" if velocity_error > _MAX_JITTER_SHARE else "note"
    fix = fix if level != "note" else ""
    yield make_finding(
        text, {"rate": 1.0 / step, "jitter": jitter, "span": duration}, level=level, fix=fix
    )


_MAX_HARMLESS_GAP = 0.1
"""Step in s over which velocities of a vessel hardly change, at any rate of the recorder."""


@check("clock", "gaps", fix="split the log there (mask kind: gap)")
def check_gaps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report time steps that are too long for interpolation."""
    dt = np.diff(log.t)
    is_gap = np.append(False, dt > _MAX_BRIDGED_STEPS * log.sampling_interval)
    if not is_gap.any():
        return
    lost_time = float((dt[is_gap[1:]] - log.sampling_interval).sum())
    longest_index = int(np.argmax(dt))
    text = (
        f"{int(is_gap.sum())} gaps, {lost_time:.2f} s in all, the longest {dt[longest_index]:.2f} s"
        f" after t = {log.t[longest_index]:.2f} s"
    )
    level: Level = "fatal" if lost_time > 0.5 * (log.t[-1] - log.t[0]) else "will mislead"
    fix = None
    if float(dt[longest_index]) <= _MAX_HARMLESS_GAP:
        level = "note"
        fix = "shorter than any motion of a vessel; no action is needed"
    figures = {
        "count": is_gap.sum(),
        "lost": lost_time,
        "longest": dt[longest_index],
        "t": log.t[longest_index],
    }
    yield make_finding(text, figures, level=level, fix=fix, sample_mask=is_gap)
