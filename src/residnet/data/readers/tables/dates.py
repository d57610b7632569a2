"""Times of a table that are dates or times of day, in the forms that people and programs write."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import shown
from residnet.data.readers.recording import Remark, remark

if TYPE_CHECKING:
    import pandas as pd

Order = Literal["dmy", "mdy", "ymd"]
"""Order of day, month and year."""

_DAY = 86_400
_NS = 1_000_000_000
_MONTHS = {
    word: number
    for number, words in enumerate(
        (
            "jan ene gen",
            "feb fév fev",
            "mar mär mrz maa mrt",
            "apr avr abr",
            "may mai mei maj",
            "jun jui",
            "jul",
            "aug aoû aou ago",
            "sep set",
            "oct okt out",
            "nov",
            "dec dez déc dic des",
        ),
        1,
    )
    for word in words.split()
}
_DATE = (
    r"(?:(?P<a>\d{1,4})\s*(?P<mark>[-./年])\s*(?P<b>\d{1,2}|[^\W\d_]{3,9}\.?)\s*[-./月]\s*"
    r"(?P<c>\d{1,4})日?|(?P<packed>\d{8}))"
)
_CLOCK = (
    r"(?P<hour>\d{1,2})\s*[:h時]\s*(?P<minute>\d{1,2})\s*"
    r"(?:[:分']\s*(?P<second>\d{1,2})(?:[.,:](?P<fraction>\d+))?秒?)?\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
)
_ZONE = r"(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2})?"
_FORM = rf"^\s*(?:{_DATE}(?:[T ,_;]+|$))?(?:{_CLOCK})?\s*{_ZONE}\s*$"


def zone_of(name: str) -> ZoneInfo:
    """Return a time zone by its name, for example `Europe/Berlin`.

    Raises:
        ValueError: where there is none of this name.
    """
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(
            f"no time zone is called '{name}'; names are such as 'Europe/Berlin' or 'UTC'"
        ) from error


def date_order(texts: pd.Series) -> Order | None:
    """Return the order of day, month and year in dates; None where it cannot be told."""
    parts = texts.dropna().astype("string").str.extract(_FORM)
    first = parts["a"].dropna()
    if first.empty or (first.str.len() == 4).any():
        return "ymd" if len(first) else None
    if not parts["b"].dropna().str.isdigit().all() or (parts["mark"] == ".").any():
        return "dmy"
    if (first.astype(int) > 12).any():
        return "dmy"
    if (parts["b"].dropna().astype(int) > 12).any() or parts["half"].notna().any():
        return "mdy"
    return None


def looks_dated(texts: pd.Series) -> bool:
    """Return whether the cells are dates or times of day."""
    filled = texts.dropna().astype("string")
    if filled.empty:
        return False
    parts = filled.str.extract(_FORM)
    return bool((parts["hour"].notna() | parts["a"].notna()).all())


@final
class DateClock:
    """Seconds since the first row of a table, from its dates or times of day, piece by piece.

    Args:
        zone: time zone of dates that name none; None leaves them without one.
        order: of day, month and year; None takes it from the cells.
    """

    def __init__(self, zone: str | None, order: Order | None) -> None:
        self._zone = None if zone is None else zone_of(zone)
        self._order = order
        self._start: int | None = None
        self._last: int | None = None
        self._dated = False
        self._midnights = 0

    def seconds(self, texts: pd.Series, days: pd.Series | None) -> np.ndarray:
        """Return the times [T] in s of one piece of the table, NaN where a cell is empty.

        Args:
            texts: dates with times, or times of day.
            days: dates, where `texts` are times of day beside a column of dates.

        Raises:
            DataError: naming the first cell that is no time.
        """
        column = texts.astype("string").str.strip()
        if days is not None:
            column = days.astype("string").str.strip() + " " + column
        known = (column.notna() & (column != "")).to_numpy()
        out = np.full(len(column), np.nan)
        if not known.any():
            return out
        parts = column[known].str.extract(_FORM)
        bad = ~(parts["hour"].notna() | parts["a"].notna() | parts["packed"].notna()).to_numpy()
        if bad.any():
            raise DataError(
                f"'{shown(column[known].iloc[int(np.argmax(bad))])}' is no date or time"
            )
        self._order = self._order or date_order(column[known]) or "dmy"
        dated = bool((parts["a"].notna() | parts["packed"].notna()).all())
        ns = self._clock(parts) + (self._days(parts, column[known]) if dated else 0)
        self._dated |= dated
        ns = self._in_utc(ns, parts["zone"]) if dated else self._past_midnight(ns)
        if self._start is None:
            self._start = int(ns[0])
        out[known] = (ns - self._start) * 1e-9
        return out

    @property
    def epoch_ns(self) -> int | None:
        """Unix time of the first row in ns; None where the table holds no dates."""
        return self._start if self._dated else None

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """What was noticed: times of day that ran past midnight."""
        if not self._midnights:
            return ()
        text = f"the times of day run past midnight {self._midnights} times; the days are counted"
        return (remark("note", "past_midnight", text, nights=self._midnights),)

    def _clock(self, parts: pd.DataFrame) -> np.ndarray:
        """Return the time of day [T] in ns."""
        hour, minute, second = (
            parts[name].fillna("0").astype("int64").to_numpy()
            for name in ("hour", "minute", "second")
        )
        half = parts["half"].fillna("").str.lower().str.slice(0, 1)
        hour = np.where(half == "p", hour % 12 + 12, np.where(half == "a", hour % 12, hour))
        digits = parts["fraction"].fillna("0").str.slice(0, 9)
        length = digits.str.len().to_numpy(dtype=np.int64)
        fraction = digits.astype("int64").to_numpy() * 10 ** (9 - length)
        out: np.ndarray = ((hour * 60 + minute) * 60 + second) * _NS + fraction
        return out

    def _days(self, parts: pd.DataFrame, cells: pd.Series) -> np.ndarray:
        """Return the days [T] since 1970 in ns."""
        import pandas as pd

        packed = parts["packed"]
        names = {"ymd": "abc", "dmy": "cba", "mdy": "cab"}[self._order or "dmy"]
        year, month, day = (parts[name].astype("string") for name in names)
        year, month, day = (
            part.where(packed.isna(), packed.str.slice(*span))
            for part, span in ((year, (0, 4)), (month, (4, 6)), (day, (6, 8)))
        )
        word = ~month.str.isdigit().fillna(False)
        named = month.str.lower().str.slice(0, 3).map(_MONTHS).astype("Int64")
        numbers = pd.to_numeric(month.where(~word), errors="coerce").astype("Int64")
        year = year.where(year.str.len() != 2, "20" + year)
        table = pd.DataFrame({"year": year, "month": numbers.fillna(named), "day": day})
        # a day repeats over many rows: each is made a date once
        key = table.astype("string").agg("-".join, axis=1).astype("category")
        moments = pd.to_datetime(
            pd.Series(key.cat.categories.astype("str")), format="%Y-%m-%d", errors="coerce"
        )
        if moments.isna().any():
            at = int(np.flatnonzero(moments.isna().to_numpy()[key.cat.codes.to_numpy()])[0])
            raise DataError(
                f"'{shown(cells.iloc[at])}' is no date with {self._order}; give the `order`"
            )
        days = ((moments - pd.Timestamp(0)) // pd.Timedelta(days=1)).to_numpy(dtype=np.int64)
        out: np.ndarray = days[key.cat.codes.to_numpy()] * (_DAY * _NS)
        return out

    def _in_utc(self, ns: np.ndarray, zones: pd.Series) -> np.ndarray:
        """Return Unix time [T] in ns from local time."""
        import pandas as pd

        written = zones.fillna("").astype("category")
        if (written != "").any():
            shift = np.array([_offset(str(text)) for text in written.cat.categories])
            moved: np.ndarray = ns - shift[written.cat.codes.to_numpy()]
            return moved
        if self._zone is None:
            return ns
        local = pd.DatetimeIndex(ns.astype("datetime64[ns]"))
        # an hour comes twice in autumn: time rises, and does so without a leap where it can
        first = local.tz_localize(self._zone, ambiguous=np.ones(ns.size, dtype=bool))
        second = local.tz_localize(self._zone, ambiguous=np.zeros(ns.size, dtype=bool))
        early, late = (index.as_unit("ns").asi8 for index in (first, second))
        back = np.append(False, np.diff(early) < 0)
        both = np.where(np.logical_or.accumulate(back), late, early)
        rising = [reading for reading in (early, late, both) if (np.diff(reading) >= 0).all()]
        out: np.ndarray = min(rising or [early], key=lambda reading: reading[-1] - reading[0])
        return out

    def _past_midnight(self, ns: np.ndarray) -> np.ndarray:
        """Return times of day [T] in ns that go on rising past midnight."""
        before = np.append(ns[0] if self._last is None else self._last, ns[:-1])
        nights = np.cumsum(ns < before - _DAY * _NS // 2)
        self._last = int(ns[-1])
        out: np.ndarray = ns + (nights + self._midnights) * _DAY * _NS
        self._midnights += int(nights[-1])
        return out


def _offset(zone: str) -> int:
    """Return the time in ns by which a written zone is ahead of UTC."""
    if not zone or zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (3600 * int(digits[:2]) + 60 * int(digits[2:])) * _NS
