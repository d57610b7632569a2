"""Times and angles as people, programs and recorders write them, and clocks that wrap or round."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import shown
from residnet.data.readers.recording import Remark, Stamps, remark

if TYPE_CHECKING:
    import pandas as pd


Order = Literal["dmy", "mdy", "ymd"]
"""Order of day, month and year."""

_NS = 10**9
_DAY = 86_400 * _NS
# Unix time of 1990 and 2090, s
_EPOCH_FROM, _EPOCH_TO = 631_152_000, 3_786_912_000
_UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
_MONTHS = (
    "jan ene gen|feb fév fev|mar mär mrz maa mrt|apr avr abr|may mai mei maj|jun jui|jul"
    "|aug aoû aou ago|sep set|oct okt out|nov|dec dez déc dic des"
)
_MONTH_OF = {word: n for n, words in enumerate(_MONTHS.split("|"), 1) for word in words.split()}
_PARTS = (
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
_FORM = (
    rf"^\s*(?:{_DATE}(?:[T ,_;]+|$))?(?:{_CLOCK})?\s*(?P<zone>Z|UTC|GMT|[+-]\d{{2}}:?\d{{2}})?\s*$"
)
# the second and its fraction of h:mm:ss, and what stands before and after them
_SECOND = (
    r"^(?P<before>(?:.*[\d日][T ,_;]+)?\d\d?:\d\d?):(?P<second>\d\d?)(?:[.,:](?P<fraction>\d+))?"
    r"(?P<after>\s*(?:[^\s\d.,:分秒'].*)?)$"
)
# minutes and seconds alone, as Excel exports a time
_MINUTES = re.compile(r"^\s*(\d{1,2}:\d\d[.,]\d+)\s*$")
_NUMBER = r"^\s*(?P<whole>[-+]?\d+)(?:\.(?P<fraction>\d+))?\s*$"
Form = Literal["number", "ddmm"]
"""How a number stands for an angle: as degrees, or as degrees and minutes in one."""
LetterO = Literal["east", "west"]
"""What O stands for: Ost and Oost, or Oeste, Ouest and Ovest."""
_DECIMAL = r"\d+(?:[.,]\d+)?"
_ANGLE = (
    r"^\s*(?P<lead>[NSEWOnsewo])?\s*(?P<sign>[-+−])?\s*"
    rf"(?P<degrees>{_DECIMAL})\s*(?:°|º|˚|deg\.?|d)?"
    rf"(?:(?:(?<=[°º˚d.g])\s*|\s+|\s*[:\-]\s*)(?P<minutes>{_DECIMAL})\s*(?:''|['′’´:m]|min\.?)?"
    rf"(?:(?:(?<=['′’´:mn.])\s*|\s+)(?P<seconds>{_DECIMAL})\s*(?:\"|″|”|''|′′|’’|sec\.?)?)?)?"
    r"[\s,]*(?P<tail>[NSEWOnsewo])?\s*$"
)
_SIDES = {"n": 1.0, "e": 1.0, "s": -1.0, "w": -1.0}
_OF = {"latitude": "ns", "longitude": "ew"}
_READ = (
    "; forms that are read are 59.90535, 59°54.321'N, 59 54 19.3 N and, with `form: ddmm`, 5954.321"
)


def zone_of(name: str) -> ZoneInfo:
    """Return a time zone by its name, for example `Europe/Berlin`."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(
            f"no time zone is called '{name}'; names are such as 'Europe/Berlin' or 'UTC'"
        ) from error


