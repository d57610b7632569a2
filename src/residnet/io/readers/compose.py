"""Conversion of a recording to a log: one clock, SI units, NED and body axes, vessel's origin."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Seconds
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.external_parts import (
    describe_part_class,
    describe_part_error,
    is_external_part,
)
from residnet.core.frames import rotate, unwrap_angle
from residnet.core.layout import ROLL_LAYOUT, SIX_DOF_LAYOUT, DegreesOfFreedom
from residnet.core.log import Log, Remark, make_remark
from residnet.core.names import CHANNEL_UNITS, to_si
from residnet.io.readers.base import ConfiguredReader, hash_files, require_samples
from residnet.io.readers.messages import extend_with_standard_messages
from residnet.io.readers.quantities import (
    AngleHeading,
    ChannelPlan,
    ClockConfig,
    CourseSpeedVelocity,
    DerivedVelocity,
    EarthFixedVelocity,
    FieldMap,
    GeodeticPosition,
    HeadingConfig,
    PositionConfig,
    TopicClock,
    TopicSource,
    UniformClock,
    VelocityConfig,
    complete_quaternion,
    list_source_channels,
    normalize_quaternion,
    project_fixes,
    quaternion_yaw,
    require_speed_units,
    resolve_drift_angle,
)
from residnet.io.readers.recording import (
    ALL_FIELDS,
    CLOCK_ONLY_FIELD,
    FieldFilter,
    Recording,
    Series,
    match_topic,
)
from residnet.io.readers.topics import align_clocks, check_unused_topics, topic_statistics
from residnet.preprocessing.channel_values import mask_fill_values
from residnet.preprocessing.derivatives import SavitzkyGolay
from residnet.preprocessing.motion import Antenna

_STATE_CHANNELS = ("x", "y", "psi", "u", "v", "r", "p", "phi")
_MOTION_CHANNELS = {*_STATE_CHANNELS, "north_rate", "east_rate"}
_MAX_GAP_SECONDS = 1.0
"""Longest step in s that is interpolated."""
_MAX_GAP_STEPS = 3.0
"""Longest step that is interpolated, in median steps of a topic (two lost rows)."""


class RecordingConfig(ConfiguredReader, ABC):
    """Base class of the readers of recordings.

    Attributes:
        channels: channel name (canonical or user-defined) -> field of a topic. `speed` and
            `drift_angle` become u and v as in tables.
        position: source of x and y.
        heading: source of psi.
        velocity: source of u and v (and r) if they are not mapped as channels.
        standard_messages: whether standard messages map automatically to channels that are not
            declared; ROS messages by REP 103 (ENU; forward, left, up).
        clock: clock of the log.
        delays: topic -> delay in s that is subtracted from its times; `estimated` takes the median
            latency of topics with header stamps for a topic without them.
        recorder_utc_offset: offset of the recorder's clock from UTC in s, positive if it is ahead;
            null estimates it from topics with stamps and arrivals.
        manoeuvre: type of manoeuvre of every recording; `folder` takes the name of its folder; null
            means unknown.
    """

    channels: dict[str, FieldMap] = Field(default_factory=dict)
    position: PositionConfig | None = None
    heading: HeadingConfig | None = None
    velocity: VelocityConfig | None = None
    standard_messages: bool = True
    clock: ClockConfig = Field(default_factory=TopicClock)
    delays: dict[str, Seconds | Literal["estimated"]] = Field(default_factory=dict)
    recorder_utc_offset: Seconds | None = None
    manoeuvre: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _reject_zone(cls, settings: Any) -> Any:
        if isinstance(settings, Mapping) and "zone" in settings:
            raise ValueError("zone: this key is now called recorder_utc_offset; rename it")
        return settings

    @model_validator(mode="after")
    def _validate_sources(self) -> RecordingConfig:
        for name, entry in self.channels.items():
            entry.require_valid_channel(name)
        require_speed_units({name: entry.unit for name, entry in self.channels.items()})
        if isinstance(self.velocity, DerivedVelocity) and not isinstance(self.clock, UniformClock):
            raise ValueError(
                "velocity: kind 'derived' needs a uniform clock; set clock: {kind: uniform, step:"
                " 0.1 s}"
            )
        declared_channels = list_source_channels(self.position, self.heading, self.velocity)
        if duplicates := ", ".join(name for name in declared_channels if name in self.channels):
            raise ValueError(
                f"channels: {duplicates} given here and by position, heading or velocity; remove"
                " one of them"
            )
        return self

    @abstractmethod
    def load(self, path: Path, field_filter: FieldFilter) -> Recording:
        """Load a recording.

        Args:
            path: file or folder.
            field_filter: filter of topics and fields; a reader may load more.

        Raises:
            ResidnetError: if the recording cannot be read.
        """

    def read(self, path: Path) -> Log:
        """Read one log; see `LogReader.read`.

        `meta["findings"]` has a remark on each problem and each correction.
        """
        return self.to_log(self.load_checked(path, self._build_field_filter()))

    @final
    def load_checked(self, path: Path, field_filter: FieldFilter) -> Recording:
        """Load a recording; an error in the code of another package becomes one line.

        Raises:
            ResidnetError: if the recording cannot be read, or `load` of a reader of another package
                raises an error or returns no valid recording.
        """
        if not is_external_part(self):
            return self.load(path, field_filter)
        subject = f"{path}: reader '{self.kind}' {describe_part_class(type(self), self)}"
        try:
            recording: Any = self.load(path, field_filter)
        except ResidnetError:
            raise
        except Exception as error:  # the code of a user may raise anything
            raise DataError(
                f"{subject}: {describe_part_error(error, type(self), 'load')}; raise a DataError"
                " that names the file and the row, or use wrap_read_errors"
            ) from error
        if not isinstance(recording, Recording):
            raise DataError(
                f"{subject}: load returned {type(recording).__name__}, expected a Recording"
            )
        for series in recording.series.values():
            times: Any = series.stamp if series.stamp is not None else series.arrival
            columns: dict[str, Any] = {"time": times, **series.fields}
            n_rows = np.size(times)
            for name, values in columns.items():
                if not isinstance(values, np.ndarray) or values.shape != (n_rows,):
                    raise DataError(
                        f"{subject}: '{name}' of series '{series.name}' is {type(values).__name__}"
                        f" of shape {list(np.shape(values))}, expected a NumPy array [{n_rows}]"
                    )
        return recording

    def to_log(self, recording: Recording) -> Log:
        """Convert a loaded recording to a log; see `read`."""
        path = recording.path
        delays = {
            topic: None if delay == "estimated" else delay for topic, delay in self.delays.items()
        }
        recording = align_clocks(recording, delays, self.recorder_utc_offset)
        plan = ChannelPlan(self.channels, self.position, self.heading, self.velocity)
        if self.standard_messages:
            plan = extend_with_standard_messages(recording, plan)
        log = build_log(recording, plan, self.clock)
        excluded: set[str] = set()
        if not DegreesOfFreedom.from_channels(log.channels).is_six_dof:
            # heave and pitch of a surface vessel are no states of its model
            excluded = {*SIX_DOF_LAYOUT.state_names} - {*ROLL_LAYOUT.state_names}
        elif isinstance(plan.velocity, EarthFixedVelocity | CourseSpeedVelocity):
            # a rotation by the heading alone gives no body velocities of a pitching vessel
            excluded = {"u", "v"}
        channels = {
            n: values for n, values in log.channels.items() if n not in excluded - {*self.channels}
        }
        log = log.replace(channels=channels, units={name: log.units[name] for name in channels})
        manoeuvre = path.resolve().parent.name if self.manoeuvre == "folder" else self.manoeuvre
        meta = {**log.meta, "source": str(path), "sha256": hash_files(recording.files or (path,))}
        name = path.name if path.is_dir() else path.stem
        return log.replace(name=name, manoeuvre=manoeuvre or "unknown", meta=meta)

    def _build_field_filter(self) -> FieldFilter:
        """Return a filter of the configured fields; of all fields if messages map automatically."""
        if self.standard_messages:
            return ALL_FIELDS
        topic_fields = [(entry.topic, entry.field) for entry in self.channels.values()]
        for source in (self.position, self.heading, self.velocity):
            if isinstance(source, TopicSource):
                topic_fields += [(source.topic, name) for name in source.fields]
        if isinstance(self.clock, TopicClock) and self.clock.topic is not None:
            topic_fields.append((self.clock.topic, CLOCK_ONLY_FIELD))
        return FieldFilter(topic_fields)


@dataclass(frozen=True)
class TopicChannels:
    """Channels of one topic in SI and residnet's frames, on the clock of the topic.

    Attributes:
        log: log with the channels and the name of the topic.
        hold_names: channels with zero-order hold.
        longest_gap: longest step in s that is interpolated.
        remarks: remarks from reading.
        conversion: descriptions of converted frames.
    """

    log: Log
    hold_names: tuple[str, ...]
    longest_gap: float
    remarks: tuple[Remark, ...]
    conversion: tuple[str, ...]

    @property
    def is_pose(self) -> bool:
        """Whether the channels are position or heading."""
        return "psi" in self.log.channels or {"x", "y"} <= set(self.log.channels)

    def resample(self, times: np.ndarray, step: float) -> dict[str, np.ndarray]:
        """Resample the channels.

        Args:
            times: new sample times [T] in s.
            step: median step of these times in s.

        Returns:
            Channel -> values [T], NaN in gaps and outside of the recorded span.
        """
        # imported here because align imports masks, which import the readers
        from residnet.preprocessing.align import GridConfig, resample_at

        if times.size == self.log.t.size and np.array_equal(times, self.log.t):
            return dict(self.log.channels)
        max_gap = max(self.longest_gap, _MAX_GAP_STEPS * _median_step(self.log.t))
        resampled: dict[str, np.ndarray] = {}
        # one channel at a time, because resampling needs several copies of its input
        for name, values in self.log.channels.items():
            hold_names = (name,) if name in self.hold_names else ()
            grid = GridConfig(step=step, held=hold_names, longest_gap=max_gap)
            resampled |= resample_at(
                self.log.replace(channels={name: values}), grid, times
            ).channels
        return resampled


def build_log(recording: Recording, plan: ChannelPlan, clock: ClockConfig) -> Log:
    """Build a log from a recording with aligned clocks.

    If the recording has dates, time starts at 0 and `meta["epoch"]` is the Unix time in s;
    otherwise the log has the time of the recording. psi starts in [0, 2 pi). Samples without a
    value of any state channel have the mask `hard:gap`.

    Args:
        recording: recording with one clock for all topics.
        plan: mapping of topics to channels.
        clock: clock of the log.

    Raises:
        UsageError: if a topic, field or sender is missing, or a quantity that another one needs.
        DataError: if a topic has no usable time, or the topics do not overlap in time.
    """
    topics = _extract_all_topics(recording, plan)
    times, step = _compute_sample_times(recording, topics, clock)
    derived_velocity = plan.velocity if isinstance(plan.velocity, DerivedVelocity) else None
    antenna = Antenna() if plan.position is None else plan.position.antenna
    values: dict[str, np.ndarray] = {}
    units = {
        name: unit for topic_channels in topics for name, unit in topic_channels.log.units.items()
    }
    for topic_channels in topics:
        if derived_velocity is None or not topic_channels.is_pose:
            values |= topic_channels.resample(times, step)
    if derived_velocity is not None:
        pose_topics = [topic_channels for topic_channels in topics if topic_channels.is_pose]
        values = _differentiate_pose(pose_topics, derived_velocity, antenna, times, step) | values
    else:
        _transform_to_vessel_origin(values, plan.velocity, antenna)
    values = resolve_drift_angle(values)
    units |= {name: CHANNEL_UNITS[name] for name in ("x", "y", "psi", "u", "v", "r")}
    units = {name: units[name] for name in values}
    t = times
    if recording.epoch is not None:
        t = times - times[:1]
        if isinstance(clock, UniformClock):
            t = clock.step * np.arange(times.size)
    require_samples(recording.path, t)
    for name, channel in values.items():
        if not np.isfinite(channel).any():
            raise DataError(
                f"{recording.path}: channel {name} has no value on the log's clock; remove it from"
                " the channel map, or set the delay of its topic"
            )
    states = [values[name] for name in _STATE_CHANNELS if name in values]
    is_missing = np.isnan(np.stack(states)).any(axis=0) if states else np.zeros(len(t), dtype=bool)
    masks = {"hard:gap": is_missing} if is_missing.any() else {}
    meta = _build_metadata(recording, plan, topics, times)
    log = Log(recording.path.stem, t, values, units, masks=masks, meta=meta)
    unused_series = [recording.series[n] for n in meta["topics_not_used"] if n in recording.series]
    findings = [*meta["findings"], *check_unused_topics(unused_series, log, float(times[0]))]
    return log.replace(meta={**meta, "findings": findings})


def _extract_all_topics(recording: Recording, plan: ChannelPlan) -> list[TopicChannels]:
    """Return the channels of all topics in a plan, the position first."""
    topics = []
    if plan.position is not None:
        topics.append(extract_position(recording, plan.position))
    if plan.heading is not None:
        topics.append(extract_heading(recording, plan.heading))
    topics += _extract_mapped_channels(recording, plan.channels)
    if isinstance(plan.velocity, EarthFixedVelocity | CourseSpeedVelocity):
        topics.append(_extract_velocity(recording, plan.velocity))
    for entry in (entry for part in topics for entry in part.remarks):
        if entry["level"] == "fatal":
            raise DataError(f"{recording.path}: {entry['text']}")
    if not topics:
        raise UsageError(
            f"{recording.path}: no channel is mapped; rename the fields, for example to x, y, psi,"
            " u, v, r, delta, n, or set `channels`, `position` and `heading` (the recording"
            f" contains {recording.contents_description})"
        )
    return topics


def _read_field(
    recording: Recording, series: Series, path: str, unit: str | None = None
) -> np.ndarray:
    """Return the values [T] of a field, in SI if a unit is given.

    Raises:
        DataError: if the field has no finite value.
    """
    values = series[path]
    if not np.isfinite(values).any():
        raise DataError(
            f"{recording.path}: topic {series.name}: field '{path}' has no number in any of"
            f" {values.size} rows; remove it from the channel map, or leave the file out"
        )
    return values if unit is None else to_si(unit) * values


def _make_topic_channels(
    recording: Recording,
    series: Series,
    values: dict[str, np.ndarray],
    conversion: Sequence[str] = (),
    remarks: Sequence[Remark] = (),
    units: Mapping[str, str] | None = None,
    hold_names: tuple[str, ...] = (),
    longest_gap: float = _MAX_GAP_SECONDS,
) -> TopicChannels:
    if len(series) < 2:
        raise DataError(
            f"{recording.path}: topic {series.name} has {len(series)} rows, at least 2 are needed;"
            " remove it from the channel map, or leave the file out"
        )
    units = {name: (units or {}).get(name) or CHANNEL_UNITS.get(name, "m/s") for name in values}
    log = Log(series.name, series.clock, values, units)
    return TopicChannels(
        log, hold_names, longest_gap, (*series.remarks, *remarks), tuple(conversion)
    )


def _extract_mapped_channels(
    recording: Recording, channels: Mapping[str, FieldMap]
) -> list[TopicChannels]:
    """Return the mapped channels in groups of the same topic, sender and longest gap.

    A channel with values in less than half of the rows is a group by itself, with these rows only.
    """
    groups: dict[tuple[str, str | None, float, str], dict[str, FieldMap]] = {}

    def is_available(entry: FieldMap) -> bool:
        series_by_name = recording.series
        topic = (
            next(iter(series_by_name), "")
            if entry.topic is None
            else match_topic(entry.topic, series_by_name)
        )
        series = recording.series.get(topic or "")
        has_rows = series is not None and series.has_field(entry.field) and len(series) > 1
        return bool(has_rows and series is not None and np.isfinite(series[entry.field]).any())

    for name, entry in channels.items():
        if not (entry.required or is_available(entry)):
            continue
        series = recording[entry.topic]
        is_sparse = np.isnan(series[entry.field]).mean() > 0.5
        longest_gap = entry.longest_gap or _MAX_GAP_SECONDS
        group_key = (series.name, entry.sender, longest_gap, name if is_sparse else "")
        groups.setdefault(group_key, {})[name] = entry
    topics = []
    for (topic, sender, longest_gap, sparse_name), entries in groups.items():
        series = recording.series[topic]
        series = series if sender is None else series.rows_of_sender(sender)
        if sparse_name:
            series = series.select_rows(np.isfinite(series[entries[sparse_name].field]))
        values = {
            name: entry.convert(name, mask_fill_values(_read_field(recording, series, entry.field)))
            for name, entry in entries.items()
        }
        conversion = [
            f"{name}: {entry.frame} of {topic}.{entry.field}"
            for name, entry in entries.items()
            if entry.frame != "as_measured"
        ]
        units = {name: entry.si_unit_of(name) for name, entry in entries.items()}
        hold_names = tuple(name for name, entry in entries.items() if entry.hold)
        topics.append(
            _make_topic_channels(
                recording, series, values, conversion, (), units, hold_names, longest_gap
            )
        )
    return topics


def _describe_lever_arm(antenna: Antenna, quantity: str) -> tuple[str, ...]:
    if antenna == Antenna():
        return ()
    return (
        f"{quantity}: transformed to the vessel's origin from ({antenna.x:g}, {antenna.y:g}) m in"
        " body axes",
    )


def extract_position(recording: Recording, config: PositionConfig) -> TopicChannels:
    """Extract x and y of the antenna in m from a recording."""
    series = recording[config.topic]
    lever_arm_note = _describe_lever_arm(config.antenna, "x, y")
    first_coordinate, second_coordinate = (
        _read_field(recording, series, name, config.unit) for name in config.fields
    )
    if not isinstance(config, GeodeticPosition):
        return _make_topic_channels(
            recording, series, {"x": first_coordinate, "y": second_coordinate}, lever_arm_note
        )
    plane_origin = (
        None if config.origin is None else (config.origin.latitude, config.origin.longitude)
    )
    north, east, origin, n_invalid = project_fixes(
        first_coordinate, second_coordinate, plane_origin
    )
    if origin is None:
        raise DataError(
            f"{recording.path}: topic {series.name}: '{config.latitude}' has no latitude in"
            f" {config.unit}; check field and unit"
        )
    text = (
        f"topic {series.name}: {n_invalid} positions at latitude 0, longitude 0 are no fixes; left"
        " out"
    )
    remarks = [make_remark("note", "no_fix", text, rows=n_invalid)] if n_invalid else []
    origin_deg = np.degrees(origin)
    plane_note = (
        f"x, y: tangent plane of WGS 84 at {origin_deg[0]:.7f} deg N, {origin_deg[1]:.7f} deg E"
    )
    return _make_topic_channels(
        recording, series, {"x": north, "y": east}, (plane_note, *lever_arm_note), remarks
    )


def extract_heading(recording: Recording, config: HeadingConfig) -> TopicChannels:
    """Extract psi from a recording, and phi and theta if configured.

    psi is unwrapped and starts in [0, 2 pi).
    """
    series = recording[config.topic]
    values: dict[str, np.ndarray] = {}
    remarks: list[Remark] = []
    offset = 0.0
    if isinstance(config, AngleHeading):
        yaw = _read_field(recording, series, config.field, config.unit)
        offset = config.offset
    else:
        parts = [_read_field(recording, series, part) for part in config.parts]
        quaternion = normalize_quaternion(*complete_quaternion(parts))
        x, y, z, w = quaternion
        n_empty = int(np.isnan(w).sum())
        if n_empty == w.size:
            raise DataError(
                f"{recording.path}: topic {series.name}: '{config.fields[0]}' has no orientation,"
                " all quaternions are empty; use another source of the heading"
            )
        if n_flips := int((sum(part[1:] * part[:-1] for part in quaternion) < 0.0).sum()):
            message = (
                f"topic {series.name}: the quaternion changes sign {n_flips} times (both signs"
                " represent one attitude); the heading remains continuous"
            )
            remarks.append(make_remark("note", "quaternion_flips", message, flips=n_flips))
        if n_empty:
            message = (
                f"topic {series.name}: {n_empty} quaternions are empty; the heading is missing"
            )
            remarks.append(make_remark("note", "empty_quaternions", message, rows=n_empty))
        yaw = quaternion_yaw(*quaternion)
        if config.roll:
            # roll has the same sign in both frames, pitch has opposite signs
            pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
            values["phi"] = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
            values["theta"] = -pitch if config.frame == "enu" else pitch
    psi = unwrap_angle((np.pi / 2 - yaw if config.frame == "enu" else yaw) + offset)
    if np.isfinite(psi).any():
        # rounding must not turn a heading of zero into 2 pi
        initial_psi = psi[np.isfinite(psi)][0] + 1e-6
        psi = psi - 2.0 * np.pi * np.floor(initial_psi / (2.0 * np.pi))
    values["psi"] = psi
    message = "psi: counter-clockwise from east (REP-103) to clockwise from north"
    conversion = (message,) if config.frame == "enu" else ()
    return _make_topic_channels(recording, series, values, conversion, remarks)


def _extract_velocity(
    recording: Recording, config: EarthFixedVelocity | CourseSpeedVelocity
) -> TopicChannels:
    """Extract the velocity over ground as the channels north_rate and east_rate in m/s."""
    series = recording[config.topic]
    if isinstance(config, CourseSpeedVelocity):
        course = _read_field(recording, series, config.course, config.course_unit)
        speed = _read_field(recording, series, config.speed, config.speed_unit)
        # receivers give no course at rest; there any course is right
        is_course_missing = np.isnan(course) & (speed > 0.3)
        north, east = (
            np.where(is_course_missing, np.nan, speed * component(np.nan_to_num(course)))
            for component in (np.cos, np.sin)
        )
    else:
        north, east = (_read_field(recording, series, name, config.unit) for name in config.fields)
    rotation_note = "u, v: earth-fixed velocity rotated to body axes"
    values = {"north_rate": north, "east_rate": east}
    lever_arm_note = _describe_lever_arm(config.antenna, "u, v")
    return _make_topic_channels(recording, series, values, (rotation_note, *lever_arm_note))


def _median_step(t: np.ndarray) -> float:
    return float(np.median(np.diff(t)))


def _compute_sample_times(
    recording: Recording, parts: Sequence[TopicChannels], clock: ClockConfig
) -> tuple[np.ndarray, float]:
    """Return the sample times of the log on the recording's clock and their median step, in s.

    Raises:
        DataError: if the topics do not overlap in time.
    """
    if not isinstance(clock, UniformClock):
        times = parts[0].log.t if clock.topic is None else recording[clock.topic].clock
        return times, _median_step(times) if times.size > 1 else 1.0
    logs = [part.log for part in parts]
    motion_logs = [log for log in logs if _MOTION_CHANNELS & set(log.channels)]
    interpolated_logs = [
        part.log for part in parts if set(part.log.channels) != set(part.hold_names)
    ]
    # the span of the motion decides; commands that are held may start later
    span_logs = motion_logs or interpolated_logs or logs
    start = max(log.t[0] for log in span_logs)
    stop = min(log.t[-1] for log in span_logs)
    if stop - start < clock.step:
        topic_spans = "; ".join(
            f"{log.name} {log.t[0]:.1f} to {log.t[-1]:.1f} s" for log in span_logs
        )
        raise DataError(
            f"{recording.path}: the topics do not overlap in time ({topic_spans}); check"
            " `recorder_utc_offset` and `delays`"
        )
    first_time = start
    if recording.epoch is not None:
        # multiples of the step in Unix time give all logs of one day the same grid
        grid_offset = recording.epoch % round(clock.step * 1e9) * 1e-9
        first_time = math.ceil((start + grid_offset) / clock.step - 1e-6) * clock.step - grid_offset
    n_samples = math.floor((stop - first_time) / clock.step + 1e-6) + 1
    return first_time + clock.step * np.arange(n_samples), clock.step


def _transform_to_vessel_origin(
    values: dict[str, np.ndarray], velocity: VelocityConfig | None, antenna: Antenna
) -> None:
    """Transform position and velocity to the vessel's origin and body axes, in place.

    Args:
        values: channel -> values [T].
        velocity: source of the velocity.
        antenna: antenna of the position.

    Raises:
        UsageError: if the heading or the yaw rate is missing.
    """
    if antenna != Antenna():
        if "psi" not in values:
            raise UsageError(
                "position.antenna: needs the heading to transform the position to the vessel's"
                " origin; set `heading`"
            )
        north, east = rotate(antenna.x, antenna.y, values["psi"])
        values["x"] = values["x"] - north
        values["y"] = values["y"] - east
    if not isinstance(velocity, EarthFixedVelocity | CourseSpeedVelocity):
        return
    if "psi" not in values:
        raise UsageError(
            "velocity: needs the heading to rotate earth-fixed velocities to body axes; set"
            " `heading`"
        )
    u, v = rotate(values.pop("north_rate"), values.pop("east_rate"), -values["psi"])
    if velocity.antenna != Antenna():
        if "r" not in values:
            raise UsageError(
                "velocity.antenna: needs the yaw rate to transform the velocity to the vessel's"
                " origin; set channels.r"
            )
        # velocity of a point P of a rigid body: u_P = u - r y, v_P = v + r x
        u, v = u + values["r"] * velocity.antenna.y, v - values["r"] * velocity.antenna.x
    values["u"] = u
    values["v"] = v


def _differentiate_pose(
    pose_topics: Sequence[TopicChannels],
    config: DerivedVelocity,
    antenna: Antenna,
    times: np.ndarray,
    step: float,
) -> dict[str, np.ndarray]:
    """Smooth and differentiate position and heading with Savitzky-Golay filters.

    The filters run on a grid with an integer fraction of the log's step that is as fine as the
    topics. They do not extend across gaps.

    Args:
        pose_topics: topics with position and heading.
        config: windows and order of the filters.
        antenna: antenna of the position.
        times: uniform sample times [T] in s.
        step: step of these times in s.

    Returns:
        The channels x, y, psi, u, v, r, [T] each.

    Raises:
        UsageError: if position or heading is missing.
    """
    pose_channels = {name for part in pose_topics for name in part.log.channels}
    if not {"x", "y", "psi"} <= pose_channels:
        raise UsageError(
            "velocity: kind 'derived' needs position and heading; set both, or channels u, v, r"
        )
    oversampling = max(1, round(step / min(_median_step(part.log.t) for part in pose_topics)))
    fine_step = step / oversampling
    # pad the log by one window at both ends, where the topics may have further samples
    n_padding = int(np.ceil(max(config.window, config.yaw_window or 0.0) / fine_step))
    grid = times[0] + fine_step * np.arange(
        -n_padding, oversampling * (times.size - 1) + n_padding + 1
    )
    motion: dict[str, np.ndarray] = {}
    for part in pose_topics:
        motion |= part.resample(grid, fine_step)
    lever_arm = np.stack(rotate(antenna.x, antenna.y, motion["psi"]), axis=1)
    positions = np.stack((motion["x"], motion["y"]), axis=1) - lever_arm
    segment_ids = np.zeros(grid.size, dtype=int)
    windows = (config.window, config.yaw_window or config.window)
    (smoothed_positions, velocities, _), (smoothed_heading, yaw_rates, _) = (
        SavitzkyGolay(window=window, order=config.order).derive(values, fine_step, segment_ids)
        for window, values in zip(windows, (positions, motion["psi"][:, None]), strict=True)
    )
    psi = smoothed_heading[:, 0]
    smoothed_states = (
        *smoothed_positions.T,
        psi,
        *rotate(velocities[:, 0], velocities[:, 1], -psi),
        yaw_rates[:, 0],
    )
    output_rows = slice(n_padding, grid.size - n_padding, oversampling)
    return {
        n: values[output_rows]
        for n, values in zip(_STATE_CHANNELS[:6], smoothed_states, strict=True)
    }


def _build_metadata(
    recording: Recording, plan: ChannelPlan, parts: Sequence[TopicChannels], times: np.ndarray
) -> dict[str, Any]:
    """Return the log's meta: remarks, topics, conversions, numbers of rows and start time."""
    remarks: list[Remark] = [*recording.remarks, *plan.remarks]
    topics: dict[str, Any] = {}
    for series in recording.series.values():
        series_remarks = topic_statistics(series)
        n_named_senders = sum(
            e.topic == series.name and e.sender is not None for e in plan.channels.values()
        )
        remarks += series.remarks
        # several publishers are no problem if the config maps their senders to channels
        remarks += [
            r
            for r in series_remarks
            if not (n_named_senders > 1 and r["code"] == "several_publishers")
        ]
        rate_figures: dict[str, float] = next(
            (r["figures"] for r in series_remarks if r["code"] == "topic_rate"), {}
        )
        topics[series.name] = {"kind": series.message_type, "rows": len(series), **rate_figures}
    present = {name for part in parts for name in part.log.channels}
    missing_channels = [name for name in plan.channels if name not in present]
    if missing_channels:
        text = (
            f"channels {', '.join(missing_channels)} are not in the recording or have no values;"
            " the log lacks them (they are not required)"
        )
        remarks.append(
            make_remark("note", "missing_channels", text, channels=len(missing_channels))
        )
    rows_used = {part.log.name: len(part.log) for part in parts}
    remarks += [entry for part in parts for entry in part.remarks if entry not in remarks]
    meta: dict[str, Any] = {
        "findings": remarks,
        "topics": topics,
        "topics_not_used": [
            n for n in (*recording.series, *recording.unread_series) if n not in rows_used
        ],
        "frames": [*plan.conversions, *(text for part in parts for text in part.conversion)],
        "rows_read": sum(len(series) for series in recording.series.values()),
        "rows_dropped": 0,
        "rows_used": sum(rows_used.values()),
    }
    if recording.epoch is not None:
        start = recording.epoch + int(np.rint(times[0] * 1e9))
        utc = datetime.fromtimestamp(start // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        utc = f"{utc}.{start % 10**9:09d}Z"
        meta |= {"epoch": start * 1e-9, "epoch_ns": start, "start_utc": utc}
    return meta
