"""The topics of a recording: one clock for all, rates, gaps, publishers, lags and levers.

A header stamp says when something was measured, an arrival when somebody wrote it down. Stamps are
preferred; topics without one keep their arrivals, brought from the recorder's clock to the
senders'.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.frames import rotate
from residnet.core.log import Log, Remark, make_remark
from residnet.io.readers.recording import Recording, Series, match_topic, normalize_field_path
from residnet.io.readers.written import repeats_previous_row
from residnet.preprocessing.statistics import estimate_agreement

# zones differ by whole quarters of an hour
_QUARTER_HOUR = 900.0
# share of the messages that are taken to arrive without delay
_PROMPT_QUANTILE = 0.01
# offsets below this are delays of the transport, not of a clock, and no lags, s
_MIN_OFFSET = 0.1
# rows out of order that sorting mends: their share, and how far back they lie, s
_MAX_UNORDERED_SHARE, _MAX_BACKWARD_STEP = 0.01, 1.0
# a gap is this many times the usual step, and this many seconds
_GAP_STEPS, _GAP_SECONDS = 5.0, 0.5
# rows below which nothing is said about publishers, lags and levers
_MIN_ROWS = 100
# shortest step by which lags are looked for, s
_MIN_LAG_STEP = 0.05
# correlation that calls two signals the same quantity
_MIN_CORRELATION = 0.9
_MIN_LEVER_ARM = 0.2
"""Distance of two points of a vessel, m, that is worth telling; chosen by hand."""


def align_clocks(
    recording: Recording, delays: Mapping[str, float | None], zone: float | None = None
) -> Recording:
    """Return the recording with one clock for all: offsets removed, rows of every series in order.

    Args:
        delays: topic -> time in s by which its rows are older than their time says; they are moved
            back by it. None takes the usual latency of the topics that have stamps and arrivals,
            for one that has arrivals only.
        zone: time by which the recorder's clock is ahead of UTC, s; None estimates it from topics
            with stamp and arrival.
    """
    series = {name: _drop_constant_stamps(topic) for name, topic in recording.series.items()}
    delays_by_topic = {
        name: topic.arrival - topic.stamp
        for name, topic in series.items()
        if topic.stamp is not None and topic.arrival is not None and len(topic)
    }
    # of the messages that arrive at once
    prompt_delays = {
        name: float(np.quantile(delay, _PROMPT_QUANTILE)) for name, delay in delays_by_topic.items()
    }
    recorder_offset, remarks = _estimate_recorder_offset(list(prompt_delays.values()), zone)
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
            text = f"topic {name}: moved back by {delay:g} s, as the config asks"
            delay_remark = make_remark("note", "delay_corrected", text, delay=delay)
            topic = topic.shift_back(delay, delay).with_remarks(delay_remark)
        aligned[name] = topic
    return dataclasses.replace(recording, series=aligned, remarks=(*recording.remarks, *remarks))


def _drop_constant_stamps(topic: Series) -> Series:
    """Return the series without stamps that carry no time."""
    if topic.stamp is None or topic.arrival is None or len(topic) < 2 or np.ptp(topic.stamp):
        return topic
    rows = len(topic)
    text = f"topic {topic.name}: all {rows} header stamps are the same; arrival times are used"
    stamp_remark = make_remark("note", "empty_stamps", text, rows=rows)
    return dataclasses.replace(topic, stamp=None).with_remarks(stamp_remark)


def _estimate_recorder_offset(
    prompt_delays: Sequence[float], zone: float | None
) -> tuple[float, list[Remark]]:
    """Return the seconds that the recorder's clock is ahead of the senders', and remarks.

    `prompt_delays` is arrival less stamp of the promptest messages of each topic, s.
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
            " arrivals are moved by it"
        )
        remarks.append(make_remark("note", "time_zone", text, offset=zone))
    if 0.0 <= zone_residual <= _MIN_OFFSET:
        return zone, remarks
    text = (
        f"the recorder's clock is {zone_residual:+.3f} s from the header stamps of {len(prompt_delays)} topics;"
        " arrivals are moved by it"
    )
    return median_offset, [
        *remarks,
        make_remark("note", "clock_offset", text, offset=zone_residual, topics=len(prompt_delays)),
    ]


