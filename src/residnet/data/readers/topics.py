"""The topics of a recording: one clock for all, rates, gaps, publishers, lags and levers.

A header stamp says when something was measured, an arrival when somebody wrote it down. Stamps are
preferred; topics without one keep their arrivals, brought from the recorder's clock to the
senders'.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.data.readers.base import turned
from residnet.data.readers.recording import Recording, Remark, Series, key_of, remark, same_topic
from residnet.data.readers.written import as_before
from residnet.data.statistics import agreement

# zones differ by whole quarters of an hour
_QUARTER = 900.0
# share of the messages that are taken to arrive without delay
_PROMPT = 0.01
# offsets below this are delays of the transport, not of a clock, and no lags, s
_TELLING = 0.1
# rows out of order that sorting mends: their share, and how far back they lie, s
_FEW, _NEAR = 0.01, 1.0
# a gap is this many times the usual step, and this many seconds
_GAP_STEPS, _GAP_SECONDS = 5.0, 0.5
# rows below which nothing is said about publishers, lags and levers
_ENOUGH = 100
# shortest step by which lags are looked for, s
_STEP = 0.05
# correlation that calls two signals the same quantity
_SAME = 0.9
_LEVER = 0.2
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
    series = {name: _plausible(topic) for name, topic in recording.series.items()}
    late = {
        name: topic.arrival - topic.stamp
        for name, topic in series.items()
        if topic.stamp is not None and topic.arrival is not None and len(topic)
    }
    # of the messages that arrive at once
    prompt = {name: float(np.quantile(delay, _PROMPT)) for name, delay in late.items()}
    shift, remarks = _recorder(list(prompt.values()), zone)
    usual = [float(np.median(delay)) - shift for delay in late.values()]
    latency = max(0.0, float(np.median(usual))) if usual else 0.0
    out = {}
    for name, topic in series.items():
        topic = topic.earlier(0.0, shift)
        if name in late:
            topic = topic.noting(*_latency(name, late[name] - shift, prompt[name] - shift))
        given = [seconds for asked, seconds in delays.items() if same_topic(asked, [name])]
        delay = given[0] if given else 0.0
        if delay is None:
            delay = latency if topic.stamp is None else 0.0
        topic = _ordered(topic)
        if delay:
            text = f"topic {name}: moved back by {delay:g} s, as the config asks"
            said = remark("note", "delay_corrected", text, delay=delay)
            topic = topic.earlier(delay, delay).noting(said)
        out[name] = topic
    return dataclasses.replace(recording, series=out, remarks=(*recording.remarks, *remarks))


def _plausible(topic: Series) -> Series:
    """Return the series without stamps that carry no time."""
    if topic.stamp is None or topic.arrival is None or len(topic) < 2 or np.ptp(topic.stamp):
        return topic
    rows = len(topic)
    text = f"topic {topic.name}: all {rows} header stamps are the same; arrival times are used"
    found = remark("note", "empty_stamps", text, rows=rows)
    return dataclasses.replace(topic, stamp=None).noting(found)


def _recorder(prompt: Sequence[float], zone: float | None) -> tuple[float, list[Remark]]:
    """Return the seconds that the recorder's clock is ahead of the senders', and remarks.

    `prompt` is arrival less stamp of the promptest messages of each topic, s.
    """
    if not prompt:
        return zone or 0.0, []
    common = float(np.median(prompt))
    zone = _QUARTER * round(common / _QUARTER) if zone is None else zone
    rest = common - zone
    remarks = []
    if zone:
        text = (
            f"the recorder's clock is {zone / 3600.0:+g} h from the header stamps (a time zone);"
            " arrivals are moved by it"
        )
        remarks.append(remark("note", "time_zone", text, offset=zone))
    if 0.0 <= rest <= _TELLING:
        return zone, remarks
    text = (
        f"the recorder's clock is {rest:+.3f} s from the header stamps of {len(prompt)} topics;"
        " arrivals are moved by it"
    )
    return common, [*remarks, remark("note", "clock_offset", text, offset=rest, topics=len(prompt))]


def _latency(name: str, late: np.ndarray, offset: float) -> list[Remark]:
    """Return what the delays [T] of a topic tell, s, arrivals being on the senders' clock."""
    usual, worst = float(np.median(late)), float(late.max())
    if abs(offset) > _TELLING:
        text = (
            f"topic {name}: stamps are {offset:+.3f} s from those of the other topics (of messages"
            " that arrive at once); its sender has another clock or stamps late: correct it with"
            " `delays`"
        )
        return [remark("will mislead", "clock_offset", text, offset=offset)]
    if worst > _TELLING:
        text = (
            f"topic {name}: receive latency is {usual:.4f} s (median) and reaches {worst:.3f} s;"
            " header stamps are used"
        )
        return [remark("note", "latency", text, median=usual, maximum=worst)]
    return []


