"""Repair of recorded clocks: counter overflow, daylight saving time, coarse stamps, copied rows."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from residnet.core.log import Remark, make_remark

_COUNTER_BITS = (16, 24, 32, 48)
"""Widths of the counters that microcontrollers use as clocks."""
_DAY_IN_SECONDS = 86_400.0
"""Length of a day; a clock of the day falls by this amount at midnight."""
_N_SAMPLED_STAMPS = 1000
"""Evenly spaced stamps that are tested first; most other clocks fail on one of them."""
_SIGNIFICANT_DIGITS = (2, 3, 4, 5, 6, 7)
"""Numbers of significant digits with which a clock may be printed."""
_MIN_PRINTED_ROWS = 50
"""Fewest rows from which the interval between rows is estimated."""
_MAX_PRINTED_SPREAD = 1.1
"""Largest spread of the differences from evenly spaced rows, in units of the last digit; rounding
and truncation both give 1."""
_MAX_WRAP_STEPS = 3.0
"""Longest step across a counter overflow, in median steps."""


def repeats_previous_row(columns: Iterable[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Return whether every column repeats its previous value, bool [K].

    Args:
        columns: values [T] each; NaN equals NaN.
        rows: indices [K] of the rows to compare with the rows before them.
    """
    is_same = np.ones(rows.size, dtype=bool)
    for values in columns:
        current = values[rows]
        previous = values[rows - 1]
        is_same &= (current == previous) | (np.isnan(current) & np.isnan(previous))
    return is_same


def find_unique_rows(t: np.ndarray, columns: Iterable[np.ndarray]) -> np.ndarray:
    """Return which rows are no copy of the previous row, bool [T].

    If times still repeat without the copies, the clock is coarser than the rows, and all rows count
    as unique.

    Args:
        t: times [T] in s, as recorded.
        columns: recorded values, [T] each.
    """
    repeated_rows = np.flatnonzero(np.diff(t) == 0.0) + 1
    is_first = np.ones(t.size, dtype=bool)
    is_first[repeated_rows] = ~repeats_previous_row(columns, repeated_rows)
    return is_first if (np.diff(t[is_first]) != 0.0).all() else np.ones_like(is_first)