def _check_latency(name: str, delays: np.ndarray, offset: float) -> list[Remark]:
    """Return what the delays [T] of a topic tell, s, arrivals being on the senders' clock."""
    median_latency, max_latency = float(np.median(delays)), float(delays.max())
    if abs(offset) > _MIN_OFFSET:
        text = (
            f"topic {name}: stamps are {offset:+.3f} s from those of the other topics (of messages"
            " that arrive at once); its sender has another clock or stamps late: correct it with"
            " `delays`"
        )
        return [make_remark("will mislead", "clock_offset", text, offset=offset)]
    if max_latency > _MIN_OFFSET:
        text = (
            f"topic {name}: receive latency is {median_latency:.4f} s (median) and reaches {max_latency:.3f} s;"
            " header stamps are used"
        )
        return [make_remark("note", "latency", text, median=median_latency, maximum=max_latency)]
    return []


def _sort_and_deduplicate(topic: Series) -> Series:
    """Return the rows in order of time, none twice."""
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
    n_copies, n_conflicts = int(is_copy.sum()), int((~is_copy).sum())
    # of rows with one time the last is the newest
    deduplicated = topic.select_rows(np.append(np.diff(topic.clock) != 0.0, True))
    if n_copies:
        text = f"topic {topic.name}: {n_copies} rows repeat the row before; left out"
        deduplicated = deduplicated.with_remarks(
            make_remark("note", "duplicate_rows", text, rows=n_copies)
        )
    if n_conflicts:
        text = (
            f"topic {topic.name}: {n_conflicts} rows have the time of the row before but other values"
            " (several senders?); the last of each time is kept"
        )
        deduplicated = deduplicated.with_remarks(
            make_remark("will mislead", "repeated_stamps", text, rows=n_conflicts)
        )
    return deduplicated


