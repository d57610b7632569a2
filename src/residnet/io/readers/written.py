"""Times and angles as people, programs and recorders write them, and clocks that wrap or round."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Remark, make_remark
from residnet.core.names import truncate
from residnet.io.readers.recording import TimeStamps

if TYPE_CHECKING:
    import pandas as pd


DateOrder = Literal["dmy", "mdy", "ymd"]
"""Order of day, month and year."""

_NS_PER_SECOND = 10**9
_DAY_NS = 86_400 * _NS_PER_SECOND
# Unix time of 1990 and 2090, s
_UNIX_MIN, _UNIX_MAX = 631_152_000, 3_786_912_000
_TICKS_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
_MONTHS = (
    "jan ene gen|feb fév fev|mar mär mrz maa mrt|apr avr abr|may mai mei maj|jun jui|jul"
    "|aug aoû aou ago|sep set|oct okt out|nov|dec dez déc dic des"
)
_MONTH_OF = {word: n for n, words in enumerate(_MONTHS.split("|"), 1) for word in words.split()}
_DATE_PARTS = (
    r"(?:(?P<a>\d{1,4})\s*(?P<mark>[-./年])\s*(?P<b>\d{1,2}|[^\W\d_]{3,9}\.?)\s*[-./月]\s*"
    r"(?P<c>\d{1,4})日?|(?P<packed>\d{8}))"
)
_DATE = r"(?P<date>\d{1,4}\s*[-./年]\s*(?:\d{1,2}|[^\W\d_]{3,9}\.?)\s*[-./月]\s*\d{1,4}日?|\d{8})"
_CLOCK = (
    # Italians and Finns write 08.30.00
    r"(?P<hour>\d{1,2})\s*(?:[:h時]|\.(?=\d\d\.\d\d))\s*(?P<minute>\d{1,2})\s*"
    r"(?:(?:[:分']|(?<=\.\d\d)\.)\s*(?P<second>\d{1,2})(?:[.,:](?P<fraction>\d+))?秒?)?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
)
_DATETIME_PATTERN = (
    rf"^\s*(?:{_DATE}(?:[T ,_;]+|$))?(?:{_CLOCK})?\s*(?P<zone>Z|UTC|GMT|[+-]\d{{2}}:?\d{{2}})?\s*$"
)
# the second and its fraction of h:mm:ss, and what stands before and after them
_SECONDS_PATTERN = (
    r"^(?P<before>(?:.*[\d日][T ,_;]+)?\d\d?:\d\d?):(?P<second>\d\d?)(?:[.,:](?P<fraction>\d+))?"
    r"(?P<after>\s*(?:[^\s\d.,:分秒'].*)?)$"
)
# minutes and seconds alone, as Excel exports a time
_MINUTES_PATTERN = re.compile(r"^\s*(\d{1,2}:\d\d[.,]\d+)\s*$")
_NUMBER_PATTERN = r"^\s*(?P<whole>[-+]?\d+)(?:\.(?P<fraction>\d+))?\s*$"
AngleForm = Literal["number", "ddmm"]
"""How a number stands for an angle: as degrees, or as degrees and minutes in one."""
LetterO = Literal["east", "west"]
"""What O stands for: Ost and Oost, or Oeste, Ouest and Ovest."""
_DECIMAL = r"\d+(?:[.,]\d+)?"
_ANGLE_PATTERN = (
    r"^\s*(?P<lead>[NSEWOnsewo])?\s*(?P<sign>[-+−])?\s*"
    rf"(?P<degrees>{_DECIMAL})\s*(?:°|º|˚|deg\.?|d)?"
    rf"(?:(?:(?<=[°º˚d.g])\s*|\s+|\s*[:\-]\s*)(?P<minutes>{_DECIMAL})\s*(?:''|['′’´:m]|min\.?)?"
    rf"(?:(?:(?<=['′’´:mn.])\s*|\s+)(?P<seconds>{_DECIMAL})\s*(?:\"|″|”|''|′′|’’|sec\.?)?)?)?"
    r"[\s,]*(?P<tail>[NSEWOnsewo])?\s*$"
)
_HEMISPHERE_SIGNS = {"n": 1.0, "e": 1.0, "s": -1.0, "w": -1.0}
_HEMISPHERES_OF_CHANNEL = {"latitude": "ns", "longitude": "ew"}
_ACCEPTED_FORMS = (
    "; forms that are read are 59.90535, 59°54.321'N, 59 54 19.3 N and, with `form: ddmm`, 5954.321"
)


def parse_zone(name: str) -> ZoneInfo:
    """Return a time zone by its name, for example `Europe/Berlin`."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(
            f"no time zone is called '{name}'; names are such as 'Europe/Berlin' or 'UTC'"
        ) from error


