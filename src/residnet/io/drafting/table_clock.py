"""Clocks of tables: columns of time or dates, and their units."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import Quantity
from residnet.core.errors import DataError, UsageError
from residnet.core.names import truncate
from residnet.core.units import to_si
from residnet.io.drafting.questions import READER_KEY, DraftNotes
from residnet.io.drafting.table_preview import TablePreview
from residnet.io.header_vocabulary import (
    DATE_PART_NAMES,
    match_state_channel,
    normalize_name,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers.clock_repair import repair_clock
from residnet.io.readers.timestamps import (
    detect_date_order,
    guess_time_unit,
    is_date_column,
    parse_texts,
)

if TYPE_CHECKING:
    import pandas as pd

_DATE_PATTERN = r"\d\s*[-./年]\s*\w{1,9}\s*[-./月]"
_DOTTED_TIME_PATTERN = r"^\d\d?\.\d\d\.\d\d[.,]"
"""Start of a time of day with points between its parts."""


def detect_or_ask_clock(
    previews: Sequence[TablePreview], draft_notes: DraftNotes
) -> tuple[TableClock, str | None]:
    """Return the clock of the first table, and the answer of the user if the tables have none.

    Raises:
        DataError: if the tables have no clock, and nobody gives the time between rows.
    """
    main_preview = previews[0]
    key = (*READER_KEY, "time", "step")
    error = DataError("the time between two rows is empty")
    if not draft_notes.has_answer(key):
        try:
            return detect_clock(main_preview), None
        except MissingClockError as missing_clock:
            error = missing_clock
    text = (
        f"{main_preview.path.name} and the other tables have no column of time; time between two"
        " rows, for example 0.1 s"
    )
    step = draft_notes.require_answer(key, text, error)
    return make_step_clock(main_preview, step), step


@dataclass(frozen=True)
class TableClock:
    """Clock of a table.

    Attributes:
        settings: `time` of the reader.
        seconds: times of the first rows [T] in s.
        guess: reason for a guess; empty if the clock is certain.
        columns: names of the columns of time and date.
    """

    settings: dict[str, Any]
    seconds: np.ndarray
    guess: str
    columns: tuple[str, ...]


class MissingClockError(DataError):
    """A table without a column of time."""


def make_step_clock(preview: TablePreview, step: str) -> TableClock:
    """Return the clock of a table with a constant time step.

    Args:
        preview: first rows of the table.
        step: time between two rows with its unit, for example `0.1 s`.

    Raises:
        UsageError: if the step is no positive time.
    """
    try:
        seconds = Quantity("s").convert(step)
    except ValueError:
        seconds = 0.0
    if seconds <= 0.0:
        raise UsageError(
            f"the time between two rows '{truncate(step, 40)}' is no time; write it as '0.1 s'"
        )
    columns: list[Any] = [*preview.numeric_columns.values(), *preview.text_columns.values()]
    settings = {"step": f"{seconds:.12g} s"}
    return TableClock(settings, seconds * np.arange(len(columns[0])), "", ())


def detect_clock(preview: TablePreview) -> TableClock:
    """Detect the column of time and its unit.

    It is a column of dates, else a column with a word for time, else one that increases regularly.

    Raises:
        MissingClockError: if no column is a clock.
        DataError: if the clock is not readable, or its parts are in several columns.
    """
    time_columns = [name for name in preview.column_names if parse_name(name).has_all("time")]
    part_columns = [
        name for name in preview.numeric_columns if normalize_name(name) in DATE_PART_NAMES
    ]
    has_time_text = any(
        preview.text_columns[name].astype("string").str.contains(":").any()
        for name in preview.text_columns
    )
    if len(part_columns) > 1 and not has_time_text:
        raise DataError(
            f"{preview.path}: date and time are in several columns ({', '.join(part_columns)});"
            " write them to one column, for example 2025-06-17 08:30:00.25"
        )
    date_columns = {
        name: cells for name, cells in preview.text_columns.items() if is_date_column(cells)
    }
    if date_columns:
        return _detect_date_clock(preview, date_columns)

    def is_increasing(name: str) -> bool:
        values = preview.numeric_columns[name]
        finite_values = values[np.isfinite(values)]
        # a column without a name may be the index of pandas: row numbers or the time
        return (
            values.size > 1
            and bool((np.diff(repair_clock(finite_values, [finite_values], 1.0)[0]) > 0.0).all())
            and not (name.startswith("Unnamed: ") and bool((np.diff(values) == 1.0).all()))
        )

    numeric_time_columns = [name for name in time_columns if name in preview.numeric_columns]
    # the time of the measurement precedes that of its arrival
    numeric_time_columns.sort(key=lambda name: not normalize_name(name).endswith("header stamp"))
    # only without a column called time, others are searched; counters are excluded
    increasing_columns = [
        name
        for name in (preview.numeric_columns if not numeric_time_columns else ())
        if parse_name(name).has_none("index")
        and match_state_channel(parse_name(name)) is None
        and is_increasing(name)
    ]
    clock_column = next(
        filter(is_increasing, numeric_time_columns),
        next(iter([*numeric_time_columns, *increasing_columns]), None),
    )
    if clock_column is None:
        if not time_columns:
            raise MissingClockError(
                f"{preview.path}: no column has a name of time or increases like a clock; if the"
                " rows are evenly spaced, give the time between them: residnet new --step '0.1 s',"
                " or time: {step: 0.1 s} of the reader in a config; in Python"
                " read_logs(files, time={'step': '0.1 s'})"
            )
        cells = preview.text_columns.get(time_columns[0], ())
        texts = [
            str(cell) for cell in cells if not re.fullmatch(r"nan|NaT|<NA>|[-\d.,]+", str(cell))
        ]
        example = f", such as '{truncate(texts[-1])}'" if texts else ""
        raise DataError(
            f"{preview.path}: column '{time_columns[0]}' has times in an unknown notation{example};"
            " delete such lines if they are no rows, else write numbers, or dates such as"
            " 2025-06-17 08:30:00.25"
        )
    values = preview.numeric_columns[clock_column]
    unit = parse_header_unit(clock_column, "s")
    guess = ""
    if unit is None:
        unit, guess = guess_time_unit(values)
    if clock_column not in time_columns:
        guess = f"no column has a name of time; this one increases like a clock. {guess}".strip()
    seconds, interpolation = _repair_preview_clock(preview, values * to_si(unit), to_si(unit))
    guess = ". ".join(filter(None, (guess, interpolation)))
    return TableClock({"column": clock_column, "unit": unit}, seconds, guess, (clock_column,))


def _repair_preview_clock(
    preview: TablePreview, t: np.ndarray, clock_resolution: float | None = None
) -> tuple[np.ndarray, str]:
    """Return the times [T] in s of a table with the corrections that its reader will apply.

    The second value says how rows with the same stamp are interpolated; empty without such rows.
    """
    is_finite = np.isfinite(t)
    if is_finite.sum() < 2 or not preview.numeric_columns:
        return t, ""
    t = t.copy()
    columns = (values[is_finite] for values in preview.numeric_columns.values())
    t[is_finite], remarks = repair_clock(t[is_finite], columns, clock_resolution)
    texts = (
        remark["text"] for remark in remarks if remark["code"] in ("printed_clock", "coarse_stamps")
    )
    return t, next(texts, "")


def _detect_date_clock(preview: TablePreview, date_columns: dict[str, pd.Series]) -> TableClock:
    """Return the clock from one column of dates with times of day, or from two columns.

    Raises:
        DataError: if the dates have no time of day.
    """

    def all_match(name: str, pattern: str) -> bool:
        return bool(date_columns[name].dropna().astype("string").str.contains(pattern).all())

    time_columns = [
        name
        for name in date_columns
        if all_match(name, rf":|時|\s\d\d?\.\d\d\.\d\d|{_DOTTED_TIME_PATTERN}")
    ]
    date_only_columns = [name for name in date_columns if name not in time_columns]
    if not time_columns:
        raise DataError(
            f"{preview.path}: column '{date_only_columns[0]}' has dates without a time of day; add"
            " a column with the time"
        )
    complete_columns = [
        name
        for name in time_columns
        if all_match(name, _DATE_PATTERN) and not all_match(name, _DOTTED_TIME_PATTERN)
    ]
    column = (complete_columns or time_columns)[0]
    settings: dict[str, Any] = {"column": column, "unit": "date"}
    texts = date_columns[column]
    guess = ""
    if not complete_columns and date_only_columns:
        settings["date"] = date_only_columns[0]
        texts = date_columns[date_only_columns[0]].astype("string") + " " + texts.astype("string")
    order = detect_date_order(texts)
    if order is None and (complete_columns or date_only_columns):
        order = "dmy"
        guess = "day and month of the dates are ambiguous in the first rows"
    settings |= {"order": order} if order in ("dmy", "mdy") else {}
    stamps = parse_texts(texts, has_only_dates=True)
    seconds, interpolation = _repair_preview_clock(preview, stamps.seconds_since(int(stamps.ns[0])))
    guess = ". ".join(filter(None, (guess, interpolation)))
    return TableClock(
        settings, seconds, guess, (column, *date_only_columns[: not complete_columns])
    )
