"""Checks of the clock of a log: order, rate, jitter, gaps, start, and columns of dates."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.readers.text_encoding import open_as_utf8
from residnet.io.readers.timestamps import parse_numbers, parse_texts
from residnet.quality.findings import Check, Finding, Level, check, format_share
from residnet.quality.statistics import SMOOTHING_SAMPLES, LogStatistics

if TYPE_CHECKING:
    import pandas as pd

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


_DATE_COLUMN_PATTERN = re.compile(r"date|time|stamp|utc|gps|clock|epoch", re.IGNORECASE)
_MAX_DATE_ROWS = 50_000
"""Rows of a table whose dates are read; chosen by hand, enough to estimate the clock rate."""
_MAX_HEADER_LENGTH = 1 << 16
"""Largest length of the header line in characters."""
# smallest relative error of the clock rate that is reported
_MIN_RATE_ERROR = 0.005
_MIN_DATES = 20
"""Smallest number of dates for an estimate of the clock rate; chosen by hand."""


def find_clock_rate_errors(log: Log, path: Path) -> list[Finding]:
    """Compare the time of a log with the columns of dates in its table.

    Args:
        log: log as read from the table, row by row. If the reader dropped rows, the rows do not
            correspond and the result is empty.
        path: CSV or Parquet file; for other files the result is empty.

    Returns:
        One finding for each column of dates that runs faster or slower than the log's time.
    """
    has_dropped_rows = log.meta.get("rows_dropped", 0) > _MIN_RATE_ERROR * len(log)
    date_columns = None if has_dropped_rows else _read_date_columns(path)
    findings = []
    if date_columns is None:
        return []
    for name in date_columns.columns:
        dates = _to_seconds(date_columns[name])[: len(log)]
        is_finite = np.isfinite(dates)
        is_too_short = dates.size < min(len(log), _MAX_DATE_ROWS) or is_finite.sum() < _MIN_DATES
        if is_too_short or float(np.ptp(dates[is_finite])) <= 0.0:
            continue
        t = log.t[: dates.size][is_finite] - log.t[0]
        dates = dates[is_finite] - dates[is_finite][0]
        clock_rate = float(np.polyfit(t, dates, 1)[0])
        correlation = float(np.corrcoef(t, dates)[0, 1])
        if (
            correlation > 0.99
            and abs(clock_rate - 1.0) > _MIN_RATE_ERROR
            and 0.05 < clock_rate < 20.0
        ):
            text = (
                f"'{name}' advances by {clock_rate:.4g} s per second of the log's time: the time"
                " column is nominal, or its unit is wrong"
            )
            action = f"take the time from '{name}'"
            findings.append(
                Finding("will mislead", "clock_rate", text, {"rate": clock_rate}, action)
            )
    return findings


def _read_date_columns(path: Path) -> pd.DataFrame | None:
    """Return the columns that may hold dates; None if the file is not a readable table."""
    import pandas as pd

    try:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet as pq

            names = [
                name for name in pq.read_schema(path).names if _DATE_COLUMN_PATTERN.search(name)
            ]
            return pd.read_parquet(path, columns=names).head(_MAX_DATE_ROWS) if names else None
        if path.suffix.lower() not in (".csv", ".txt", ".tsv"):
            return None
        with open_as_utf8(path) as file:
            with file.open(encoding="utf-8-sig", newline="") as text_file:
                header = text_file.readline(_MAX_HEADER_LENGTH)
            if not _DATE_COLUMN_PATTERN.search(header):
                return None
            return pd.read_csv(
                file,
                sep=csv.Sniffer().sniff(header).delimiter,
                skipinitialspace=True,
                nrows=_MAX_DATE_ROWS,
                usecols=lambda name: bool(_DATE_COLUMN_PATTERN.search(str(name))),
                encoding="utf-8-sig",
            )
    except (DataError, OSError, ValueError, LookupError, csv.Error):
        # the check is optional: without a readable table it reports nothing
        return None


def _to_seconds(column: pd.Series) -> np.ndarray:
    """Convert a column of dates to seconds [T] with NaN for empty cells; empty if not dates."""
    import pandas as pd

    try:
        if pd.api.types.is_numeric_dtype(column):
            values = column.to_numpy(dtype=float)
            is_finite = np.isfinite(values)
            timestamps = parse_numbers(values[is_finite])
            seconds = np.full(values.size, np.nan)
            seconds[is_finite] = timestamps.seconds_since(0)
        else:
            timestamps = parse_texts(column.astype("string"), has_only_dates=True)
            seconds = timestamps.seconds_since(0)
    except DataError:
        return np.zeros(0)
    return seconds if timestamps.is_absolute and np.isfinite(seconds).mean() >= 0.9 else np.zeros(0)
