"""Checks of input channels: the unit of a rudder, stuck actuators, and relative wind."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from residnet.core.names import BOW_WIND_CHANNELS
from residnet.core.stretches import find_runs
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    check,
    format_quantity,
)
from residnet.quality.statistics import (
    LogStatistics,
    abs_quantile,
    fit_least_squares,
)


@check("inputs", "unit", fix="correct the unit in the channel map", is_record_fault=True)
def check_rudder_unit(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report rudder angles that are too large for any rudder."""
    for name in log.inputs:
        largest = abs_quantile(log[name], 0.99)
        if name in ("delta", "cmd_delta") and largest > math.radians(100.0):
            largest_text = format_quantity(largest, "rad")
            text = f"{name} reaches {largest_text}, more than any rudder: deg taken as rad?"
            yield make_finding(text, {"largest": largest})


# parts of a name that mark a command instead of the state of the actuator
_DEMAND_PATTERN = re.compile(
    r"^(cmd|ref|command|commanded|set|desired)_|_(cmd|ref|command|commanded|set|desired)(?=_|$)"
)
_MIN_STUCK_DURATION = 5.0
"""Shortest time in s of a stuck actuator; chosen by hand, above the delay of actuators."""
_MIN_STUCK_ERROR = 0.2
"""Smallest distance of a stuck actuator from its command, as a share of the command's range."""


@check("inputs", "stuck", fix="exclude this part", is_record_fault=True)
def check_stuck_actuators(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report actuators that are constant although their command changes."""
    import pandas as pd

    for demand_name in log:
        base_name = _DEMAND_PATTERN.sub("", demand_name)
        candidate_names = [
            base_name,
            f"n_{base_name}",
            f"actual_{base_name}",
            f"{base_name}_actual",
            f"acting_{base_name}",
        ]
        candidate_names = candidate_names if base_name != demand_name else [f"acting_{demand_name}"]
        actual_name = next((name for name in candidate_names if name in log), "")
        demand_range = float(np.nanmax(log[demand_name]) - np.nanmin(log[demand_name]))
        if (
            not actual_name
            or log.units[actual_name] != log.units[demand_name]
            or demand_range <= 0.0
        ):
            continue
        demanded_values = log[demand_name]
        measured_values = log[actual_name]
        rest_tolerance = max(6.0 * log.noise_std(actual_name), 1e-4 * demand_range)
        # a slow gear moves less per step than its sensor noise, therefore the range over many steps
        # decides
        n_window_samples = max(2, round(_MIN_STUCK_DURATION / log.sampling_interval))
        rolling = pd.Series(measured_values).rolling(n_window_samples, min_periods=1)
        is_at_rest = ~(
            (rolling.max() - rolling.min()).to_numpy()[n_window_samples - 1 :] > rest_tolerance
        )
        longest_run = slice(0, 0)
        longest_duration = 0.0
        for start, stop in zip(*find_runs(is_at_rest), strict=True):
            segment = slice(start, stop + n_window_samples - 1)
            duration = float(log.t[segment.stop - 1] - log.t[start])
            is_far_from_demand = (
                np.abs(demanded_values[segment] - measured_values[segment])
                > _MIN_STUCK_ERROR * demand_range
            )
            has_demand_moved = (
                float(np.ptp(demanded_values[segment])) > _MIN_STUCK_ERROR * demand_range
            )
            if (
                duration > longest_duration
                and has_demand_moved
                and float(is_far_from_demand.sum()) * log.sampling_interval >= _MIN_STUCK_DURATION
            ):
                longest_run = segment
                longest_duration = duration
        if longest_duration:
            is_stuck = np.zeros(len(log), dtype=bool)
            start_time = float(log.t[longest_run.start])
            is_stuck[longest_run] = True
            text = (
                f"{actual_name} is constant for {longest_duration:.1f} s from t = {start_time:.2f}"
                f" s while {demand_name} changes: stuck, or not recorded"
            )
            yield make_finding(
                text, {"seconds": longest_duration, "t": start_time}, sample_mask=is_stuck
            )


@check("inputs", "relative_wind", required_channels=("psi",), on_subsample=True)
def check_relative_wind(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report wind directions that are relative to the bow instead of true."""
    direction_names = [
        n for n in log if "wind" in n and log.units[n] == "rad" and n not in BOW_WIND_CHANNELS
    ]
    for name in direction_names:
        slope, error = _estimate_slope_against_heading(log, name)
        has_heading_slope = (
            error > 0.0 and slope < -5.0 * error and abs(slope + 1.0) < max(3.0 * error, 0.2)
        )
        if not (has_heading_slope or "relative" in name or name.startswith("rel_")):
            continue
        text = f"{name} turns by {slope:+.2f} +- {2.0 * error:.2f} per unit change of heading"
        is_input = name in log.inputs
        level: Level = "will mislead" if is_input else "note"
        fix = "it must not drive a free run" if is_input else "do not use it as an input"
        text += ": a relative wind contains psi, u and v"
        yield make_finding(
            text, {"slope": slope, "error": error}, level=level, fix=f"{fix}: use the true wind"
        )


def _estimate_slope_against_heading(log: LogStatistics, name: str) -> tuple[float, float]:
    """Estimate the change of a direction per rad change of heading, over ten seconds.

    Returns:
        Slope and its standard error; both 0 if the log is too short or the heading constant.
    """
    n_hop_samples = max(round(10.0 / log.sampling_interval), 1)
    if len(log) < 5 * n_hop_samples:
        return 0.0, 0.0
    direction_changes = np.angle(
        np.exp(1j * (log[name][n_hop_samples:] - log[name][:-n_hop_samples]))
    )
    heading_changes = log["psi"][n_hop_samples:] - log["psi"][:-n_hop_samples]
    # a change of direction by more than half a circle is ambiguous
    is_valid = (
        np.isfinite(direction_changes)
        & np.isfinite(heading_changes)
        & (np.abs(heading_changes) < 1.5)
    )
    if is_valid.sum() < 100 or float(np.std(heading_changes[is_valid])) < math.radians(1.0):
        return 0.0, 0.0
    centred_turn = heading_changes[is_valid] - heading_changes[is_valid].mean()
    centred_change = direction_changes[is_valid] - direction_changes[is_valid].mean()
    slope_fit = fit_least_squares(centred_turn[:, None], centred_change)
    return float(slope_fit.coefficients[0]), float(slope_fit.standard_errors[0])
