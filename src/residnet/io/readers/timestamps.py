"""Parsers of time stamps: dates, times of day and numbers, as recorders and people write them."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Remark, make_remark
from residnet.core.names import truncate
from residnet.io.header_vocabulary import MONTH_NUMBERS
from residnet.io.readers.recording import TimeStamps

if TYPE_CHECKING:
    import pandas as pd


DateOrder = Literal["dmy", "mdy", "ymd"]
"""Order of day, month and year."""

_NS_PER_SECOND = 10**9
_DAY_NS = 86_400 * _NS_PER_SECOND
"""Length of a day in ns."""
_UNIX_MIN = 631_152_000
"""Unix time in s of the year 1990; smaller numbers are no dates."""
_UNIX_MAX = 3_786_912_000
"""Unix time in s of the year 2090; larger numbers are no dates."""
_TICKS_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Number of units per second by the unit of a Unix time."""
_DATE_PARTS = (
    r"(?:(?P<a>\d{1,4})\s*(?P<mark>[-./年])\s*(?P<b>\d{1,2}|[^\W\d_]{3,9}\.?)\s*[-./月]\s*"
    r"(?P<c>\d{1,4})日?|(?P<packed>\d{8}))"
)
_DATE = r"(?P<date>\d{1,4}\s*[-./年]\s*(?:\d{1,2}|[^\W\d_]{3,9}\.?)\s*[-./月]\s*\d{1,4}日?|\d{8})"
_CLOCK = (
    # Italian and Finnish exports write 08.30.00
    r"(?P<hour>\d{1,2})\s*(?:[:h時]|\.(?=\d\d\.\d\d))\s*(?P<minute>\d{1,2})\s*"
    r"(?:(?:[:分']|(?<=\.\d\d)\.)\s*(?P<second>\d{1,2})(?:[.,:](?P<fraction>\d+))?秒?)?"
    r"\s*(?P<am_pm>[AaPp]\.?[Mm]\.?)?"
)
_DATETIME_PATTERN = (
    rf"^\s*(?:{_DATE}(?:[T ,_;]+|$))?(?:{_CLOCK})?\s*(?P<zone>Z|UTC|GMT|[+-]\d{{2}}:?\d{{2}})?\s*$"
)
# the second and its fraction in h:mm:ss, and the text before and after them
_SECONDS_PATTERN = (
    r"^(?P<before>(?:.*[\d日][T ,_;]+)?\d\d?:\d\d?):(?P<second>\d\d?)(?:[.,:](?P<fraction>\d+))?"
    r"(?P<after>\s*(?:[^\s\d.,:分秒'].*)?)$"
)
# minutes and seconds without an hour, as Excel exports a time
_MINUTES_PATTERN = re.compile(r"^\s*(\d{1,2}:\d\d[.,]\d+)\s*$")
_NUMBER_PATTERN = r"^\s*(?P<whole>[-+]?\d+)(?:\.(?P<fraction>\d+))?\s*$"


def parse_zone(name: str) -> ZoneInfo:
    """Return the time zone with a name of the IANA database, for example `Europe/Berlin`.

    Raises:
        ValueError: if the database has no such zone.
    """
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(
            f"no time zone is called '{name}'; write for example 'Europe/Berlin' or 'UTC'"
        ) from error


def parse_numbers(values: np.ndarray, seconds_per_unit: float | None = None) -> TimeStamps:
    """Convert numbers to time stamps.

    Args:
        values: times [T].
        seconds_per_unit: unit of the numbers in s. None detects Unix time in s, ms, us or ns by its
            size and takes smaller numbers as s.

    Raises:
        DataError: if a number is not finite.
    """
    if not np.isfinite(values).all():
        raise DataError(f"{int((~np.isfinite(values)).sum())} rows have no time")
    unit = detect_unix_unit(values) if seconds_per_unit is None else None
    if unit is None:
        ns = np.rint(values * ((seconds_per_unit or 1.0) * _NS_PER_SECOND)).astype(np.int64)
        is_float_seconds = seconds_per_unit in (None, 1.0) and values.dtype.kind == "f"
        return TimeStamps(
            ns, False, seconds=values.astype(np.float64) if is_float_seconds else None
        )
    # Unix time in ns exceeds the 53 bits of a float: convert integer part and fraction separately
    ns_per_tick = _NS_PER_SECOND // _TICKS_PER_SECOND[unit]
    integer_part = values if values.dtype.kind in "iu" else np.floor(values)
    fraction_ns = np.rint((values - integer_part) * ns_per_tick).astype(np.int64)
    return TimeStamps(integer_part.astype(np.int64) * ns_per_tick + fraction_ns, True)


