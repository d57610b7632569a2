"""Clocks and checks of topics: offsets, delays, rates, gaps, publishers, lags and lever arms.

A header stamp is the time of a measurement on the sender's clock, an arrival the time of its
recording on the recorder's clock. Stamps are preferred. Arrivals of topics without stamps are
converted to the senders' clock.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.frames import rotate
from residnet.core.log import Log, Remark, make_remark
from residnet.io.readers.clock_repair import repeats_previous_row
from residnet.io.readers.recording import Recording, Series, match_topic, normalize_field_path
from residnet.preprocessing.statistics import estimate_agreement

# time zones differ by multiples of a quarter of an hour, s
_QUARTER_HOUR = 900.0
# quantile of the delays that counts as undelayed
_PROMPT_QUANTILE = 0.01
# smaller offsets are delays of the transport, not offsets of a clock, s
_MIN_OFFSET = 0.1
_MAX_UNORDERED_SHARE = 0.01
"""Largest share of unordered rows that sorting corrects."""
_MAX_BACKWARD_STEP = 1.0
"""Longest backward step of the time in s that sorting corrects."""
_GAP_STEPS = 5.0
"""Length in median steps above which a step is a gap, if it is also longer than `_GAP_SECONDS`."""
_GAP_SECONDS = 0.5
"""Length in s above which a step can be a gap."""
# fewest rows for checks of publishers, lags and lever arms
_MIN_ROWS = 100
# shortest step of the grid on which lags are estimated, s
_MIN_LAG_STEP = 0.05
# smallest correlation of two signals of the same quantity
_MIN_CORRELATION = 0.9
_MIN_LEVER_ARM = 0.2
"""Shortest lever arm in m that is reported."""


def align_clocks(
    recording: Recording,
    delays: Mapping[str, float | None],
    recorder_utc_offset: float | None = None,
) -> Recording:
    """Bring all topics of a recording to one clock and sort their rows.

    Args:
        recording: recording as loaded.
        delays: topic -> delay in s that is subtracted from its times. None subtracts the median
            latency of the topics with stamps and arrivals, if this topic has arrivals only.
        recorder_utc_offset: offset of the recorder's clock from UTC in s; None estimates it from
            topics with stamps and arrivals.
    """
    series = {name: _drop_constant_stamps(topic) for name, topic in recording.series.items()}
    delays_by_topic = {
        name: topic.arrival - topic.stamp
        for name, topic in series.items()
        if topic.stamp is not None and topic.arrival is not None and len(topic)
    }
    # the fastest messages have no transport delay: their delay is the offset of the clock
    prompt_delays = {
        name: float(np.quantile(delay, _PROMPT_QUANTILE)) for name, delay in delays_by_topic.items()
    }
    recorder_offset, remarks = _estimate_recorder_offset(
        list(prompt_delays.values()), recorder_utc_offset
    )
    median_delays = [
        float(np.median(delay)) - recorder_offset for delay in delays_by_topic.values()
    ]
    latency = max(0.0, float(np.median(median_delays))) if median_delays else 0.0
    aligned = {}
    for name, topic in series.items():
        topic = topic.shift_back(0.0, recorder_offset)
        if name in delays_by_topic:
            topic = topic.with_remarks(
                *_check_latency(
                    name,
                    delays_by_topic[name] - recorder_offset,
                    prompt_delays[name] - recorder_offset,
                )
            )
        configured_delays = [
            seconds for topic_name, seconds in delays.items() if match_topic(topic_name, [name])
        ]
        delay = configured_delays[0] if configured_delays else 0.0
        if delay is None:
            delay = latency if topic.stamp is None else 0.0
        topic = _sort_and_deduplicate(topic)
        if delay:
            text = f"topic {name}: times are reduced by the configured delay of {delay:g} s"
            delay_remark = make_remark("note", "delay_corrected", text, delay=delay)
            topic = topic.shift_back(delay, delay).with_remarks(delay_remark)
        aligned[name] = topic
    return dataclasses.replace(recording, series=aligned, remarks=(*recording.remarks, *remarks))


def _drop_constant_stamps(topic: Series) -> Series:
    """Return the series without its stamps if all of them are equal."""
    if topic.stamp is None or topic.arrival is None or len(topic) < 2 or np.ptp(topic.stamp):
        return topic
    rows = len(topic)
    text = f"topic {topic.name}: all {rows} header stamps are the same; arrival times are used"
    stamp_remark = make_remark("note", "empty_stamps", text, rows=rows)
    return dataclasses.replace(topic, stamp=None).with_remarks(stamp_remark)


def _estimate_recorder_offset(
    prompt_delays: Sequence[float], zone: float | None
) -> tuple[float, list[Remark]]:
    """Estimate the offset of the recorder's clock from the senders' clocks.

    Args:
        prompt_delays: arrival minus stamp of the fastest messages of each topic in s.
        zone: offset from UTC in s; None rounds it to quarters of an hour.

    Returns:
        The offset in s, and remarks.
    """
    if not prompt_delays:
        return zone or 0.0, []
    median_offset = float(np.median(prompt_delays))
    zone = _QUARTER_HOUR * round(median_offset / _QUARTER_HOUR) if zone is None else zone
    zone_residual = median_offset - zone
    remarks = []
    if zone:
        text = (
            f"the recorder's clock is {zone / 3600.0:+g} h from the header stamps (a time zone);"
            " arrivals are corrected"
        )
        remarks.append(make_remark("note", "time_zone", text, offset=zone))
    if 0.0 <= zone_residual <= _MIN_OFFSET:
        return zone, remarks
    text = (
        f"the recorder's clock is {zone_residual:+.3f} s from the header stamps of"
        f" {len(prompt_delays)} topics; arrivals are corrected"
    )
    return median_offset, [
        *remarks,
        make_remark("note", "clock_offset", text, offset=zone_residual, topics=len(prompt_delays)),
    ]


def _check_latency(name: str, delays: np.ndarray, offset: float) -> list[Remark]:
    """Return remarks on the latency of a topic.

    Args:
        name: name of the topic.
        delays: arrival minus stamp [T] in s, with the offset of the recorder's clock removed.
        offset: delay of the fastest messages in s.
    """
    median_latency = float(np.median(delays))
    max_latency = float(delays.max())
    if abs(offset) > _MIN_OFFSET:
        text = (
            f"topic {name}: stamps have an offset of {offset:+.3f} s from those of other topics"
            " (fastest messages); its sender has another clock or stamps late: correct it with"
            " `delays`"
        )
        return [make_remark("will mislead", "clock_offset", text, offset=offset)]
    if max_latency > _MIN_OFFSET:
        text = (
            f"topic {name}: receive latency is {median_latency:.4f} s (median) and at most"
            f" {max_latency:.3f} s; header stamps are used"
        )
        return [make_remark("note", "latency", text, median=median_latency, maximum=max_latency)]
    return []


def _sort_and_deduplicate(topic: Series) -> Series:
    """Return the series with sorted rows and unique times."""
    if len(topic) < 2:
        return topic
    time_steps = np.diff(topic.clock)
    n_backward = int((time_steps < 0.0).sum())
    if n_backward:
        topic = _repair_order(topic, n_backward, -float(time_steps.min()))
    repeated_rows = np.flatnonzero(np.diff(topic.clock) == 0.0) + 1
    if not repeated_rows.size:
        return topic
    is_copy = repeats_previous_row(topic.fields.values(), repeated_rows)
    n_copies = int(is_copy.sum())
    n_conflicts = int((~is_copy).sum())
    # of rows with equal times the last one is the newest
    deduplicated = topic.select_rows(np.append(np.diff(topic.clock) != 0.0, True))
    if n_copies:
        text = f"topic {topic.name}: {n_copies} rows repeat the previous row; left out"
        deduplicated = deduplicated.with_remarks(
            make_remark("note", "duplicate_rows", text, rows=n_copies)
        )
    if n_conflicts:
        text = (
            f"topic {topic.name}: {n_conflicts} rows have the time of the previous row but other"
            " values (several senders?); the last row of each time is used"
        )
        deduplicated = deduplicated.with_remarks(
            make_remark("will mislead", "repeated_stamps", text, rows=n_conflicts)
        )
    return deduplicated


def _repair_order(topic: Series, n_backward: int, max_backward_step: float) -> Series:
    """Return the series with increasing times.

    A few unordered rows are sorted. Otherwise stamps are replaced by arrivals minus the median
    latency if the arrivals increase; else the remark is fatal.

    Args:
        topic: series with decreasing times.
        n_backward: number of steps back.
        max_backward_step: largest step back in s.
    """
    figures = {"steps": float(n_backward), "farthest": max_backward_step}
    description = f"backwards {n_backward} times, by up to {max_backward_step:.3g} s"
    is_sortable = (
        n_backward <= max(1.0, _MAX_UNORDERED_SHARE * len(topic))
        and max_backward_step <= _MAX_BACKWARD_STEP
    )
    arrival = topic.arrival
    stamp = topic.stamp
    if (
        stamp is not None
        and arrival is not None
        and not is_sortable
        and (np.diff(arrival) >= 0.0).all()
    ):
        median_latency = float(np.median(arrival - stamp))
        text = (
            f"topic {topic.name}: header stamps run {description}; arrival times minus the median"
            f" latency of {median_latency:.3g} s are used instead"
        )
        order_remark = make_remark(
            "will mislead", "stamps_run_backwards", text, **figures, latency=median_latency
        )
        return dataclasses.replace(topic, stamp=arrival - median_latency).with_remarks(order_remark)
    text = f"topic {topic.name}: time runs {description}; "
    if is_sortable:
        order_remark = make_remark("note", "out_of_order", f"{text}rows are sorted", **figures)
    else:
        text += "split the recording where its clock restarts"
        order_remark = make_remark("fatal", "time_runs_backwards", text, **figures)
    return topic.select_rows(np.argsort(topic.clock, kind="stable")).with_remarks(order_remark)


def topic_statistics(series: Series) -> list[Remark]:
    """Return remarks on rate, gaps, empty fields and publishers of a sorted series."""
    if not len(series):
        return [make_remark("note", "empty_topic", f"topic {series.name}: has no rows")]
    remarks = []
    empty_fields = [path for path, values in series.fields.items() if np.isnan(values).all()]
    if empty_fields:
        field_list = ", ".join(empty_fields[:6]) + (", ..." if len(empty_fields) > 6 else "")
        text = f"topic {series.name}: {len(empty_fields)} fields have no values ({field_list})"
        remarks.append(make_remark("note", "empty_columns", text, fields=len(empty_fields)))
    if len(series) < 3:
        return remarks
    step = np.diff(series.clock)
    median_step = float(np.median(step))
    max_step = float(step.max())
    rate = (len(series) - 1) / float(series.clock[-1] - series.clock[0])
    text = (
        f"topic {series.name}: {len(series)} rows, {rate:.3g} Hz, median step {median_step:.3g} s,"
        f" standard deviation {float(np.std(step)):.2g} s, longest step {max_step:.3g} s"
    )
    figures = {"rows": len(series), "rate": rate, "step": median_step, "longest": max_step}
    remarks.append(make_remark("note", "topic_rate", text, **figures))
    n_gaps = int((step > max(_GAP_STEPS * median_step, _GAP_SECONDS)).sum())
    if n_gaps:
        gap_time = float(series.clock[int(np.argmax(step))])
        text = (
            f"topic {series.name}: {n_gaps} gaps, the longest {max_step:.3g} s at {gap_time:.1f} s;"
            " gaps are not interpolated"
        )
        remarks.append(
            make_remark("note", "topic_gaps", text, gaps=n_gaps, longest=max_step, at=gap_time)
        )
    return remarks + _detect_multiple_publishers(series, step)


def _detect_multiple_publishers(series: Series, step: np.ndarray) -> list[Remark]:
    """Return a remark if several publishers share a topic.

    They are detected from the sender of each row. Without senders, values that jump and return
    immediately (A, B, A) indicate two publishers, if the steps between rows are irregular and
    short, or if nearly all rows have such jumps and the jumps are wide.

    Args:
        series: sorted series.
        step: time steps [T - 1] in s.
    """
    if series.sender is not None:
        names = [str(name) for name in dict.fromkeys(series.sender.tolist())]
        n_alternations = int((series.sender[1:] != series.sender[:-1]).sum())
        if len(names) > 1 and n_alternations >= len(names):
            text = (
                f"topic {series.name}: rows of {len(names)} senders alternate"
                f" ({', '.join(names[:6])}); select one with `sender`"
            )
            figures = {"senders": len(names), "turns": n_alternations}
            return [make_remark("will mislead", "several_publishers", text, **figures)]
    short_step_share = float((step < 0.2 * step.mean()).mean())
    for path, values in series.fields.items():
        finite_values = values[np.isfinite(values)]
        if finite_values.size < _MIN_ROWS:
            continue
        jump_share, return_share, jump_width = _measure_value_jumps(finite_values)
        is_bursty = (
            short_step_share > 0.15 and return_share > 0.05 and return_share > 0.3 * jump_share
        )
        is_mixed = (
            short_step_share > 0.05
            and return_share > 0.2
            and return_share > 0.35 * jump_share
            and jump_width > 0.05
        )
        is_alternating = (
            return_share > 0.3 and return_share > 0.8 * jump_share and jump_width > 0.05
        )
        if is_bursty or is_mixed or is_alternating:
            text = (
                f"topic {series.name}: probably several publishers: field {path} jumps and returns"
                f" in {return_share:.0%} of the rows, {short_step_share:.0%} of the steps are"
                " shorter than a fifth of the mean; use it only if the source distinguishes its"
                " senders"
            )
            share_figures = {"returns": return_share, "short_steps": short_step_share}
            return [make_remark("will mislead", "several_publishers", text, **share_figures)]
    return []


def _measure_value_jumps(values: np.ndarray) -> tuple[float, float, float]:
    """Return statistics of the jumps in values [T].

    Returns:
        The share of rows that change in two consecutive steps, the share that returns to the value
        two rows before, and the median width of the latter jumps relative to the range of values.
    """
    lower, upper = np.quantile(values, (0.01, 0.99))
    change = np.abs(np.diff(values))
    first_change = change[:-1]
    second_change = change[1:]
    two_step_change = np.abs(values[2:] - values[:-2])
    is_jump = (first_change > 0.0) & (second_change > 0.0)
    is_return = is_jump & (two_step_change <= 0.1 * np.minimum(first_change, second_change))
    relative_width = (
        float(np.median(first_change[is_return])) / float(upper - lower)
        if is_return.any() and upper > lower
        else 0.0
    )
    return float(is_jump.mean()), float(is_return.mean()), relative_width


def check_unused_topics(
    unused_series: Sequence[Series], log: Log, start_time: float
) -> list[Remark]:
    """Return remarks on lags and lever arms of topics that the log does not use.

    Args:
        unused_series: series with possible velocities and positions.
        log: log of the recording.
        start_time: time of the log's first sample on the clock of the recording in s.
    """
    rates: dict[str, np.ndarray] = {n: log[n] for n in ("u", "v", "r") if n in log.channels}
    if {"u", "v", "psi"} <= set(log.channels):
        over_ground = rotate(log["u"], log["v"], log["psi"])
        rates |= zip(("north velocity", "east velocity"), over_ground, strict=True)
    rates = {
        name: values for name, values in rates.items() if np.isfinite(values).sum() > _MIN_ROWS
    }
    remarks: list[Remark] = []
    for series in unused_series:
        if len(series) >= _MIN_ROWS:
            t = series.clock - start_time + log.t[0]
            for path in series.fields:
                if normalize_field_path(path).endswith(("linear_x", "linear_y", "angular_z")):
                    remarks += _detect_lag(series, path, t, log.t, rates)
            remarks += _detect_lever_arm(series, t, log)
    return remarks


def _interpolate_finite(t: np.ndarray, clock: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate the finite values at times t, NaN outside of their range."""
    is_finite = np.isfinite(values)
    interpolated: np.ndarray = np.interp(
        t, clock[is_finite], values[is_finite], left=np.nan, right=np.nan
    )
    return interpolated


