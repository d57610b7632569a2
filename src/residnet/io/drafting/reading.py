"""Drafting of readers for logs without a config, and reading of these logs.

The commands `inspect`, `fit`, `new` and `draft` and `residnet.read_logs` use the same drafts.
Recordings map their standard messages; the result is checked and completed by names of fields.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from residnet.core.config import validate_config
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.layout import SIX_DOF_LAYOUT, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, STATE_NAMES
from residnet.core.progress import report_progress
from residnet.io.drafting.channel_map import draft_channel_map
from residnet.io.drafting.motion_columns import (
    choose_quaternion_order,
    find_depth_channels,
    find_quaternions,
    is_vertical_axis_up,
)
from residnet.io.drafting.motion_regression import (
    MIN_STANDARD_ERRORS,
    POSE_FRAMES,
    Motion,
    RawTable,
    ScaleFit,
    estimate_motion,
    estimate_rudder_gain,
    fit_to_motion,
    forward_alignment,
)
from residnet.io.drafting.problems import (
    UnreadableLogsError,
    name_files_in_errors,
    raise_unreadable,
    without_channel_map,
)
from residnet.io.drafting.questions import (
    CHANNELS_KEY,
    READER_KEY,
    UNMAPPED_FIELDS,
    DraftNotes,
    Key,
)
from residnet.io.drafting.tables import (
    draft_manoeuvre_setting,
    draft_tables,
    match_channels,
    preview_table,
    rename_pulsed_drives,
)
from residnet.io.drafting.vertical import draft_vertical_motion, project_on_horizontal
from residnet.io.header_vocabulary import (
    MOTION_CHANNELS,
    PLANE_PATTERN,
    guess_scaling,
    infer_unit,
    match_input_channel,
    match_state_channel,
    parse_name,
)
from residnet.io.readers import ReaderConfig
from residnet.io.readers.compose import extract_heading, extract_position
from residnet.io.readers.detect import (
    AutoConfig,
    detect_external_kind,
    detect_log_kind,
    is_channel_reader,
    suggest_conversion,
)
from residnet.io.readers.joined_files import group_trip_files
from residnet.io.readers.manoeuvre_kinds import UNKNOWN, resolve_manoeuvre
from residnet.io.readers.messages import (
    KNOWN_COMMANDS,
    extend_with_standard_messages,
    is_ned_format,
)
from residnet.io.readers.quantities import (
    QUATERNION,
    AngleHeading,
    ChannelPlan,
    FieldMap,
    GeodeticPosition,
    HeadingConfig,
    LocalPosition,
    PositionConfig,
    QuaternionHeading,
)
from residnet.io.readers.recording import ALL_FIELDS, Recording, Series
from residnet.io.readers.tables import TABLE_KINDS, read_column_names
from residnet.io.readers.topics import align_clocks
from residnet.io.split import assign_log_names, find_logs
from residnet.preprocessing.motion import MotionConfig, complete_motion

# smallest consistency (0 to 1) of position, heading and velocities for an unchanged mapping
_MIN_CONSISTENCY = 0.7
# median step in s above which a pose with a higher rate is searched
_MAX_POSE_INTERVAL = 0.6
_MIN_MOTION_ROWS = 50
"""Smallest number of rows of a topic with motion."""
_MIN_INPUT_ROWS = 20
"""Smallest number of rows of a topic with inputs."""
_MAX_POSE_CANDIDATES = 12
"""Largest number of positions and of headings whose combinations are tested."""
_AXIS_PAIRS = (("x", "y"), ("north", "east"), ("east", "north"))


@dataclass(frozen=True)
class _MotionSources:
    """Sources of the motion in a recording.

    Attributes:
        settings: reader settings with position, heading and channels.
        used_fields: topic and field of each quantity.
        step: smaller one of the median steps of position and heading in s.
    """

    settings: dict[str, Any]
    used_fields: set[tuple[str, str]]
    step: float


def draft_recordings(
    paths: Sequence[Path], draft_notes: DraftNotes
) -> tuple[dict[str, Any], dict[Path, Recording]]:
    """Draft a reader for recordings of one format.

    Standard messages map automatically. If their position, heading and velocities are inconsistent,
    or the rate of the pose is low, other topics and frames are tested unless the format defines its
    frames. Inputs are found by their names.

    Args:
        paths: recordings.
        draft_notes: receives guesses and notes.

    Returns:
        The settings of the reader, and the recordings that were loaded.

    Raises:
        UsageError: if the first recording cannot be read.
        DataError: if it has no usable contents.
    """
    # three recordings are loaded, because a constant signal of one may vary in another
    stride = max(1, (len(paths) - 1) // 2)
    auto = AutoConfig()
    recordings = {path: auto.load(path, ALL_FIELDS) for path in (paths[0], *paths[::stride])}
    aligned = [align_clocks(recording, {}, None) for recording in recordings.values()]
    external_kind = detect_external_kind(paths[0])
    settings: dict[str, Any] = {
        "kind": external_kind or "auto",
        **draft_manoeuvre_setting(paths, draft_notes),
    }
    try:
        log = auto.build().to_log(recordings[paths[0]])
    except ResidnetError:
        log = None
    plan = extend_with_standard_messages(aligned[0], ChannelPlan())
    pose_sources = [source for source in (plan.position, plan.heading) if source is not None]
    used_fields = {(entry.topic or "", entry.field) for entry in plan.channels.values()}
    used_fields |= {
        (source.topic or "", field) for source in pose_sources for field in source.fields
    }
    steps = [
        _median_series_step(aligned[0].series[s.topic])
        for s in pose_sources
        if s.topic in aligned[0].series
    ]
    sample_step = max(min(steps), 0.02) if steps else 1.0
    if not steps and log is not None:
        sample_step = float(np.median(np.diff(log.t)))
    sources = _choose_motion_sources(
        aligned,
        log,
        _MotionSources({}, used_fields, sample_step),
        draft_notes,
        is_frame_fixed=any(is_ned_format(aligned[0][source.topic]) for source in pose_sources),
    )
    settings |= sources.settings
    settings["clock"] = {"kind": "uniform", "step": f"{float(f'{sources.step:.2g}'):g} s"}
    draft_notes.add_note((*READER_KEY, "clock"), "rate of the heading or of the position")
    uses_standard_messages = "standard_messages" not in settings
    known_channels = set(log.channels) if log is not None and uses_standard_messages else set()
    channels = dict(settings.pop("channels", {}))
    renamed_fields = _name_bare_numbers(aligned[0], plan.channels) if uses_standard_messages else ()
    for name, (topic, field) in (
        *renamed_fields,
        *_find_actuator_fields(aligned, sources.used_fields, plan, draft_notes),
    ):
        if name in known_channels or name in channels:
            continue
        if (known := _known_command(aligned[0], topic, field)) is not None:
            settings_of_format = known[1]
            scale_text = f"{settings_of_format.get('scale', 1.0):g} " * ("scale" in known[1])
            text = f"the format defines {field} in {scale_text}{settings_of_format['unit']}"
            draft_notes.add_note((*CHANNELS_KEY, name), text)
            channels[name] = {"topic": topic, "field": field, **settings_of_format, "hold": True}
            continue
        values = _concatenate_field(aligned, topic, field)
        scaling = guess_scaling(name, field, values) or infer_unit(name, field, values)
        reason = f"taken by its name; {scaling.reason}" if scaling.reason else "taken by its name"
        draft_notes.add_guess((*CHANNELS_KEY, name), reason)
        channels[name] = {"topic": topic, "field": field, **scaling.settings, "hold": True}
    return settings | ({"channels": channels} if channels else {}), recordings


def _choose_motion_sources(
    recordings: Sequence[Recording],
    log: Log | None,
    standard_sources: _MotionSources,
    draft_notes: DraftNotes,
    *,
    is_frame_fixed: bool,
) -> _MotionSources:
    """Return the sources of position and heading: the standard messages, or better ones.

    Args:
        recordings: recordings with aligned clocks.
        log: log of the first recording from its standard messages; None if they are not sufficient.
        standard_sources: fields of the standard messages.
        draft_notes: receives guesses and notes.
        is_frame_fixed: whether the format defines the frame of its poses.
    """
    has_pose = log is not None and {"x", "y", "psi"} <= set(log.channels)
    if named_sources := _find_named_table(recordings, draft_notes, needs_pose=not has_pose):
        return named_sources
    if log is None or not has_pose or not _is_consistent(log, draft_notes):
        other_sources = None
        if not (has_pose and is_frame_fixed):
            min_consistency = _MIN_CONSISTENCY if has_pose else 0.0
            other_sources = _find_best_pose(recordings[0], draft_notes, min_consistency)
        if other_sources is None and has_pose:
            text = "position, heading and velocities are inconsistent: check the frames"
            draft_notes.add_guess(READER_KEY, text)
        return other_sources or standard_sources
    if standard_sources.step > _MAX_POSE_INTERVAL and not is_frame_fixed:
        candidate_notes = DraftNotes()
        other_sources = _find_best_pose(recordings[0], candidate_notes, _MIN_CONSISTENCY)
        # the new sources have no measured velocities, so that they must have a higher rate
        if other_sources is not None and other_sources.step < 0.9 * standard_sources.step:
            draft_notes.extend(candidate_notes)
            return other_sources
    return standard_sources


def _median_series_step(series: Series) -> float:
    return float(np.median(np.diff(series.clock))) if len(series) > 1 else float("inf")


def _is_consistent(log: Log, draft_notes: DraftNotes) -> bool:
    """Return whether position, heading and velocities of a log are consistent.

    A guess is noted if they are inconsistent and no other frame is better.
    """
    table = RawTable(log.t, log.channels)
    motions = [estimate_motion(table, "rad", frame) for frame in POSE_FRAMES]
    if None in motions:
        return True
    scores = []
    for motion in motions:
        velocity_fits = [
            fit_to_motion([table], [motion], name) for name in ("u", "v") if name in log.channels
        ]
        velocity_score = sum(f.correlation * np.sign(f.factor) for f in velocity_fits) / 2
        scores.append(velocity_score if len(velocity_fits) == 2 else forward_alignment([motion]))
    if scores[0] < _MIN_CONSISTENCY and max(scores) > scores[0] + 0.1:
        return False
    if scores[0] < 0.3:
        if forward_alignment(motions[:1]) > _MIN_CONSISTENCY:
            # the pose is consistent in itself: the velocities are not in body axes
            return False
        text = f"position, heading and velocities are inconsistent ({scores[0]:.2f} of 1)"
        draft_notes.add_guess(READER_KEY, f"{text}: check the frames")
    return True


def _find_named_table(
    recordings: Sequence[Recording], draft_notes: DraftNotes, *, needs_pose: bool
) -> _MotionSources | None:
    """Return the motion and inputs of series without message type, or None.

    Such series are MATLAB structs, HDF5 groups and csv files of topics. Their fields have names
    like columns of a table, and units, signs and frames are determined in the same way. Position,
    heading and velocities may be in one series or in several.

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
    # fields with finite values in all recordings; increasing times are no channels
    fields = [
        name
        for name in sources
        if all(name in table.columns and np.isfinite(table.columns[name]).any() for table in tables)
        and not (
            parse_name(name).has_all("time")
            and bool((np.diff(tables[0].columns[name]) > 0.0).all())
        )
    ]
    attitudes = find_quaternions(fields)
    compound_fields = {field for attitude in attitudes for field in attitude.values()}
    simple_fields = [name for name in fields if name not in compound_fields]
    names = match_channels(simple_fields, draft_notes)
    names = rename_pulsed_drives(names, [table.columns for table in tables])
    names |= find_depth_channels(simple_fields, names)
    if "psi" not in names:
        names |= choose_quaternion_order(attitudes, [table.columns for table in tables])
    has_attitude = "psi" in names or "qw" in names
    has_position = {"x", "y"} <= {*names} or {"latitude", "longitude"} <= {*names}
    if not (has_attitude and has_position):
        return None
    logs = [
        RawTable(table.t, {name: table.columns[field] for name, field in names.items()})
        for table in tables
    ]
    columns = [table.columns for table in tables]
    entries = draft_channel_map(
        names,
        project_on_horizontal(simple_fields, columns, logs, names),
        draft_notes,
        is_up_positive=is_vertical_axis_up(simple_fields, names, columns),
    )
    entries |= draft_vertical_motion(simple_fields, columns, logs, entries, draft_notes)
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
    return _MotionSources(settings, {*sources.values()}, _median_series_step(base_series))