def detect_unix_unit(values: np.ndarray) -> str | None:
    """Return the unit in which numbers [T] are Unix times between 1990 and 2090, or None."""
    median_value = abs(float(np.median(values))) if values.size else 0.0
    units = (
        unit
        for unit, ticks in _TICKS_PER_SECOND.items()
        if _UNIX_MIN <= median_value / ticks <= _UNIX_MAX
    )
    return next(units, None)


def infer_time_unit(step: float) -> str:
    """Return the unit of times from their usual step, assuming that steps are at most 5 s long."""
    step_limits = (("s", 5.0), ("ms", 5e3), ("us", 5e6))
    return next((unit for unit, limit in step_limits if step <= limit), "ns")


def guess_time_unit(values: np.ndarray) -> tuple[str, str]:
    """Guess the unit of times [T] from their size and step; return the unit and the reason."""
    finite_values = values[np.isfinite(values)]
    step = float(np.median(np.diff(finite_values)))
    median_size = float(np.median(np.abs(finite_values)))
    if unix_unit := detect_unix_unit(finite_values):
        return unix_unit, f"numbers of this size are Unix time in {unix_unit}"
    if step < 1e-3 and (2e4 < median_size < 7e4 or is_datenum(finite_values)):
        return "day", "numbers of this size are the days of Excel or MATLAB"
    unit = infer_time_unit(step)
    return unit, f"the header has no unit; steps of {step:g} would be {unit}"


def is_datenum(values: np.ndarray) -> bool:
    """Return whether numbers [T] are days since year 0, as MATLAB counts them, of our time."""
    return 6.5e5 < float(np.median(np.abs(values))) < 8e5


_ROWS_PER_CHUNK = 250_000
"""Rows that are parsed at a time: the intermediate columns of 3 million rows take 1 GB."""


def _split_datetimes(cells: pd.Series) -> pd.DataFrame:
    """Split dates and times into columns such as date, hour, minute, second, fraction and zone.

    The columns are categorical: as text they would take several times the memory of the file.
    """
    import pandas as pd
    import pyarrow as pa
    from pandas.api.types import union_categoricals
    from pyarrow import compute

    has_no_hours = _MINUTES_PATTERN.fullmatch(str(next(iter(cells), ""))) is not None
    pattern = re.compile(_DATETIME_PATTERN)

    def split_chunk(chunk: pd.Series) -> pd.DataFrame:
        if has_no_hours:
            chunk = chunk.str.replace(_MINUTES_PATTERN, r"0:\1", regex=True)
        texts = pa.array(chunk.tolist(), pa.string())
        # without the second and its fraction most texts are equal and are matched only once
        text_before, *second_and_fraction, text_after = compute.extract_regex(
            texts, _SECONDS_PATTERN
        ).flatten()
        minute_texts = compute.coalesce(
            compute.binary_join_element_wise(text_before, text_after, ""), texts
        ).dictionary_encode()
        matches = [pattern.match(text) for text in minute_texts.dictionary.to_pylist()]
        rows = [match.groups() if match else (None,) * pattern.groups for match in matches]
        table = pd.DataFrame(rows, columns=list(pattern.groupindex), dtype=object)
        table = table.take(minute_texts.indices.to_numpy()).set_axis(chunk.index)
        for name, digits in zip(("second", "fraction"), second_and_fraction, strict=True):
            encoded = digits.dictionary_encode()
            codes = encoded.indices.to_numpy(zero_copy_only=False)
            # the last entry stands for missing digits
            digit_texts = np.array([*encoded.dictionary.to_pylist(), None], dtype=object)
            codes = np.where(np.isfinite(codes), codes, -1).astype(np.int64)
            extracted = pd.Series(digit_texts[codes], index=chunk.index)
            table[name] = extracted.where(extracted.notna() & (extracted != ""), table[name])
        return table.astype("category")

    starts = range(0, max(len(cells), 1), _ROWS_PER_CHUNK)
    tables = [split_chunk(cells.iloc[start : start + _ROWS_PER_CHUNK]) for start in starts]
    if len(tables) == 1:
        return tables[0]
    # unlike `concat`, `union_categoricals` keeps columns of unlike categories categorical
    columns = {
        name: union_categoricals([table[name] for table in tables]) for name in tables[0].columns
    }
    return pd.DataFrame(columns, index=cells.index)


