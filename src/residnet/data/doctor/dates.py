"""Whether a log's time goes as fast as the dates that stand in the same table."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.doctor.findings import Finding
from residnet.data.readers.encoding import as_utf8

if TYPE_CHECKING:
    import pandas as pd

_NAMED = re.compile(r"date|time|stamp|utc|gps|clock|epoch", re.IGNORECASE)
# seconds, milliseconds, microseconds and nanoseconds since 1970 of the years 2001 to 2065
_EPOCHS = {1.0: (1e9, 3e9), 1e-3: (1e12, 3e12), 1e-6: (1e15, 3e15), 1e-9: (1e18, 3e18)}
_ROWS = 50_000
# a clock that is off by more than this share misleads
_LEAST_RATE = 0.005
_FEWEST = 20


def date_findings(log: Log, path: Path) -> list[Finding]:
    """Return the columns of dates that go faster or slower than the log's time.

    Args:
        log: as read from the table, row by row.
        path: the table; anything that is no csv or Parquet file has no such columns.
    """
    table = _dated_columns(path)
    if table is None or len(log) < _FEWEST:
        return []
    out = []
    for name in table.columns:
        seconds = _seconds(table[name])
        count = min(seconds.size, len(log))
        if count < _FEWEST or seconds.size < min(len(log), _ROWS):
            continue
        t, dates = log.t[:count] - log.t[0], seconds[:count]
        known = np.isfinite(dates)
        if known.sum() < _FEWEST or float(np.ptp(dates[known])) <= 0.0:
            continue
        rate = float(np.polyfit(t[known], dates[known] - dates[known][0], 1)[0])
        follows = float(np.corrcoef(t[known], dates[known])[0, 1])
        if follows > 0.99 and abs(rate - 1.0) > _LEAST_RATE and 0.05 < rate < 20.0:
            text = (
                f"'{name}' goes on by {rate:.4g} s for every second of the log's time: the time"
                " column is nominal, or its unit is wrong"
            )
            figures = {"rate": rate}
            action = f"take the time from '{name}'"
            out.append(Finding("will mislead", "clock_rate", text, figures, action))
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
            return pd.read_csv(
                file,
                sep=None,
                engine="python",
                nrows=_ROWS,
                usecols=lambda name: bool(_NAMED.search(str(name))),
                encoding="utf-8-sig",
            )
    except (DataError, OSError, ValueError, LookupError):
        # a file that cannot be read again has no date to tell
        return None


def _seconds(column: pd.Series) -> np.ndarray:
    """Return a column of dates as seconds [T]; empty where it holds none."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(column):
        values = column.to_numpy(dtype=float)
        middle = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
        for unit, (low, high) in _EPOCHS.items():
            if low < middle < high:
                return np.asarray((values - values[np.isfinite(values)][0]) * unit)
        return np.zeros(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dates = pd.to_datetime(column.astype("string"), errors="coerce", utc=True)
    if dates.notna().mean() < 0.9:
        return np.zeros(0)
    first = dates.dropna().iloc[0]
    return np.asarray((dates - first).dt.total_seconds(), dtype=float)
