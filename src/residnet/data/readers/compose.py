"""From a recording to a log: one clock, SI, NED and body axes, the vessel's centre."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import ROLL, SIX, Live
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, to_si
from residnet.data.channels import without_fills
from residnet.data.derivatives import SavitzkyGolay
from residnet.data.readers.base import ConfiguredReader, digest, require_samples, turned, unwrap
from residnet.data.readers.messages import standard_plan
from residnet.data.readers.quantities import (
    Angle,
    Antenna,
    ClockConfig,
    CourseSpeed,
    Derived,
    EarthFixed,
    FieldMap,
    Geodetic,
    HeadingConfig,
    OfTopic,
    Plan,
    PositionConfig,
    Source,
    Uniform,
    VelocityConfig,
    fixes_on_plane,
    given_by,
    unit_quaternion,
    yaw_of,
)
from residnet.data.readers.recording import (
    CLOCK_ONLY,
    EVERYTHING,
    Recording,
    Remark,
    Series,
    Wanted,
    remark,
    same_topic,
)
from residnet.data.readers.topics import align_clocks, beside, traffic

_STATE = ("x", "y", "psi", "u", "v", "r", "p", "phi")
_MOVING = {*_STATE, "north_rate", "east_rate"}
_LONGEST_GAP, _USUAL_GAP = 1.0, 3.0
"""Longest step that is bridged, s, and in usual steps of a topic: two rows may get lost; chosen by
hand."""


class RecordingConfig(ConfiguredReader, ABC):
    """What to take from a recording.

    Attributes:
        channels: canonical names (or names of your own) -> field of a topic.
        position: source of x and y.
        heading: source of psi.
        velocity: source of u and v (and r) where they are not channels.
        standard_messages: standard messages of ROS map themselves to what is not declared, by
            REP-103 (ENU, forward-left-up).
        clock: the log's clock.
        delays: topic -> time in s by which what it says is older than its time says; `estimated`
            takes, for a topic without header stamps, the usual latency of those that have them.
        zone: time by which the recorder's clock is ahead of UTC, s; null estimates it where topics
            have stamps and arrivals.
        manoeuvre: kind of manoeuvre of every recording, `folder` takes the name of the folder it
            lies in, null says that it is not known.
    """

    channels: dict[str, FieldMap] = Field(default_factory=dict)
    position: PositionConfig | None = None
    heading: HeadingConfig | None = None
    velocity: VelocityConfig | None = None
    standard_messages: bool = True
    clock: ClockConfig = Field(default_factory=OfTopic)
    delays: dict[str, Seconds | Literal["estimated"]] = Field(default_factory=dict)
    zone: Seconds | None = None
    manoeuvre: str | None = None
    formats: ClassVar[Mapping[str, Callable[[Path, bytes], bool]]] = {}
    """Name of each format that it reads -> whether a path with these first bytes is of it."""
    endings: ClassVar[tuple[str, ...]] = ()
    """Endings of its files."""

    @model_validator(mode="after")
    def _fits(self) -> RecordingConfig:
        for name, entry in self.channels.items():
            entry.require_fit(name)
        if isinstance(self.velocity, Derived) and not isinstance(self.clock, Uniform):
            raise ValueError(
                "velocity: kind 'derived' needs a uniform clock; set clock: {kind: uniform, step:"
                " 0.1 s}"
            )
        given = given_by(self.position, self.heading, self.velocity)
        if double := ", ".join(name for name in given if name in self.channels):
            raise ValueError(
                f"channels: {double} given here and by position, heading or velocity; take one of"
                " them away"
            )
        return self

    @abstractmethod
    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Return the recording in `path`, at least the series that are wanted.

        Raises:
            ResidnetError: where it cannot be read.
        """

    def read(self, path: Path) -> Log:
        """Return the log in `path`.

        See `LogReader.read`. `meta["findings"]` says what was noticed and mended on the way in.
        """
        return self.log_of(self.load(path, self._wanted()))

    def log_of(self, recording: Recording) -> Log:
        """Return the log of a recording as it was loaded; see `read`."""
        path = recording.path
        delays = {
            topic: None if delay == "estimated" else delay for topic, delay in self.delays.items()
        }
        recording = align_clocks(recording, delays, self.zone)
        plan = Plan(self.channels, self.position, self.heading, self.velocity)
        if self.standard_messages:
            plan = standard_plan(recording, plan)
        log = compose(recording, plan, self.clock)
        rest: set[str] = set()
        if not Live.told(log.channels).spatial:
            # of a vessel that does not dive nobody asked for these
            rest = {*SIX.names} - {*ROLL.names}
        elif isinstance(plan.velocity, EarthFixed | CourseSpeed):
            # turned by the heading alone they are not along the axes of one that pitches
            rest = {"u", "v"}
        kept = {n: values for n, values in log.channels.items() if n not in rest - {*self.channels}}
        log = log.replace(channels=kept, units={name: log.units[name] for name in kept})
        manoeuvre = path.resolve().parent.name if self.manoeuvre == "folder" else self.manoeuvre
        meta = {**log.meta, "source": str(path), "sha256": digest(recording.files or (path,))}
        name = path.name if path.is_dir() else path.stem
        return log.replace(name=name, manoeuvre=manoeuvre or "unknown", meta=meta)

    def _wanted(self) -> Wanted:
        """Return what the config names; everything where standard messages may add to it."""
        if self.standard_messages:
            return EVERYTHING
        named = [(entry.topic, entry.field) for entry in self.channels.values()]
        for source in (self.position, self.heading, self.velocity):
            if isinstance(source, Source):
                named += [(source.topic, name) for name in source.fields]
        if isinstance(self.clock, OfTopic) and self.clock.topic is not None:
            named.append((self.clock.topic, CLOCK_ONLY))
        return Wanted(named)