def is_date_column(texts: pd.Series) -> bool:
    """Return whether all filled cells are dates or times of day."""
    filled_cells = texts.dropna().astype("string")
    parts = _split_datetimes(filled_cells)
    return len(filled_cells) > 0 and bool((parts["hour"].notna() | parts["date"].notna()).all())


def detect_date_order(texts: pd.Series) -> DateOrder | None:
    """Return the order of day, month and year in dates, or None if it is ambiguous."""
    return _order_from_parts(_split_datetimes(texts.dropna().astype("string")))


def _order_from_parts(cells: pd.DataFrame) -> DateOrder | None:
    parts = cells["date"].drop_duplicates().astype("string").str.extract(_DATE_PARTS)
    first_part = parts["a"].dropna()
    second_part = parts["b"].dropna()
    if first_part.empty or (first_part.str.len() == 4).any():
        return "ymd" if len(first_part) else None
    if not second_part.str.isdigit().all() or (parts["mark"] == ".").any():
        return "dmy"
    if (first_part.astype(int) > 12).any():
        return "dmy"
    if (second_part.astype(int) > 12).any() or cells["am_pm"].notna().any():
        return "mdy"
    return None


def parse_texts(
    texts: pd.Series | np.ndarray,
    *,
    zone: str | None = None,
    order: DateOrder | None = None,
    has_only_dates: bool = False,
    unit: str = "s",
) -> TimeStamps:
    """Convert text to time stamps: dates and times of day in most notations, or numbers.

    A fraction of a second that was printed as an integer without its leading zeros (`09.70533347`
    for 9.070533347 s) is recognised from the complete column. Times of day continue past midnight.

    Args:
        texts: cells [T] in one notation.
        zone: time zone of dates without one; None takes them as UTC.
        order: order of day, month and year; None detects it.
        has_only_dates: whether cells are dates or empty, never plain numbers.
        unit: unit of numbers that are no Unix time.

    Raises:
        DataError: if a cell is no time; the message quotes the first one.
    """
    import pandas as pd

    if isinstance(texts, pd.Series) and pd.api.types.is_string_dtype(texts.dtype):
        # contiguous strings of pandas take a quarter of the memory of Python objects
        text_series = texts.reset_index(drop=True)
    else:
        text_series = pd.Series(np.asarray(texts, dtype=object))
    column, is_filled = strip_cells(text_series)
    if has_only_dates:
        cells = column if is_filled.all() else column[is_filled]
    else:
        cells = column.fillna("")
    if not len(cells):
        return TimeStamps(np.zeros(len(column), dtype=np.int64), False, is_filled)
    if not has_only_dates:
        if ":" in cells.iloc[0]:
            return _parse_datetimes(cells, zone, order)
        return _parse_digits(cells, unit)
    stamps = _parse_datetimes(cells, zone, order)
    ns = np.full(len(column), stamps.ns[0])
    ns[is_filled] = stamps.ns
    return TimeStamps(ns, stamps.is_absolute, is_filled, stamps.remarks)


def strip_cells(cells: pd.Series) -> tuple[pd.Series, np.ndarray]:
    """Return the cells without surrounding blanks, and which of them are not empty, bool [T]."""
    column = cells.astype("string")
    # most files have no blanks, and a second copy of the text takes as much memory as the first
    if column.str.contains(r"^\s|\s$", regex=True).any():
        column = column.str.strip()
    return column, (column.notna() & (column != "")).to_numpy(dtype=bool)


def require_valid_cells(
    cells: pd.Series, is_invalid: np.ndarray, description: str, advice: str = ""
) -> None:
    """Raise an error that quotes the first invalid cell and its row.

    Args:
        cells: text [T].
        is_invalid: bool [T].
        description: quantity that was expected.
        advice: end of the message.

    Raises:
        DataError: if any cell is invalid.
    """
    if is_invalid.any():
        row = int(np.argmax(is_invalid))
        raise DataError(
            f"'{truncate(str(cells.iloc[row]))}' in row {int(cells.index[row]) + 1} is no"
            f" {description} ({int(is_invalid.sum())} such cells){advice}"
        )