def _choose_named_fields(
    recording: Recording, *, needs_pose: bool
) -> tuple[dict[str, tuple[str, str]], str]:
    """Choose the series without message type that have position and heading.

    Args:
        recording: recording with aligned clocks.
        needs_pose: whether several series may be combined.

    Returns:
        Name -> topic and field, and the topic whose clock is used; empty if there are none.

    Raises:
        DataError: if several series have the same columns.
    """
    candidates = []
    for series in recording.series.values():
        channels = {
            match_state_channel(parse_name(name)) for name in _name_vector_parts(series.fields)
        }
        has_attitude = "psi" in channels or bool(find_quaternions([*series.fields]))
        has_position = {"x", "y"} <= channels or {"latitude", "longitude"} <= channels
        if (
            not series.message_type
            and len(series) >= _MIN_MOTION_ROWS
            and has_attitude
            and has_position
        ):
            candidates.append(series)
    if len({frozenset(series.fields) for series in candidates}) < len(candidates):
        table_names = ", ".join(series.name for series in candidates)
        raise DataError(
            f"{recording.path}: contains {len(candidates)} tables of the same columns"
            f" ({table_names[:120]}), each a separate log; write each to a file, in Python"
            " pandas.DataFrame({name: column for name, column in table.items()}).to_csv(...)"
        )
    if len(candidates) > 1:
        return {}, ""
    if candidates:
        topic = candidates[0].name
        fields = _name_vector_parts(candidates[0].fields)
        combined = _find_named_topics(recording) if needs_pose else {}
        if not _velocity_channels(combined) <= _velocity_channels(fields):
            return combined, _find_base_topic(recording, combined)
        return {name: (topic, field) for name, field in fields.items()}, topic
    sources = _find_named_topics(recording) if needs_pose else {}
    return sources, _find_base_topic(recording, sources) if sources else ""