@dataclass(frozen=True)
class Part:
    """Channels of one topic on its own clock: SI and residnet's frames, not yet aligned.

    Attributes:
        log: the channels; it is named as the topic is.
        held: those whose last value holds until the next.
        longest_gap: longest step that is bridged, s.
        remarks: what was noticed on the way.
        conversion: which frames were converted, in words.
    """

    log: Log
    held: tuple[str, ...]
    longest_gap: float
    remarks: tuple[Remark, ...]
    conversion: tuple[str, ...]

    @property
    def pose(self) -> bool:
        """Whether this is the position or the heading."""
        return "psi" in self.log.channels or {"x", "y"} <= set(self.log.channels)

    def at(self, times: np.ndarray, step: float) -> dict[str, np.ndarray]:
        """Return the channels at `times` [T], whose usual step is `step`, both s.

        NaN in gaps and beyond the ends.
        """
        # the aligner imports masks, which import the readers
        from residnet.data.align import GridConfig, onto

        if times.size == self.log.t.size and np.array_equal(times, self.log.t):
            return dict(self.log.channels)
        gap = max(self.longest_gap, _USUAL_GAP * _usual_step(self.log.t))
        out: dict[str, np.ndarray] = {}
        # one by one: aligning needs several copies of what it aligns
        for name, values in self.log.channels.items():
            held = (name,) if name in self.held else ()
            grid = GridConfig(step=step, held=held, longest_gap=gap)
            out |= onto(self.log.replace(channels={name: values}), grid, times).channels
        return out


