"""The clocks of a recording: sender against recorder, time zones, latency, order of the rows.

A header stamp says when something was measured, an arrival when somebody wrote it down. Stamps are
preferred; topics without one keep their arrivals, brought from the recorder's clock to the
senders'.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

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


def align_clocks(
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
        if topic.arrival is not None:
            topic = dataclasses.replace(topic, arrival=topic.arrival - shift)
        if name in late and topic.arrival is not None and topic.stamp is not None:
            moved = topic.arrival - topic.stamp
            topic = topic.noting(*_latency(name, moved, prompt[name] - shift))
        given = [seconds for asked, seconds in delays.items() if same_topic(asked, [name])]
        delay = given[0] if given else 0.0
        if delay is None:
            delay = latency if topic.stamp is None else 0.0
        out[name] = _moved(_ordered(topic), delay)
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
    same = np.append(False, np.diff(topic.clock) == 0.0)
    if not same.any():
        return topic
    rows = np.stack(list(topic.fields.values())) if topic.fields else np.zeros((1, len(topic)))
    equal = same & np.append(
        False,
        ((rows[:, 1:] == rows[:, :-1]) | (np.isnan(rows[:, 1:]) & np.isnan(rows[:, :-1]))).all(
            axis=0
        ),
    )
    copies, others = int(equal.sum()), int((same & ~equal).sum())
    # of rows with one time the last is the newest
    kept = topic.where(np.append(~same[1:], True))
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
    if behind <= max(1.0, _FEW * len(topic)) and farthest <= _NEAR:
        text = (
            f"topic {topic.name}: time runs backwards {behind} times, by up to {farthest:.3g} s;"
            " rows are sorted"
        )
        return topic.where(np.argsort(topic.clock, kind="stable")).noting(
            remark("note", "out_of_order", text, **figures)
        )
    if (
        topic.stamp is not None
        and topic.arrival is not None
        and (np.diff(topic.arrival) >= 0.0).all()
    ):
        usual = float(np.median(topic.arrival - topic.stamp))
        text = (
            f"topic {topic.name}: header stamps run backwards {behind} times, by up to"
            f" {farthest:.3g} s; arrival times less the median latency of {usual:.3g} s are"
            " used instead"
        )
        figures["latency"] = usual
        topic = dataclasses.replace(topic, stamp=topic.arrival - usual)
        return topic.noting(remark("will mislead", "stamps_run_backwards", text, **figures))
    text = (
        f"topic {topic.name}: time runs backwards {behind} times, by up to {farthest:.3g} s; split"
        " the recording where its clock restarts"
    )
    return topic.where(np.argsort(topic.clock, kind="stable")).noting(
        remark("fatal", "time_runs_backwards", text, **figures)
    )


def _moved(topic: Series, delay: float) -> Series:
    if not delay:
        return topic
    stamp = None if topic.stamp is None else topic.stamp - delay
    arrival = None if topic.arrival is None else topic.arrival - delay
    text = f"topic {topic.name}: moved back by {delay:g} s, as the config asks"
    return dataclasses.replace(topic, stamp=stamp, arrival=arrival).noting(
        remark("note", "delay_corrected", text, delay=delay)
    )
