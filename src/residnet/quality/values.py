"""Checks of single channels: missing, frozen, outlying, clipped, coarse and filled values."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from residnet.core.errors import ResidnetError
from residnet.core.frames import unwrap_angle
from residnet.core.layout import DegreesOfFreedom, to_horizontal_plane
from residnet.core.log import Log
from residnet.core.names import POSE_NAMES, STATE_NAMES
from residnet.core.stretches import find_runs
from residnet.preprocessing.channel_values import (
    estimate_noise_std,
    find_spikes,
    is_fill_value,
    is_implausible,
    mask_from_ranges,
    median_update_interval,
    nan_median,
    nan_quantiles,
    nan_std,
)
from residnet.preprocessing.motion import MAX_BRIDGED_INTERVALS, MotionConfig, complete_motion
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    check,
    format_quantity,
    format_share,
)
from residnet.quality.statistics import (
    MOTION_CHANNELS,
    STEERING_CHANNELS,
    LogStatistics,
)


@check("header", "channels", "note")
def report_channels(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the names and units of the channels."""
    channels_text = ", ".join(f"{name} [{unit}]" for name, unit in log.units.items())
    summary_text = f"{len(log.units)} channels, {len(log)} samples, manoeuvre {log.log.manoeuvre}"
    yield make_finding(f"{summary_text}: {channels_text}")