def compose(recording: Recording, plan: Plan, clock: ClockConfig) -> Log:
    """Return the log of a recording whose clocks are settled.

    Time starts at 0 where the recording has dates (`meta["epoch"]`, Unix time in s), else it is the
    recording's own. psi starts in [0, 2 pi). Samples at which a state channel has no value are
    masked as `hard:gap`.

    Raises:
        UsageError: where a topic, field or sender is missing, or a quantity that another one needs.
        DataError: where a topic that is used has no usable time, or the topics share no stretch of
            time.
    """
    parts = _parts(recording, plan)
    times, step = _times(recording, parts, clock)
    derived = plan.velocity if isinstance(plan.velocity, Derived) else None
    lever = Antenna() if plan.position is None else plan.position.antenna
    values: dict[str, np.ndarray] = {}
    units = {name: unit for part in parts for name, unit in part.log.units.items()}
    for part in parts:
        if derived is None or not part.pose:
            values |= part.at(times, step)
    if derived is not None:
        pose = [part for part in parts if part.pose]
        values = _derived_motion(pose, derived, lever, times, step) | values
    else:
        _move_and_turn(values, plan.velocity, lever)
    units |= {name: CHANNEL_UNITS[name] for name in ("x", "y", "psi", "u", "v", "r")}
    units = {name: units[name] for name in values}
    t = times
    if recording.epoch is not None:
        t = times - times[:1]
        if isinstance(clock, Uniform):
            t = clock.step * np.arange(times.size)
    require_samples(recording.path, t)
    for name, channel in values.items():
        if not np.isfinite(channel).any():
            raise DataError(
                f"{recording.path}: channel {name} holds no number on the log's clock; take it out"
                " of the map, or give its topic's delay"
            )
    states = [values[name] for name in _STATE if name in values]
    lost = np.isnan(np.stack(states)).any(axis=0) if states else np.zeros(len(t), dtype=bool)
    masks = {"hard:gap": lost} if lost.any() else {}
    meta = _meta(recording, plan, parts, times)
    log = Log(recording.path.stem, t, values, units, masks=masks, meta=meta)
    idle = [recording.series[n] for n in meta["topics_not_used"] if n in recording.series]
    findings = [*meta["findings"], *beside(idle, log, float(times[0]))]
    return log.replace(meta={**meta, "findings": findings})


def _parts(recording: Recording, plan: Plan) -> list[Part]:
    parts = []
    if plan.position is not None:
        parts.append(position_part(recording, plan.position))
    if plan.heading is not None:
        parts.append(heading_part(recording, plan.heading))
    parts += _channel_parts(recording, plan.channels)
    if isinstance(plan.velocity, EarthFixed | CourseSpeed):
        parts.append(_velocity_part(recording, plan.velocity))
    for entry in (entry for part in parts for entry in part.remarks):
        if entry["level"] == "fatal":
            raise DataError(f"{recording.path}: {entry['text']}")
    if not parts:
        raise UsageError(
            f"{recording.path}: no channel to read; name them under `channels`, `position`,"
            f" `heading` (the recording holds {recording.contents})"
        )
    return parts


def _numbers(
    recording: Recording, series: Series, path: str, unit: str | None = None
) -> np.ndarray:
    """Return the numbers [T] of a field, in SI by their unit."""
    values = series[path]
    if not np.isfinite(values).any():
        raise DataError(
            f"{recording.path}: topic {series.name}: field '{path}' holds no number in any of"
            f" {values.size} rows; take it out of the map"
        )
    return values if unit is None else to_si(unit) * values


def _part(
    recording: Recording,
    series: Series,
    values: dict[str, np.ndarray],
    conversion: Sequence[str] = (),
    remarks: Sequence[Remark] = (),
    units: Mapping[str, str] | None = None,
    held: tuple[str, ...] = (),
    gap: float = _LONGEST_GAP,
) -> Part:
    if len(series) < 2:
        raise DataError(
            f"{recording.path}: topic {series.name} has {len(series)} rows, at least 2 are needed;"
            " take it out of the map"
        )
    units = {name: (units or {}).get(name) or CHANNEL_UNITS.get(name, "m/s") for name in values}
    log = Log(series.name, series.clock, values, units)
    return Part(log, held, gap, (*series.remarks, *remarks), tuple(conversion))


