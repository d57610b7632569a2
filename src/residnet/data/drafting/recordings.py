"""The reader of recordings: what describes itself is taken, checked, and completed by names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.drafting.channels import CHANNELS, READER
from residnet.data.drafting.fields import named_fields
from residnet.data.drafting.physics import FRAMES, Raw, along, follows, motion_of
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.sources import found_sources, step_of
from residnet.data.drafting.units import thrown, unit_by_size
from residnet.data.drafting.words import MOTION, input_channel, words_of
from residnet.data.readers.detect import AutoConfig, recording_for
from residnet.data.readers.messages import standard_plan
from residnet.data.readers.quantities import FieldMap, Plan
from residnet.data.readers.recording import Recording

_COHERENT = 0.7
"""How well position, heading and velocities fit together in a recording that is taken as it is."""
_SLOW = 0.6
"""Interval in s from which a pose is looked for that comes more often."""
_FEWEST = 20


@dataclass(frozen=True)
class _Input:
    """A field that may drive the vessel."""

    channel: str
    topic: str
    field: str
    values: np.ndarray


def draft_recordings(paths: Sequence[Path], marks: Marks) -> dict[str, Any]:
    """Return the reader of recordings of one format.

    Standard messages map themselves. Where position, heading and velocities do not fit together by
    them, or the pose comes rarely, other topics and frames are tried. Inputs are found by names.

    Args:
        paths: files and folders.
        marks: is told what is not sure.

    Raises:
        UsageError: where the first one cannot be read.
        DataError: where it holds nothing that can be used.
    """
    # what stands still in one recording may move in another
    some = [recording_for(path) for path in dict.fromkeys((paths[0], *paths[:: _every(paths)]))]
    recording = some[0]
    content: dict[str, Any] = {"kind": "auto"}
    if len({path.resolve().parent for path in paths}) > 1:
        content["manoeuvre"] = "folder"
        marks.guess((*READER, "manoeuvre"), "the kind of manoeuvre is taken from the folder's name")
    log = _read(paths[0])
    plan = standard_plan(recording, Plan())
    taken = _taken(plan)
    step = _interval(log, plan, recording)
    fields = named_fields(some, marks)
    if fields is not None:
        content |= fields.content
        taken, step = fields.taken, fields.step
    elif log is None or not _sound(log, marks) or step > _SLOW:
        whole = log is not None and {"x", "y", "psi"} <= set(log.channels)
        found = found_sources(recording, marks, _COHERENT if whole else 0.0)
        if found is None and whole:
            text = "position, heading and velocities fit together badly: check the frames"
            marks.guess(READER, text)
        elif found is not None:
            content |= found.content
            taken, step = found.taken, found.step
    content["clock"] = {"kind": "uniform", "step": f"{float(f'{step:.2g}'):g} s"}
    marks.note((*READER, "clock"), "as often as the heading or the position comes")
    standard = {} if "standard_messages" in content else dict(plan.channels)
    known = set(log.channels) if log is not None and "standard_messages" not in content else set()
    channels = dict(content.pop("channels", {}))
    channels |= _renamed(some, standard, known, marks)
    for found_input in _inputs(some, taken):
        name = found_input.channel
        if name not in known and name not in channels:
            channels[name] = _entry(found_input, marks)
    if channels:
        content["channels"] = channels
    return content


def _every(paths: Sequence[Path]) -> int:
    """Return the stride through recordings of which three are looked at."""
    return max(1, (len(paths) - 1) // 2)


def _renamed(
    recordings: Sequence[Recording],
    standard: Mapping[str, FieldMap],
    known: set[str],
    marks: Marks,
) -> dict[str, dict[str, Any]]:
    """Return entries of plain numbers whose topic or joint is named as an actuator is.

    A message that holds a bare number says neither what it measures nor its unit.
    """
    out: dict[str, dict[str, Any]] = {}
    for name, field in standard.items():
        topic = field.topic or ""
        series = recordings[0].series.get(topic)
        if name in CHANNEL_UNITS or series is None or field.unit not in ("-", "rad"):
            continue
        # the last part of a topic says more than the folders that it lies in
        names = (topic.rsplit("/", 1)[-1], name) if field.field == "data" else (name,)
        channels = [input_channel(words_of(one.removesuffix("_position"))) for one in names]
        channel = next((one for one in channels if one), None)
        if channel is None or channel in known or channel in out:
            continue
        values = _values(recordings, topic, field.field)
        out[channel] = _entry(_Input(channel, topic, field.field, values), marks)
    return out


def _values(recordings: Sequence[Recording], topic: str, field: str) -> np.ndarray:
    """Return the values of a field in all recordings that hold it."""
    held = [r.series[topic] for r in recordings if topic in r.series]
    return np.concatenate([series[field] for series in held if series.has(field)])


def _read(path: Path) -> Log | None:
    try:
        return AutoConfig().build().read(path)
    except ResidnetError:
        return None


def _taken(plan: Plan) -> set[tuple[str, str]]:
    """Return the topics and fields that a plan takes."""
    out = {(entry.topic or "", entry.field) for entry in plan.channels.values()}
    for source in (plan.position, plan.heading):
        if source is not None:
            out |= {(source.topic or "", field) for field in source.fields}
    return out


def _sound(log: Log, marks: Marks) -> bool:
    """Return whether position, heading and velocities fit together as they are."""
    if not {"x", "y", "psi"} <= set(log.channels):
        return False
    raw = Raw(log.t, log.channels)
    scores = []
    for frame in FRAMES:
        motion = [motion_of(raw, "rad", frame)]
        if motion[0] is None:
            return True
        fits = [follows([raw], motion, name) for name in ("u", "v") if name in log.channels]
        if len(fits) == 2:
            scores.append(sum(f.correlation * np.sign(f.factor) for f in fits) / 2)
        else:
            scores.append(along(motion))
    if scores[0] < _COHERENT and max(scores) > scores[0] + 0.1:
        return False
    if scores[0] < 0.3 and along([motion_of(raw, "rad", FRAMES[0])]) > _COHERENT:
        # the pose is right, and the velocities are not those of the body
        return False
    if scores[0] < 0.3:
        text = f"position, heading and velocities fit together badly ({scores[0]:.2f} of 1)"
        marks.guess(READER, f"{text}: check the frames")
    return True


def _interval(log: Log | None, plan: Plan, recording: Recording) -> float:
    """Return the shorter of the usual steps of position and heading, s."""
    topics = [source.topic for source in (plan.position, plan.heading) if source is not None]
    steps = [step_of(recording.series[topic]) for topic in topics if topic in recording.series]
    if steps:
        return max(min(steps), 0.02)
    return float(np.median(np.diff(log.t))) if log is not None else 1.0


def _inputs(recordings: Sequence[Recording], taken: set[tuple[str, str]]) -> list[_Input]:
    """Return the fields whose topics and names are those of actuators."""
    found: dict[str, list[_Input]] = {}
    for series in recordings[0].series.values():
        for field in series.fields:
            channel = input_channel(words_of(f"{series.name} {field}"))
            values = _values(recordings, series.name, field)
            known = values[np.isfinite(values)]
            if channel is None or (series.name, field) in taken or known.size < _FEWEST:
                continue
            if channel not in MOTION and float(np.ptp(known)) > 0.0:
                found.setdefault(channel, []).append(_Input(channel, series.name, field, values))
    return [entry for same in found.values() for entry in _numbered(same)]


def _numbered(same: Sequence[_Input]) -> list[_Input]:
    """Return what to take of fields that stand for one channel, by names of their own.

    Several actuators of one topic are told apart by a number alone, `control[0]` and `control[1]`:
    each is taken. Of other fields the first one is.
    """
    first = same[0]
    alike = [
        entry
        for entry in same
        if entry.topic == first.topic
        and re.sub(r"\d+", "#", entry.field) == re.sub(r"\d+", "#", first.field)
    ]
    if len(alike) == 1:
        return alike
    return [
        replace(entry, channel=f"{entry.channel}_{number}")
        for number, entry in enumerate(alike, start=1)
    ]


def _entry(found: _Input, marks: Marks) -> dict[str, Any]:
    key = (*CHANNELS, found.channel)
    entry: dict[str, Any] = {"topic": found.topic, "field": found.field}
    if throw := thrown(found.channel, found.field, found.values):
        marks.guess(key, throw.reason)
        return {**entry, **throw.settings, "hold": True}
    unit, reason = unit_by_size(found.channel, found.values)
    marks.guess(key, f"taken by its name; {reason}")
    return {**entry, "unit": unit, "hold": True}
