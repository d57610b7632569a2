"""Clocks that go on though their numbers do not: counters that wrap, stamps of whole seconds,
hours, minutes and seconds in one number.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from residnet.data.readers.recording import Remark, remark

_BITS = (16, 24, 32, 48)
"""Widths of the counters that microcontrollers stamp with."""
_DAY = 86_400.0
"""s"""
_SOME = 1000
"""Stamps, evenly spread, of which most clocks have one that is no time of day."""
_USUAL_STEPS = 3.0
"""Usual steps within which the clock has gone on where its counter began anew."""


def _as_before(columns: Iterable[np.ndarray], at: np.ndarray) -> np.ndarray:
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
    first[again] = ~_as_before(columns, again)
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
    out += _DAY * np.cumsum(np.diff(out, prepend=out[0]) < -0.5 * _DAY)
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
    if tick is not None:
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
    if _as_before(columns, shared).mean() > 0.5:
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
