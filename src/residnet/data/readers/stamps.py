"""Times as sources print them: numbers or dates, with zones, and with damaged fractions.

Fractions of seconds may have lost their leading zeros.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.recording import Remark, remark

_DATE = (
    r"^\s*(?P<date>\d{4}[-/.]\d{1,2}[-/.]\d{1,2})[T"
    r" ]+(?P<clock>\d{1,2}:\d{2}:\d{2})(?:[.,](?P<fraction>\d+))?"
    r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2})?\s*$"
)
_NUMBER = r"^\s*(?P<whole>[-+]?\d+)(?:\.(?P<fraction>\d+))?\s*$"
# Unix time in s, ms, us, ns between 1990 and 2090
_EPOCH_FROM, _EPOCH_TO = 631_152_000, 3_786_912_000
_SCALES = (1, 10**3, 10**6, 10**9)
_NS = 10**9


@dataclass(frozen=True)
class Stamps:
    """The times of a column, parsed.

    Attributes:
        ns: [T] int64, whole ns; Unix time where `absolute`.
        absolute: whether the source gave dates or Unix time.
        zoned: whether the source named its time zone (Unix time is UTC).
        remarks: what was noticed.
        unpadded: whether fractions are whole numbers without their leading zeros.
    """

    ns: np.ndarray
    absolute: bool
    zoned: bool
    remarks: tuple[Remark, ...] = ()
    unpadded: bool = False


def parse_numbers(values: np.ndarray, factor: float | None = None) -> Stamps:
    """Return the times from numbers [T], in units of `factor` seconds.

    None reads Unix time in s, ms, us or ns by its size, and anything smaller as s.

    Raises:
        DataError: where a value is not finite.
    """
    if not np.isfinite(values).all():
        raise DataError(f"{int((~np.isfinite(values)).sum())} rows have no time")
    if factor is None:
        typical = float(np.median(np.abs(values))) if values.size else 0.0
        scale = next((s for s in _SCALES if _EPOCH_FROM * s <= typical <= _EPOCH_TO * s), None)
        if scale is not None:
            whole = values if values.dtype.kind in "iu" else np.floor(values)
            rest = np.rint((values - whole) * (_NS // scale)).astype(np.int64)
            return Stamps(whole.astype(np.int64) * (_NS // scale) + rest, True, True)
        factor = 1.0
    return Stamps(np.rint(values * (factor * _NS)).astype(np.int64), False, False)


def parse_texts(texts: np.ndarray, unpadded: bool | None = None) -> Stamps:
    """Return the times of text [T]: dates with or without a zone, or numbers, in one style.

    A fraction of a second printed as an integer without its leading zeros (`09.70533347` for
    9.070533347 s) is recognised by the whole column: it makes time run backwards where the padded
    reading does not, or no fraction at all starts with a zero. `unpadded` says what an earlier part
    of the column was found to be.

    Raises:
        DataError: naming the first cell that is no time.
    """
    import pandas as pd

    column = pd.Series(texts, dtype="string")
    first = next((str(text) for text in column if not pd.isna(text)), "")
    dated = ":" in first
    parts = column.str.extract(_DATE if dated else _NUMBER)
    bad = np.flatnonzero(parts.iloc[:, 0].isna().to_numpy())
    if bad.size and not dated:
        # exponents: the digits are not the ones that a clock printed
        numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
        if np.isfinite(numbers).all():
            return parse_numbers(numbers)
    if bad.size:
        raise DataError(
            f"'{texts[bad[0]]}' in row {int(bad[0]) + 1} is no time ({bad.size} such cells)"
        )
    whole = _whole(parts, dated)
    fraction, remarks = _fractions(parts["fraction"], whole, unpadded)
    lost_zeros = bool(remarks) or bool(unpadded)
    if not dated:
        fraction = np.where(
            column.str.strip().str.startswith("-").to_numpy(dtype=bool), -fraction, fraction
        )
        scale = next(
            (
                s
                for s in _SCALES
                if whole.size and _EPOCH_FROM * s <= abs(int(np.median(whole))) <= _EPOCH_TO * s
            ),
            None,
        )
        return Stamps(
            whole * (_NS // (scale or 1)) + fraction // (scale or 1),
            scale is not None,
            scale is not None,
            remarks,
            bool(remarks) or bool(unpadded),
        )
    zone = parts["zone"].dropna()
    return Stamps(whole * _NS + fraction, True, len(zone) > 0, remarks, lost_zeros)


def _whole(parts: object, dated: bool) -> np.ndarray:
    """Return the whole seconds (or whole units of a number) [T] int64; dates in UTC."""
    import pandas as pd

    assert isinstance(parts, pd.DataFrame)
    if not dated:
        return parts["whole"].astype("int64").to_numpy()
    # a date and a clock time repeat over many rows: parse each once
    minutes = (parts["date"].str.replace(r"[/.]", "-", regex=True) + " " + parts["clock"]).astype(
        "category"
    )
    moments = pd.to_datetime(
        pd.Series(minutes.cat.categories.astype("str")), format="%Y-%m-%d %H:%M:%S", errors="coerce"
    )
    if moments.isna().any():
        raise DataError(
            f"'{minutes.cat.categories[int(np.flatnonzero(moments.isna())[0])]}' is no date"
        )
    seconds = (moments - pd.Timestamp(0)) // pd.Timedelta(seconds=1)
    whole = seconds.to_numpy(dtype=np.int64)[minutes.cat.codes.to_numpy()]
    zone = parts["zone"].fillna("Z").astype("category")
    offsets = np.array([_zone_seconds(str(text)) for text in zone.cat.categories], dtype=np.int64)
    out: np.ndarray = whole - offsets[zone.cat.codes.to_numpy()]
    return out


def _zone_seconds(zone: str) -> int:
    if zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))


def _fractions(
    column: object, whole: np.ndarray, known: bool | None
) -> tuple[np.ndarray, tuple[Remark, ...]]:
    """Return the fractions of the unit in ns [T] int64."""
    import pandas as pd

    assert isinstance(column, pd.Series)
    digits = column.fillna("0").str.slice(0, 9)
    length = digits.str.len().to_numpy(dtype=np.int64)
    value = digits.astype("int64").to_numpy()
    padded = value * 10 ** (9 - length)
    longest = int(length.max(initial=0))
    if longest not in (3, 6, 9) or (length == longest).all():
        return padded, ()
    if known is False:
        return padded, ()
    unpadded = value * 10 ** (9 - longest)
    back = [int((np.diff(whole * _NS + part) < 0).sum()) for part in (padded, unpadded)]
    zeros = int((digits.str.startswith("0") & (length > 1)).sum())
    # one fraction in ten starts with a zero where zeros are printed
    if known is None and back[1] >= back[0] and (back[0] > 0 or zeros > 0 or whole.size < 100):
        return padded, ()
    unit = {3: "ms", 6: "us", 9: "ns"}[longest]
    changed = int((padded != unpadded).sum())
    text = (
        f"fractions of seconds are whole {unit} without their leading zeros: {changed} of"
        f" {whole.size} times are repaired, taken as printed time runs backwards {back[0]} times"
    )
    return unpadded, (
        remark(
            "note",
            "unpadded_fraction",
            text,
            repaired=changed,
            backwards_as_printed=back[0],
            backwards_repaired=back[1],
        ),
    )
