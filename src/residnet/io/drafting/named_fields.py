"""Sources of the motion in series without message types, by the names of their fields."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.io.drafting.column_names import match_channels
from residnet.io.drafting.motion_columns import (
    find_quaternions,
)
from residnet.io.drafting.motion_regression import RawTable
from residnet.io.drafting.motion_sources import MIN_MOTION_ROWS, MotionSources, median_series_step
from residnet.io.drafting.questions import CHANNELS_KEY, READER_KEY, UNMAPPED_FIELDS, DraftNotes
from residnet.io.drafting.tables import draft_columns
from residnet.io.header_vocabulary import MOTION_CHANNELS, match_state_channel, parse_name
from residnet.io.readers.quantities import QUATERNION, SPEED_CHANNELS
from residnet.io.readers.recording import Recording


def find_named_table(
    recordings: Sequence[Recording], draft_notes: DraftNotes, *, needs_pose: bool
) -> MotionSources | None:
    """Return the motion and inputs of series by the names of their fields, or None.

    Series without message type are MATLAB structs, HDF5 groups and csv files of topics. Units,
    signs and frames are determined as those of columns of a table. Position, heading and velocities
    may be in one series or in several. Series of other message types are used likewise if standard
    messages give no pose.

    Args:
        recordings: recordings with aligned clocks.
        draft_notes: receives guesses and notes.
        needs_pose: whether standard messages give no pose; only then are several series combined.

    Raises:
        DataError: if several series have the same columns.
    """
    sources, base_topic = _choose_named_fields(recordings[0], needs_pose=needs_pose)
    if not sources:
        return None
    tables = [
        _tabulate_fields(recording, sources, base_topic)
        for recording in recordings
        if base_topic in recording.series
    ]
    # fields with finite values in all recordings
    fields = [
        name
        for name in sources
        if all(name in table.columns and np.isfinite(table.columns[name]).any() for table in tables)
    ]
    channel_notes = DraftNotes()
    names, entries = draft_columns(fields, tables, channel_notes, match_channels, has_heading=True)
    has_attitude = "psi" in names or "qw" in names
    has_position = {"x", "y"} <= {*names} or {"latitude", "longitude"} <= {*names}
    if not (has_attitude and has_position):
        return None
    draft_notes.extend(channel_notes)
    used_columns = {entry["column"] for entry in entries.values()} | {*names.values()}
    unused_fields = [name for name in fields if name not in used_columns]
    if unused_fields:
        draft_notes.add_note(CHANNELS_KEY, f"{UNMAPPED_FIELDS}: {', '.join(unused_fields[:20])}")
    settings = _convert_entries(entries, sources, base_topic)
    setting_names = dict.fromkeys(("x", "y"), "position")
    setting_names |= dict.fromkeys(("psi", *QUATERNION), "heading")
    if "velocity" in settings:
        setting_names |= {"u": "velocity", "v": "velocity"}
    for name, setting_name in setting_names.items():
        draft_notes.move_key((*CHANNELS_KEY, name), (*READER_KEY, setting_name))
    base_series = recordings[0].series[base_topic]
    return MotionSources(settings, {*sources.values()}, median_series_step(base_series))


def _choose_named_fields(
    recording: Recording, *, needs_pose: bool
) -> tuple[dict[str, tuple[str, str]], str]:
    """Choose the series that have position and heading by the names of their fields.

    Args:
        recording: recording with aligned clocks.
        needs_pose: whether several series may be combined, and those with a message type used.

    Returns:
        Name -> topic and field, and the topic whose clock is used; empty without such series.

    Raises:
        DataError: if several series have the same columns.
    """
    candidates = [
        series
        for series in recording.series.values()
        if (needs_pose or not series.message_type)
        and not parse_name(series.name).has_all("command")
        and len(series) >= MIN_MOTION_ROWS
        and all(_find_pose_columns([*_name_vector_parts(series.fields)]))
    ]
    tables = [series for series in candidates if not series.message_type]
    if len({frozenset(series.fields) for series in tables}) < len(tables):
        table_names = ", ".join(series.name for series in tables)
        raise DataError(
            f"{recording.path}: contains {len(tables)} tables of the same columns"
            f" ({table_names[:120]}), each a separate log; write each to a file, in Python"
            " pandas.DataFrame({name: column for name, column in table.items()}).to_csv(...)"
        )
    sources, topic = _find_named_topics(recording) if needs_pose else ({}, "")
    # of several poses the one with most velocities
    candidates.sort(key=lambda series: -len(_find_velocities(_name_vector_parts(series.fields))))
    for series in candidates[:1]:
        fields = _name_vector_parts(series.fields)
        # other series are read where they have velocities that the one with the pose lacks
        if not _find_velocities(sources) - _find_velocities(fields):
            return {name: (series.name, field) for name, field in fields.items()}, series.name
    return sources, topic


def _find_velocities(names: Iterable[str]) -> set[str | None]:
    """Return the velocities of the planar motion among the names of fields."""
    return {match_state_channel(parse_name(name)) for name in names} & {"u", "v", "r"}


def _convert_entries(
    entries: dict[str, dict[str, Any]], sources: Mapping[str, tuple[str, str]], base_topic: str
) -> dict[str, Any]:
    """Convert the channel map of a table to the settings of a reader of recordings.

    Args:
        entries: channel -> entry; entries of the pose are removed.
        sources: column -> topic and field.
        base_topic: topic whose clock is used.
    """
    settings: dict[str, Any] = {"standard_messages": False}
    vectors = [
        ("position", "local", ("x", "y"), ("north", "east")),
        ("position", "geodetic", ("latitude", "longitude"), ("latitude", "longitude")),
    ]
    if entries.get("u", {}).get("frame") == "ned":
        vectors.append(("velocity", "earth_fixed", ("u", "v"), ("north", "east")))
    for section, kind, names, keys in vectors:
        if {*names} <= entries.keys():
            parts = [entries.pop(name) for name in names]
            fields = [sources[part["column"]] for part in parts]
            settings[section] = {"kind": kind, "topic": fields[0][0], "unit": parts[0]["unit"]}
            settings[section] |= {key: field for key, (_, field) in zip(keys, fields, strict=True)}
    attitude = {name: entries.pop(name) for name in ("psi", *QUATERNION) if name in entries}
    fields = [sources[entry["column"]] for entry in attitude.values()]
    heading: dict[str, Any] = {"kind": "angle", "topic": fields[0][0], "field": fields[0][1]}
    if "psi" in attitude:
        heading["unit"] = attitude["psi"]["unit"]
    else:
        heading |= {"kind": "quaternion", "field": [field for _, field in fields]}
        heading["roll"] = len(fields) == len(QUATERNION)
    frame = attitude.get("psi", attitude.get("qw", {})).get("frame", "ned")
    settings["heading"] = {**heading, "frame": frame}
    settings["channels"] = {}
    for name, entry in entries.items():
        topic, field = sources[entry.pop("column")]
        # a command of another topic applies until the next one
        is_motion = name in (*MOTION_CHANNELS, *SIX_DOF_LAYOUT.state_names, *SPEED_CHANNELS)
        hold_setting = {} if topic == base_topic or is_motion else {"hold": True}
        settings["channels"][name] = {"topic": topic, "field": field, **entry, **hold_setting}
    return settings


def _find_named_topics(recording: Recording) -> tuple[dict[str, tuple[str, str]], str]:
    """Return the fields of all series, and the topic whose clock is used.

    The name of a field that several series have, such as `data`, contains its topic.

    Returns:
        Name -> topic and field, and the topic of position or heading with more rows; empty if
        position or heading are missing, or are in several series.
    """
    names_by_topic = {
        topic: _name_vector_parts(series.fields)
        for topic, series in recording.series.items()
        if len(series) > 1
    }
    counts = Counter(name for names in names_by_topic.values() for name in names)
    sources = {
        name if counts[name] == 1 and name != "data" else f"{topic} {name}": (topic, field)
        for topic, names in names_by_topic.items()
        for name, field in names.items()
    }
    pose_topics = [{sources[name][0] for name in names} for names in _find_pose_columns([*sources])]
    if any(len(topics) != 1 for topics in pose_topics):
        return {}, ""
    topics = [topic for group in pose_topics for topic in group]
    n_rows = [len(recording.series[topic]) for topic in topics]
    return (sources, topics[int(np.argmax(n_rows))]) if min(n_rows) >= MIN_MOTION_ROWS else ({}, "")


def _find_pose_columns(columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the columns of the position, and those of the heading or a quaternion."""
    names = match_channels(columns, DraftNotes())
    pairs = (("x", "y"), ("latitude", "longitude"))
    position = next(([*pair] for pair in pairs if {*pair} <= names.keys()), [])
    attitude = (
        {"psi": names["psi"]} if "psi" in names else next(iter(find_quaternions(columns)), {})
    )
    return [names[name] for name in position], [*attitude.values()]


