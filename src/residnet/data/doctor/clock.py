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
from residnet.data.doctor.findings import Check, Finding, Level, check, share_of
from residnet.data.doctor.statistics import WINDOW, Record
from residnet.data.readers.texts import as_utf8
from residnet.data.readers.written import parse_numbers, parse_texts

if TYPE_CHECKING:
    import pandas as pd

# stamps that scatter move a velocity by this share of its spread before a fit suffers
_MOST_MOVED = 0.05
# longest time step, in usual ones, that the grid interpolates across, and rounding
_BRIDGED = 3.0 * (1.0 + 1e-6)
# stamps beyond this count from 1970
EPOCH = 1e8


_RESTARTS = "sort the rows, or split the log where its clock restarts"


@check("order", "time_missing", "fatal", "delete them or restore their time")
def order(log: Record, found: Check) -> Iterator[Finding]:
    """Report samples without a time, and times that run backwards or repeat."""
    count, step = int((~np.isfinite(log.t)).sum()), np.diff(log.t)
    if count:
        yield found(f"{count} of {len(log)} samples have no time", {"count": count})
        return
    for code, bad, text, fix in (
        ("time_backwards", step < 0.0, "time runs backwards {} times, first after", _RESTARTS),
        ("duplicate_rows", step == 0.0, "{} time stamps repeat, first", "delete the repeated rows"),
    ):
        at = np.flatnonzero(bad)
        if at.size:
            text = f"{text.format(at.size)} t = {log.t[at[0]]:.6g} s"
            yield found(text, {"count": at.size}, code=code, fix=fix)


@check("clock", "clock")
def rate(log: Record, found: Check) -> Iterator[Finding]:
    """Report the rate of the samples, and how much their times scatter.

    Stamps that scatter mislead by what the vessel does meanwhile, not by their share of a step.
    """
    dt, step, span = np.diff(log.t), log.step, float(log.t[-1] - log.t[0])
    jitter = float(dt[dt <= 1.5 * step].std() / step)
    moving = log.moving if len(log) > WINDOW else []
    changes = [log.std(n) and np.diff(log.smooth(n)).std() / log.std(n) for n in moving]
    text = (
        f"{1.0 / step:.4g} Hz over {span:.1f} s from t = {log.t[0]:.1f} s, steps vary by"
        f" {share_of(jitter)} (standard deviation)"
    )
    fix = (
        "use the sender's stamps, or a coarser grid (prepare.grid.step), so that averaging replaces"
        " interpolation"
    )
    moved = jitter / np.sqrt(2.0) * max(changes, default=0.0)
    level: Level = "will mislead" if moved > _MOST_MOVED else "note"
    fix = fix if level != "note" else ""
    yield found(text, {"rate": 1.0 / step, "jitter": jitter, "span": span}, level=level, fix=fix)


@check("clock", "dropped_samples", "note", "the grid interpolates across them")
def dropped(log: Record, found: Check) -> Iterator[Finding]:
    """Report single samples that are missing."""
    dt = np.diff(log.t)
    short = dt[(dt > 1.5 * log.step) & (dt <= _BRIDGED * log.step)]
    if short.size:
        text = f"{short.size} single samples or pairs are missing (steps up to {short.max():.3g} s)"
        yield found(text, {"count": short.size, "longest": short.max()})


@check("clock", "gaps", fix="split the log there (mask kind: gap)")
def gaps(log: Record, found: Check) -> Iterator[Finding]:
    """Report time steps that are too long to be bridged."""
    dt = np.diff(log.t)
    at = np.append(False, dt > _BRIDGED * log.step)
    if not at.any():
        return
    lost = float((dt[at[1:]] - log.step).sum())
    longest = int(np.argmax(dt))
    text = (
        f"{int(at.sum())} gaps, {lost:.2f} s in all, the longest {dt[longest]:.2f} s after t ="
        f" {log.t[longest]:.2f} s"
    )
    level: Level = "fatal" if lost > 0.5 * (log.t[-1] - log.t[0]) else "will mislead"
    figures = {"count": at.sum(), "lost": lost, "longest": dt[longest], "t": log.t[longest]}
    yield found(text, figures, level=level, at=at)