def _channel_parts(recording: Recording, channels: Mapping[str, FieldMap]) -> list[Part]:
    """Return one part for all channels of a topic that may share one.

    A channel with hardly a value has one of its own, of the rows that have any.
    """
    groups: dict[tuple[str, str | None, float, str], dict[str, FieldMap]] = {}

    def there(entry: FieldMap) -> bool:
        names = recording.series
        topic = next(iter(names), "") if entry.topic is None else same_topic(entry.topic, names)
        series = recording.series.get(topic or "")
        found = series is not None and series.has(entry.field) and len(series) > 1
        return bool(found and series is not None and np.isfinite(series[entry.field]).any())

    for name, entry in channels.items():
        if not (entry.required or there(entry)):
            continue
        series = recording[entry.topic]
        sparse = np.isnan(series[entry.field]).mean() > 0.5
        gap = entry.longest_gap or _LONGEST_GAP
        key = (series.name, entry.sender, gap, name if sparse else "")
        groups.setdefault(key, {})[name] = entry
    parts = []
    for (topic, sender, gap, alone), entries in groups.items():
        series = recording.series[topic]
        series = series if sender is None else series.of_sender(sender)
        if alone:
            series = series.where(np.isfinite(series[entries[alone].field]))
        values = {
            name: entry.convert(name, without_fills(_numbers(recording, series, entry.field)))
            for name, entry in entries.items()
        }
        conversion = [
            f"{name}: {entry.frame} of {topic}.{entry.field}"
            for name, entry in entries.items()
            if entry.frame != "as_measured"
        ]
        units = {name: entry.si(name) for name, entry in entries.items()}
        held = tuple(name for name, entry in entries.items() if entry.hold)
        parts.append(_part(recording, series, values, conversion, (), units, held, gap))
    return parts


def _moved(lever: Antenna, what: str) -> tuple[str, ...]:
    if lever == Antenna():
        return ()
    return (f"{what}: moved to the vessel's centre from ({lever.x:g}, {lever.y:g}) m in body axes",)


def position_part(recording: Recording, config: PositionConfig) -> Part:
    """Return x and y of the antenna, m."""
    series, moved = recording[config.topic], _moved(config.antenna, "x, y")
    first, second = (_numbers(recording, series, name, config.unit) for name in config.fields)
    if not isinstance(config, Geodetic):
        return _part(recording, series, {"x": first, "y": second}, moved)
    at = None if config.origin is None else (config.origin.latitude, config.origin.longitude)
    north, east, origin, none = fixes_on_plane(first, second, at)
    if origin is None:
        raise DataError(
            f"{recording.path}: topic {series.name}: '{config.latitude}' holds no latitude in"
            f" {config.unit}; check field and unit"
        )
    text = f"topic {series.name}: {none} fixes at latitude 0, longitude 0 are no fixes; left out"
    remarks = [remark("note", "no_fix", text, rows=none)] if none else []
    degrees = np.degrees(origin)
    plane = f"x, y: tangent plane of WGS 84 at {degrees[0]:.7f} deg N, {degrees[1]:.7f} deg E"
    return _part(recording, series, {"x": north, "y": east}, (plane, *moved), remarks)


def heading_part(recording: Recording, config: HeadingConfig) -> Part:
    """Return psi, unwrapped from its first value in [0, 2 pi); phi and theta where wanted."""
    series = recording[config.topic]
    values: dict[str, np.ndarray] = {}
    remarks: list[Remark] = []
    offset = 0.0
    if isinstance(config, Angle):
        yaw, offset = _numbers(recording, series, config.field, config.unit), config.offset
    else:
        parts = unit_quaternion(
            *(_numbers(recording, series, f"{config.field}.{axis}") for axis in "xyzw")
        )
        x, y, z, w = parts
        empty = int(np.isnan(w).sum())
        if empty == w.size:
            raise DataError(
                f"{recording.path}: topic {series.name}: '{config.field}' holds no orientation, all"
                " quaternions are empty"
            )
        if flips := int((sum(part[1:] * part[:-1] for part in parts) < 0.0).sum()):
            text = (
                f"topic {series.name}: the quaternion changes sign {flips} times (both signs are"
                " one attitude); the heading is taken through"
            )
            remarks.append(remark("note", "quaternion_flips", text, flips=flips))
        if empty:
            text = f"topic {series.name}: {empty} quaternions are empty; no heading there"
            remarks.append(remark("note", "empty_quaternions", text, rows=empty))
        yaw = yaw_of(*parts)
        if config.roll:
            # roll about the forward axis has one sign in both frames, pitch about the sideways one
            # has not
            pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
            values["phi"] = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
            values["theta"] = -pitch if config.frame == "enu" else pitch
    psi = unwrap((np.pi / 2 - yaw if config.frame == "enu" else yaw) + offset)
    if np.isfinite(psi).any():
        # a heading of zero with rounding stays zero
        start = psi[np.isfinite(psi)][0] + 1e-6
        psi = psi - 2.0 * np.pi * np.floor(start / (2.0 * np.pi))
    values["psi"] = psi
    text = "psi: counter-clockwise from east (REP-103) to clockwise from north"
    conversion = (text,) if config.frame == "enu" else ()
    return _part(recording, series, values, conversion, remarks)