@check("values", "absent", "note")
def report_missing_motion(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report states that are not measured, and measured states that no model uses."""
    dof = DegreesOfFreedom.from_channels(log.log.channels)
    missing_names = [name for name in STATE_NAMES if name not in log]
    if missing_names:
        try:
            completed = complete_motion(log.log, MotionConfig(), dof)
        except ResidnetError as error:
            yield make_finding(f"it cannot be fitted: {error}", level="will mislead")
        else:
            derivation = "they follow from position and heading by a smoother"
            if "integrated" in completed.meta:
                derivation = "they are integrated from the velocities"
            if dof.fixed_states:
                derivation = dof.description
            yield make_finding(f"no {', '.join(missing_names)}: {derivation}")
    if "p" in log and not dof.has_roll:
        text = "p of the roll is measured and not modelled: a model that rolls needs an angle phi"
        yield make_finding(f"{text} that varies", code="roll")
    if {"z", "theta"} & {*log} and not dof.is_six_dof and {"x", "u"} & {*log}:
        text = "depth or pitch is measured and not modelled: six degrees of freedom need both, phi,"
        yield make_finding(f"{text} psi, and u and v or a position, that move", code="depth")


# one full circle in rad, and in degrees that were taken as rad
_FULL_CIRCLES = ((2.0 * math.pi, ""), (360.0, " of 360: degrees taken as rad"))
_ANGLE_CHANNELS = ("psi", "phi")


@check("clock", "heading_wrap", fix="unwrap it before it is filtered or differentiated")
def check_heading_wraps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report headings that wrap: steps by about a full circle."""
    for name in _ANGLE_CHANNELS:
        for full_circle, suffix in _FULL_CIRCLES if name in log else ():
            is_finite = np.isfinite(log[name])
            changes = np.abs(np.diff(log[name][is_finite]))
            wrap_indices = np.flatnonzero(is_finite)[1:][
                np.abs(changes - full_circle) < 0.25 * full_circle
            ]
            if wrap_indices.size:
                text = (
                    f"{name} wraps {wrap_indices.size} times{suffix}, first at t ="
                    f" {log.t[wrap_indices[0]]:.2f} s: logs hold it continuous"
                )
                yield make_finding(text, {"count": wrap_indices.size, "t": log.t[wrap_indices[0]]})


def horizontal_motion(log: Log) -> Log:
    """Return a log with the velocities u, v, r of the horizontal plane.

    The checks of the motion are planar. In a log with roll or pitch the body-fixed velocities are
    rotated to the horizontal plane. With roll only, v and r may be body-fixed (a gyro's yaw rate
    falls with the cosine of the roll) or planar (a compass): the convention that explains the pose
    better is chosen. Any other log is returned unchanged.
    """
    dof = DegreesOfFreedom.from_channels(log.channels)
    if not dof.is_six_dof:
        return _select_yaw_rate_convention(log) if dof.has_roll else log
    if not log.channels.keys() >= {*dof.dynamic_states}:
        log = complete_motion(log, MotionConfig(), dof)
    velocities = log.stack(dof.dynamic_states)
    u, v, r = to_horizontal_plane(velocities).T
    p = log["p"] + r * np.sin(log["theta"])
    return log.replace(channels={**log.channels, "u": u, "v": v, "r": r, "p": p})


def _select_yaw_rate_convention(log: Log) -> Log:
    """Return a log with planar v and r; whether they are body-fixed is inferred from the pose."""
    pose_increments = {"r": np.diff(log["psi"])} if log.channels.keys() >= {"psi", "r"} else {}
    if log.channels.keys() >= {"psi", "x", "y", "v"}:
        pose_increments["v"] = (
            np.diff(log["x"] + 1j * log["y"]) * np.exp(-1j * log["psi"][1:])
        ).imag
    channels = dict(log.channels)
    for name, increment in pose_increments.items():
        candidates = (log[name], log[name] * np.cos(log["phi"]))
        mean_square_errors = [
            np.nanmean(np.square(increment - np.diff(log.t) * candidate_rate[1:]))
            for candidate_rate in candidates
        ]
        channels[name] = candidates[int(np.argmin(mean_square_errors))]
    return log.replace(channels=channels)


def unwrap_headings(log: Log) -> Log:
    """Return the log with continuous (unwrapped) headings and roll angles."""
    unwrapped_headings = {
        name: unwrap_angle(log[name]) for name in _ANGLE_CHANNELS if name in log.channels
    }
    return log.replace(channels={**log.channels, **unwrapped_headings})


@check("values", "nan", fix="split the log there (mask kind: nan)")
def check_missing_values(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report missing samples, and channels with a lower sampling rate than the log."""
    for name in log:
        is_missing = ~np.isfinite(log[name])
        missing_share = float(is_missing.mean())
        valid_indices = np.flatnonzero(~is_missing)
        if not missing_share:
            continue
        intervals = np.diff(valid_indices)
        median_interval = float(np.median(intervals)) if intervals.size else 1.0
        # gaps at both ends count as well
        longest_gap = max(
            intervals.max(initial=0), valid_indices[0], len(log) - 1 - valid_indices[-1]
        )
        if median_interval > 1.0 and longest_gap <= 2.0 * median_interval:
            text = (
                f"{name} holds a value once in {median_interval:.0f} samples: its sensor is slower"
                " than the log"
            )
            fix = "give it a log of its own, or interpolate it"
            figures = {"share": missing_share, "every": median_interval}
            yield make_finding(text, figures, code="slow_channel", level="note", fix=fix)
            continue
        starts, stops = find_runs(is_missing)
        longest_segment = int(np.argmax(stops - starts))
        start_time = float(log.t[starts[longest_segment]])
        duration = float(log.t[min(stops[longest_segment], len(log) - 1)]) - start_time
        text = (
            f"{name} is missing in {format_share(missing_share)} of the samples, {starts.size}"
            f" stretches, the longest {duration:.2f} s from t = {start_time:.2f} s"
        )
        level: Level = "fatal" if missing_share > 0.5 else "will mislead"
        figures = {
            "share": missing_share,
            "stretches": starts.size,
            "longest": duration,
            "t": start_time,
        }
        if longest_gap <= MAX_BRIDGED_INTERVALS:
            level = "note"
            text = f"{text}; short gaps are interpolated"
        yield make_finding(
            text, figures, level=level, sample_mask=is_missing, fix="" if level == "note" else None
        )


@check(
    "values", "repeated_rows", fix="delete them, or log at the sensors' rate", is_record_fault=True
)
def check_repeated_rows(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report rows that repeat the previous row in every channel more often than by chance.

    The expected number of repeats is the product of the channels' shares of equal neighbours,
    because channels of low resolution repeat values by chance. A single measured channel repeats
    where its sensor is slower than the log, which is no repeated row.
    """
    is_repeated = np.ones(len(log) - 1, dtype=bool)
    n_noisy_channels = 0
    n_expected = float(len(log))
    for name in log:
        is_equal_to_previous = log[name][1:] == log[name][:-1]
        is_repeated &= is_equal_to_previous
        n_expected *= float(is_equal_to_previous.mean())
        n_noisy_channels += name in MOTION_CHANNELS and float(is_equal_to_previous.mean()) < 0.5
    is_repeated = np.append(False, is_repeated)
    repeated_share = float(is_repeated.mean())
    # a log of commands only repeats its rows while nobody changes them
    has_motion_channel = any(name in MOTION_CHANNELS for name in log)
    is_beyond_chance = int(is_repeated.sum()) > n_expected + 3.0 * np.sqrt(n_expected)
    if has_motion_channel and ((n_noisy_channels > 1 and is_beyond_chance) or repeated_share > 0.5):
        text = (
            f"{int(is_repeated.sum())} rows ({format_share(repeated_share)}) repeat the row before"
            " in every channel: logged twice, or faster than measured"
        )
        level: Level = "fatal" if repeated_share > 0.9 else "will mislead"
        yield make_finding(
            text,
            {"count": is_repeated.sum(), "share": repeated_share},
            level=level,
            sample_mask=is_repeated,
        )


@check("values", "spikes", is_record_fault=True, invalidates_samples=True)
def check_wrong_values(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report samples that are no measurement: fill values, implausible values and spikes."""
    spikes = find_spikes(log.log)
    no_spikes = np.zeros(len(log), dtype=bool)
    for name in log:
        values = log[name]
        is_reported = no_spikes
        kinds: tuple[tuple[str, Level, np.ndarray, str, str], ...] = (
            (
                "fill_values",
                "will mislead",
                is_fill_value(values),
                "hold a fill value: nothing was measured there",
                "leave these cells empty",
            ),
            (
                "absurd",
                "fatal",
                is_implausible(values, log.units[name]),
                "are beyond what any vessel reaches",
                "correct or empty them",
            ),
            (
                "spikes",
                "will mislead",
                spikes.get(name, no_spikes),
                "are single samples far outside the other values",
                "correct or empty these cells; a fit bridges them and leaves them out",
            ),
        )
        for code, level, is_wrong, text, fix in kinds:
            is_new = is_wrong & ~is_reported
            is_reported = is_reported | is_wrong
            if not is_new.any():
                continue
            deviations = np.abs(values - np.nanmedian(values))
            worst_index = int(np.argmax(np.where(is_new, deviations, -1.0)))
            worst_text = format_quantity(float(values[worst_index]), log.units[name])
            yield make_finding(
                f"{int(is_new.sum())} samples of {name} {text}, the worst {worst_text} at t ="
                f" {log.t[worst_index]:.2f} s",
                {"count": is_new.sum(), "value": values[worst_index], "t": log.t[worst_index]},
                code=code,
                level=level,
                fix=fix,
                sample_mask=is_new,
            )


# shortest run of equal values that counts as frozen, in steps
_MIN_FROZEN_STEPS = 5
# time in s that the filter of a receiver needs to recover after a freeze
_RECOVERY_DURATION = 2.0
# duration in s for which a compass may be constant on a steady heading
_MAX_STEADY_HEADING_DURATION = 3.0


@check("values", "frozen", is_record_fault=True, invalidates_samples=True)
def check_frozen_sensors(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report sensors that hold their last value although the vessel moves."""
    position = tuple(name for name in ("x", "y") if name in log.measured_motion)
    others = [(name,) for name in log.measured_motion if name not in position]
    for names in (position, *others) if position else others:
        is_frozen = _find_frozen_samples(log, names)
        starts, stops = find_runs(is_frozen)
        if not starts.size:
            continue
        durations = log.t[stops - 1] - log.t[starts]
        affected = is_frozen
        if names[0] in ("x", "y"):
            recovery_ends = np.searchsorted(log.t, log.t[stops - 1] + _RECOVERY_DURATION - 1e-9)
            affected = is_frozen | mask_from_ranges(
                len(log), stops, np.maximum(recovery_ends, stops)
            )
        affected_share = float(affected.mean())
        longest_run = int(np.argmax(durations))
        text = (
            f"{'position' if len(names) == 2 else names[0]} is bit-identical in {starts.size}"
            f" stretches of {_MIN_FROZEN_STEPS} steps or more while the vessel moves,"
            f" {durations.sum():.2f} s in all, the longest {durations[longest_run]:.2f} s from t ="
            f" {log.t[starts[longest_run]]:.2f} s"
        )
        level: Level = "fatal" if affected_share > 0.5 else "will mislead"
        if names[0] in _ANGLE_CHANNELS and durations[longest_run] < _MAX_STEADY_HEADING_DURATION:
            level = "note"
        yield make_finding(
            text,
            {
                "count": starts.size,
                "seconds": durations.sum(),
                "longest": durations[longest_run],
                "share": affected_share,
                "t": log.t[starts[longest_run]],
            },
            level=level,
            fix=f"mask them and what follows (kind: frozen, channels: [{', '.join(names)}])",
            sample_mask=affected,
        )


def _find_frozen_samples(log: LogStatistics, names: tuple[str, ...]) -> np.ndarray:
    """Find runs of equal values that neither chance nor a vessel at rest explains.

    Args:
        log: statistics of the log.
        names: channels that freeze together.

    Returns:
        [T] bool.
    """
    is_frozen_sample = np.zeros(len(log), dtype=bool)
    is_multi_channel = len(names) > 1
    is_repeated = np.logical_and.reduce([log[name][1:] == log[name][:-1] for name in names])
    if not is_repeated.any():
        return is_frozen_sample
    starts, stops = find_runs(is_repeated)
    # a slow sensor repeats each value: its steps are its update intervals
    min_run = _MIN_FROZEN_STEPS * median_update_interval(log.subsample.log.stack(names))
    is_long = stops - starts >= min_run
    n_outside = is_repeated.size - int((stops - starts)[is_long].sum())
    if n_outside < 0.02 * is_repeated.size:
        return is_frozen_sample
    # share of equal neighbours outside long runs: a coarse channel repeats values by chance
    repeat_probability = min(float((stops - starts)[~is_long].sum()) / n_outside, 0.99)
    # a geometric distribution gives the run length that chance reaches; two channels that repeat
    # together are no chance
    if repeat_probability > 0.0 and not is_multi_channel:
        min_run = max(
            min_run, int(np.ceil(np.log(1e-4 / is_repeated.size) / np.log(repeat_probability)))
        )
    # the last digits of a noisy channel change at every sample, even at rest
    is_repeat_rare = repeat_probability < (0.15 if is_multi_channel else 1e-3)
    is_long = stops - starts >= min_run
    if not is_long.any():
        return is_frozen_sample
    starts = starts[is_long]
    stops = stops[is_long]
    # noise contributes to the increments; without noise, only a change after the run proves motion
    is_noisy = log.noise_std(names[0]) > 0.05 * nan_std(np.diff(log[names[0]]))
    is_noisy &= is_repeat_rare or names[0] not in POSE_NAMES
    vessel_moves = np.full(starts.size, is_noisy)
    for name in () if is_noisy else names:
        vessel_moves |= _moves_after_run(log[name], stops)
    return mask_from_ranges(is_frozen_sample.size, starts[vessel_moves], stops[vessel_moves] + 1)


def _moves_after_run(values: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return whether a channel changes by a large step after each run of equal values.

    Args:
        values: channel [T].
        stops: sample after each run [R].

    Returns:
        [R] bool: the step after the run exceeds three times those that follow it.
    """
    changes = np.abs(np.diff(values))
    min_change = nan_quantiles(changes[changes > 0.0], 0.1)[0] if (changes > 0.0).any() else 0.0
    # the six steps after each run, padded at the end of the log
    following_changes = sliding_window_view(np.append(changes, np.full(5, np.nan)), 6)[
        np.minimum(stops, changes.size - 1)
    ]
    typical_change = np.nanmax(following_changes[:, 1:], axis=1)
    is_large_step = following_changes[:, 0] > np.maximum(3.0 * typical_change, 3.0 * min_change)
    return np.asarray((stops < changes.size - 3) & is_large_step)


_MIN_STRAIGHT_SAMPLES = 8
"""Smallest number of samples of a straight stretch."""
_MIN_STRAIGHT_DURATION = 3.0
"""Shortest duration of a straight stretch in s; a table of three digits has some of 1.9 s."""


@check(
    "values",
    "interpolated",
    fix="leave the cells between two measurements empty",
    is_record_fault=True,
    invalidates_samples=True,
)
def check_interpolated_values(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report stretches of two or more noisy channels that are straight lines at the same time.

    Channels without noise are straight by the resolution of their values.
    """
    if len(log) < _MIN_STRAIGHT_SAMPLES:
        return
    names = tuple(name for name in log.measured_motion if name in STATE_NAMES)
    n_straight = np.zeros(len(log) - 2)
    for name in names:
        bends = np.abs(np.diff(np.diff(log[name]) / np.diff(log.t)))
        is_noise = np.sqrt(6.0) * log.noise_std(name) > 0.5 * nan_median(
            np.abs(np.diff(log[name], 2))
        )
        typical_bend = nan_median(bends)
        # the noise of rounding is at most a few steps of the last printed digit
        smallest_bend = bends[bends > 1e-5 * typical_bend].min(initial=np.inf)
        is_noise &= typical_bend > 2.5 * smallest_bend
        is_flat = (bends <= 1e-5 * typical_bend) & (np.diff(log[name])[1:] != 0.0)
        n_straight += is_flat & is_noise
    starts, stops = find_runs(n_straight >= 2.0)
    durations = log.t[stops] - log.t[starts]
    is_long = (durations >= _MIN_STRAIGHT_DURATION) & (stops - starts >= _MIN_STRAIGHT_SAMPLES)
    if not is_long.any():
        return
    is_straight = mask_from_ranges(len(log), starts[is_long], stops[is_long] + 2)
    longest = int(np.argmax(durations))
    text = (
        f"motion is exactly linear for {durations[is_long].sum():.1f} s"
        f" ({format_share(float(is_straight.mean()))}), the longest {durations[longest]:.1f} s from"
        f" t = {log.t[starts[longest]]:.2f} s: it was interpolated"
    )
    figures = {"seconds": durations[is_long].sum(), "longest": durations[longest]}
    yield make_finding(
        text,
        {**figures, "t": log.t[starts[longest]], "share": is_straight.mean()},
        sample_mask=is_straight,
    )


@check("values", "outliers", invalidates_samples=True)
def check_outliers(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report outliers among neighbouring samples, by the rule of the mask `hampel`.

    An input may jump, so its outliers must also be outside the range of its other values.
    """
    for name in (*log.measured_motion, *log.inputs):
        values = log[name]
        is_out_of_range = np.ones(1, dtype=bool)
        if name not in log.measured_motion:
            lower, upper = nan_quantiles(values, 0.01, 0.99)
            is_out_of_range = np.maximum(lower - values, values - upper) > 0.25 * max(
                upper - lower, 1e-12
            )
            # a direction, for example of a light wind, may change to any value at once
            if not is_out_of_range.any() or (
                log.units[name] == "rad" and name not in STEERING_CHANNELS
            ):
                continue
        is_outlier = log.is_spike(name) & is_out_of_range
        n_outliers = int(is_outlier.sum())
        if not n_outliers:
            continue
        is_inlier = np.isfinite(values) & ~is_outlier
        sample_indices = np.arange(len(log))
        interpolated_values = np.interp(
            sample_indices, sample_indices[is_inlier], values[is_inlier]
        )
        worst_index = int(
            np.argmax(np.where(is_outlier, np.abs(values - interpolated_values), 0.0))
        )
        outlier_share = n_outliers / len(log)
        time = float(log.t[worst_index])
        text = (
            f"{n_outliers} samples of {name} ({format_share(outlier_share)}) are outliers among"
            f" their neighbours, the worst at t = {time:.2f} s"
        )
        level: Level = "will mislead" if n_outliers > 2 else "note"
        fix = f"mask them (kind: hampel, channels: [{name}])"
        figures = {"count": n_outliers, "share": outlier_share, "t": time}
        yield make_finding(text, figures, level=level, fix=fix, sample_mask=is_outlier)


@check("values", "clipping", fix="mask them, or log with a wider range", invalidates_samples=True)
def check_clipping(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report channels with many more samples at an extreme than at the neighbouring levels."""
    for name in log.measured_motion:
        finite_values = log[name][np.isfinite(log[name])]
        if name in ("x", "y", "psi"):
            continue
        for limit in (float(finite_values.min()), float(finite_values.max())):
            n_clipped = int((finite_values == limit).sum())
            clipped_share = n_clipped / finite_values.size
            if n_clipped < max(5, 0.003 * finite_values.size):
                continue
            levels, counts = np.unique(finite_values, return_counts=True)
            neighbour_counts = counts[1:4] if limit == levels[0] else counts[-4:-1]
            if levels.size < 10 or n_clipped < 4 * int(neighbour_counts.max()):
                continue
            text = (
                f"{name} is exactly at its limit {format_quantity(limit, log.units[name])} in"
                f" {n_clipped} samples ({format_share(clipped_share)}): the sensor clips or holds"
            )
            figures = {"count": n_clipped, "share": clipped_share, "limit": limit}
            yield make_finding(text, figures, sample_mask=log[name] == limit)


# smallest number of levels between the 5th and the 95th percentile for a sufficient resolution
_MIN_LEVELS = 50
# smallest median increment, in steps of the resolution, of a channel that noise dithers
_DITHER_STEPS = 2.0
# a channel with a smaller range carries no information; yaw rates of +-0.05 deg/s turn a vessel by
# 3 deg in a minute
_NEGLIGIBLE_RANGES = {"rad": math.radians(3.0), "rad/s": math.radians(0.1)}


@check(
    "values",
    "resolution",
    fix="decimals were dropped on the way: log more digits",
    on_subsample=True,
)
def check_resolution(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the resolution of channels; it is too coarse with few levels in their range."""
    for name in log.measured_motion:
        finite_values = log[name][np.isfinite(log[name])]
        lower, upper = nan_quantiles(finite_values, 0.05, 0.95)
        levels = np.unique(finite_values)
        if levels.size < 2 or levels.size > 0.5 * finite_values.size:
            continue
        level_step = float(np.median(np.diff(levels)))
        n_levels = (upper - lower) / level_step
        # a resolution exists only if most increments are multiples of it
        increments_in_steps = np.diff(finite_values) / level_step
        if float((np.abs(increments_in_steps - np.round(increments_in_steps)) < 1e-3).mean()) < 0.9:
            continue
        text = (
            f"{name} has a resolution of {format_quantity(level_step, log.units[name])},"
            f" {n_levels:.0f} levels between its 5th and 95th percentile"
        )
        # noise beyond the resolution makes rounding a white noise of step / sqrt(12) without bias
        # (Widrow 1956)
        is_dithered = float(np.median(np.abs(increments_in_steps))) >= _DITHER_STEPS
        is_fine = (
            n_levels >= _MIN_LEVELS
            or is_dithered
            or upper - lower < _NEGLIGIBLE_RANGES.get(log.units[name], 0.0)
        )
        level: Level = "note" if is_fine else "will mislead"
        fix = "" if is_fine else None
        yield make_finding(
            text, {"resolution": level_step, "levels": n_levels}, level=level, fix=fix
        )


_MIN_REPEATED_SHARE = 0.1
"""Smallest share of repeated positions that is reported."""


@check(
    "values",
    "held",
    fix=(
        "leave the cells between two measurements empty: held values are late by half an interval"
        " and their derivative consists of spikes; a fit excludes and smooths them"
    ),
    on_subsample=True,
)
def check_sample_and_hold(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report slow sensors whose value is held until the next measurement."""
    for name in log.measured_motion:
        update_interval = median_update_interval(log[name])
        if update_interval >= 2.0:
            text = (
                f"{name} changes once in {update_interval:.0f} samples, its last value is held in"
                " between"
            )
            yield make_finding(
                text, {"every": update_interval}, level="note" if name in STATE_NAMES else None
            )
    if not {"x", "y"} <= {*log.measured_motion}:
        return
    increments = np.diff(log.log.stack(("x", "y")), axis=0)
    is_repeated = (increments == 0.0).all(axis=1)
    starts, stops = find_runs(is_repeated)
    is_short = stops - starts < _MIN_FROZEN_STEPS
    repeated_share = float((stops - starts)[is_short].sum()) / len(log)
    # a position with steps of several times its resolution does not repeat by chance
    steps = np.abs(increments[~is_repeated])
    resolution = float(steps[steps > 0.0].min(initial=np.inf))
    is_regular = median_update_interval(log.log.stack(("x", "y"))) > 1.0
    if (
        repeated_share >= _MIN_REPEATED_SHARE
        and not is_regular
        and nan_median(steps.max(axis=1)) > 4.0 * resolution
    ):
        text = (
            f"{format_share(repeated_share)} of the rows repeat the last position: the fix is older"
            " than the row"
        )
        yield make_finding(text, {"share": repeated_share})


@check("values", "jump", is_record_fault=True)
def check_velocity_jumps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report steps of a velocity within one sample, which the inertia of a vessel excludes."""
    for name in (name for name in log.velocities if name in log.measured_motion):
        values = np.where(log.is_spike(name), np.nan, log[name])
        # a velocity may change by any amount in a gap
        is_gap = np.diff(log.t) > 3.0 * log.sampling_interval
        changes = np.where(is_gap, np.nan, np.abs(np.diff(values)))
        if np.isfinite(changes).sum() < 50:
            continue
        is_gap = np.diff(log.t) > 3.5 * log.sampling_interval
        changes = np.where(is_gap, 0.0, np.nan_to_num(changes))
        lower, upper = nan_quantiles(values, 0.01, 0.99)
        # a step exceeds the noise, 30 % of the range, and four times the neighbouring changes
        min_jump = 0.3 * (upper - lower)
        min_jump = (
            max(8.0 * estimate_noise_std(values), min_jump) if changes.max() > min_jump else np.inf
        )
        is_jump = changes > min_jump
        if is_jump.any():
            neighbouring_changes = sliding_window_view(np.pad(changes, 4, mode="edge"), 9)
            is_jump[is_jump] = (
                changes[is_jump] > 4.0 * np.sort(neighbouring_changes[is_jump], axis=1)[:, -2]
            )
        if is_jump.any():
            largest_index = int(np.argmax(np.where(is_jump, changes, 0.0)))
            text = (
                f"{name} changes level {int(is_jump.sum())} times within one sample, at most by"
                f" {format_quantity(changes[largest_index], log.units[name])} at t ="
                f" {log.t[largest_index + 1]:.2f} s"
            )
            yield make_finding(
                text,
                {
                    "count": is_jump.sum(),
                    "largest": changes[largest_index],
                    "t": log.t[largest_index + 1],
                },
                fix=f"mask it (kind: jump, channel: {name}), or split the log there",
                sample_mask=np.append(False, is_jump) | np.append(is_jump, False),
            )


_MAX_SPEED = 75.0
"""Largest speed of a vessel in m/s, about 150 kn."""
_MAX_TURN_RATE = 2.0 * math.pi
"""Largest yaw rate of a vessel in rad/s, one turn per second."""
_RATE_INTERVAL = 1.0
"""Shortest time in s over which rates are computed from the pose, whose noise at shorter intervals
would give large rates."""


@check("values", "impossible_rate", fix="check units and times, or whether rows are of two vessels")
def check_impossible_rates(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report speeds and turns beyond what a vessel can do, measured or implied by the pose."""
    stride = max(math.ceil(_RATE_INTERVAL / log.sampling_interval), 1)
    dt = np.maximum(log.t[stride:] - log.t[:-stride], 1e-9)
    rates = {}
    if "x" in log and "y" in log:
        track = log["x"] + 1j * log["y"]
        rates["the speed from x, y"] = (np.abs(track[stride:] - track[:-stride]) / dt, _MAX_SPEED)
    if "psi" in log:
        rates["the rate of psi"] = (
            np.abs(log["psi"][stride:] - log["psi"][:-stride]) / dt,
            _MAX_TURN_RATE,
        )
    rates |= {name: (np.abs(log[name]), _MAX_SPEED) for name in ("u", "v") if name in log}
    rates |= {"r": (np.abs(log["r"]), _MAX_TURN_RATE)} if "r" in log else {}
    for name, (values, limit) in rates.items():
        is_impossible = np.nan_to_num(values) > limit
        # single samples are outliers, which other checks report
        if is_impossible.sum() > max(0.01 * values.size, 2):
            unit = "rad/s" if limit == _MAX_TURN_RATE else "m/s"
            text = (
                f"{name} reaches {format_quantity(float(np.nanmax(values)), unit)}, more than a"
                f" vessel can ({format_quantity(limit, unit)}), in"
                f" {format_share(float(is_impossible.mean()))} of the samples"
            )
            yield make_finding(text, {"share": float(is_impossible.mean())})