def _detect_lag(
    series: Series, path: str, t: np.ndarray, clock: np.ndarray, rates: dict[str, np.ndarray]
) -> list[Remark]:
    """Return a remark if a field follows a velocity of the log with a lag.

    Args:
        series: series with the field.
        path: path of the field.
        t: times of the series [T] in s on the log's clock.
        clock: times of the log [K] in s.
        rates: velocities of the log [K] by name.
    """
    step = max(float(np.median(np.diff(t))), _MIN_LAG_STEP)
    grid = np.arange(t[0], t[-1], step)
    values = _interpolate_finite(grid, t, series[path])
    rates_on_grid = {n: _interpolate_finite(grid, clock, r) for n, r in rates.items()}
    matches = {
        name: match
        for name in rates_on_grid
        if (match := estimate_agreement(rates_on_grid[name], values, step))
    }
    name = max(matches, key=lambda name: abs(matches[name].correlation), default="")
    if (
        not name
        or abs(matches[name].correlation) < _MIN_CORRELATION
        or abs(matches[name].lag) < _MIN_OFFSET
    ):
        return []
    correlation = abs(matches[name].correlation)
    lag = matches[name].lag
    is_finite = np.isfinite(values) & np.isfinite(rates_on_grid[name])
    correlation_without_lag = abs(
        float(np.corrcoef(values[is_finite], rates_on_grid[name][is_finite])[0, 1])
    )
    # report a lag only if it explains more than 30 % of the unexplained correlation
    if 1.0 - correlation > 0.7 * (1.0 - correlation_without_lag):
        return []
    description = f"{'lags' if lag > 0.0 else 'leads'} {name} of the log by {abs(lag):.2f} s"
    text = (
        f"topic {series.name}: {path} {description} (correlation {correlation:.3f},"
        f" {correlation_without_lag:.3f} without the lag); set `delays` of the topic before it is"
        " used"
    )
    figures = {
        "lag": lag,
        "correlation": correlation,
        "correlation_without": correlation_without_lag,
    }
    return [make_remark("note", "topic_lag", text, **figures)]