def _velocity_part(recording: Recording, config: EarthFixed | CourseSpeed) -> Part:
    series = recording[config.topic]
    if isinstance(config, CourseSpeed):
        course = _numbers(recording, series, config.course, config.course_unit)
        speed = _numbers(recording, series, config.speed, config.speed_unit)
        # receivers give no course at rest
        undirected = np.isnan(course) & (speed > 0.3)
        north, east = (
            np.where(undirected, np.nan, speed * turn(np.nan_to_num(course)))
            for turn in (np.cos, np.sin)
        )
    else:
        north, east = (_numbers(recording, series, name, config.unit) for name in config.fields)
    turned = "u, v: earth-fixed velocity turned into body axes"
    values = {"north_rate": north, "east_rate": east}
    moved = _moved(config.antenna, "u, v")
    return _part(recording, series, values, (turned, *moved))


def _usual_step(t: np.ndarray) -> float:
    return float(np.median(np.diff(t)))


def _times(
    recording: Recording, parts: Sequence[Part], clock: ClockConfig
) -> tuple[np.ndarray, float]:
    """Return the times of the log's samples on the recording's clock, and their step, s."""
    if not isinstance(clock, Uniform):
        times = parts[0].log.t if clock.topic is None else recording[clock.topic].clock
        return times, _usual_step(times) if times.size > 1 else 1.0
    logs = [part.log for part in parts]
    state = [log for log in logs if _MOVING & set(log.channels)]
    free = [part.log for part in parts if set(part.log.channels) != set(part.held)]
    moving = state or free or logs
    start, stop = max(log.t[0] for log in moving), min(log.t[-1] for log in moving)
    if stop - start < clock.step:
        spans = "; ".join(f"{log.name} {log.t[0]:.1f} to {log.t[-1]:.1f} s" for log in moving)
        raise DataError(
            f"{recording.path}: the topics share no stretch of time ({spans}); check `zone` and"
            " `delays`"
        )
    first = start
    if recording.epoch is not None:
        # whole multiples of the step in Unix time let logs of one day lie on one grid
        ahead = recording.epoch % round(clock.step * 1e9) * 1e-9
        first = math.ceil((start + ahead) / clock.step - 1e-6) * clock.step - ahead
    count = math.floor((stop - first) / clock.step + 1e-6) + 1
    return first + clock.step * np.arange(count), clock.step


def _move_and_turn(
    values: dict[str, np.ndarray], velocity: VelocityConfig | None, lever: Antenna
) -> None:
    """Bring position and velocity to the vessel's centre and into body axes, in place."""
    if lever != Antenna():
        if "psi" not in values:
            raise UsageError(
                "position.antenna: needs the heading to move the position to the vessel's centre;"
                " give `heading`"
            )
        north, east = turned(lever.x, lever.y, values["psi"])
        values["x"], values["y"] = values["x"] - north, values["y"] - east
    if not isinstance(velocity, EarthFixed | CourseSpeed):
        return
    if "psi" not in values:
        raise UsageError(
            "velocity: needs the heading to turn earth-fixed velocities into body axes; give"
            " `heading`"
        )
    u, v = turned(values.pop("north_rate"), values.pop("east_rate"), -values["psi"])
    if velocity.antenna != Antenna():
        if "r" not in values:
            raise UsageError(
                "velocity.antenna: needs the yaw rate to move the velocity to the vessel's centre;"
                " give channels.r"
            )
        # for a rigid body u_P = u - r y, v_P = v + r x
        u, v = u + values["r"] * velocity.antenna.y, v - values["r"] * velocity.antenna.x
    values["u"], values["v"] = u, v