def _velocity_channels(names: Iterable[str]) -> set[str | None]:
    """Return the velocities of the planar motion among the names of fields."""
    channels = {match_state_channel(parse_name(name)) for name in names}
    return channels & {"u", "v", "r"}


def _convert_entries(
    entries: dict[str, dict[str, Any]], sources: Mapping[str, tuple[str, str]], base_topic: str
) -> dict[str, Any]:
    """Convert the channel map of a table to the settings of a reader of recordings.

    Args:
        entries: channel -> entry; those of the pose are removed.
        sources: column -> topic and field.
        base_topic: topic whose clock is used.
    """
    settings: dict[str, Any] = {"standard_messages": False}
    for position_kind, channel_pair, keys in (
        ("local", ("x", "y"), ("north", "east")),
        ("geodetic", ("latitude", "longitude"), ("latitude", "longitude")),
    ):
        if set(channel_pair) <= set(entries):
            first_entry, second_entry = (entries.pop(name) for name in channel_pair)
            topic, first_field = sources[first_entry["column"]]
            position_settings = {"kind": position_kind, "topic": topic, keys[0]: first_field}
            settings["position"] = position_settings | {
                keys[1]: sources[second_entry["column"]][1],
                "unit": first_entry["unit"],
            }
    if entries.get("u", {}).get("frame") == "ned":
        north, east = (entries.pop(name) for name in ("u", "v"))
        topic, north_field = sources[north["column"]]
        velocity = {"kind": "earth_fixed", "topic": topic, "unit": north["unit"]}
        velocity |= {"north": north_field, "east": sources[east["column"]][1]}
        settings["velocity"] = velocity
    if "psi" in entries:
        heading = entries.pop("psi")
        topic, heading_field = sources[heading["column"]]
        settings["heading"] = {"kind": "angle", "topic": topic, "field": heading_field}
        settings["heading"] |= {"unit": heading["unit"], "frame": heading.get("frame", "ned")}
    else:
        quaternion = {name: entries.pop(name) for name in QUATERNION if name in entries}
        topic, _ = sources[quaternion["qw"]["column"]]
        parts = [sources[entry["column"]][1] for entry in quaternion.values()]
        settings["heading"] = {"kind": "quaternion", "topic": topic, "field": parts}
        settings["heading"] |= {"frame": quaternion["qw"].get("frame", "ned")}
        settings["heading"] |= {"roll": len(quaternion) == len(QUATERNION)}
    settings["channels"] = {}
    for name, entry in entries.items():
        topic, field = sources[entry.pop("column")]
        # a command of another topic applies until the next one
        is_motion = name in (*MOTION_CHANNELS, *SIX_DOF_LAYOUT.state_names)
        hold = {} if topic == base_topic or is_motion else {"hold": True}
        settings["channels"][name] = {"topic": topic, "field": field, **entry, **hold}
    return settings