def _ordered(topic: Series) -> Series:
    """Return the rows in order of time, none twice."""
    if len(topic) < 2:
        return topic
    back = np.diff(topic.clock)
    behind = int((back < 0.0).sum())
    if behind:
        topic = _sorted(topic, behind, -float(back.min()))
    again = np.flatnonzero(np.diff(topic.clock) == 0.0) + 1
    if not again.size:
        return topic
    equal = as_before(topic.fields.values(), again)
    copies, others = int(equal.sum()), int((~equal).sum())
    # of rows with one time the last is the newest
    kept = topic.where(np.append(np.diff(topic.clock) != 0.0, True))
    if copies:
        text = f"topic {topic.name}: {copies} rows repeat the row before; left out"
        kept = kept.noting(remark("note", "duplicate_rows", text, rows=copies))
    if others:
        text = (
            f"topic {topic.name}: {others} rows have the time of the row before but other values"
            " (several senders?); the last of each time is kept"
        )
        kept = kept.noting(remark("will mislead", "repeated_stamps", text, rows=others))
    return kept


def _sorted(topic: Series, behind: int, farthest: float) -> Series:
    figures = {"steps": float(behind), "farthest": farthest}
    back = f"backwards {behind} times, by up to {farthest:.3g} s"
    mends = behind <= max(1.0, _FEW * len(topic)) and farthest <= _NEAR
    arrival, stamp = topic.arrival, topic.stamp
    if stamp is not None and arrival is not None and not mends and (np.diff(arrival) >= 0.0).all():
        usual = float(np.median(arrival - stamp))
        text = (
            f"topic {topic.name}: header stamps run {back}; arrival times less the median latency"
            f" of {usual:.3g} s are used instead"
        )
        found = remark("will mislead", "stamps_run_backwards", text, **figures, latency=usual)
        return dataclasses.replace(topic, stamp=arrival - usual).noting(found)
    text = f"topic {topic.name}: time runs {back}; "
    if mends:
        found = remark("note", "out_of_order", f"{text}rows are sorted", **figures)
    else:
        text += "split the recording where its clock restarts"
        found = remark("fatal", "time_runs_backwards", text, **figures)
    return topic.where(np.argsort(topic.clock, kind="stable")).noting(found)


def traffic(series: Series) -> list[Remark]:
    """Return the remarks on a series whose rows are in order."""
    if not len(series):
        return [remark("note", "empty_topic", f"topic {series.name}: holds no rows")]
    out = []
    empty = [path for path, values in series.fields.items() if np.isnan(values).all()]
    if empty:
        shown = ", ".join(empty[:6]) + (", ..." if len(empty) > 6 else "")
        text = f"topic {series.name}: {len(empty)} fields hold no number ({shown})"
        out.append(remark("note", "empty_columns", text, fields=len(empty)))
    if len(series) < 3:
        return out
    step = np.diff(series.clock)
    usual, longest = float(np.median(step)), float(step.max())
    rate = (len(series) - 1) / float(series.clock[-1] - series.clock[0])
    text = (
        f"topic {series.name}: {len(series)} rows, {rate:.3g} Hz, step {usual:.3g} s (median),"
        f" spread {float(np.std(step)):.2g} s, longest {longest:.3g} s"
    )
    figures = {"rows": len(series), "rate": rate, "step": usual, "longest": longest}
    out.append(remark("note", "topic_rate", text, **figures))
    gaps = int((step > max(_GAP_STEPS * usual, _GAP_SECONDS)).sum())
    if gaps:
        at = float(series.clock[int(np.argmax(step))])
        text = (
            f"topic {series.name}: {gaps} gaps, the longest {longest:.3g} s at {at:.1f} s; nothing"
            " is interpolated across"
        )
        out.append(remark("note", "topic_gaps", text, gaps=gaps, longest=longest, at=at))
    return out + _publishers(series, step)