def _derived_motion(
    pose: Sequence[Part], config: Derived, lever: Antenna, times: np.ndarray, step: float
) -> dict[str, np.ndarray]:
    """Return x, y, psi, u, v, r [T] on a uniform clock, smoothed and differentiated.

    The polynomials run on a grid that divides the log's step until it is as fine as the topics;
    nothing is smoothed across a gap.
    """
    held = {name for part in pose for name in part.log.channels}
    if not {"x", "y", "psi"} <= held:
        raise UsageError(
            "velocity: kind 'derived' needs position and heading; give both, or channels u, v, r"
        )
    share = max(1, round(step / min(_usual_step(part.log.t) for part in pose)))
    fine = step / share
    # one window beyond the log's ends where the topics reach further
    reach = int(np.ceil(max(config.window, config.yaw_window or 0.0) / fine))
    grid = times[0] + fine * np.arange(-reach, share * (times.size - 1) + reach + 1)
    motion: dict[str, np.ndarray] = {}
    for part in pose:
        motion |= part.at(grid, fine)
    arm = np.stack(turned(lever.x, lever.y, motion["psi"]), axis=1)
    place = np.stack((motion["x"], motion["y"]), axis=1) - arm
    whole = np.zeros(grid.size, dtype=int)
    windows = (config.window, config.yaw_window or config.window)
    (smooth, rate, _), (angle, turning, _) = (
        SavitzkyGolay(window=window, order=config.order).derive(values, fine, whole)
        for window, values in zip(windows, (place, motion["psi"][:, None]), strict=True)
    )
    psi = angle[:, 0]
    found = (*smooth.T, psi, *turned(rate[:, 0], rate[:, 1], -psi), turning[:, 0])
    kept = slice(reach, grid.size - reach, share)
    return {n: values[kept] for n, values in zip(_STATE[:6], found, strict=True)}


def _meta(
    recording: Recording, plan: Plan, parts: Sequence[Part], times: np.ndarray
) -> dict[str, Any]:
    remarks: list[Remark] = [*recording.remarks, *plan.remarks]
    topics: dict[str, Any] = {}
    for series in recording.series.values():
        found = traffic(series)
        named = sum(e.topic == series.name and e.sender is not None for e in plan.channels.values())
        remarks += series.remarks
        # senders that each have a channel are told apart already
        remarks += [r for r in found if not (named > 1 and r["code"] == "several_publishers")]
        rate: dict[str, float] = next(
            (r["figures"] for r in found if r["code"] == "topic_rate"), {}
        )
        topics[series.name] = {"kind": series.kind, "rows": len(series), **rate}
    present = {name for part in parts for name in part.log.channels}
    absent = [name for name in plan.channels if name not in present]
    if absent:
        text = (
            f"channels {', '.join(absent)} are not in the recording or hold no number; the log"
            " lacks them (they are not required)"
        )
        remarks.append(remark("note", "missing_channels", text, channels=len(absent)))
    used = {part.log.name: len(part.log) for part in parts}
    remarks += [entry for part in parts for entry in part.remarks if entry not in remarks]
    meta: dict[str, Any] = {
        "findings": remarks,
        "topics": topics,
        "topics_not_used": [n for n in (*recording.series, *recording.listed) if n not in used],
        "frames": [*plan.conversions, *(text for part in parts for text in part.conversion)],
        "rows_read": sum(len(series) for series in recording.series.values()),
        "rows_dropped": 0,
        "rows_used": sum(used.values()),
    }
    if recording.epoch is not None:
        start = recording.epoch + int(np.rint(times[0] * 1e9))
        utc = datetime.fromtimestamp(start // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        utc = f"{utc}.{start % 10**9:09d}Z"
        meta |= {"epoch": start * 1e-9, "epoch_ns": start, "start_utc": utc}
    return meta