def _find_named_topics(recording: Recording) -> dict[str, tuple[str, str]]:
    """Return the fields of the series without message type: name -> topic and field.

    A field that several series have, such as `data`, is named with its topic. Empty if position
    and heading are not among the names, or if the position is in several series.
    """
    series_by_topic = {
        topic: series
        for topic, series in recording.series.items()
        if not series.message_type and len(series) > 1
    }
    names_by_topic = {
        topic: _name_vector_parts(series.fields) for topic, series in series_by_topic.items()
    }
    counts = Counter(name for names in names_by_topic.values() for name in names)
    sources = {
        name if counts[name] == 1 and name != "data" else f"{topic} {name}": (topic, field)
        for topic, names in names_by_topic.items()
        for name, field in names.items()
    }
    channels = match_channels([*sources], DraftNotes())
    position = next(
        (pair for pair in (("x", "y"), ("latitude", "longitude")) if {*pair} <= channels.keys()),
        None,
    )
    attitude = _attitude_fields(channels, sources)
    if position is None or not attitude:
        return {}
    first_topic, second_topic = (sources[channels[name]][0] for name in position)
    topics = {sources[name][0] for name in (*(channels[axis] for axis in position), *attitude)}
    has_rows = all(len(series_by_topic[topic]) >= _MIN_MOTION_ROWS for topic in topics)
    return sources if first_topic == second_topic and has_rows else {}


_VECTOR_PART_PATTERN = re.compile(r"(?P<stem>.*[^\W\d])(?:\.|\[)(?P<index>\d)\]?")
_VECTOR_STATES = {
    ("eta", 3): ("x", "y", "psi"),
    ("eta", 6): ("x", "y", "z", "phi", "theta", "psi"),
    ("nu", 3): ("u", "v", "r"),
    ("nu", 6): ("u", "v", "w", "p", "q", "r"),
    ("tau", 3): ("tau_x", "tau_y", "tau_n"),
}
"""Name and length of a vector in Fossen's notation (2021, table 2.1) -> names of its parts."""
_SPATIAL_VECTOR_PATTERN = re.compile(
    r"(?:^|[\W_])(?:pos|position|linear|angular|vel|velocity|lin_?vel|ang_?vel|omega|gyro|force)s?"
    r"(?:$|[\W_])",
    re.IGNORECASE,
)


def _name_vector_parts(fields: Iterable[str]) -> dict[str, str]:
    """Name the columns of matrices of positions, velocities and forces by their axes.

    Args:
        fields: fields; those of a matrix end in `.0`, `.1`, ... or `[0]`, `[1]`, ...

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


def _attitude_fields(
    channels: Mapping[str, str], sources: Mapping[str, tuple[str, str]]
) -> list[str]:
    """Return the name of the heading, or the names of a quaternion's parts in one topic."""
    if "psi" in channels:
        return [channels["psi"]]
    for parts in find_quaternions([*sources]):
        if len({sources[name][0] for name in parts.values()}) == 1:
            return [*parts.values()]
    return []


def _find_base_topic(recording: Recording, sources: Mapping[str, tuple[str, str]]) -> str:
    """Return the topic of position or heading with more rows."""
    channels = match_channels([*sources], DraftNotes())
    position = "x" if "x" in channels else "latitude"
    names = [channels[position], *_attitude_fields(channels, sources)[:1]]
    topics = [sources[name][0] for name in names]
    return max(topics, key=lambda topic: len(recording.series[topic]))


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


def _find_best_pose(
    recording: Recording, draft_notes: DraftNotes, min_score: float
) -> _MotionSources | None:
    """Return the most consistent pair of position and heading, with preference for high rates.

    Args:
        recording: recording with aligned clocks.
        draft_notes: receives guesses and notes.
        min_score: smallest consistency, at most 1.

    Returns:
        The sources; None if no pair reaches the smallest consistency.
    """
    positions = list(_iter_position_sources(recording))
    headings = list(_iter_heading_sources(recording))
    velocities = list(_iter_velocity_fields(recording))
    best_candidate: tuple[float, Any] = (-np.inf, None)
    for position in positions[:_MAX_POSE_CANDIDATES]:
        for heading in headings[:_MAX_POSE_CANDIDATES]:
            pose = _extract_pose(recording, position, heading)
            if pose is None:
                continue
            score, velocity = _score_pose(pose, velocities)
            source_steps = [
                _median_series_step(recording[source.topic]) for source in (position, heading)
            ]
            # a tenth of the rate costs .3 of the score
            score_with_rate = score - 0.3 * float(np.log10(max(max(source_steps), 0.05) / 0.05))
            if score_with_rate > best_candidate[0]:
                best_candidate = (
                    score_with_rate,
                    (position, heading, score, velocity, min(source_steps)),
                )
    if best_candidate[1] is None or best_candidate[1][2] < min_score:
        return None
    position, heading, score, velocity, step = best_candidate[1]
    text = f"most consistent pair of {len(positions)} positions and {len(headings)} headings"
    draft_notes.add_guess((*READER_KEY, "position"), f"{text} (consistency {score:.2f} of 1)")
    draft_notes.add_guess(
        (*READER_KEY, "heading"), f"frame {heading.frame}: consistent with the motion"
    )
    if velocity is not None:
        draft_notes.add_note(
            READER_KEY, f"velocities in {velocity} were used to check the frames only"
        )
    settings: dict[str, Any] = {"standard_messages": False}
    for name, source in (("position", position), ("heading", heading)):
        source_settings = source.model_dump(mode="json", exclude_defaults=True)
        settings[name] = {"kind": source.kind, **source_settings}
    used_fields = {
        (source.topic, field) for source in (position, heading) for field in source.fields
    }
    return _MotionSources(settings, used_fields, max(step, 0.02))