def _detect_lever_arm(series: Series, t: np.ndarray, log: Log) -> list[Remark]:
    """Return a remark if a topic has positions of another point of the vessel than the log.

    The difference of both positions is fitted by a constant vector in body axes (the lever arm)
    plus a constant vector in earth axes.

    Args:
        series: series with possible positions.
        t: times of the series [T] in s on the log's clock.
        log: log of the recording.
    """
    prefixes = [f"{parent}position" for parent in ("pose.", "pose.pose.", "")]
    prefix = next(
        (p for p in prefixes if series.has_field(f"{p}.x") and series.has_field(f"{p}.y")), None
    )
    if prefix is None or not {"x", "y", "psi"} <= set(log.channels):
        return []
    is_finite = np.isfinite(log["psi"]) & np.isfinite(log["x"]) & np.isfinite(log["y"])
    if is_finite.sum() < _MIN_ROWS:
        return []
    x, y, psi = (
        _interpolate_finite(t, log.t[is_finite], log[name][is_finite]) for name in ("x", "y", "psi")
    )
    first_coordinate = series[f"{prefix}.x"]
    second_coordinate = series[f"{prefix}.y"]
    is_usable = np.isfinite(first_coordinate) & np.isfinite(second_coordinate) & np.isfinite(x)
    if is_usable.sum() < _MIN_ROWS or np.ptp(psi[is_usable]) < np.pi / 3:
        return []
    c = np.cos(psi[is_usable])
    s = np.sin(psi[is_usable])
    unit_column = np.ones_like(c)
    columns = np.block(
        [
            [np.stack((c, -s, unit_column, 0.0 * unit_column), 1)],
            [np.stack((s, c, 0.0 * unit_column, unit_column), 1)],
        ]
    )
    # the source may have its axes in either order
    best_fit = (np.inf, np.zeros(4), 0.0)
    for north, east in (
        (first_coordinate, second_coordinate),
        (second_coordinate, first_coordinate),
    ):
        position_difference = (x - north)[is_usable], (y - east)[is_usable]
        offset = np.concatenate(position_difference)
        lever_arm, *_ = np.linalg.lstsq(columns, offset, rcond=None)
        residual = float(np.sqrt(np.mean((columns @ lever_arm - offset) ** 2)))
        best_fit = min(
            best_fit,
            (residual, lever_arm, float(sum(map(np.std, position_difference)))),
            key=lambda fit: fit[0],
        )
    residual, lever_arm, offset_std = best_fit
    lever_length = float(np.hypot(lever_arm[0], lever_arm[1]))
    if lever_length < _MIN_LEVER_ARM or residual > 0.5 * offset_std or residual > lever_length:
        return []
    text = (
        f"topic {series.name}: its positions and those of the log are {lever_length:.2f} m from"
        f" each other: the position of the log is ({lever_arm[0]:.2f}, {lever_arm[1]:.2f}) m"
        f" (forward, starboard) from that of the topic, residual {residual:.3f} m; set"
        " `position.antenna` if the log has the position of an antenna"
    )
    figures = {
        "forward": float(lever_arm[0]),
        "starboard": float(lever_arm[1]),
        "residual": residual,
    }
    return [make_remark("will mislead", "lever_arm", text, **figures)]
