"""What is wrong with a log's clock: order, rate, jitter, gaps, start, dates beside it."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.readers.text_tables import open_as_utf8
from residnet.io.readers.timestamps import parse_numbers, parse_texts
from residnet.quality.findings import Check, Finding, Level, check, format_share
from residnet.quality.statistics import SMOOTHING_SAMPLES, LogStatistics

if TYPE_CHECKING:
    import pandas as pd

# stamps that scatter move a velocity by this share of its spread before a fit suffers
_MAX_JITTER_SHARE = 0.05
# longest time step, in usual ones, that the grid interpolates across, and rounding
_MAX_BRIDGED_STEPS = 3.0 * (1.0 + 1e-6)
# stamps beyond this count from 1970
MIN_UNIX_TIME = 1e8


_CLOCK_RESTART_FIX = "sort the rows, or split the log where its clock restarts"


@check("order", "time_missing", "fatal", "delete them or restore their time")
def check_time_order(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report samples without a time, and times that run backwards or repeat."""
    n_missing, increments = int((~np.isfinite(log.t)).sum()), np.diff(log.t)
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
    """Report the rate of the samples, and how much their times scatter.

    Stamps that scatter mislead by what the vessel does meanwhile, not by their share of a step.
    """
    dt, step, duration = np.diff(log.t), log.sampling_interval, float(log.t[-1] - log.t[0])
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


@check("clock", "dropped_samples", "note", "the grid interpolates across them")
def check_dropped_samples(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report single samples that are missing."""
    dt = np.diff(log.t)
    short_gaps = dt[
        (dt > 1.5 * log.sampling_interval) & (dt <= _MAX_BRIDGED_STEPS * log.sampling_interval)
    ]
    if short_gaps.size:
        text = f"{short_gaps.size} single samples or pairs are missing (steps up to {short_gaps.max():.3g} s)"
        yield make_finding(text, {"count": short_gaps.size, "longest": short_gaps.max()})


@check("clock", "gaps", fix="split the log there (mask kind: gap)")
def check_gaps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report time steps that are too long to be bridged."""
    dt = np.diff(log.t)
    is_gap = np.append(False, dt > _MAX_BRIDGED_STEPS * log.sampling_interval)
    if not is_gap.any():
        return
    lost_time = float((dt[is_gap[1:]] - log.sampling_interval).sum())
    longest_index = int(np.argmax(dt))
    text = (
        f"{int(is_gap.sum())} gaps, {lost_time:.2f} s in all, the longest {dt[longest_index]:.2f} s after t ="
        f" {log.t[longest_index]:.2f} s"
    )
    level: Level = "fatal" if lost_time > 0.5 * (log.t[-1] - log.t[0]) else "will mislead"
    figures = {
        "count": is_gap.sum(),
        "lost": lost_time,
        "longest": dt[longest_index],
        "t": log.t[longest_index],
    }
    yield make_finding(text, figures, level=level, sample_mask=is_gap)


@check("clock", "clock_start", "note", "times count from the log's own clock, nothing to do")
def check_clock_start(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a clock that does not start at 0."""
    if abs(log.t[0]) > log.sampling_interval:
        clock_text = "Unix time" if log.t[0] > MIN_UNIX_TIME else "not at 0"
        yield make_finding(
            f"time starts at {log.t[0]:.10g} s ({clock_text})", {"start": float(log.t[0])}
        )


_DATE_COLUMN_PATTERN = re.compile(r"date|time|stamp|utc|gps|clock|epoch", re.IGNORECASE)
_MAX_DATE_ROWS = 50_000
"""Rows of a table whose dates are read; chosen by hand: more tell no better how fast it goes."""
_MAX_HEADER_LENGTH = 1 << 16
"""Characters of a line of names."""
# a clock that is off by more than this share misleads
_MIN_RATE_ERROR = 0.005
_MIN_DATES = 20
"""Dates below which no rate is told; chosen by hand."""


def find_clock_rate_errors(log: Log, path: Path) -> list[Finding]:
    """Return the columns of dates that go faster or slower than the log's time.

    Args:
        log: as read from the table, row by row; where rows were dropped, a row of the table is none
            of the log's, and nothing is told.
        path: the table; anything that is no csv or Parquet file has no such columns.
    """
    has_dropped_rows = log.meta.get("rows_dropped", 0) > _MIN_RATE_ERROR * len(log)
    date_columns, findings = None if has_dropped_rows else _read_date_columns(path), []
    if date_columns is None:
        return []
    for name in date_columns.columns:
        dates = _to_seconds(date_columns[name])[: len(log)]
        is_finite = np.isfinite(dates)
        is_too_short = dates.size < min(len(log), _MAX_DATE_ROWS) or is_finite.sum() < _MIN_DATES
        if is_too_short or float(np.ptp(dates[is_finite])) <= 0.0:
            continue
        t, dates = log.t[: dates.size][is_finite] - log.t[0], dates[is_finite] - dates[is_finite][0]
        clock_rate = float(np.polyfit(t, dates, 1)[0])
        correlation = float(np.corrcoef(t, dates)[0, 1])
        if (
            correlation > 0.99
            and abs(clock_rate - 1.0) > _MIN_RATE_ERROR
            and 0.05 < clock_rate < 20.0
        ):
            text = (
                f"'{name}' goes on by {clock_rate:.4g} s for every second of the log's time: the time"
                " column is nominal, or its unit is wrong"
            )
            action = f"take the time from '{name}'"
            findings.append(
                Finding("will mislead", "clock_rate", text, {"rate": clock_rate}, action)
            )
    return findings


def _read_date_columns(path: Path) -> pd.DataFrame | None:
    """Return the columns that may hold dates; None where the file is no table that can be read."""
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
        # a file that cannot be read again has no date to tell
        return None


def _to_seconds(column: pd.Series) -> np.ndarray:
    """Return a column of dates as seconds [T], NaN where empty; no samples where it holds none."""
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