def _publishers(series: Series, step: np.ndarray) -> list[Remark]:
    """Return a remark where several publishers share the topic.

    They are recognised by the sender that the source names, else by values that leap away and come
    straight back (A, B, A) while rows follow each other at irregular short steps, as two trains of
    messages on one track do, or by such leaps alone where nearly every row is one and they are
    wide.
    """
    if series.sender is not None:
        names = [str(name) for name in dict.fromkeys(series.sender.tolist())]
        turns = int((series.sender[1:] != series.sender[:-1]).sum())
        if len(names) > 1 and turns >= len(names):
            text = (
                f"topic {series.name}: rows of {len(names)} senders alternate"
                f" ({', '.join(names[:6])}); name one with `sender`"
            )
            figures = {"senders": len(names), "turns": turns}
            return [remark("will mislead", "several_publishers", text, **figures)]
    short = float((step < 0.2 * step.mean()).mean())
    for path, values in series.fields.items():
        known = values[np.isfinite(values)]
        if known.size < _ENOUGH:
            continue
        leaps, returns, width = _returns(known)
        bursts = short > 0.15 and returns > 0.05 and returns > 0.3 * leaps
        mixed = short > 0.05 and returns > 0.2 and returns > 0.35 * leaps and width > 0.05
        in_turns = returns > 0.3 and returns > 0.8 * leaps and width > 0.05
        if bursts or mixed or in_turns:
            text = (
                f"topic {series.name}: several publishers seem to write to it: field {path} leaps"
                f" away and straight back in {returns:.0%} of the rows, {short:.0%} of the steps"
                " are shorter than a fifth of the mean; do not use it unless the source tells its"
                " senders apart"
            )
            told = {"returns": returns, "short_steps": short}
            return [remark("will mislead", "several_publishers", text, **told)]
    return []


def _returns(known: np.ndarray) -> tuple[float, float, float]:
    """Return the share of rows that change twice, that come back, and the leaps' width.

    A row comes back to the value before; the width is a share of the values' range.
    """
    low, high = np.quantile(known, (0.01, 0.99))
    change = np.abs(np.diff(known))
    first, second, over = change[:-1], change[1:], np.abs(known[2:] - known[:-2])
    leap = (first > 0.0) & (second > 0.0)
    back = leap & (over <= 0.1 * np.minimum(first, second))
    width = float(np.median(first[back])) / float(high - low) if back.any() and high > low else 0.0
    return float(leap.mean()), float(back.mean()), width


def beside(idle: Sequence[Series], log: Log, start: float) -> list[Remark]:
    """Return the remarks on velocities and positions in topics that the log was not made of.

    `start` is the log's first sample on the recording's clock, s.
    """
    rates: dict[str, np.ndarray] = {n: log[n] for n in ("u", "v", "r") if n in log.channels}
    if {"u", "v", "psi"} <= set(log.channels):
        over_ground = turned(log["u"], log["v"], log["psi"])
        rates |= zip(("north velocity", "east velocity"), over_ground, strict=True)
    rates = {name: values for name, values in rates.items() if np.isfinite(values).sum() > _ENOUGH}
    out: list[Remark] = []
    for series in idle:
        if len(series) >= _ENOUGH:
            t = series.clock - start + log.t[0]
            for path in series.fields:
                if key_of(path).endswith(("linear_x", "linear_y", "angular_z")):
                    out += _lag(series, path, t, log.t, rates)
            out += _lever(series, t, log)
    return out


