"""The clocks of a recording: sender against recorder, time zones, latency, order of the rows.

A header stamp says when something was measured, an arrival when somebody wrote it down. Stamps are
preferred; topics without one keep their arrivals, brought from the recorder's clock to the
senders'.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from residnet.data.readers.recording import Recording, Remark, Series, remark, same_topic

# zones differ by whole quarters of an hour
_QUARTER = 900.0
# share of the messages that are taken to arrive without delay
_PROMPT = 0.01
# offsets below this are delays of the transport, not of a clock, s
_TELLING = 0.1
# rows out of order that sorting mends: their share, and how far back they lie, s
_FEW, _NEAR = 0.01, 1.0


def settle(
    recording: Recording, delays: Mapping[str, float | None], zone: float | None = None
) -> Recording:
    """Return the recording with one clock for all: offsets removed, rows of every series in order.

    Args:
        recording: as read.
        delays: topic -> time in s by which its rows are older than their time says; they are moved
            back by it. None takes the usual latency of the topics that have stamps and arrivals,
            for one that has arrivals only.
        zone: time by which the recorder's clock is ahead of UTC, s; None estimates it from topics
            with stamp and arrival.
    """
    series = {name: _plausible(one) for name, one in recording.series.items()}
    offsets = {
        name: _offset(one)
        for name, one in series.items()
        if one.stamp is not None and one.arrival is not None and len(one)
    }
    shift, remarks = _recorder(offsets, zone)
    late = [float(np.median(series[name].arrival - series[name].stamp)) - shift for name in offsets]  # type: ignore[operator]
    usual = max(0.0, float(np.median(late))) if late else 0.0
    out = {}
    for name, one in series.items():
        arrival = None if one.arrival is None else one.arrival - shift
        one = dataclasses.replace(one, arrival=arrival)
        if name in offsets:
            one = one.noting(*_latency(one, offsets[name] - shift))
        delay = next(
            (seconds for topic, seconds in delays.items() if same_topic(topic, [name])), 0.0
        )
        out[name] = _moved(
            _ordered(one), (usual if one.stamp is None else 0.0) if delay is None else delay
        )
    return dataclasses.replace(recording, series=out, remarks=(*recording.remarks, *remarks))


def _plausible(one: Series) -> Series:
    """Return the series without stamps that carry no time."""
    if one.stamp is None or not len(one):
        return one
    if len(one) > 1 and np.ptp(one.stamp) == 0.0 and one.arrival is not None:
        text = (
            f"topic {one.name}: all {len(one)} header stamps are the same; arrival times are used"
        )
        return dataclasses.replace(one, stamp=None).noting(
            remark("note", "empty_stamps", text, rows=len(one))
        )
    return one


def _offset(one: Series) -> float:
    """Return the arrival less stamp of the promptest messages, s."""
    assert one.stamp is not None
    assert one.arrival is not None
    return float(np.quantile(one.arrival - one.stamp, _PROMPT))


def _recorder(offsets: Mapping[str, float], zone: float | None) -> tuple[float, tuple[Remark, ...]]:
    """Return the seconds that the recorder's clock is ahead of the senders', and a remark."""
    if not offsets:
        return zone or 0.0, ()
    common = float(np.median(list(offsets.values())))
    zone = _QUARTER * round(common / _QUARTER) if zone is None else zone
    rest = common - zone
    remarks = []
    if zone:
        text = (
            f"the recorder's clock is {zone / 3600.0:+g} h from the header stamps (a time zone);"
            " arrivals are moved by it"
        )
        remarks.append(remark("note", "time_zone", text, offset=zone))
    if abs(rest) <= _TELLING and rest >= 0.0:
        return zone, tuple(remarks)
    text = (
        f"the recorder's clock is {rest:+.3f} s from the header stamps of {len(offsets)} topics;"
        " arrivals are moved by it"
    )
    return common, (
        *remarks,
        remark("note", "clock_offset", text, offset=rest, topics=len(offsets)),
    )


def _latency(one: Series, offset: float) -> list[Remark]:
    """Return the latency of a topic with stamps and arrivals.

    Arrivals are on the senders' clock.
    """
    assert one.stamp is not None
    assert one.arrival is not None
    late = one.arrival - one.stamp
    usual, worst = float(np.median(late)), float(late.max())
    out = []
    if abs(offset) > _TELLING:
        text = (
            f"topic {one.name}: stamps are {offset:+.3f} s from those of the other topics (of"
            " messages that arrive at once); its sender has another clock or stamps late: correct"
            " it with `delays`"
        )
        out.append(remark("will mislead", "clock_offset", text, offset=offset))
    elif worst > _TELLING:
        text = (
            f"topic {one.name}: receive latency is {usual:.4f} s (median) and reaches {worst:.3f}"
            " s; header stamps are used"
        )
        out.append(remark("note", "latency", text, median=usual, maximum=worst))
    return out


def _ordered(one: Series) -> Series:
    """Return the rows in order of time, none twice."""
    if len(one) < 2:
        return one
    back = np.diff(one.clock)
    behind = int((back < 0.0).sum())
    if behind:
        one = _sorted(one, behind, -float(back.min()))
    same = np.append(False, np.diff(one.clock) == 0.0)
    if not same.any():
        return one
    rows = np.stack(list(one.fields.values())) if one.fields else np.zeros((1, len(one)))
    equal = same & np.append(
        False,
        ((rows[:, 1:] == rows[:, :-1]) | (np.isnan(rows[:, 1:]) & np.isnan(rows[:, :-1]))).all(
            axis=0
        ),
    )
    copies, others = int(equal.sum()), int((same & ~equal).sum())
    # of rows with one time the last is the newest
    kept = one.where(np.append(~same[1:], True))
    if copies:
        kept = kept.noting(
            remark(
                "note",
                "duplicate_rows",
                f"topic {one.name}: {copies} rows repeat the row before; left out",
                rows=copies,
            )
        )
    if others:
        text = (
            f"topic {one.name}: {others} rows have the time of the row before but other values"
            " (several senders?); the last of each time is kept"
        )
        kept = kept.noting(remark("will mislead", "repeated_stamps", text, rows=others))
    return kept


def _sorted(one: Series, behind: int, farthest: float) -> Series:
    figures = {"steps": float(behind), "farthest": farthest}
    if behind <= max(1.0, _FEW * len(one)) and farthest <= _NEAR:
        text = (
            f"topic {one.name}: time runs backwards {behind} times, by up to {farthest:.3g} s; rows"
            " are sorted"
        )
        return one.where(np.argsort(one.clock, kind="stable")).noting(
            remark("note", "out_of_order", text, **figures)
        )
    if one.stamp is not None and one.arrival is not None and (np.diff(one.arrival) >= 0.0).all():
        usual = float(np.median(one.arrival - one.stamp))
        text = (
            f"topic {one.name}: header stamps run backwards {behind} times, by up to {farthest:.3g}"
            f" s; arrival times less the median latency of {usual:.3g} s are used instead"
        )
        figures["latency"] = usual
        one = dataclasses.replace(one, stamp=one.arrival - usual)
        return one.noting(remark("will mislead", "stamps_run_backwards", text, **figures))
    text = (
        f"topic {one.name}: time runs backwards {behind} times, by up to {farthest:.3g} s; split"
        " the recording where its clock restarts"
    )
    return one.where(np.argsort(one.clock, kind="stable")).noting(
        remark("fatal", "time_runs_backwards", text, **figures)
    )


def _moved(one: Series, delay: float) -> Series:
    if not delay:
        return one
    stamp = None if one.stamp is None else one.stamp - delay
    arrival = None if one.arrival is None else one.arrival - delay
    text = f"topic {one.name}: moved back by {delay:g} s, as the config asks"
    return dataclasses.replace(one, stamp=stamp, arrival=arrival).noting(
        remark("note", "delay_corrected", text, delay=delay)
    )