def _parse_digits(cells: pd.Series, default_unit: str) -> TimeStamps:
    """Convert decimal numbers to time stamps without rounding them to float64."""
    import pandas as pd

    parts = cells.str.extract(_NUMBER_PATTERN)
    is_not_number = parts["whole"].isna().to_numpy()
    if is_not_number.any():
        # digits of a number with an exponent cannot be split at its decimal point
        numeric_values = pd.to_numeric(cells, errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        require_valid_cells(cells, ~np.isfinite(numeric_values), "time")
        return parse_numbers(
            numeric_values,
            None if detect_unix_unit(numeric_values) else 1.0 / _TICKS_PER_SECOND[default_unit],
        )
    integer_part = parts["whole"].astype("int64").to_numpy()
    fraction, remarks = _parse_fractions(parts["fraction"], integer_part)
    fraction = np.where(cells.str.startswith("-").to_numpy(dtype=bool), -fraction, fraction)
    unit = detect_unix_unit(integer_part)
    ticks_per_second = _TICKS_PER_SECOND[unit or default_unit]
    ns = integer_part * (_NS_PER_SECOND // ticks_per_second) + fraction // ticks_per_second
    return TimeStamps(ns, unit is not None, None, remarks)


def _parse_datetimes(cells: pd.Series, zone: str | None, order: DateOrder | None) -> TimeStamps:
    """Convert dates with times of day, or times of day alone, to time stamps."""
    parts = _split_datetimes(cells)
    has_dates = bool(parts["date"].notna().all())
    require_valid_cells(
        cells, (parts["date" if has_dates else "hour"].isna()).to_numpy(), "date or time"
    )
    # remove each column of text as soon as its numbers exist, to save memory
    hour = convert_per_text(parts.pop("hour"), int, missing="0")
    if parts["am_pm"].notna().any():
        half_day = parts["am_pm"].astype("string").fillna("").str.lower().str.slice(0, 1)
        hour = np.where(half_day == "p", hour % 12 + 12, np.where(half_day == "a", hour % 12, hour))
    whole_seconds = hour * 3_600
    del hour
    whole_seconds += convert_per_text(parts.pop("minute"), int, missing="0") * 60
    whole_seconds += convert_per_text(parts.pop("second"), int, missing="0")
    if has_dates:
        date_order = order or _order_from_parts(parts) or "dmy"
        whole_seconds += _parse_days(cells, parts["date"], date_order) * 86_400
    fraction, remarks = _parse_fractions(parts.pop("fraction"), whole_seconds)
    ns = whole_seconds * _NS_PER_SECOND + fraction
    if has_dates:
        return TimeStamps(_to_utc(ns, parts["zone"], zone), True, None, remarks)
    # a step back by more than half a day is midnight
    midnight_count = np.cumsum(np.diff(ns, prepend=ns[0]) < -_DAY_NS // 2)
    n_midnights = int(midnight_count[-1])
    if n_midnights:
        text = f"the times of day pass midnight {n_midnights} times; the days are counted"
        remarks = (*remarks, make_remark("note", "past_midnight", text, nights=n_midnights))
    return TimeStamps(ns + midnight_count * _DAY_NS, False, None, remarks)


def convert_per_text(
    column: pd.Series, function: Callable[[str], int], *, missing: str
) -> np.ndarray:
    """Return the integer [T] of each text, calling the function once per distinct text.

    Args:
        column: texts [T], best as categories.
        function: conversion of one text.
        missing: text that replaces a missing one.
    """
    categories = column.astype("category")
    # a missing text has the code -1, which selects the last entry
    texts = [*categories.cat.categories, missing]
    converted = np.array([function(str(text)) for text in texts], np.int64)
    integers: np.ndarray = converted[categories.cat.codes.to_numpy()]
    return integers


def _parse_days(cells: pd.Series, dates: pd.Series, order: DateOrder) -> np.ndarray:
    """Return the days [T] since 1970-01-01, parsing each distinct date once."""
    import pandas as pd

    categories = dates.astype("category")
    parts = pd.Series(categories.cat.categories, dtype="string").str.extract(_DATE_PARTS)
    packed = parts["packed"]
    year, month, day = (
        parts[name].where(packed.isna(), packed.str.slice(*span))
        for name, span in zip(
            {"ymd": "abc", "dmy": "cba", "mdy": "cab"}[order], ((0, 4), (4, 6), (6, 8)), strict=True
        )
    )
    month_abbreviation = month.str.lower().str.slice(0, 3)
    month_number = month_abbreviation.map(MONTH_NUMBERS).astype("Int64").astype("string")
    month = month.where(month.str.isdigit(), month_number)
    year = year.where(year.str.len() != 2, "20" + year)
    iso_dates = (year + "-" + month + "-" + day).astype("object")
    dates_parsed = pd.to_datetime(iso_dates, format="%Y-%m-%d", errors="coerce")
    category_codes = categories.cat.codes.to_numpy()
    is_invalid = dates_parsed.isna().to_numpy()[category_codes]
    require_valid_cells(cells, is_invalid, f"date with {order}; give the `order`")
    days_per_category = (dates_parsed - pd.Timestamp(0)) // pd.Timedelta(days=1)
    day_numbers: np.ndarray = days_per_category.to_numpy("int64")[category_codes]
    return day_numbers


def _to_utc(ns: np.ndarray, zones: pd.Series, zone: str | None) -> np.ndarray:
    """Convert local times [T] in ns to Unix time [T] in ns.

    Args:
        ns: local times.
        zones: UTC offset in the text of each cell; missing where a cell has none.
        zone: time zone if no cell has an offset; None takes local time as UTC.
    """
    import pandas as pd

    if (zones.notna() & (zones != "")).any():
        utc_offsets = convert_per_text(zones, _parse_utc_offset, missing="")
        utc_ns: np.ndarray = ns - utc_offsets * _NS_PER_SECOND
        return utc_ns
    if zone is None:
        return ns
    local = pd.DatetimeIndex(ns.astype("datetime64[ns]"))
    # In autumn one hour occurs twice. Of the three readings (daylight saving time, standard time,
    # one change between them) take an increasing one, preferably the one without a gap.
    dst_times = local.tz_localize(zone, ambiguous=np.ones(ns.size, dtype=bool))
    standard_times = local.tz_localize(zone, ambiguous=np.zeros(ns.size, dtype=bool))
    earlier_ns, later_ns = (index.as_unit("ns").asi8 for index in (dst_times, standard_times))
    is_backward = np.append(False, np.diff(earlier_ns) < 0)
    switched_ns = np.where(np.logical_or.accumulate(is_backward), later_ns, earlier_ns)
    increasing_readings = [
        reading for reading in (earlier_ns, later_ns, switched_ns) if (np.diff(reading) >= 0).all()
    ]
    shortest_ns: np.ndarray = min(
        increasing_readings or [earlier_ns], key=lambda reading: reading[-1] - reading[0]
    )
    return shortest_ns


def _parse_utc_offset(zone: str) -> int:
    """Return a UTC offset such as `+02:00` in s, positive east of Greenwich."""
    if not zone or zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))


def _parse_fractions(
    column: pd.Series, whole_seconds: np.ndarray
) -> tuple[np.ndarray, tuple[Remark, ...]]:
    """Return decimal fractions in units of 1e-9, int64 [T], with lost leading zeros restored.

    Args:
        column: digits behind the decimal sign, as text [T].
        whole_seconds: integer parts [T].

    Returns:
        The fractions, and a remark if leading zeros were restored.
    """
    digit_count = convert_per_text(column, lambda text: len(text[:9]), missing="0")
    value = convert_per_text(column, lambda text: int(text[:9]), missing="0")
    as_printed = value * 10 ** (9 - digit_count)
    max_digits = int(digit_count.max(initial=0))
    if max_digits not in (3, 6, 9) or (digit_count == max_digits).all():
        return as_printed, ()
    # alternative reading: integers of ms, us or ns whose leading zeros were not printed
    as_integers = value * 10 ** (9 - max_digits)
    n_backward_printed, n_backward_integers = (
        int((np.diff(whole_seconds * _NS_PER_SECOND + fraction) < 0).sum())
        for fraction in (as_printed, as_integers)
    )
    starts_with_zero = convert_per_text(column, lambda text: text.startswith("0"), missing="0")
    n_leading_zeros = int(((starts_with_zero == 1) & (digit_count > 1)).sum())
    # Where zeros are printed, about one fraction in ten starts with a zero. If none of at least a
    # hundred does, they were not printed.
    is_undecided = n_backward_integers == n_backward_printed and (
        n_backward_printed > 0 or n_leading_zeros > 0 or whole_seconds.size < 100
    )
    if n_backward_integers > n_backward_printed or is_undecided:
        return as_printed, ()
    unit = {3: "ms", 6: "us", 9: "ns"}[max_digits]
    n_changed = int((as_printed != as_integers).sum())
    if not n_changed:
        return as_printed, ()
    text = (
        f"fractions of seconds are integers of {unit} without their leading zeros: {n_changed} of"
        f" {whole_seconds.size} times are corrected; as printed, time runs backwards"
        f" {n_backward_printed} times"
    )
    figures = {
        "backwards_as_printed": n_backward_printed,
        "backwards_repaired": n_backward_integers,
    }
    fraction_remark = make_remark("note", "unpadded_fraction", text, repaired=n_changed, **figures)
    return as_integers, (fraction_remark,)