def _at(t: np.ndarray, clock: np.ndarray, values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    out: np.ndarray = np.interp(t, clock[known], values[known], left=np.nan, right=np.nan)
    return out


def _lag(
    series: Series, path: str, t: np.ndarray, clock: np.ndarray, rates: dict[str, np.ndarray]
) -> list[Remark]:
    step = max(float(np.median(np.diff(t))), _STEP)
    grid = np.arange(t[0], t[-1], step)
    values, seen = _at(grid, t, series[path]), {n: _at(grid, clock, r) for n, r in rates.items()}
    found = {name: match for name in seen if (match := agreement(seen[name], values, step))}
    name = max(found, key=lambda name: abs(found[name].correlation), default="")
    if not name or abs(found[name].correlation) < _SAME or abs(found[name].lag) < _TELLING:
        return []
    size, lag = abs(found[name].correlation), found[name].lag
    known = np.isfinite(values) & np.isfinite(seen[name])
    without = abs(float(np.corrcoef(values[known], seen[name][known])[0, 1]))
    # a lag is reported only where it explains a good part of what the two differ by
    if 1.0 - size > 0.7 * (1.0 - without):
        return []
    verb = f"{'lags' if lag > 0.0 else 'leads'} {name} of the log by {abs(lag):.2f} s"
    text = (
        f"topic {series.name}: {path} {verb} (correlation {size:.3f}, {without:.3f} without the"
        " lag); give the topic's `delays` before it is used"
    )
    figures = {"lag": lag, "correlation": size, "correlation_without": without}
    return [remark("note", "topic_lag", text, **figures)]


def _lever(series: Series, t: np.ndarray, log: Log) -> list[Remark]:
    """Return whether a topic's positions turn about the log's.

    Both then belong to different points of the vessel.
    """
    pairs = [f"{start}position" for start in ("pose.", "pose.pose.", "")]
    pair = next((p for p in pairs if series.has(f"{p}.x") and series.has(f"{p}.y")), None)
    if pair is None or not {"x", "y", "psi"} <= set(log.channels):
        return []
    known = np.isfinite(log["psi"]) & np.isfinite(log["x"]) & np.isfinite(log["y"])
    if known.sum() < _ENOUGH:
        return []
    x, y, psi = (_at(t, log.t[known], log[name][known]) for name in ("x", "y", "psi"))
    first, second = series[f"{pair}.x"], series[f"{pair}.y"]
    good = np.isfinite(first) & np.isfinite(second) & np.isfinite(x)
    if good.sum() < _ENOUGH or np.ptp(psi[good]) < np.pi / 3:
        return []
    c, s, one = np.cos(psi[good]), np.sin(psi[good]), np.ones(int(good.sum()))
    columns = np.block(
        [[np.stack((c, -s, one, 0.0 * one), 1)], [np.stack((s, c, 0.0 * one, one), 1)]]
    )
    best = (np.inf, np.zeros(4), 0.0)
    for north, east in ((first, second), (second, first)):
        apart = (x - north)[good], (y - east)[good]
        offset = np.concatenate(apart)
        lever, *_ = np.linalg.lstsq(columns, offset, rcond=None)
        residual = float(np.sqrt(np.mean((columns @ lever - offset) ** 2)))
        best = min(best, (residual, lever, float(sum(map(np.std, apart)))), key=lambda fit: fit[0])
    residual, lever, spread = best
    length = float(np.hypot(lever[0], lever[1]))
    if length < _LEVER or residual > 0.5 * spread or residual > length:
        return []
    text = (
        f"topic {series.name}: its positions and the log's belong to points {length:.2f} m apart:"
        f" the log's lies at ({lever[0]:.2f}, {lever[1]:.2f}) m (forward, starboard) of it, rest"
        f" {residual:.3f} m; give `position.antenna` where the log's is an antenna"
    )
    figures = {"forward": float(lever[0]), "starboard": float(lever[1]), "residual": residual}
    return [remark("will mislead", "lever_arm", text, **figures)]