def _repair_order(topic: Series, n_backward: int, max_backward_step: float) -> Series:
    figures = {"steps": float(n_backward), "farthest": max_backward_step}
    description = f"backwards {n_backward} times, by up to {max_backward_step:.3g} s"
    is_sortable = (
        n_backward <= max(1.0, _MAX_UNORDERED_SHARE * len(topic))
        and max_backward_step <= _MAX_BACKWARD_STEP
    )
    arrival, stamp = topic.arrival, topic.stamp
    if (
        stamp is not None
        and arrival is not None
        and not is_sortable
        and (np.diff(arrival) >= 0.0).all()
    ):
        median_latency = float(np.median(arrival - stamp))
        text = (
            f"topic {topic.name}: header stamps run {description}; arrival times less the median latency"
            f" of {median_latency:.3g} s are used instead"
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
    """Return the remarks on a series whose rows are in order."""
    if not len(series):
        return [make_remark("note", "empty_topic", f"topic {series.name}: holds no rows")]
    remarks = []
    empty_fields = [path for path, values in series.fields.items() if np.isnan(values).all()]
    if empty_fields:
        field_list = ", ".join(empty_fields[:6]) + (", ..." if len(empty_fields) > 6 else "")
        text = f"topic {series.name}: {len(empty_fields)} fields hold no number ({field_list})"
        remarks.append(make_remark("note", "empty_columns", text, fields=len(empty_fields)))
    if len(series) < 3:
        return remarks
    step = np.diff(series.clock)
    median_step, max_step = float(np.median(step)), float(step.max())
    rate = (len(series) - 1) / float(series.clock[-1] - series.clock[0])
    text = (
        f"topic {series.name}: {len(series)} rows, {rate:.3g} Hz, step {median_step:.3g} s (median),"
        f" spread {float(np.std(step)):.2g} s, longest {max_step:.3g} s"
    )
    figures = {"rows": len(series), "rate": rate, "step": median_step, "longest": max_step}
    remarks.append(make_remark("note", "topic_rate", text, **figures))
    n_gaps = int((step > max(_GAP_STEPS * median_step, _GAP_SECONDS)).sum())
    if n_gaps:
        gap_time = float(series.clock[int(np.argmax(step))])
        text = (
            f"topic {series.name}: {n_gaps} gaps, the longest {max_step:.3g} s at {gap_time:.1f} s; nothing"
            " is interpolated across"
        )
        remarks.append(
            make_remark("note", "topic_gaps", text, gaps=n_gaps, longest=max_step, at=gap_time)
        )
    return remarks + _detect_multiple_publishers(series, step)


def _detect_multiple_publishers(series: Series, step: np.ndarray) -> list[Remark]:
    """Return a remark where several publishers share the topic.

    They are recognised by the sender that the source names, else by values that leap away and come
    straight back (A, B, A) while rows follow each other at irregular short steps, as two trains of
    messages on one track do, or by such leaps alone where nearly every row is one and they are
    wide.
    """
    if series.sender is not None:
        names = [str(name) for name in dict.fromkeys(series.sender.tolist())]
        n_alternations = int((series.sender[1:] != series.sender[:-1]).sum())
        if len(names) > 1 and n_alternations >= len(names):
            text = (
                f"topic {series.name}: rows of {len(names)} senders alternate"
                f" ({', '.join(names[:6])}); name one with `sender`"
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
                f"topic {series.name}: several publishers seem to write to it: field {path} leaps"
                f" away and straight back in {return_share:.0%} of the rows, {short_step_share:.0%} of the steps"
                " are shorter than a fifth of the mean; do not use it unless the source tells its"
                " senders apart"
            )
            share_figures = {"returns": return_share, "short_steps": short_step_share}
            return [make_remark("will mislead", "several_publishers", text, **share_figures)]
    return []


def _measure_value_jumps(values: np.ndarray) -> tuple[float, float, float]:
    """Return the share of rows that change twice, that come back, and the leaps' width.

    A row comes back to the value before; the width is a share of the values' range.
    """
    lower, upper = np.quantile(values, (0.01, 0.99))
    change = np.abs(np.diff(values))
    first_change, second_change, two_step_change = (
        change[:-1],
        change[1:],
        np.abs(values[2:] - values[:-2]),
    )
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
    """Return the remarks on velocities and positions in topics that the log was not made of.

    `start` is the log's first sample on the recording's clock, s.
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
    is_finite = np.isfinite(values)
    interpolated: np.ndarray = np.interp(
        t, clock[is_finite], values[is_finite], left=np.nan, right=np.nan
    )
    return interpolated


def _detect_lag(
    series: Series, path: str, t: np.ndarray, clock: np.ndarray, rates: dict[str, np.ndarray]
) -> list[Remark]:
    step = max(float(np.median(np.diff(t))), _MIN_LAG_STEP)
    grid = np.arange(t[0], t[-1], step)
    values, rates_on_grid = (
        _interpolate_finite(grid, t, series[path]),
        {n: _interpolate_finite(grid, clock, r) for n, r in rates.items()},
    )
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
    correlation, lag = abs(matches[name].correlation), matches[name].lag
    is_finite = np.isfinite(values) & np.isfinite(rates_on_grid[name])
    correlation_without_lag = abs(
        float(np.corrcoef(values[is_finite], rates_on_grid[name][is_finite])[0, 1])
    )
    # a lag is reported only where it explains a good part of what the two differ by
    if 1.0 - correlation > 0.7 * (1.0 - correlation_without_lag):
        return []
    description = f"{'lags' if lag > 0.0 else 'leads'} {name} of the log by {abs(lag):.2f} s"
    text = (
        f"topic {series.name}: {path} {description} (correlation {correlation:.3f}, {correlation_without_lag:.3f} without the"
        " lag); give the topic's `delays` before it is used"
    )
    figures = {
        "lag": lag,
        "correlation": correlation,
        "correlation_without": correlation_without_lag,
    }
    return [make_remark("note", "topic_lag", text, **figures)]


def _detect_lever_arm(series: Series, t: np.ndarray, log: Log) -> list[Remark]:
    """Return whether a topic's positions turn about the log's.

    Both then belong to different points of the vessel.
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
    first_coordinate, second_coordinate = series[f"{prefix}.x"], series[f"{prefix}.y"]
    is_usable = np.isfinite(first_coordinate) & np.isfinite(second_coordinate) & np.isfinite(x)
    if is_usable.sum() < _MIN_ROWS or np.ptp(psi[is_usable]) < np.pi / 3:
        return []
    c, s, unit_column = (
        np.cos(psi[is_usable]),
        np.sin(psi[is_usable]),
        np.ones(int(is_usable.sum())),
    )
    columns = np.block(
        [
            [np.stack((c, -s, unit_column, 0.0 * unit_column), 1)],
            [np.stack((s, c, 0.0 * unit_column, unit_column), 1)],
        ]
    )
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
        f"topic {series.name}: its positions and the log's belong to points {lever_length:.2f} m apart:"
        f" the log's lies at ({lever_arm[0]:.2f}, {lever_arm[1]:.2f}) m (forward, starboard) of it, rest"
        f" {residual:.3f} m; give `position.antenna` where the log's is an antenna"
    )
    figures = {
        "forward": float(lever_arm[0]),
        "starboard": float(lever_arm[1]),
        "residual": residual,
    }
    return [make_remark("will mislead", "lever_arm", text, **figures)]