def _iter_measured_series(recording: Recording) -> Iterator[Series]:
    """Yield the series with sufficient rows that are no setpoints."""
    for series in recording.series.values():
        parsed_name = parse_name(series.name)
        if (
            len(series) >= _MIN_MOTION_ROWS
            and not parsed_name.has_all("command")
            and "guidance" not in parsed_name.text
        ):
            yield series


def _iter_position_sources(recording: Recording) -> Iterator[PositionConfig]:
    """Yield possible positions of a recording, local ones in both orders of their axes."""
    for series in _iter_measured_series(recording):
        if series.has_field("latitude") and series.has_field("longitude"):
            yield GeodeticPosition(topic=series.name)
            continue
        field_by_channel = {
            match_state_channel(parse_name(field)): field for field in reversed(series.fields)
        }
        if {"latitude", "longitude"} <= set(field_by_channel):
            fix_fields = field_by_channel["latitude"], field_by_channel["longitude"]
            largest = [float(np.nanmax(np.abs(series[name]), initial=0.0)) for name in fix_fields]
            if min(largest) > 0.0 and max(largest) <= 180.0:
                yield GeodeticPosition(
                    topic=series.name, latitude=fix_fields[0], longitude=fix_fields[1]
                )
                continue
        prefixes = ("pose.pose.position.", "pose.position.", "position.", "")
        pairs = ((f"{p}{a}", f"{p}{b}") for p in prefixes for a, b in _AXIS_PAIRS)
        axis_pair = next(
            (axis_pair for axis_pair in pairs if all(map(series.has_field, axis_pair))), None
        )
        if axis_pair is None or ("." not in axis_pair[0] and "orientation" in series.name):
            continue
        if all(float(np.nanstd(series[name])) > 0.05 for name in axis_pair):
            yield LocalPosition(topic=series.name, north=axis_pair[0], east=axis_pair[1])
            if not is_ned_format(series):
                yield LocalPosition(topic=series.name, north=axis_pair[1], east=axis_pair[0])


def _iter_heading_sources(recording: Recording) -> Iterator[HeadingConfig]:
    """Yield possible headings of a recording: quaternions and angles, in both frames."""
    for series in _iter_measured_series(recording):
        frames: tuple[Literal["ned", "enu"], ...] = (
            ("ned",) if is_ned_format(series) else ("ned", "enu")
        )
        for quaternion_path in [
            field[:-2] for field in series.fields if field.endswith((".w", "_w"))
        ]:
            if (
                all(series.has_field(f"{quaternion_path}.{axis}") for axis in "xyz")
                and series[f"{quaternion_path}.w"].any()
            ):
                for frame in frames:
                    yield QuaternionHeading(topic=series.name, field=quaternion_path, frame=frame)
        for field in series.fields:
            if match_state_channel(parse_name(field)) == "psi" and np.isfinite(series[field]).any():
                max_angle = float(np.nanmax(np.abs(series[field])))
                unit = "deg" if max_angle > 7.0 else "rad"
                if 0.0 < max_angle <= 400.0:
                    for frame in frames:
                        yield AngleHeading(topic=series.name, field=field, unit=unit, frame=frame)


def _iter_velocity_fields(recording: Recording) -> Iterator[tuple[Series, str, str]]:
    """Yield series and fields of possible velocities forward and sideways."""
    for series in _iter_measured_series(recording):
        prefixes = ("twist.twist.linear.", "twist.linear.", "linear.")
        prefix = next(
            (p for p in prefixes if series.has_field(f"{p}x") and series.has_field(f"{p}y")), None
        )
        if prefix is not None:
            yield series, f"{prefix}x", f"{prefix}y"


def _extract_pose(
    recording: Recording, position: PositionConfig, heading: HeadingConfig
) -> RawTable | None:
    """Return north, east and heading at the times of the positions, or None.

    None means that a source cannot be read, the clocks do not overlap, or the heading is constant.
    """
    try:
        position_log = extract_position(recording, position).log
        heading_log = extract_heading(recording, heading).log
    except ResidnetError:
        return None
    is_finite = np.isfinite(heading_log["psi"])
    # with a constant heading, velocities in body axes and in earth axes are equally consistent
    if is_finite.sum() < _MIN_MOTION_ROWS or float(np.ptp(heading_log["psi"][is_finite])) < 0.3:
        return None
    if heading_log.t[-1] < position_log.t[0] or heading_log.t[0] > position_log.t[-1]:
        return None
    heading_at_positions = np.interp(
        position_log.t,
        heading_log.t[is_finite],
        heading_log["psi"][is_finite],
        left=np.nan,
        right=np.nan,
    )
    return RawTable(
        position_log.t,
        {"x": position_log["x"], "y": position_log["y"], "psi": heading_at_positions},
    )


def _score_pose(
    pose: RawTable, velocities: list[tuple[Series, str, str]]
) -> tuple[float, str | None]:
    """Return the consistency of a pose, at most 1, and the topic of the velocities used for it.

    Without suitable velocities the consistency is the forward alignment of the motion.

    Args:
        pose: table with x, y, psi.
        velocities: series and fields of possible velocities forward and sideways.
    """
    motion = estimate_motion(pose, "rad", POSE_FRAMES[0])
    if motion is None:
        return -1.0, None
    unrotated_pose = RawTable(pose.t, {**pose.columns, "psi": np.zeros(pose.t.size)})
    earth_fixed_motion = estimate_motion(unrotated_pose, "rad", POSE_FRAMES[0])
    scored_topics = [(-1.0, "")]
    for series, first_field, second_field in velocities:
        field_orders = [(first_field, second_field), (second_field, first_field)]
        earth_fixed_scores = (
            [
                _mean_velocity_correlation(unrotated_pose, earth_fixed_motion, series, *pair)
                for pair in field_orders
            ]
            if earth_fixed_motion
            else [0.0]
        )
        # velocities in earth axes do not depend on the heading
        if max(earth_fixed_scores) <= 0.85:
            scored_topics.append(
                (
                    _mean_velocity_correlation(pose, motion, series, first_field, second_field),
                    series.name,
                )
            )
    best_fit = max(scored_topics)
    return best_fit if best_fit[0] > 0.3 else (forward_alignment([motion]), None)