_VECTOR_PART_PATTERN = re.compile(r"(?P<stem>.*[^\W\d])(?:\.|\[)(?P<index>\d)\]?")
_VECTOR_STATES = {
    ("eta", 3): ("x", "y", "psi"),
    ("eta", 6): ("x", "y", "z", "phi", "theta", "psi"),
    ("nu", 3): ("u", "v", "r"),
    ("nu", 6): ("u", "v", "w", "p", "q", "r"),
    ("tau", 3): ("tau_x", "tau_y", "tau_n"),
    **dict.fromkeys((("rpy", 3), ("euler", 3), ("euler_angles", 3)), ("phi", "theta", "psi")),
    ("ypr", 3): ("psi", "theta", "phi"),
    ("pqr", 3): ("p", "q", "r"),
    ("uvw", 3): ("u", "v", "w"),
}
"""Name and length of a vector -> names of its parts (Fossen 2021, table 2.1; autopilots)."""
_SPATIAL_VECTOR_PATTERN = re.compile(
    r"(?:^|[\W_])(?:pos|position|linear|angular|vel|velocity|lin_?vel|ang_?vel|omega|gyro|force)s?"
    r"(?:$|[\W_])",
    re.IGNORECASE,
)


def _name_vector_parts(fields: Iterable[str]) -> dict[str, str]:
    """Name the columns of matrices of positions, velocities and forces by their axes.

    Args:
        fields: fields; columns of a matrix end in `.0`, `.1`, ... or `[0]`, `[1]`, ...

    Returns:
        Name -> field, in the order of the fields.
    """
    names = {field: field for field in fields}
    parts_by_stem: dict[str, dict[int, str]] = {}
    for field in names:
        if match := _VECTOR_PART_PATTERN.fullmatch(field):
            parts_by_stem.setdefault(match["stem"], {})[int(match["index"])] = field
    for stem, parts in parts_by_stem.items():
        length = len(parts)
        if sorted(parts) != list(range(length)):
            continue
        parent, separator, last_name = stem.rpartition(".")
        labels = _VECTOR_STATES.get((last_name.lower(), length), ())
        if labels:
            labels = tuple(f"{parent}{separator}{label}" for label in labels)
        elif length in (2, 3) and _SPATIAL_VECTOR_PATTERN.search(stem):
            labels = tuple(f"{stem}_{axis}" for axis in "xyz"[:length])
        names |= {parts[index]: label for index, label in enumerate(labels)}
    return {name: field for field, name in names.items()}


def _tabulate_fields(
    recording: Recording, sources: Mapping[str, tuple[str, str]], base_topic: str
) -> RawTable:
    """Return fields of several topics on the clock of one of them, by the nearest sample.

    Angles cannot be interpolated before their unit is known.
    """
    clock = recording.series[base_topic].clock
    columns = {}
    for name, (topic, field) in sources.items():
        series = recording.series.get(topic)
        if series is None or not series.has_field(field) or not len(series):
            continue
        values = series[field]
        if topic != base_topic:
            midpoints = 0.5 * (series.clock[1:] + series.clock[:-1])
            values = values[np.searchsorted(midpoints, clock)]
        columns[name] = values
    return RawTable(clock, columns)
