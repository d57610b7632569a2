"""Fields of actuators and commands in recordings, by their names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.io.drafting.motion_regression import RawTable, estimate_rudder_gain
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.header_vocabulary import MOTION_CHANNELS, match_input_channel, parse_name
from residnet.io.readers.compose import extract_heading
from residnet.io.readers.messages import KNOWN_COMMANDS
from residnet.io.readers.quantities import ChannelPlan
from residnet.io.readers.recording import Recording

_MIN_INPUT_ROWS = 20
"""Smallest number of rows of a topic with inputs."""


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
            followed = _find_followed_field(
                channel, recordings[0], candidate_fields, plan, draft_notes
            )
            candidate_fields.sort(key=lambda entry: entry != followed)
            followed_publisher = _publisher_of(followed[0])
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


def _find_followed_field(
    channel: str,
    recording: Recording,
    fields: Sequence[tuple[str, str]],
    plan: ChannelPlan,
    draft_notes: DraftNotes,
) -> tuple[str, str]:
    """Return which of the commands of one rudder by several topics the vessel follows.

    It is the one with the most significant effect on the yaw rate; without a heading the first one.

    Args:
        channel: channel of the rudder.
        recording: recording with aligned clocks.
        fields: topic and field of each command.
        plan: sources of position and heading by standard messages.
        draft_notes: receives the guess.
    """
    if plan.heading is None:
        return fields[0]
    try:
        log = extract_heading(recording, plan.heading).log
    except ResidnetError:
        return fields[0]
    yaw_rate = np.gradient(log["psi"], log.t)
    significances = {}
    for topic, field in fields:
        series = recording.series[topic]
        rows = np.maximum(np.searchsorted(series.clock, log.t, side="right") - 1, 0)
        table = RawTable(log.t, {channel: series[field][rows]})
        gain, standard_error = estimate_rudder_gain([table], channel, {0: yaw_rate})
        significances[topic, field] = abs(gain) / standard_error
    followed = max(fields, key=lambda source: significances[source])
    text = ", ".join(f"{topic} {ratio:.0f}" for (topic, _), ratio in significances.items())
    draft_notes.add_guess(
        (*CHANNELS_KEY, channel),
        f"{fields[0][1]} is written by {' and '.join(topic for topic, _ in fields)};"
        f" {followed[0]} is used, because its effect on the yaw rate is the most significant"
        f" (in standard errors: {text})",
    )
    return followed


_MOOS_MESSAGE_TYPE = "moos/Variables"
"""Type of the series of the reader of MOOS, see `readers/formats/moos.py`."""