def _unpack_clock_numbers(t: np.ndarray) -> np.ndarray | None:
    """Convert numbers of the form hhmmss (83059.8 for 8:30:59.8) to seconds [T]; None for others.

    At each full minute such a number jumps by 40 more than the clock, which identifies it.
    """
    # most other clocks are rejected from a few stamps
    sampled = np.floor(t[:: t.size // _N_SAMPLED_STAMPS | 1])
    if sampled.min() < 0.0 or sampled.max() >= 240_000 or (sampled % 100).max() >= 60:
        return None
    integer_part = np.floor(t)
    hours = integer_part // 10_000
    minutes = integer_part // 100 % 100
    seconds = t - integer_part // 100 * 100
    if t.min() < 0.0 or hours.max() >= 24 or max(minutes.max(), seconds.max()) >= 60.0:
        return None
    seconds_of_day = (60.0 * hours + minutes) * 60.0 + seconds
    # days after midnight
    is_midnight = np.diff(seconds_of_day, prepend=seconds_of_day[0]) < -0.5 * _DAY_IN_SECONDS
    seconds_of_day += _DAY_IN_SECONDS * np.cumsum(is_midnight)
    step = np.diff(seconds_of_day)
    is_jump = np.diff(t) - step > 1.0
    max_step = _MAX_WRAP_STEPS * float(np.median(step))
    jumps_are_regular = bool(((step[is_jump] > 0.0) & (step[is_jump] <= max_step)).all())
    return seconds_of_day if is_jump.any() and jumps_are_regular else None


def _restore_printed_clock(t: np.ndarray) -> tuple[np.ndarray, int, float] | None:
    """Restore the clock of evenly spaced rows that was printed with few significant digits.

    A time of 123.7 s that is printed with three digits reads 124. The last digit is therefore worth
    more at later times. Rows are evenly spaced if all times differ from a straight line over the
    row number by less than their last digit.

    Args:
        t: printed times [T] in s, not decreasing.

    Returns:
        The restored times [T] in s, the number of digits and the interval between rows in s; None
        for other clocks.
    """
    if t.size < _MIN_PRINTED_ROWS or t[0] < 0.0:
        return None
    exponents = np.floor(np.log10(np.maximum(t, 1e-300)))
    for digits in _SIGNIFICANT_DIGITS:
        # worth of the last digit of each time
        last_digit = 10.0 ** (exponents - digits + 1)
        if not (np.abs(t / last_digit - np.round(t / last_digit)) < 1e-6).all():
            continue
        is_positive = t > 0.0
        rows = np.arange(t.size, dtype=np.float64)
        weights = 1.0 / last_digit[is_positive]
        regressors = np.stack((np.ones(weights.size), rows[is_positive]), axis=1)
        intercept, interval = np.linalg.lstsq(
            weights[:, None] * regressors, weights * t[is_positive], rcond=None
        )[0]
        restored = intercept + interval * rows
        difference = ((t - restored)[is_positive]) * weights
        if interval > 0.0 and float(np.ptp(difference)) <= _MAX_PRINTED_SPREAD:
            return restored, digits, float(interval)
        return None
    return None


def repair_clock(
    t: np.ndarray, columns: Iterable[np.ndarray], clock_resolution: float | None = None
) -> tuple[np.ndarray, list[Remark]]:
    """Correct the known faults of a recorded clock.

    - Numbers of the form hhmmss (83059.8 for 8:30:59.8) become seconds.
    - A counter that overflows restarts at zero; its range is added from there on.
    - The hour by which a clock of dates is set back in autumn is added, the hour in spring is
      subtracted.
    - Times of evenly spaced rows that were printed with few significant digits follow from the row
      number.
    - Rows with one stamp are spread over the time to the next stamp if the clock is coarser than
      the rows; copies of rows are not spread.

    Args:
        t: recorded times [T] in s, all finite.
        columns: recorded values, [T] each.
        clock_resolution: unit of the counter in s; None for a clock of dates.

    Returns:
        Corrected times [T] in s, and a remark for each correction.
    """
    step = np.diff(t)
    positive_steps = step[step > 0.0]
    if not positive_steps.size:
        return t, []
    median_step = float(np.median(positive_steps))
    remarks: list[Remark] = []
    if clock_resolution == 1.0 and (unpacked := _unpack_clock_numbers(t)) is not None:
        text = "times are hours, minutes and seconds in one number (83059.8 for 8:30:59.8)"
        remarks = [make_remark("note", "clock_packed", text)]
        t = unpacked
        step = np.diff(t)
    t = t + _estimate_jump_correction(t, step, clock_resolution, median_step, remarks)
    return _spread_shared_stamps(t, columns, remarks), remarks


def _estimate_jump_correction(
    t: np.ndarray,
    step: np.ndarray,
    clock_resolution: float | None,
    median_step: float,
    remarks: list[Remark],
) -> np.ndarray:
    """Return the correction [T] in s for counter overflows and daylight saving time.

    A jump is accepted if the step without it is at most `_MAX_WRAP_STEPS` median steps, so that
    interruptions of the recording stay. A remark for each kind of jump is appended to `remarks`.
    """
    wrap_lengths: dict[str, float] = {}
    if clock_resolution is None:
        wrap_lengths = {"one hour (end of daylight saving time)": 3600.0}
    elif (step < 0.0).any():
        wrap_lengths = {
            f"2^{bits} counts (overflow)": 2.0**bits * clock_resolution for bits in _COUNTER_BITS
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
            text = (
                f"the clock jumps back after {event_time:.6g} s by {wrap_description}; the jump is"
                " removed"
            )
            remarks.append(make_remark("note", "clock_wraps", text, count=float(is_wrap.sum())))
        is_leap = (step > length) & (step - length < _MAX_WRAP_STEPS * median_step)
        if clock_resolution is None and is_leap.any():
            correction[1:] -= length * np.cumsum(is_leap)
            event_time = float(t[:-1][is_leap][0])
            text = (
                f"the clock jumps forward by one hour after {event_time:.6g} s (start of daylight"
                " saving time); the jump is removed"
            )
            remarks.append(make_remark("note", "clock_leaps", text, count=float(is_leap.sum())))
    return correction


def _spread_shared_stamps(
    t: np.ndarray, columns: Iterable[np.ndarray], remarks: list[Remark]
) -> np.ndarray:
    """Spread rows that share a time stamp evenly over the time to the next stamp.

    Times are unchanged if stamps repeat only now and then, or if the rows are copies. A remark is
    appended to `remarks` if rows were spread.
    """
    repeated_rows = np.flatnonzero(np.diff(t) == 0.0) + 1
    if not repeated_rows.size:
        return t
    stamps, first_rows, counts = np.unique(t, return_index=True, return_counts=True)
    rows_per_stamp = int(np.median(counts))
    if stamps.size < 3 or (np.diff(t) < 0.0).any():
        return t
    if repeats_previous_row(columns, repeated_rows).mean() > 0.5:
        return t
    if (printed_clock := _restore_printed_clock(t)) is not None:
        restored, digits, interval = printed_clock
        text = (
            f"the times are printed with {digits} digits, so that up to {int(counts.max())} rows"
            f" share one; the rows are {interval:.4g} s apart, and their times follow from the row"
            " number"
        )
        remarks.append(
            make_remark("note", "printed_clock", text, digits=float(digits), step=interval)
        )
        return restored
    if rows_per_stamp < 2:
        return t
    stamp_step = float(np.median(np.diff(stamps)))
    # the last stamp has no successor; the first one may be incomplete, its rows are its last ones
    stamp_gaps = np.minimum(np.append(np.diff(stamps), stamp_step), 2.0 * stamp_step)
    position_in_stamp = np.arange(t.size) - np.repeat(first_rows, counts)
    rows_in_stamp = np.maximum(counts, rows_per_stamp)
    position_in_stamp[: counts[0]] += rows_in_stamp[0] - counts[0]
    spread_times: np.ndarray = t + position_in_stamp * np.repeat(stamp_gaps / rows_in_stamp, counts)
    text = (
        f"about {rows_per_stamp} rows share each time stamp (a stamp every {stamp_step:.4g} s);"
        " they are spread evenly to the next stamp"
    )
    remarks.append(
        make_remark("note", "coarse_stamps", text, rows=float(rows_per_stamp), step=stamp_step)
    )
    return spread_times
