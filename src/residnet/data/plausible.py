"""Numbers that no vessel can have, and numbers that stand for a missing measurement."""

from __future__ import annotations

import numpy as np

# what recorders, NetCDF and spreadsheets write where nothing was measured
_FILLS = np.array(
    [
        *(-99.0, -999.0, -9999.0, -99999.0, -999999.0, -99.99, -999.99, -9999.99, -999.9, -999.25),
        *(999.0, 9999.0, 99999.0, 999999.0, 9999999.0),
        *(-128.0, -127.0, -32768.0, -32767.0, 32767.0, 32768.0, 65535.0),
        *(-2147483648.0, -2147483647.0, 2147483647.0, 4294967295.0, -9.2233720368547758e18),
        *(9.9692099683868690e36, 1e20, -1e20, 1e30, -1e30, 1e31, -1e31, 1e34, -1e34, 1e35, 1e37),
        *(3.4028234663852886e38, -3.4028234663852886e38),
        *(1.7976931348623157e308, -1.7976931348623157e308),
    ]
)
_SORTED = np.sort(_FILLS)
# largest size that any vessel, manoeuvre or site gives a quantity, by its SI unit
_LARGEST = {
    "m": 5e7,
    "m/s": 300.0,
    "m/s^2": 1e4,
    "rad": 1e5,
    "rad/s": 1e3,
    "rad/s^2": 1e5,
    "1/s": 1e4,
    "N": 1e10,
    "N m": 1e13,
    "kg": 1e10,
    "V": 1e7,
    "A": 1e7,
    "W": 1e11,
    "-": 1e15,
}


def fills(values: np.ndarray) -> np.ndarray:
    """Return [T] bool: cells that hold a usual fill value far from all that was measured.

    Far is by more than the whole range of the other cells, so that a distance of 999 m between
    900 m and 1100 m is a distance.

    Args:
        values: a column as it stands in the file [T], NaN where empty.
    """
    known = np.isfinite(values)
    size = np.abs(values)
    # most columns hold nothing of the kind: one comparison is enough for them
    if not known.any() or float(size[known].max()) < 99.0:
        return np.zeros(values.size, dtype=bool)
    candidate = np.zeros(values.size, dtype=bool)
    large = np.flatnonzero(known & (size >= 99.0))
    # single precision keeps seven digits of a fill value
    near = np.searchsorted(_SORTED, values[large])
    for offset in (-1, 0):
        fill = _SORTED[np.clip(near + offset, 0, _SORTED.size - 1)]
        candidate[large] |= np.abs(values[large] - fill) <= 2e-7 * np.abs(fill)
    rest = values[known & ~candidate]
    if not candidate.any() or not rest.size:
        return np.zeros(values.size, dtype=bool)
    low, high = float(rest.min()), float(rest.max())
    span = high - low
    far: np.ndarray = (values < low - span) | (values > high + span)
    return np.asarray(candidate & far)


def without_fills(values: np.ndarray) -> np.ndarray:
    """Return a column [T] with NaN in place of its fill values."""
    filled = fills(values)
    return np.where(filled, np.nan, values) if filled.any() else values


def beyond_belief(values: np.ndarray, unit: str) -> np.ndarray:
    """Return [T] bool: values that no vessel, manoeuvre or site can have.

    Args:
        values: a channel [T], SI, NaN where missing.
        unit: its SI unit; a unit that is not known has no limit.
    """
    limit = _LARGEST.get(unit, np.inf)
    beyond: np.ndarray = np.abs(values) > limit
    return beyond


def largest(unit: str) -> float:
    """Return the largest size of a quantity of this SI unit."""
    return _LARGEST.get(unit, np.inf)