def parse_numbers(values: np.ndarray, seconds_per_unit: float | None = None) -> TimeStamps:
    """Return the times from numbers [T], in units of `seconds_per_unit` seconds.

    None reads Unix time in s, ms, us or ns by its size, and anything smaller as s.
    """
    if not np.isfinite(values).all():
        raise DataError(f"{int((~np.isfinite(values)).sum())} rows have no time")
    unit = detect_unix_unit(values) if seconds_per_unit is None else None
    if unit is None:
        ns = np.rint(values * ((seconds_per_unit or 1.0) * _NS_PER_SECOND)).astype(np.int64)
        seconds = seconds_per_unit in (None, 1.0) and values.dtype.kind == "f"
        return TimeStamps(ns, False, seconds=values.astype(np.float64) if seconds else None)
    ticks_per_second = _TICKS_PER_SECOND[unit]
    integer_part = values if values.dtype.kind in "iu" else np.floor(values)
    fraction_ns = np.rint((values - integer_part) * (_NS_PER_SECOND // ticks_per_second)).astype(
        np.int64
    )
    return TimeStamps(
        integer_part.astype(np.int64) * (_NS_PER_SECOND // ticks_per_second) + fraction_ns, True
    )


def detect_unix_unit(values: np.ndarray) -> str | None:
    """Return the unit in which numbers [T] are Unix time between 1990 and 2090; None for others."""
    median_value = abs(float(np.median(values))) if values.size else 0.0
    units = (
        unit
        for unit, ticks in _TICKS_PER_SECOND.items()
        if _UNIX_MIN <= median_value / ticks <= _UNIX_MAX
    )
    return next(units, None)


def infer_time_unit(step: float) -> str:
    """Return the unit of times that go on by such a step; no recorder waits longer than 5 s."""
    step_limits = (("s", 5.0), ("ms", 5e3), ("us", 5e6))
    return next((unit for unit, limit in step_limits if step <= limit), "ns")


_PIECE = 250_000
"""Rows of text that are taken apart at a time: what lies between would be 1 GB of 3 million."""


def _split_datetimes(cells: pd.Series) -> pd.DataFrame:
    """Return the parts of dates and times; equal texts are one object in memory."""
    import pandas as pd

    minutes = _MINUTES_PATTERN.fullmatch(str(next(iter(cells), ""))) is not None
    pieces = [cells.iloc[k : k + _PIECE] for k in range(0, max(len(cells), 1), _PIECE)]
    matches = [_parts_of_piece(piece, minutes=minutes) for piece in pieces]
    return matches[0] if len(matches) == 1 else pd.concat(matches)


def _parts_of_piece(cells: pd.Series, *, minutes: bool) -> pd.DataFrame:
    """Return the parts of dates and times; with `minutes` times begin with minutes."""
    import pandas as pd
    import pyarrow as pa
    from pyarrow import compute

    if minutes:
        cells = cells.str.replace(_MINUTES_PATTERN, r"0:\1", regex=True)
    form, texts = re.compile(_DATETIME_PATTERN), pa.array(cells.tolist(), pa.string())
    before, *seconds, after = compute.extract_regex(texts, _SECONDS_PATTERN).flatten()
    rest = compute.coalesce(compute.binary_join_element_wise(before, after, ""), texts)
    rest = rest.dictionary_encode()
    found = [form.match(text) for text in rest.dictionary.to_pylist()]
    rows = [one.groups() if one else (None,) * form.groups for one in found]
    table = pd.DataFrame(rows, columns=list(form.groupindex), dtype=object)
    table = table.take(rest.indices.to_numpy()).set_axis(cells.index)
    for name, digits in zip(("second", "fraction"), seconds, strict=True):
        coded = digits.dictionary_encode()
        codes = coded.indices.to_numpy(zero_copy_only=False)
        words = np.array([*coded.dictionary.to_pylist(), None], dtype=object)
        codes = np.where(np.isfinite(codes), codes, -1).astype(np.int64)
        cut = pd.Series(words[codes], index=cells.index)
        table[name] = cut.where(cut.notna() & (cut != ""), table[name])
    return table


def is_date_column(texts: pd.Series) -> bool:
    """Return whether the cells are dates or times of day."""
    filled_cells = texts.dropna().astype("string")
    parts = _split_datetimes(filled_cells)
    return len(filled_cells) > 0 and bool((parts["hour"].notna() | parts["date"].notna()).all())


def detect_date_order(texts: pd.Series) -> DateOrder | None:
    """Return the order of day, month and year in dates; None where it cannot be told."""
    return _order_from_parts(_split_datetimes(texts.dropna().astype("string")))


def _order_from_parts(cells: pd.DataFrame) -> DateOrder | None:
    parts = cells["date"].drop_duplicates().str.extract(_DATE_PARTS)
    first_part, second_part = parts["a"].dropna(), parts["b"].dropna()
    if first_part.empty or (first_part.str.len() == 4).any():
        return "ymd" if len(first_part) else None
    if not second_part.str.isdigit().all() or (parts["mark"] == ".").any():
        return "dmy"
    if (first_part.astype(int) > 12).any():
        return "dmy"
    if (second_part.astype(int) > 12).any() or cells["half"].notna().any():
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
    """Return the times of text [T]: dates and times of day in most forms, or numbers.

    A fraction of a second printed as an integer without its leading zeros (`09.70533347` for
    9.070533347 s) is recognised by the whole column. Times of day count on past midnight.

    Args:
        texts: in one style.
        zone: time zone of dates that name none; None takes them as UTC.
        order: of day, month and year; None takes it from the cells.
        has_only_dates: none are numbers, and some cells may be empty.
        unit: of numbers that are no Unix time.

    Raises:
        DataError: naming the first cell that is no time.
    """
    import pandas as pd

    if isinstance(texts, pd.Series) and pd.api.types.is_string_dtype(texts.dtype):
        # texts that pandas holds side by side take a quarter of what objects take
        written = texts.reset_index(drop=True)
    else:
        written = pd.Series(np.asarray(texts, dtype=object))
    column, is_filled = _strip_cells(written)
    cells = (
        (column if is_filled.all() else column[is_filled]) if has_only_dates else column.fillna("")
    )
    if not len(cells):
        return TimeStamps(np.zeros(len(column), dtype=np.int64), False, is_filled)
    if not has_only_dates:
        return (
            _parse_datetimes(cells, zone, order)
            if ":" in cells.iloc[0]
            else _parse_digits(cells, unit)
        )
    stamps = _parse_datetimes(cells, zone, order)
    ns = np.full(len(column), stamps.ns[0])
    ns[is_filled] = stamps.ns
    return TimeStamps(ns, stamps.is_absolute, is_filled, stamps.remarks)


def _strip_cells(cells: pd.Series) -> tuple[pd.Series, np.ndarray]:
    """Return the cells without blanks around them, and [T] which of them are not empty."""
    column = cells.astype("string").str.strip()
    return column, (column.notna() & (column != "")).to_numpy(dtype=bool)


def _require_valid_cells(
    cells: pd.Series, is_invalid: np.ndarray, description: str, advice: str = ""
) -> None:
    if is_invalid.any():
        row = int(np.argmax(is_invalid))
        raise DataError(
            f"'{truncate(str(cells.iloc[row]))}' in row {int(cells.index[row]) + 1} is no {description}"
            f" ({int(is_invalid.sum())} such cells){advice}"
        )


def _parse_digits(cells: pd.Series, default_unit: str) -> TimeStamps:
    """Return the times of numbers as a clock printed them, to the last digit."""
    import pandas as pd

    parts = cells.str.extract(_NUMBER_PATTERN)
    is_not_number = parts["whole"].isna().to_numpy()
    if is_not_number.any():
        # exponents: the digits are not the ones that a clock printed
        numeric_values = pd.to_numeric(cells, errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        _require_valid_cells(cells, ~np.isfinite(numeric_values), "time")
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
    parts = _split_datetimes(cells)
    has_dates = bool(parts["date"].notna().all())
    _require_valid_cells(
        cells, (parts["date" if has_dates else "hour"].isna()).to_numpy(), "date or time"
    )
    # each part is let go where its number is made
    hour, minute, second = (
        convert_per_text(parts.pop(name).fillna("0"), int) for name in ("hour", "minute", "second")
    )
    if parts["half"].notna().any():
        half_day = parts["half"].fillna("").str.lower().str.slice(0, 1)
        hour = np.where(half_day == "p", hour % 12 + 12, np.where(half_day == "a", hour % 12, hour))
    whole_seconds = (hour * 60 + minute) * 60 + second
    whole_seconds += (
        _parse_days(cells, parts["date"], order or _order_from_parts(parts) or "dmy") * 86_400
        if has_dates
        else 0
    )
    fraction, remarks = _parse_fractions(parts.pop("fraction"), whole_seconds)
    ns = whole_seconds * _NS_PER_SECOND + fraction
    if has_dates:
        return TimeStamps(_to_utc(ns, parts["zone"], zone), True, None, remarks)
    midnight_count = np.cumsum(np.diff(ns, prepend=ns[0]) < -_DAY_NS // 2)
    if midnight_count[-1]:
        text = (
            f"the times of day run past midnight {midnight_count[-1]} times; the days are counted"
        )
        remarks = (
            *remarks,
            make_remark("note", "past_midnight", text, nights=int(midnight_count[-1])),
        )
    return TimeStamps(ns + midnight_count * _DAY_NS, False, None, remarks)


def convert_per_text(column: pd.Series, function: Callable[[str], int]) -> np.ndarray:
    """Return an integer [T] of each text; one that repeats over many rows is made once."""
    texts = column.astype("category")
    made = np.array([function(str(text)) for text in texts.cat.categories], dtype=np.int64)
    out: np.ndarray = made[texts.cat.codes.to_numpy()]
    return out


def _parse_days(cells: pd.Series, dates: pd.Series, order: DateOrder) -> np.ndarray:
    """Return the days [T] since 1970; a day repeats over many rows, and is made a date once."""
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
    month_number = month.str.lower().str.slice(0, 3).map(_MONTH_OF).astype("Int64").astype("string")
    month = month.where(month.str.isdigit(), month_number)
    year = year.where(year.str.len() != 2, "20" + year)
    text = year + "-" + month + "-" + day
    dates_parsed = pd.to_datetime(text.astype("object"), format="%Y-%m-%d", errors="coerce")
    category_codes = categories.cat.codes.to_numpy()
    is_invalid = dates_parsed.isna().to_numpy()[category_codes]
    _require_valid_cells(
        cells, is_invalid, f"date with {order}; give the `order`" if is_invalid.any() else ""
    )
    day_numbers: np.ndarray = ((dates_parsed - pd.Timestamp(0)) // pd.Timedelta(days=1)).to_numpy(
        "int64"
    )[category_codes]
    return day_numbers


def _to_utc(ns: np.ndarray, zones: pd.Series, zone: str | None) -> np.ndarray:
    """Return Unix time [T] in ns from local time."""
    import pandas as pd

    zone_categories = zones.fillna("").astype("category")
    if (zone_categories != "").any():
        utc_offsets = np.array(
            [_parse_utc_offset(str(text)) for text in zone_categories.cat.categories]
        )
        utc_ns: np.ndarray = ns - utc_offsets[zone_categories.cat.codes.to_numpy()] * _NS_PER_SECOND
        return utc_ns
    if zone is None:
        return ns
    local = pd.DatetimeIndex(ns.astype("datetime64[ns]"))
    # an hour comes twice in autumn: time rises, and does so without a leap where it can
    dst_times = local.tz_localize(zone, ambiguous=np.ones(ns.size, dtype=bool))
    standard_times = local.tz_localize(zone, ambiguous=np.zeros(ns.size, dtype=bool))
    earlier_ns, later_ns = (index.as_unit("ns").asi8 for index in (dst_times, standard_times))
    is_backward = np.append(False, np.diff(earlier_ns) < 0)
    switched_ns = np.where(np.logical_or.accumulate(is_backward), later_ns, earlier_ns)
    increasing_readings = [
        reading for reading in (earlier_ns, later_ns, switched_ns) if (np.diff(reading) >= 0).all()
    ]
    chosen_ns: np.ndarray = min(
        increasing_readings or [earlier_ns], key=lambda reading: reading[-1] - reading[0]
    )
    return chosen_ns


def _parse_utc_offset(zone: str) -> int:
    """Return the seconds by which a written zone is ahead of UTC."""
    if not zone or zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))


def _parse_fractions(
    column: pd.Series, whole_seconds: np.ndarray
) -> tuple[np.ndarray, tuple[Remark, ...]]:
    """Return the fractions of the unit in ns [T] int64, mended where they lost leading zeros."""
    digits = column.fillna("0").str.slice(0, 9)
    digit_count, value = convert_per_text(digits, len), convert_per_text(digits, int)
    padded = value * 10 ** (9 - digit_count)
    max_digits = int(digit_count.max(initial=0))
    if max_digits not in (3, 6, 9) or (digit_count == max_digits).all():
        return padded, ()
    unpadded = value * 10 ** (9 - max_digits)
    n_backward = [
        int((np.diff(whole_seconds * _NS_PER_SECOND + part) < 0).sum())
        for part in (padded, unpadded)
    ]
    n_leading_zeros = int((digits.str.startswith("0") & (digit_count > 1)).sum())
    # one fraction in ten starts with a zero where zeros are printed
    if n_backward[1] > n_backward[0] or (
        n_backward[1] == n_backward[0]
        and (n_backward[0] > 0 or n_leading_zeros > 0 or whole_seconds.size < 100)
    ):
        return padded, ()
    unit = {3: "ms", 6: "us", 9: "ns"}[max_digits]
    n_changed = int((padded != unpadded).sum())
    if not n_changed:
        return padded, ()
    text = (
        f"fractions of seconds are whole {unit} without their leading zeros: {n_changed} of"
        f" {whole_seconds.size} times are repaired, taken as printed time runs backwards {n_backward[0]} times"
    )
    figures = {"backwards_as_printed": n_backward[0], "backwards_repaired": n_backward[1]}
    fraction_remark = make_remark("note", "unpadded_fraction", text, repaired=n_changed, **figures)
    return unpadded, (fraction_remark,)


def parse_degrees(
    cells: pd.Series, name: str, form: AngleForm = "number", letter_o: LetterO | None = None
) -> np.ndarray:
    """Return angles [T] in degrees from cells such as `59°54.321'N`, `59 54 19.3 N` or `-59.9`.

    NaN stands for empty cells.

    Args:
        name: of the channel: a latitude has no east.
        form: of a number that stands alone.
        letter_o: what O stands for; None refuses it.

    Raises:
        DataError: naming the first cell that is no such angle.
    """
    import pandas as pd

    quantity = name if name in _HEMISPHERES_OF_CHANNEL else "angle"
    if pd.api.types.is_numeric_dtype(cells):
        values = cells.to_numpy(dtype=np.float64, na_value=np.nan)
        angles = degrees_from_form(values, form)
        _require_valid_cells(cells, np.isnan(angles) & ~np.isnan(values), quantity, _ACCEPTED_FORMS)
        return angles
    column, is_filled = _strip_cells(cells)
    parts = column[is_filled].str.extract(_ANGLE_PATTERN)
    degrees, minutes, seconds = (
        pd.to_numeric(parts[part].str.replace(",", "."), errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        for part in ("degrees", "minutes", "seconds")
    )
    has_no_minutes = np.isnan(minutes)
    degrees = np.where(has_no_minutes, degrees_from_form(degrees, form), degrees)
    # a fraction has nothing below it; sixty is what a printer may have rounded to
    is_invalid = np.isnan(degrees) | (~has_no_minutes & ((degrees % 1 > 0) | (minutes > 60.0)))
    is_invalid |= ~np.isnan(seconds) & ((minutes % 1 > 0) | (seconds > 60.0))
    lead, tail = (parts[part].str.lower() for part in ("lead", "tail"))
    hemisphere = lead.fillna(tail)
    is_negative = parts["sign"].fillna("+").isin(["-", "−"]).to_numpy()
    signs = hemisphere_signs(hemisphere, name, letter_o)
    is_invalid |= (lead.notna() & tail.notna()).to_numpy() | (
        is_negative & (signs > 0) & hemisphere.notna()
    )
    _require_valid_cells(column[is_filled], is_invalid, quantity, _ACCEPTED_FORMS)
    angles_deg = np.full(len(cells), np.nan)
    magnitude = degrees + np.nan_to_num(minutes) / 60.0 + np.nan_to_num(seconds) / 3600.0
    angles_deg[is_filled] = np.where(is_negative, -1.0, signs) * magnitude
    return angles_deg


def degrees_from_form(values: np.ndarray, form: AngleForm) -> np.ndarray:
    """Return degrees [T] from numbers of a form; NaN where the minutes are more than sixty."""
    if form == "number":
        return values
    magnitude = np.abs(values)
    whole_degrees, minutes = np.floor(magnitude / 100.0), magnitude % 100.0
    with np.errstate(invalid="ignore"):
        degrees: np.ndarray = np.where(minutes <= 60.0, np.sign(values), np.nan)
    degrees *= whole_degrees + minutes / 60.0
    return degrees


def hemisphere_signs(
    hemispheres: pd.Series, name: str, letter_o: LetterO | None = None
) -> np.ndarray:
    """Return 1 or -1 [T] for the letters of hemispheres; 1 where there is none."""
    letters = hemispheres.astype("string").str.strip().str.lower()
    letters = letters.mask(letters == "")
    if letter_o is not None and name == "longitude":
        letters = letters.replace("o", letter_o[0])
    allowed = _HEMISPHERES_OF_CHANNEL.get(name, "nsew")
    is_invalid = (letters.notna() & ~letters.isin([*allowed])).to_numpy(dtype=bool)
    if is_invalid.any():
        first_invalid = truncate(str(hemispheres.iloc[int(np.argmax(is_invalid))]), 20)
        hint = (
            "; O is east to some and west to others: set letter_o"
            if first_invalid.upper() == "O"
            else ""
        )
        raise DataError(
            f"'{first_invalid}' is no hemisphere of {name}; {' or '.join(allowed.upper())} was"
            f" expected{hint}"
        )
    return letters.map(_HEMISPHERE_SIGNS).fillna(1.0).to_numpy(dtype=np.float64)


_COUNTER_BITS = (16, 24, 32, 48)
"""Widths of the counters that microcontrollers stamp with."""
_DAY_IN_SECONDS = 86_400.0
"""s"""
_CHECKED_STAMPS = 1000
"""Stamps, evenly spread, of which most clocks have one that is no time of day."""
_MAX_WRAP_STEPS = 3.0
"""Usual steps within which the clock has gone on where its counter began anew."""


def repeats_previous_row(columns: Iterable[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Return [K] bool: at rows [K] every column [T] holds what it holds in the row before."""
    is_same = np.ones(rows.size, dtype=bool)
    for values in columns:
        current, previous = values[rows], values[rows - 1]
        is_same &= (current == previous) | (np.isnan(current) & np.isnan(previous))
    return is_same


def find_unique_rows(t: np.ndarray, columns: Iterable[np.ndarray]) -> np.ndarray:
    """Return [T] bool: rows that do not repeat the one before them, time and all.

    True everywhere where times repeat without that, for then the clock is coarser than the rows.

    Args:
        t: times [T] in s, as recorded.
        columns: what was recorded, [T] each.
    """
    repeated_rows = np.flatnonzero(np.diff(t) == 0.0) + 1
    is_first = np.ones(t.size, dtype=bool)
    is_first[repeated_rows] = ~repeats_previous_row(columns, repeated_rows)
    return is_first if (np.diff(t[is_first]) != 0.0).all() else np.ones_like(is_first)


def _unpack_clock_numbers(t: np.ndarray) -> np.ndarray | None:
    """Return seconds [T] from numbers such as 83059.8 for 8:30:59.8; None where they are others.

    They tell themselves where a minute ends: the number goes on by 40 more than the clock.
    """
    sampled = np.floor(t[:: t.size // _CHECKED_STAMPS | 1])
    if sampled.min() < 0.0 or sampled.max() >= 240_000 or (sampled % 100).max() >= 60:
        return None
    integer_part = np.floor(t)
    hours, minutes, seconds = (
        integer_part // 10_000,
        integer_part // 100 % 100,
        t - integer_part // 100 * 100,
    )
    if t.min() < 0.0 or hours.max() >= 24 or max(minutes.max(), seconds.max()) >= 60.0:
        return None
    seconds_of_day = (60.0 * hours + minutes) * 60.0 + seconds
    seconds_of_day += _DAY_IN_SECONDS * np.cumsum(
        np.diff(seconds_of_day, prepend=seconds_of_day[0]) < -0.5 * _DAY_IN_SECONDS
    )
    step = np.diff(seconds_of_day)
    is_jump = np.diff(t) - step > 1.0
    max_step = _MAX_WRAP_STEPS * float(np.median(step))
    return (
        seconds_of_day
        if is_jump.any() and bool(((step[is_jump] > 0.0) & (step[is_jump] <= max_step)).all())
        else None
    )


def repair_clock(
    t: np.ndarray, columns: Iterable[np.ndarray], clock_resolution: float | None = None
) -> tuple[np.ndarray, list[Remark]]:
    """Return times [T] in s as the clock went on, and what was mended.

    A counter that passes its largest number begins anew at zero: where a step back is one of its
    lengths but for a few usual steps, that length is added from there on; so is the hour that a
    clock on the wall is set back in autumn, and taken off that of spring. Stamps that several rows
    share are those of a clock coarser than the rows: these are spread over the time to the next
    stamp, unless they are copies. Numbers that hold hours, minutes and seconds in one (83059.8 for
    8:30:59.8) are read as such.

    Args:
        t: as recorded; all finite.
        columns: what was recorded, [T] each.
        clock_resolution: s that the counter counts by; None for a clock of dates.
    """
    step = np.diff(t)
    positive_steps = step[step > 0.0]
    if not positive_steps.size:
        return t, []
    median_step, remarks = float(np.median(positive_steps)), list[Remark]()
    if clock_resolution == 1.0 and (unpacked := _unpack_clock_numbers(t)) is not None:
        text = "times are hours, minutes and seconds in one number (83059.8 for 8:30:59.8)"
        t, remarks = unpacked, [make_remark("note", "clock_packed", text)]
        step = np.diff(t)
    wrap_lengths = {"an hour, as in autumn": 3600.0} if clock_resolution is None else {}
    if clock_resolution is not None and (step < 0.0).any():
        wrap_lengths = {
            f"2^{bits} of its ticks": 2.0**bits * clock_resolution for bits in _COUNTER_BITS
        }
    correction = np.zeros_like(t)
    for wrap_description, length in wrap_lengths.items():
        wrapped_step = step + length
        is_wrap = (
            (step < -0.5 * length)
            & (wrapped_step > 0.0)
            & (wrapped_step < _MAX_WRAP_STEPS * median_step)
        )
        if is_wrap.any():
            correction[1:] += length * np.cumsum(is_wrap)
            event_time = float(t[:-1][is_wrap][0])
            text = f"the clock fell back after {event_time:.6g} s by {wrap_description}; it is read as going on"
            remarks.append(make_remark("note", "clock_wraps", text, count=float(is_wrap.sum())))
        is_leap = (step > length) & (step - length < _MAX_WRAP_STEPS * median_step)
        if clock_resolution is None and is_leap.any():
            correction[1:] -= length * np.cumsum(is_leap)
            event_time = float(t[:-1][is_leap][0])
            text = (
                f"the clock leapt an hour after {event_time:.6g} s, as in spring; it is taken off"
            )
            remarks.append(make_remark("note", "clock_leaps", text, count=float(is_leap.sum())))
    t = t + correction
    repeated_rows = np.flatnonzero(np.diff(t) == 0.0) + 1
    if not repeated_rows.size:
        return t, remarks
    stamps, first_rows, counts = np.unique(t, return_index=True, return_counts=True)
    rows_per_stamp = int(np.median(counts))
    if stamps.size < 3 or rows_per_stamp < 2 or (np.diff(t) < 0.0).any():
        return t, remarks
    if repeats_previous_row(columns, repeated_rows).mean() > 0.5:
        return t, remarks
    stamp_step = float(np.median(np.diff(stamps)))
    # a last stamp has none after it; a first one may have begun before the recording did
    stamp_gaps = np.minimum(np.append(np.diff(stamps), stamp_step), 2.0 * stamp_step)
    position_in_stamp = np.arange(t.size) - np.repeat(first_rows, counts)
    rows_in_stamp = np.maximum(counts, rows_per_stamp)
    position_in_stamp[: counts[0]] += rows_in_stamp[0] - counts[0]
    spread_times = t + position_in_stamp * np.repeat(stamp_gaps / rows_in_stamp, counts)
    text = (
        f"about {rows_per_stamp} rows share each time stamp, which come every {stamp_step:.4g} s; they are spread"
        " evenly from one stamp to the next"
    )
    remarks.append(
        make_remark("note", "coarse_stamps", text, rows=float(rows_per_stamp), step=stamp_step)
    )
    return spread_times, remarks