def _mean_velocity_correlation(
    pose: RawTable, motion: Motion, series: Series, forward_field: str, sideways_field: str
) -> float:
    """Return the mean correlation of surge and sway velocity with a pair of fields."""
    velocity_fits: list[ScaleFit] = []
    for name, field in (("u", forward_field), ("v", sideways_field)):
        is_finite = np.isfinite(series[field])
        if is_finite.sum() < _MIN_MOTION_ROWS:
            return -1.0
        interpolated = np.interp(pose.t, series.clock[is_finite], series[field][is_finite])
        velocity_fits.append(
            fit_to_motion([RawTable(pose.t, {**pose.columns, name: interpolated})], [motion], name)
        )
    forward_fit, sideways_fit = velocity_fits
    # the sign of the forward factor counts: a heading that is off by 90 deg exchanges both
    return float(
        0.5 * (forward_fit.correlation * np.sign(forward_fit.factor) + sideways_fit.correlation)
    )


def _name_bare_numbers(
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


def _concatenate_field(recordings: Sequence[Recording], topic: str, field: str) -> np.ndarray:
    """Return the values of a field in all recordings with this field."""
    series_with_topic = [r.series[topic] for r in recordings if topic in r.series]
    return np.concatenate(
        [series[field] for series in series_with_topic if series.has_field(field)]
    )


def _find_actuator_fields(
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
            known = _known_command(recordings[0], topic, field)
            # a source of MOOS is the name of a program, which says nothing about an actuator
            name = field if series.message_type == _MOOS_MESSAGE_TYPE else f"{topic} {field}"
            channel = known[0] if known else match_input_channel(parse_name(name))
            if channel is None or channel in MOTION_CHANNELS or (topic, field) in used_fields:
                continue
            values = _concatenate_field(recordings, topic, field)
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
            followed_publisher = _publisher(candidate_fields[0][0])
        elif has_publishers and followed_publisher:
            candidate_fields.sort(key=lambda entry: _publisher(entry[0]) != followed_publisher)
            if _publisher(candidate_fields[0][0]) == followed_publisher:
                text = (
                    f"{candidate_fields[0][1]} is written by"
                    f" {' and '.join(_publisher(topic) for topic, _ in candidate_fields)};"
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


def _known_command(
    recording: Recording, topic: str, field: str
) -> tuple[str, dict[str, Any]] | None:
    """Return channel and settings of a command that the format defines, or None."""
    series = recording.series.get(topic)
    message_type = series.message_type.rsplit("/", 1)[-1] if series is not None else ""
    return KNOWN_COMMANDS.get((message_type, field))


def _publisher(topic: str) -> str:
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

    The vessel follows the command that explains most of the changes of its yaw rate over a second,
    beyond what the yaw rate itself explains.

    Args:
        channel: channel of the rudder.
        recording: recording with aligned clocks.
        fields: topic and field of each command.
        plan: sources of position and heading by standard messages.
        draft_notes: receives the guess.
    """
    pose = None
    if len(fields) > 1 and plan.position is not None and plan.heading is not None:
        pose = _extract_pose(recording, plan.position, plan.heading)
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
INPUTS_KEY = ("signals", "inputs")
"""Key of the inputs in a config."""
_TABLE_SUFFIXES = (".csv", ".parquet")


def find_log_files(paths: Sequence[Path]) -> list[Path]:
    """Return all logs in files and folders without duplicates, in sorted order.

    A folder may itself be a log, such as a ROS 2 bag. In a folder without bags, csv and Parquet
    files, logs of other formats are used.

    Raises:
        UsageError: if a path does not exist or a folder has no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            nested_logs = find_logs(path)
            # other files next to tables are often notes and settings
            preferred_logs = [
                p for p in nested_logs if p.is_dir() or p.suffix in _TABLE_SUFFIXES
            ] or nested_logs
            if not preferred_logs:
                raise UsageError(
                    f"{path}: has no log of a known format{describe_other_files(path)}"
                )
            files += preferred_logs
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    unique_files: dict[Path, Path] = {}
    for file in files:
        unique_files.setdefault(file.resolve(), file)
    return list(unique_files.values())


def describe_other_files(folder: Path) -> str:
    """Return a text with the types of files in a folder and how to convert them; may be empty."""
    endings = Counter(path.suffix.lower() for path in folder.rglob("*") if path.is_file())
    counts_text = ", ".join(
        f"{n} file{'s' * (n > 1)} {suffix or 'without ending'}" for suffix, n in endings.items()
    )
    most_frequent = max(endings, key=lambda ending: endings[ending], default="")
    return f", but {counts_text[:120]}; {suggest_conversion(most_frequent)}" if counts_text else ""


@dataclass
class DraftResult:
    """Drafted reader and its logs.

    Attributes:
        reader: settings of the reader, `data.reader` of a config.
        draft_notes: guesses and notes on these settings.
        logs: path -> log in SI.
        errors: path -> error of a log that cannot be read.
    """

    reader: dict[str, Any]
    draft_notes: DraftNotes
    logs: dict[Path, Log] = dataclasses.field(default_factory=dict)
    errors: dict[Path, ResidnetError] = dataclasses.field(default_factory=dict)


def read_drafted(
    paths: Sequence[Path], draft_notes: DraftNotes, *, is_gridded: bool = True
) -> DraftResult:
    """Draft a reader for files of one format and read them.

    Args:
        paths: files.
        draft_notes: receives guesses and notes.
        is_gridded: whether recordings get a uniform clock; otherwise the clock of their positions.

    Raises:
        UsageError: if the files have several formats.
        DataError: if no file can be read.
    """
    log_kind = _detect_common_kind(paths)
    result = DraftResult({"kind": "canonical"}, draft_notes)
    recordings: dict[Path, Recording] = {}
    if log_kind == "table" and (trip_files := group_by_trip(paths)):
        result.reader, result.errors = _draft_trip_parts(trip_files, draft_notes)
        result.errors |= {
            path: DataError(f"{path}: another file of its trip is missing; leave it out")
            for path in sorted(set(paths).difference(*trip_files.values()))
        }
        # a trip has the name of its file with the most channels of the motion
        paths = [*trip_files[next(iter(result.reader["parts"]))]]
    elif log_kind == "table":
        with name_files_in_errors(paths):
            result.reader, result.errors = draft_tables(paths, draft_notes)
    elif is_channel_reader(log_kind):
        # a registered reader that returns channels in SI units needs no channel map
        result.reader = {"kind": log_kind}
    elif log_kind != "canonical":
        try:
            result.reader, recordings = draft_recordings(paths, draft_notes)
        except ResidnetError as error:
            raise without_channel_map(error) from None
    settings = {key: value for key, value in result.reader.items() if is_gridded or key != "clock"}
    reader = validate_config(settings, ReaderConfig, "draft").build()
    names = assign_log_names(paths)
    for number, path in enumerate(paths):
        report_progress("reading logs", number, len(paths))
        try:
            if path not in result.errors:
                # recordings from which the reader was drafted are loaded already
                recording = recordings.pop(path, None)
                log = reader.read(path) if recording is None else reader.to_log(recording)
                result.logs[path] = log.replace(name=names[path])
        except ResidnetError as error:
            result.errors[path] = without_channel_map(error)
    report_progress("reading logs", len(paths), len(paths))
    if not result.logs:
        raise_unreadable(result.errors)
    _correct_rudder_signs(result)
    _name_manoeuvres(result)
    return result


def _detect_common_kind(paths: Sequence[Path]) -> str:
    """Return the format of logs.

    Raises:
        UsageError: if they have several formats.
    """
    kind_by_path = {path: detect_log_kind(path) for path in paths}
    if len(set(kind_by_path.values())) > 1:
        names_by_kind: dict[str, list[str]] = {}
        for path, kind in sorted(kind_by_path.items(), key=lambda item: item[1]):
            names_by_kind.setdefault(kind, []).append(path.name)
        kinds_text = "; ".join(
            f"{kind}: {', '.join(file_names)[:120]}" for kind, file_names in names_by_kind.items()
        )
        raise UsageError(
            f"the logs have several formats, one was expected ({kinds_text}); give logs of one"
            " format"
        )
    return kind_by_path[paths[0]]


def _draft_trip_parts(
    trip_files: Mapping[str, Sequence[Path]], draft_notes: DraftNotes
) -> tuple[dict[str, Any], dict[Path, ResidnetError]]:
    """Draft a reader that joins several tables of each trip.

    Args:
        trip_files: files of each part in the order of the trips, see `group_by_trip`.
        draft_notes: receives guesses and notes.

    Returns:
        Settings of the reader, the part with most channels of the motion first, and the error of
        each table that cannot be read.
    """
    part_settings: dict[str, dict[str, Any]] = {}
    errors: dict[Path, ResidnetError] = {}
    for part_name, files in trip_files.items():
        part_notes = DraftNotes()
        part_settings[part_name], part_errors = draft_tables(files, part_notes, has_heading=True)
        errors |= part_errors
        part_notes.move_key(READER_KEY, (*READER_KEY, "parts", part_name))
        draft_notes.extend(part_notes)
    part_order = sorted(
        part_settings, key=lambda name: -len(_motion_channels(part_settings[name]["channels"]))
    )
    text = (
        f"files whose names differ only in {' and '.join(part_order)} are joined as one trip;"
        " the clock offset follows from a yaw rate against a heading, from dates, or from the"
        " motion that the commands explain"
    )
    draft_notes.add_guess((*READER_KEY, "parts"), text)
    parts = {part_name: part_settings[part_name] for part_name in part_order}
    return {"kind": "joined", "parts": parts}, errors


def _name_manoeuvres(result: DraftResult) -> None:
    """Infer the kinds of manoeuvres of tables, unless folders name them.

    Args:
        result: drafted reader and its logs, which receive the kinds.
    """
    if "manoeuvre" in result.reader or result.reader["kind"] not in TABLE_KINDS.values():
        return
    kinds = {path: resolve_manoeuvre("auto", path, log) for path, log in result.logs.items()}
    counts = Counter(kind for kind in kinds.values() if kind != UNKNOWN)
    if not counts:
        return
    result.reader["manoeuvre"] = "auto"
    text = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    result.draft_notes.add_guess(
        (*READER_KEY, "manoeuvre"),
        f"{text} of {len(kinds)} logs, by the names of the files or by rudder angle and heading",
    )
    result.logs = {path: log.replace(manoeuvre=kinds[path]) for path, log in result.logs.items()}


def group_by_trip(paths: Sequence[Path]) -> dict[str, list[Path]]:
    """Group tables that are parts of trips by the word in which their names differ.

    Two files that both have a position or a speed are separate logs, of two vessels or of two
    recorders. A heading may be in both.

    Returns:
        Word -> tables in the order of the trips; empty if the tables are separate logs.
    """
    columns = {path: read_column_names(path) for path in paths}
    # tables without channels next to logs are notes
    paths_by_columns: dict[tuple[str, ...], list[Path]] = {}
    for path, names in columns.items():
        paths_by_columns.setdefault(names, []).append(path)
    log_groups = {
        n: files
        for n, files in paths_by_columns.items()
        if len(paths_by_columns) > 1 and _channels_from_headers(files)
    }
    trip_files = group_trip_files(
        {path: names for path, names in columns.items() if names in log_groups}
    )
    motion_sets = [
        _motion_channels(_channels_from_headers(files)) & {*"xyuv"} for files in trip_files.values()
    ]
    is_ambiguous = any(
        first_set & second_set for first_set, second_set in itertools.combinations(motion_sets, 2)
    )
    return {} if is_ambiguous else trip_files


def _channels_from_headers(files: Sequence[Path]) -> Iterable[str]:
    """Return the channels of the column names of the first readable table; may be empty."""
    for path in files:
        with contextlib.suppress(ResidnetError):
            if channels := match_channels([*preview_table(path, 50).numeric_columns], DraftNotes()):
                return channels
    return ()


def _motion_channels(channels: Iterable[str]) -> set[str]:
    """Return the channels of position, heading, velocities and roll under canonical names."""
    equivalent_channels = {"latitude": "x", "longitude": "y", **dict.fromkeys(QUATERNION, "psi")}
    return {equivalent_channels.get(name, name) for name in channels} & {*STATE_NAMES, "phi", "p"}


def read_mixed_formats(
    paths: Sequence[Path], answers: Mapping[Key, str] | None = None
) -> list[DraftResult]:
    """Read logs of any formats with one drafted reader per format and set of columns.

    A group of logs without a readable one has the error in its result.

    Args:
        paths: files.
        answers: answers that the user has given in advance, by key.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    columns_by_path = {
        path: read_column_names(path) for path in paths if detect_log_kind(path) == "table"
    }
    has_trips = bool(group_by_trip([*columns_by_path]))
    for path in paths:
        log_kind = detect_log_kind(path)
        names = columns_by_path[path] if log_kind == "table" and not has_trips else ()
        groups.setdefault((log_kind, *names), []).append(path)
    results = []
    for group in groups.values():
        draft_notes = DraftNotes(answers=answers)
        try:
            results.append(read_drafted(group, draft_notes, is_gridded=False))
        except UnreadableLogsError as error:
            results.append(DraftResult({}, draft_notes, errors=error.errors))
        except ResidnetError as error:
            results.append(DraftResult({}, draft_notes, errors=dict.fromkeys(group, error)))
    return results


def _correct_rudder_signs(result: DraftResult) -> None:
    """Reverse the sign of rudders that turn the vessel to port, and of planes that pitch it up.

    The signs of the drafted reader and of the logs are changed in place.

    Args:
        result: drafted reader and its logs.
    """
    part_settings: dict[Key, Mapping[str, Any]] = {
        (*READER_KEY, "parts", part_name): part
        for part_name, part in result.reader.get("parts", {}).items()
    }
    part_settings = part_settings or {READER_KEY: result.reader}
    channels: dict[str, dict[str, Any]] = {}
    entry_keys: dict[str, Key] = {}
    for part_key, part in part_settings.items():
        for name, entry in part.get("channels", {}).items():
            channels.setdefault(name, entry)
            entry_keys.setdefault(name, (*part_key, "channels", name))
    channel_names = dict.fromkeys(name for log in result.logs.values() for name in log.channels)
    names = [name for name in channel_names if re.match(r"(cmd_)?delta(?!_rate)", name)]
    logs_with_rates = [
        completed_log
        for log in result.logs.values()
        if names and (completed_log := _complete_turn_rates(log))
    ]
    for name in names:
        is_plane = PLANE_PATTERN.match(name) is not None
        rate, rate_sign, opposite_direction = (
            ("q", -1.0, "up") if is_plane else ("r", 1.0, "to port")
        )
        columns = [name, "theta"] if is_plane else [name]
        usable_logs = [log for log in logs_with_rates if {rate, *columns} <= log.channels.keys()]
        logs = [RawTable(log.t, {column: log[column] for column in columns}) for log in usable_logs]
        rates = {number: rate_sign * log[rate] for number, log in enumerate(usable_logs)}
        gain, standard_error = estimate_rudder_gain(
            logs, name, rates, "theta" if is_plane else None
        )
        key = entry_keys.get(name, INPUTS_KEY)
        if abs(gain) < MIN_STANDARD_ERRORS * standard_error:
            result.draft_notes.add_guess(
                key, f"the logs do not determine in which direction {name} turns the vessel"
            )
        elif gain < 0.0 and name in channels:
            channels[name]["sign"] = -1 * int(channels[name].get("sign", 1))
            text = (
                f"positive values turned the vessel {opposite_direction} in the logs"
                f" ({-gain / standard_error:.0f} standard errors): the sign is reversed"
            )
            result.draft_notes.add_guess(key, text)
            for path, log in result.logs.items():
                if name in log.channels:
                    negated_channels = {**log.channels, name: -log[name]}
                    result.logs[path] = log.replace(channels=negated_channels)
        elif gain < 0.0:
            text = f"positive values of {name} turned the vessel {opposite_direction} in the logs"
            result.draft_notes.add_guess(key, text)


def _complete_turn_rates(log: Log) -> Log | None:
    """Return a log with yaw rate, and pitch rate for underwater vessels; None if impossible."""
    try:
        dof = DegreesOfFreedom.from_channels(log.channels)
        rates = {"r", "q"} if dof.is_six_dof else {"r"}
        return log if rates <= log.channels.keys() else complete_motion(log, MotionConfig(), dof)
    except ResidnetError:
        return None
