"""The time of a table that nobody described: numbers with a unit, dates, or times of day."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.units import to_si
from residnet.data.drafting.sheets import Sheet
from residnet.data.drafting.units import written_unit
from residnet.data.drafting.words import words_of
from residnet.data.readers.times import date_order, looks_dated, parse_texts

if TYPE_CHECKING:
    import pandas as pd

_DAY = r"\d\s*[-./年]\s*\w{1,9}\s*[-./月]"


@dataclass(frozen=True)
class Clock:
    """The time of a table.

    Attributes:
        settings: `time` of a table's reader.
        seconds: times [T] of the first rows.
        guess: what is not sure about it; empty where all is.
        columns: that it takes.
    """

    settings: dict[str, Any]
    seconds: np.ndarray
    guess: str
    columns: tuple[str, ...]


def clock_of(sheet: Sheet) -> Clock:
    """Return the time of a table.

    Raises:
        DataError: where no column holds any.
    """
    named = [name for name in sheet.header if words_of(name).has("time")]
    dated = {name: cells for name, cells in sheet.texts.items() if looks_dated(cells)}
    if dated:
        return _dated(sheet, dated)
    rising = [
        name
        for name, values in sheet.numbers.items()
        if values.size > 1 and bool((np.diff(values[np.isfinite(values)]) > 0.0).all())
    ]
    called = [name for name in named if name in sheet.numbers]
    # one that is called time and does not increase is refused where it is read; a counter is none
    others = [name for name in rising if words_of(name).lacks("index")] if not called else []
    chosen = next((name for name in rising if name in named), next(iter([*called, *others]), None))
    if chosen is None:
        if not named:
            raise DataError(
                f"{sheet.path}: no column is called time or increases as time does; name it in a"
                " channel map (--config)"
            )
        raise DataError(f"{sheet.path}: column '{named[0]}' holds no times that can be read")
    values = sheet.numbers[chosen]
    unit = written_unit(chosen, "s")
    guess = ""
    if unit is None:
        unit, guess = _time_unit(values)
    if chosen not in named:
        guess = f"no column is called time; this one increases as time does. {guess}".strip()
    return Clock({"column": chosen, "unit": unit}, values * to_si(unit), guess, (chosen,))


def _dated(sheet: Sheet, dated: dict[str, pd.Series]) -> Clock:
    """Return the time from one column of dates with times, or from two."""
    clocks = [
        name for name, cells in dated.items() if cells.astype("string").str.contains(":|時").all()
    ]
    days = [name for name in dated if name not in clocks]
    if not clocks:
        raise DataError(f"{sheet.path}: column '{days[0]}' holds dates without a time of day")
    whole = [name for name in clocks if _has(dated[name], _DAY)]
    column = (whole or clocks)[0]
    settings: dict[str, Any] = {"column": column, "unit": "date"}
    day = None if whole or not days else days[0]
    texts = dated[column]
    if day is not None:
        settings["date"] = day
        texts = dated[day].astype("string") + " " + texts.astype("string")
    order = date_order(texts)
    guess = ""
    if order is None and (whole or day):
        order = "dmy"
        guess = "day and month of the dates can be told apart nowhere in the first rows"
    settings |= {"order": order} if order in ("dmy", "mdy") else {}
    stamps = parse_texts(texts, dates=True)
    seconds = stamps.since(int(stamps.ns[0])) if stamps.absolute else stamps.since(None)
    return Clock(settings, seconds, guess, (column,) if day is None else (column, day))


def _has(cells: pd.Series, pattern: str) -> bool:
    """Return whether every filled cell holds a pattern."""
    return bool(cells.dropna().astype("string").str.contains(pattern, regex=True).all())


def _time_unit(values: np.ndarray) -> tuple[str, str]:
    """Return the unit of times without one, and why it is a guess."""
    known = values[np.isfinite(values)]
    step, size = float(np.median(np.diff(known))), float(np.median(np.abs(known)))
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if 6.3e8 * scale <= size <= 3.8e9 * scale:
            return unit, f"times of this size are Unix time in {unit}"
    if step < 1e-3 and (2e4 < size < 7e4 or 6.5e5 < size < 8e5):
        return "day", "times of this size are days as Excel and MATLAB count them"
    for unit, longest in (("s", 5.0), ("ms", 5e3), ("us", 5e6)):
        if step <= longest:
            return unit, f"the header has no unit; steps of {step:g} would be {unit}"
    return "ns", f"the header has no unit; steps of {step:g} would be ns"
