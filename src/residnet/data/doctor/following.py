"""How one channel follows another: sign, gain and lag."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from residnet.data.doctor.causes import LEAST_LAG
from residnet.data.doctor.findings import Finding, Level, unit_slip
from residnet.data.doctor.rates import Rates

FEWEST_SAMPLES = 50
"""Fewest samples that a comparison needs."""


_LONGEST_LAG = 3.0


def follow_findings(
    name: str,
    reference: np.ndarray,
    motion: Rates,
    least: float,
    reference_name: str,
    certain: bool,
) -> Iterator[Finding]:
    """Return the sign, gain and lag of a channel against a reference [T].

    Nothing is returned where the reference varies by less than `least`.

    A lag alone misleads where the finer look is `certain` that pose and velocities differ at all:
    slow channels correlate at any lag.
    """
    match = _agreement(reference, motion.measured[name], np.isfinite(reference), motion.step)
    if match is None or match[3] < least:
        return
    correlation, gain, lag, spread = match
    text = (
        f"{name} against {reference_name}: correlation {correlation:.3f}, gain {gain:.3f},"
        f" lag {lag:+.2f} s"
    )
    level: Level = "will mislead"
    action = ""
    clear = name != "r" or spread > 5.0 * max(motion.noise)
    if correlation < -0.8 or (correlation < -0.5 and clear):
        text, action = f"{text}; it has the opposite sign", "turn it in the channel map (sign: -1)"
    elif correlation < 0.5 and name == "r" and clear:
        level, text, action = (
            "fatal",
            f"{text}; they do not describe one motion",
            "are both columns of this vessel and this clock?",
        )
    elif correlation > 0.9 and not 0.6 < gain < 1.6:
        text, action = (
            f"{text}; check its unit{slip_in_words(gain)}",
            "correct the unit in the channel map",
        )
    elif correlation > 0.9 and abs(lag) > max(LEAST_LAG, motion.step) and clear and certain:
        # how far it misleads is measured with the causes, which tell the channels apart
        level = "note"
        text = f"{text}; it {'trails' if lag > 0.0 else 'leads'}, a filter or another clock"
    else:
        level = "note"
    yield Finding(
        level,
        f"follows_{name}",
        text,
        {"correlation": correlation, "gain": gain, "lag": lag},
        action,
    )


def _agreement(
    reference: np.ndarray, measured: np.ndarray, good: np.ndarray, step: float
) -> tuple[float, float, float, float] | None:
    """Return how `measured` [T] follows `reference` [T] where `good` [T].

    Returns:
        Correlation (means removed) and gain (least squares through the origin) at the lag with the
        largest correlation, that lag in s (positive where `measured` trails; within 3 s, refined by
        a parabola), and the standard deviation of the reference; None where fewer than 50 samples
        can be compared at all lags, or either does not vary.
    """
    reach = max(round(_LONGEST_LAG / step), 10)
    if good.size < 2 * reach + FEWEST_SAMPLES:
        return None
    # the same samples for every lag, or the comparison of lags would be one of samples
    around = np.lib.stride_tricks.sliding_window_view(np.isfinite(measured), 2 * reach + 1).all(
        axis=1
    )
    at = np.flatnonzero(good[reach:-reach] & around) + reach
    if at.size < FEWEST_SAMPLES:
        return None
    a, spread = reference[at], float(reference[at].std())
    lags = np.arange(-reach, reach + 1)
    cov = np.array([(a - a.mean()) @ measured[at + k] for k in lags]) / at.size
    std = np.array([measured[at + k].std() for k in lags])
    if spread == 0.0 or std.min() <= 1e-12 * np.nanmax(np.abs(measured)):
        return None
    values = cov / (spread * std)
    best = int(np.argmax(np.abs(values)))
    shift = 0.0
    if 0 < best < lags.size - 1:
        before, peak, after = np.abs(values[best - 1 : best + 2])
        curvature = before - 2.0 * peak + after
        shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    return (
        float(values[best]),
        float(a @ measured[at + lags[best]] / (a @ a)),
        float((lags[best] + shift) * step),
        spread,
    )


def slip_in_words(factor: float) -> str:
    """Return which slip of a unit a factor looks like, in brackets; empty where it is none."""
    slip = unit_slip(factor)
    return f" ({slip})" if slip else ""
