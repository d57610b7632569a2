"""Fields of actuators and commands in recordings, by their names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.names import CHANNEL_UNITS
from residnet.io.drafting.pose_search import extract_pose
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.header_vocabulary import MOTION_CHANNELS, match_input_channel, parse_name
from residnet.io.readers.messages import KNOWN_COMMANDS
from residnet.io.readers.quantities import ChannelPlan, FieldMap
from residnet.io.readers.recording import Recording

_MIN_INPUT_ROWS = 20
"""Smallest number of rows of a topic with inputs."""


def name_bare_numbers(
    recording: Recording, standard: Mapping[str, FieldMap]
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield channel, topic and field of numbers without a unit whose topic names an actuator.

    Args:
        recording: recording with aligned clocks.
        standard: channels of standard messages.
    """
    for name, entry in standard.items():
        topic = entry.topic or ""
        field = entry.field
        if name in CHANNEL_UNITS or entry.unit not in ("-", "rad") or topic not in recording.series:
            continue
        # the last part of a topic's name is the most specific one
        names = (topic.rsplit("/", 1)[-1], name) if field == "data" else (name,)
        channels = (
            match_input_channel(parse_name(candidate.removesuffix("_position")))
            for candidate in names
        )
        if channel := next(filter(None, channels), None):
            yield channel, (topic, field)


def concatenate_field(recordings: Sequence[Recording], topic: str, field: str) -> np.ndarray:
    """Return the values of a field of a topic in one array, recording after recording."""
    series_with_topic = [r.series[topic] for r in recordings if topic in r.series]
    return np.concatenate(
        [series[field] for series in series_with_topic if series.has_field(field)]
    )