def parse_numbers(values: np.ndarray, factor: float | None = None) -> Stamps:
    """Return the times from numbers [T], in units of `factor` seconds.

    None reads Unix time in s, ms, us or ns by its size, and anything smaller as s.
    """
    if not np.isfinite(values).all():
        raise DataError(f"{int((~np.isfinite(values)).sum())} rows have no time")
    unit = unix_unit(values) if factor is None else None
    if unit is None:
        ns = np.rint(values * ((factor or 1.0) * _NS)).astype(np.int64)
        seconds = factor in (None, 1.0) and values.dtype.kind == "f"
        return Stamps(ns, False, seconds=values.astype(np.float64) if seconds else None)
    scale = _UNITS[unit]
    whole = values if values.dtype.kind in "iu" else np.floor(values)
    rest = np.rint((values - whole) * (_NS // scale)).astype(np.int64)
    return Stamps(whole.astype(np.int64) * (_NS // scale) + rest, True)


def unix_unit(values: np.ndarray) -> str | None:
    """Return the unit in which numbers [T] are Unix time between 1990 and 2090; None for others."""
    size = abs(float(np.median(values))) if values.size else 0.0
    units = (unit for unit, one in _UNITS.items() if _EPOCH_FROM <= size / one <= _EPOCH_TO)
    return next(units, None)


def unit_of_steps(step: float) -> str:
    """Return the unit of times that go on by such a step; no recorder waits longer than 5 s."""
    longest = (("s", 5.0), ("ms", 5e3), ("us", 5e6))
    return next((unit for unit, most in longest if step <= most), "ns")


_PIECE = 250_000
"""Rows of text that are taken apart at a time: what lies between would be 1 GB of 3 million."""


def _parts(cells: pd.Series) -> pd.DataFrame:
    """Return the parts of dates and times; equal texts are one object in memory."""
    import pandas as pd

    minutes = _MINUTES.fullmatch(str(next(iter(cells), ""))) is not None
    pieces = [cells.iloc[k : k + _PIECE] for k in range(0, max(len(cells), 1), _PIECE)]
    found = [_parts_of_piece(piece, minutes=minutes) for piece in pieces]
    return found[0] if len(found) == 1 else pd.concat(found)


def _parts_of_piece(cells: pd.Series, *, minutes: bool) -> pd.DataFrame:
    """Return the parts of dates and times; with `minutes` times begin with minutes."""
    import pandas as pd
    import pyarrow as pa
    from pyarrow import compute

    if minutes:
        cells = cells.str.replace(_MINUTES, r"0:\1", regex=True)
    form, texts = re.compile(_FORM), pa.array(cells.tolist(), pa.string())
    before, *seconds, after = compute.extract_regex(texts, _SECOND).flatten()
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


def looks_dated(texts: pd.Series) -> bool:
    """Return whether the cells are dates or times of day."""
    filled = texts.dropna().astype("string")
    parts = _parts(filled)
    return len(filled) > 0 and bool((parts["hour"].notna() | parts["date"].notna()).all())


def date_order(texts: pd.Series) -> Order | None:
    """Return the order of day, month and year in dates; None where it cannot be told."""
    return _order_of(_parts(texts.dropna().astype("string")))


def _order_of(cells: pd.DataFrame) -> Order | None:
    parts = cells["date"].drop_duplicates().str.extract(_PARTS)
    first, second = parts["a"].dropna(), parts["b"].dropna()
    if first.empty or (first.str.len() == 4).any():
        return "ymd" if len(first) else None
    if not second.str.isdigit().all() or (parts["mark"] == ".").any():
        return "dmy"
    if (first.astype(int) > 12).any():
        return "dmy"
    if (second.astype(int) > 12).any() or cells["half"].notna().any():
        return "mdy"
    return None


def parse_texts(
    texts: pd.Series | np.ndarray,
    *,
    zone: str | None = None,
    order: Order | None = None,
    dates: bool = False,
    unit: str = "s",
) -> Stamps:
    """Return the times of text [T]: dates and times of day in most forms, or numbers.

    A fraction of a second printed as an integer without its leading zeros (`09.70533347` for
    9.070533347 s) is recognised by the whole column. Times of day count on past midnight.

    Args:
        texts: in one style.
        zone: time zone of dates that name none; None takes them as UTC.
        order: of day, month and year; None takes it from the cells.
        dates: none are numbers, and some cells may be empty.
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
    column, known = _filled(written)
    cells = (column if known.all() else column[known]) if dates else column.fillna("")
    if not len(cells):
        return Stamps(np.zeros(len(column), dtype=np.int64), False, known)
    if not dates:
        return _dated(cells, zone, order) if ":" in cells.iloc[0] else _digits(cells, unit)
    stamps = _dated(cells, zone, order)
    ns = np.full(len(column), stamps.ns[0])
    ns[known] = stamps.ns
    return Stamps(ns, stamps.absolute, known, stamps.remarks)


def _filled(cells: pd.Series) -> tuple[pd.Series, np.ndarray]:
    """Return the cells without blanks around them, and [T] which of them are not empty."""
    column = cells.astype("string").str.strip()
    return column, (column.notna() & (column != "")).to_numpy(dtype=bool)


def _require(cells: pd.Series, bad: np.ndarray, what: str, do: str = "") -> None:
    if bad.any():
        at = int(np.argmax(bad))
        raise DataError(
            f"'{shown(str(cells.iloc[at]))}' in row {int(cells.index[at]) + 1} is no {what}"
            f" ({int(bad.sum())} such cells){do}"
        )


def _digits(cells: pd.Series, counted: str) -> Stamps:
    """Return the times of numbers as a clock printed them, to the last digit."""
    import pandas as pd

    parts = cells.str.extract(_NUMBER)
    bad = parts["whole"].isna().to_numpy()
    if bad.any():
        # exponents: the digits are not the ones that a clock printed
        numbers = pd.to_numeric(cells, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
        _require(cells, ~np.isfinite(numbers), "time")
        return parse_numbers(numbers, None if unix_unit(numbers) else 1.0 / _UNITS[counted])
    whole = parts["whole"].astype("int64").to_numpy()
    fraction, remarks = _fractions(parts["fraction"], whole)
    fraction = np.where(cells.str.startswith("-").to_numpy(dtype=bool), -fraction, fraction)
    unit = unix_unit(whole)
    scale = _UNITS[unit or counted]
    ns = whole * (_NS // scale) + fraction // scale
    return Stamps(ns, unit is not None, None, remarks)


def _dated(cells: pd.Series, zone: str | None, order: Order | None) -> Stamps:
    parts = _parts(cells)
    dated = bool(parts["date"].notna().all())
    _require(cells, (parts["date" if dated else "hour"].isna()).to_numpy(), "date or time")
    # each part is let go where its number is made
    hour, minute, second = (
        convert_per_text(parts.pop(name).fillna("0"), int) for name in ("hour", "minute", "second")
    )
    if parts["half"].notna().any():
        half = parts["half"].fillna("").str.lower().str.slice(0, 1)
        hour = np.where(half == "p", hour % 12 + 12, np.where(half == "a", hour % 12, hour))
    whole = (hour * 60 + minute) * 60 + second
    whole += (
        _days(cells, parts["date"], order or _order_of(parts) or "dmy") * 86_400 if dated else 0
    )
    fraction, remarks = _fractions(parts.pop("fraction"), whole)
    ns = whole * _NS + fraction
    if dated:
        return Stamps(_in_utc(ns, parts["zone"], zone), True, None, remarks)
    nights = np.cumsum(np.diff(ns, prepend=ns[0]) < -_DAY // 2)
    if nights[-1]:
        text = f"the times of day run past midnight {nights[-1]} times; the days are counted"
        remarks = (*remarks, remark("note", "past_midnight", text, nights=int(nights[-1])))
    return Stamps(ns + nights * _DAY, False, None, remarks)


def convert_per_text(column: pd.Series, function: Callable[[str], int]) -> np.ndarray:
    """Return an integer [T] of each text; one that repeats over many rows is made once."""
    texts = column.astype("category")
    made = np.array([function(str(text)) for text in texts.cat.categories], dtype=np.int64)
    out: np.ndarray = made[texts.cat.codes.to_numpy()]
    return out


def _days(cells: pd.Series, dates: pd.Series, order: Order) -> np.ndarray:
    """Return the days [T] since 1970; a day repeats over many rows, and is made a date once."""
    import pandas as pd

    days = dates.astype("category")
    parts = pd.Series(days.cat.categories, dtype="string").str.extract(_PARTS)
    packed = parts["packed"]
    year, month, day = (
        parts[name].where(packed.isna(), packed.str.slice(*span))
        for name, span in zip(
            {"ymd": "abc", "dmy": "cba", "mdy": "cab"}[order], ((0, 4), (4, 6), (6, 8)), strict=True
        )
    )
    named = month.str.lower().str.slice(0, 3).map(_MONTH_OF).astype("Int64").astype("string")
    month = month.where(month.str.isdigit(), named)
    year = year.where(year.str.len() != 2, "20" + year)
    text = year + "-" + month + "-" + day
    moments = pd.to_datetime(text.astype("object"), format="%Y-%m-%d", errors="coerce")
    row = days.cat.codes.to_numpy()
    wrong = moments.isna().to_numpy()[row]
    _require(cells, wrong, f"date with {order}; give the `order`" if wrong.any() else "")
    out: np.ndarray = ((moments - pd.Timestamp(0)) // pd.Timedelta(days=1)).to_numpy("int64")[row]
    return out


def _in_utc(ns: np.ndarray, zones: pd.Series, zone: str | None) -> np.ndarray:
    """Return Unix time [T] in ns from local time."""
    import pandas as pd

    written = zones.fillna("").astype("category")
    if (written != "").any():
        shift = np.array([_ahead(str(text)) for text in written.cat.categories])
        moved: np.ndarray = ns - shift[written.cat.codes.to_numpy()] * _NS
        return moved
    if zone is None:
        return ns
    local = pd.DatetimeIndex(ns.astype("datetime64[ns]"))
    # an hour comes twice in autumn: time rises, and does so without a leap where it can
    first = local.tz_localize(zone, ambiguous=np.ones(ns.size, dtype=bool))
    second = local.tz_localize(zone, ambiguous=np.zeros(ns.size, dtype=bool))
    early, late = (index.as_unit("ns").asi8 for index in (first, second))
    back = np.append(False, np.diff(early) < 0)
    both = np.where(np.logical_or.accumulate(back), late, early)
    rising = [reading for reading in (early, late, both) if (np.diff(reading) >= 0).all()]
    out: np.ndarray = min(rising or [early], key=lambda reading: reading[-1] - reading[0])
    return out


def _ahead(zone: str) -> int:
    """Return the seconds by which a written zone is ahead of UTC."""
    if not zone or zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))


def _fractions(column: pd.Series, whole: np.ndarray) -> tuple[np.ndarray, tuple[Remark, ...]]:
    """Return the fractions of the unit in ns [T] int64, mended where they lost leading zeros."""
    digits = column.fillna("0").str.slice(0, 9)
    length, value = convert_per_text(digits, len), convert_per_text(digits, int)
    padded = value * 10 ** (9 - length)
    longest = int(length.max(initial=0))
    if longest not in (3, 6, 9) or (length == longest).all():
        return padded, ()
    unpadded = value * 10 ** (9 - longest)
    back = [int((np.diff(whole * _NS + part) < 0).sum()) for part in (padded, unpadded)]
    zeros = int((digits.str.startswith("0") & (length > 1)).sum())
    # one fraction in ten starts with a zero where zeros are printed
    if back[1] > back[0] or (back[1] == back[0] and (back[0] > 0 or zeros > 0 or whole.size < 100)):
        return padded, ()
    unit = {3: "ms", 6: "us", 9: "ns"}[longest]
    changed = int((padded != unpadded).sum())
    if not changed:
        return padded, ()
    text = (
        f"fractions of seconds are whole {unit} without their leading zeros: {changed} of"
        f" {whole.size} times are repaired, taken as printed time runs backwards {back[0]} times"
    )
    figures = {"backwards_as_printed": back[0], "backwards_repaired": back[1]}
    found = remark("note", "unpadded_fraction", text, repaired=changed, **figures)
    return unpadded, (found,)


def degrees_of(
    cells: pd.Series, name: str, form: Form = "number", letter_o: LetterO | None = None
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

    what = name if name in _OF else "angle"
    if pd.api.types.is_numeric_dtype(cells):
        values = cells.to_numpy(dtype=np.float64, na_value=np.nan)
        angles = from_form(values, form)
        _require(cells, np.isnan(angles) & ~np.isnan(values), what, _READ)
        return angles
    column, known = _filled(cells)
    parts = column[known].str.extract(_ANGLE)
    degrees, minutes, seconds = (
        pd.to_numeric(parts[part].str.replace(",", "."), errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        for part in ("degrees", "minutes", "seconds")
    )
    alone = np.isnan(minutes)
    degrees = np.where(alone, from_form(degrees, form), degrees)
    # a fraction has nothing below it; sixty is what a printer may have rounded to
    wrong = np.isnan(degrees) | (~alone & ((degrees % 1 > 0) | (minutes > 60.0)))
    wrong |= ~np.isnan(seconds) & ((minutes % 1 > 0) | (seconds > 60.0))
    lead, tail = (parts[part].str.lower() for part in ("lead", "tail"))
    side = lead.fillna(tail)
    turned = parts["sign"].fillna("+").isin(["-", "−"]).to_numpy()
    signs = side_signs(side, name, letter_o)
    wrong |= (lead.notna() & tail.notna()).to_numpy() | (turned & (signs > 0) & side.notna())
    _require(column[known], wrong, what, _READ)
    out = np.full(len(cells), np.nan)
    size = degrees + np.nan_to_num(minutes) / 60.0 + np.nan_to_num(seconds) / 3600.0
    out[known] = np.where(turned, -1.0, signs) * size
    return out


def from_form(values: np.ndarray, form: Form) -> np.ndarray:
    """Return degrees [T] from numbers of a form; NaN where the minutes are more than sixty."""
    if form == "number":
        return values
    size = np.abs(values)
    whole, minutes = np.floor(size / 100.0), size % 100.0
    with np.errstate(invalid="ignore"):
        out: np.ndarray = np.where(minutes <= 60.0, np.sign(values), np.nan)
    out *= whole + minutes / 60.0
    return out


def side_signs(sides: pd.Series, name: str, letter_o: LetterO | None = None) -> np.ndarray:
    """Return 1 or -1 [T] for the letters of hemispheres; 1 where there is none."""
    letters = sides.astype("string").str.strip().str.lower()
    letters = letters.mask(letters == "")
    if letter_o is not None and name == "longitude":
        letters = letters.replace("o", letter_o[0])
    allowed = _OF.get(name, "nsew")
    wrong = (letters.notna() & ~letters.isin([*allowed])).to_numpy(dtype=bool)
    if wrong.any():
        first = shown(str(sides.iloc[int(np.argmax(wrong))]), 20)
        either = (
            "; O is east to some and west to others: set letter_o" if first.upper() == "O" else ""
        )
        raise DataError(
            f"'{first}' is no hemisphere of {name}; {' or '.join(allowed.upper())} was"
            f" expected{either}"
        )
    return letters.map(_SIDES).fillna(1.0).to_numpy(dtype=np.float64)


_BITS = (16, 24, 32, 48)
"""Widths of the counters that microcontrollers stamp with."""
_DAY_IN_SECONDS = 86_400.0
"""s"""
_SOME = 1000
"""Stamps, evenly spread, of which most clocks have one that is no time of day."""
_USUAL_STEPS = 3.0
"""Usual steps within which the clock has gone on where its counter began anew."""


def as_before(columns: Iterable[np.ndarray], at: np.ndarray) -> np.ndarray:
    """Return [K] bool: at rows [K] every column [T] holds what it holds in the row before."""
    same = np.ones(at.size, dtype=bool)
    for values in columns:
        here, before = values[at], values[at - 1]
        same &= (here == before) | (np.isnan(here) & np.isnan(before))
    return same


def first_of_copies(t: np.ndarray, columns: Iterable[np.ndarray]) -> np.ndarray:
    """Return [T] bool: rows that do not repeat the one before them, time and all.

    True everywhere where times repeat without that, for then the clock is coarser than the rows.

    Args:
        t: times [T] in s, as recorded.
        columns: what was recorded, [T] each.
    """
    again = np.flatnonzero(np.diff(t) == 0.0) + 1
    first = np.ones(t.size, dtype=bool)
    first[again] = ~as_before(columns, again)
    return first if (np.diff(t[first]) != 0.0).all() else np.ones_like(first)


def _unpacked(t: np.ndarray) -> np.ndarray | None:
    """Return seconds [T] from numbers such as 83059.8 for 8:30:59.8; None where they are others.

    They tell themselves where a minute ends: the number goes on by 40 more than the clock.
    """
    some = np.floor(t[:: t.size // _SOME | 1])
    if some.min() < 0.0 or some.max() >= 240_000 or (some % 100).max() >= 60:
        return None
    whole = np.floor(t)
    hours, minutes, seconds = whole // 10_000, whole // 100 % 100, t - whole // 100 * 100
    if t.min() < 0.0 or hours.max() >= 24 or max(minutes.max(), seconds.max()) >= 60.0:
        return None
    out = (60.0 * hours + minutes) * 60.0 + seconds
    out += _DAY_IN_SECONDS * np.cumsum(np.diff(out, prepend=out[0]) < -0.5 * _DAY_IN_SECONDS)
    step = np.diff(out)
    jumps = np.diff(t) - step > 1.0
    usual = _USUAL_STEPS * float(np.median(step))
    return (
        out if jumps.any() and bool(((step[jumps] > 0.0) & (step[jumps] <= usual)).all()) else None
    )


def steady_clock(
    t: np.ndarray, columns: Iterable[np.ndarray], tick: float | None = None
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
        tick: s that the counter counts by; None for a clock of dates.
    """
    step = np.diff(t)
    forward = step[step > 0.0]
    if not forward.size:
        return t, []
    usual, remarks = float(np.median(forward)), list[Remark]()
    if tick == 1.0 and (packed := _unpacked(t)) is not None:
        text = "times are hours, minutes and seconds in one number (83059.8 for 8:30:59.8)"
        t, remarks = packed, [remark("note", "clock_packed", text)]
        step = np.diff(t)
    lengths = {"an hour, as in autumn": 3600.0} if tick is None else {}
    if tick is not None and (step < 0.0).any():
        lengths = {f"2^{bits} of its ticks": 2.0**bits * tick for bits in _BITS}
    added = np.zeros_like(t)
    for what, length in lengths.items():
        on = step + length
        began = (step < -0.5 * length) & (on > 0.0) & (on < _USUAL_STEPS * usual)
        if began.any():
            added[1:] += length * np.cumsum(began)
            first = float(t[:-1][began][0])
            text = f"the clock fell back after {first:.6g} s by {what}; it is read as going on"
            remarks.append(remark("note", "clock_wraps", text, count=float(began.sum())))
        ahead = (step > length) & (step - length < _USUAL_STEPS * usual)
        if tick is None and ahead.any():
            added[1:] -= length * np.cumsum(ahead)
            first = float(t[:-1][ahead][0])
            text = f"the clock leapt an hour after {first:.6g} s, as in spring; it is taken off"
            remarks.append(remark("note", "clock_leaps", text, count=float(ahead.sum())))
    t = t + added
    shared = np.flatnonzero(np.diff(t) == 0.0) + 1
    if not shared.size:
        return t, remarks
    stamps, begins, counts = np.unique(t, return_index=True, return_counts=True)
    each = int(np.median(counts))
    if stamps.size < 3 or each < 2 or (np.diff(t) < 0.0).any():
        return t, remarks
    if as_before(columns, shared).mean() > 0.5:
        return t, remarks
    coarse = float(np.median(np.diff(stamps)))
    # a last stamp has none after it; a first one may have begun before the recording did
    gap = np.minimum(np.append(np.diff(stamps), coarse), 2.0 * coarse)
    share = np.arange(t.size) - np.repeat(begins, counts)
    whole = np.maximum(counts, each)
    share[: counts[0]] += whole[0] - counts[0]
    spread = t + share * np.repeat(gap / whole, counts)
    text = (
        f"about {each} rows share each time stamp, which come every {coarse:.4g} s; they are spread"
        " evenly from one stamp to the next"
    )
    remarks.append(remark("note", "coarse_stamps", text, rows=float(each), step=coarse))
    return spread, remarks