@check("clock", "clock_start", "note", "times count from the log's own clock, nothing to do")
def start(log: Record, found: Check) -> Iterator[Finding]:
    """Report a clock that does not start at 0."""
    if abs(log.t[0]) > log.step:
        kind = "Unix time" if log.t[0] > EPOCH else "not at 0"
        yield found(f"time starts at {log.t[0]:.10g} s ({kind})", {"start": float(log.t[0])})


_NAMED = re.compile(r"date|time|stamp|utc|gps|clock|epoch", re.IGNORECASE)
_ROWS = 50_000
"""Rows of a table whose dates are read; chosen by hand: more tell no better how fast it goes."""
_LINE = 1 << 16
"""Characters of a line of names."""
# a clock that is off by more than this share misleads
_LEAST_RATE = 0.005
_FEWEST_DATES = 20
"""Dates below which no rate is told; chosen by hand."""


def date_findings(log: Log, path: Path) -> list[Finding]:
    """Return the columns of dates that go faster or slower than the log's time.

    Args:
        log: as read from the table, row by row; where rows were dropped, a row of the table is none
            of the log's, and nothing is told.
        path: the table; anything that is no csv or Parquet file has no such columns.
    """
    dropped = log.meta.get("rows_dropped", 0) > _LEAST_RATE * len(log)
    table, out = None if dropped else _dated_columns(path), []
    if table is None:
        return []
    for name in table.columns:
        dates = _seconds(table[name])[: len(log)]
        known = np.isfinite(dates)
        short = dates.size < min(len(log), _ROWS) or known.sum() < _FEWEST_DATES
        if short or float(np.ptp(dates[known])) <= 0.0:
            continue
        t, dates = log.t[: dates.size][known] - log.t[0], dates[known] - dates[known][0]
        rate = float(np.polyfit(t, dates, 1)[0])
        follows = float(np.corrcoef(t, dates)[0, 1])
        if follows > 0.99 and abs(rate - 1.0) > _LEAST_RATE and 0.05 < rate < 20.0:
            text = (
                f"'{name}' goes on by {rate:.4g} s for every second of the log's time: the time"
                " column is nominal, or its unit is wrong"
            )
            action = f"take the time from '{name}'"
            out.append(Finding("will mislead", "clock_rate", text, {"rate": rate}, action))
    return out


def _dated_columns(path: Path) -> pd.DataFrame | None:
    """Return the columns that may hold dates; None where the file is no table that can be read."""
    import pandas as pd

    try:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet as pq

            names = [name for name in pq.read_schema(path).names if _NAMED.search(name)]
            return pd.read_parquet(path, columns=names).head(_ROWS) if names else None
        if path.suffix.lower() not in (".csv", ".txt", ".tsv"):
            return None
        with as_utf8(path) as file:
            with file.open(encoding="utf-8-sig", newline="") as stream:
                line = stream.readline(_LINE)
            if not _NAMED.search(line):
                return None
            return pd.read_csv(
                file,
                sep=csv.Sniffer().sniff(line).delimiter,
                skipinitialspace=True,
                nrows=_ROWS,
                usecols=lambda name: bool(_NAMED.search(str(name))),
                encoding="utf-8-sig",
            )
    except (DataError, OSError, ValueError, LookupError, csv.Error):
        # a file that cannot be read again has no date to tell
        return None


def _seconds(column: pd.Series) -> np.ndarray:
    """Return a column of dates as seconds [T], NaN where empty; no samples where it holds none."""
    import pandas as pd

    try:
        if pd.api.types.is_numeric_dtype(column):
            values = column.to_numpy(dtype=float)
            known = np.isfinite(values)
            stamps = parse_numbers(values[known])
            out = np.full(values.size, np.nan)
            out[known] = stamps.since(0)
        else:
            stamps = parse_texts(column.astype("string"), dates=True)
            out = stamps.since(0)
    except DataError:
        return np.zeros(0)
    return out if stamps.absolute and np.isfinite(out).mean() >= 0.9 else np.zeros(0)