def find_actuator_fields(
    recordings: Sequence[Recording],
    used_fields: set[tuple[str, str]],
    plan: ChannelPlan,
    draft_notes: DraftNotes,
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield channel, topic and field of fields with names of actuators.

    Fields that differ in a number only (`control[0]`, `control[1]`) become several channels. Of a
    rudder that several topics command, the one that the vessel follows is used. Otherwise the first
    field of a channel is used.

    Args:
        recordings: recordings with aligned clocks.
        used_fields: topics and fields that are mapped already.
        plan: sources of position and heading by standard messages.
        draft_notes: receives guesses and notes.
    """
    fields_by_channel: dict[str, list[tuple[str, str]]] = {}
    for topic, series in recordings[0].series.items():
        for field in series.fields:
            command_of_format = match_known_command(recordings[0], topic, field)
            # a source of MOOS is the name of a program, which says nothing about an actuator
            name = field if series.message_type == _MOOS_MESSAGE_TYPE else f"{topic} {field}"
            channel = (
                command_of_format[0] if command_of_format else match_input_channel(parse_name(name))
            )
            if channel is None or channel in MOTION_CHANNELS or (topic, field) in used_fields:
                continue
            values = concatenate_field(recordings, topic, field)
            finite_values = values[np.isfinite(values)]
            if finite_values.size >= _MIN_INPUT_ROWS and float(np.ptp(finite_values)) > 0.0:
                fields_by_channel.setdefault(channel, []).append((topic, field))
    followed_publisher = ""
    # rudders first: the publisher that steers the vessel commands its propellers, too
    for channel in sorted(fields_by_channel, key=lambda name: "delta" not in name):
        candidate_fields = fields_by_channel[channel]
        has_publishers = len({f for _, f in candidate_fields}) == 1 and len(candidate_fields) > 1
        if has_publishers and channel in ("delta", "cmd_delta"):
            candidate_fields.sort(
                key=_rank_publishers(channel, recordings[0], candidate_fields, plan, draft_notes)
            )
            followed_publisher = _publisher_of(candidate_fields[0][0])
        elif has_publishers and followed_publisher:
            candidate_fields.sort(key=lambda entry: _publisher_of(entry[0]) != followed_publisher)
            if _publisher_of(candidate_fields[0][0]) == followed_publisher:
                text = (
                    f"{candidate_fields[0][1]} is written by"
                    f" {' and '.join(_publisher_of(topic) for topic, _ in candidate_fields)};"
                    f" {followed_publisher} is taken, as for the rudder"
                )
                draft_notes.add_guess((*CHANNELS_KEY, channel), text)
        field_patterns = [(topic, re.sub(r"\d+", "#", field)) for topic, field in candidate_fields]
        numbered_fields = [
            topic_field
            for topic_field, field_pattern in zip(candidate_fields, field_patterns, strict=True)
            if field_pattern == field_patterns[0]
        ]
        for number, topic_field in enumerate(numbered_fields, 1):
            yield f"{channel}_{number}" if len(numbered_fields) > 1 else channel, topic_field


def match_known_command(
    recording: Recording, topic: str, field: str
) -> tuple[str, dict[str, Any]] | None:
    """Return channel and settings of a command that the format defines, or None."""
    series = recording.series.get(topic)
    message_type = series.message_type.rsplit("/", 1)[-1] if series is not None else ""
    return KNOWN_COMMANDS.get((message_type, field))


def _publisher_of(topic: str) -> str:
    """Return the first part of a topic's name: the source of MOOS, the namespace of ROS."""
    return topic.strip("/").split("/", 1)[0]


def _rank_publishers(
    channel: str,
    recording: Recording,
    fields: Sequence[tuple[str, str]],
    plan: ChannelPlan,
    draft_notes: DraftNotes,
) -> Callable[[tuple[str, str]], float]:
    """Return the sort key of commands of one rudder by several topics: the followed one first.

    The vessel follows the command whose regression explains most of the changes of its yaw rate
    over a second; the yaw rate itself is another regressor.

    Args:
        channel: channel of the rudder.
        recording: recording with aligned clocks.
        fields: topic and field of each command.
        plan: sources of position and heading by standard messages.
        draft_notes: receives the guess.
    """
    pose = None
    if len(fields) > 1 and plan.position is not None and plan.heading is not None:
        pose = extract_pose(recording, plan.position, plan.heading)
    if pose is None:
        return lambda _: 0.0
    is_known = np.isfinite(pose.columns["psi"])
    t = pose.t[is_known]
    yaw_rate = np.gradient(np.unwrap(pose.columns["psi"][is_known]), t)
    horizon = max(1, round(1.0 / float(np.median(np.diff(t)))))
    change = yaw_rate[horizon:] - yaw_rate[:-horizon]
    explained: dict[tuple[str, str], float] = {}
    for topic, field in fields:
        series = recording.series[topic]
        rows = np.maximum(np.searchsorted(series.clock, t, side="right") - 1, 0)
        command = series[field][rows][:-horizon]
        regressors = np.stack((np.ones(command.size), yaw_rate[:-horizon], command), axis=1)
        usable = np.isfinite(regressors).all(axis=1) & np.isfinite(change)
        solution = np.linalg.lstsq(regressors[usable], change[usable], rcond=None)[0]
        residual = change[usable] - regressors[usable] @ solution
        explained[topic, field] = 1.0 - float(
            np.var(residual) / max(np.var(change[usable]), 1e-300)
        )
    followed = max(fields, key=lambda source: explained[source])
    shares = ", ".join(f"{topic} {explained[topic, field]:.2f}" for topic, field in fields)
    draft_notes.add_guess(
        (*CHANNELS_KEY, channel),
        f"{fields[0][1]} is written by {' and '.join(topic for topic, _ in fields)};"
        f" {followed[0]} is used, because it explains the yaw rate best (explained share of its"
        f" changes: {shares})",
    )
    return lambda source: -explained[source]


_MOOS_MESSAGE_TYPE = "moos/Variables"
"""Type of the series of the reader of MOOS, see `readers/formats/moos.py`."""
