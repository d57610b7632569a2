"""Parts of a log, each on its topic's clock: SI and residnet's frames, not yet aligned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, to_si
from residnet.data.plausible import without_fills
from residnet.data.readers.base import unwrap
from residnet.data.readers.composing.geodesy import tangent_plane
from residnet.data.readers.composing.orientation import (
    field_values,
    from_first_circle,
    from_quaternion,
)
from residnet.data.readers.composing.quantities import (
    Angle,
    CourseSpeed,
    EarthFixed,
    FieldMap,
    Geodetic,
    HeadingConfig,
    Lever,
    PositionConfig,
)
from residnet.data.readers.recording import Recording, Remark, Series, remark, same_topic

_USUAL_GAP = 3.0
_STATE = ("x", "y", "psi", "u", "v", "r", "p", "phi", "north_rate", "east_rate")


@dataclass(frozen=True)
class Part:
    """Channels of one topic on its own clock.

    Attributes:
        topic: where they come from.
        log: the channels.
        held: those whose last value holds until the next.
        longest_gap: longest step that is bridged, s.
        remarks: what was noticed on the way.
        conversion: which frames were converted, in words.
    """

    topic: str
    log: Log
    held: tuple[str, ...]
    longest_gap: float
    remarks: tuple[Remark, ...] = ()
    conversion: tuple[str, ...] = field(default=())

    @property
    def pose(self) -> bool:
        """Whether this is the position or the heading."""
        return "psi" in self.log.channels or {"x", "y"} <= set(self.log.channels)

    @property
    def state(self) -> bool:
        """Whether it holds a state of the vessel."""
        return any(name in _STATE for name in self.log.channels)

    @property
    def all_held(self) -> bool:
        """Whether all channels are commands."""
        return set(self.log.channels) == set(self.held)

    @property
    def step(self) -> float:
        """The usual step, s."""
        return float(np.median(np.diff(self.log.t)))

    def at(self, times: np.ndarray, step: float) -> dict[str, np.ndarray]:
        """Return the channels at `times` [T], whose usual step is `step`, both s.

        NaN in gaps and beyond the ends.
        """
        # the aligner imports masks, which import the readers
        from residnet.data.align import GridConfig, onto

        gap = max(self.longest_gap, _USUAL_GAP * self.step)
        if times.size == self.log.t.size and np.array_equal(times, self.log.t):
            return dict(self.log.channels)
        out: dict[str, np.ndarray] = {}
        # one by one: aligning needs several copies of what it aligns
        for name, values in self.log.channels.items():
            own_rows = self.log.replace(channels={name: values})
            held = (name,) if name in self.held else ()
            out.update(
                onto(own_rows, GridConfig(step=step, held=held, longest_gap=gap), times).channels
            )
        return out


def channel_parts(
    recording: Recording, channels: Mapping[str, FieldMap], longest_gap: float
) -> list[Part]:
    """Return one part for all channels of a topic that may share one.

    a channel with hardly a value has one of its own, of the rows that have any.

    Raises:
        UsageError: where a topic, field or sender is missing.
        DataError: where a field holds no number.
    """
    groups: dict[tuple[str, str | None, float, str], dict[str, FieldMap]] = {}
    for name, entry in present(recording, channels).items():
        series = recording[entry.topic]
        sparse = np.isnan(series[entry.field]).mean() > 0.5
        key = (series.name, entry.sender, entry.longest_gap or longest_gap, name if sparse else "")
        groups.setdefault(key, {})[name] = entry
    parts = []
    for (topic, sender, gap, own_rows), entries in groups.items():
        series = (
            recording.series[topic] if sender is None else recording.series[topic].of_sender(sender)
        )
        if own_rows:
            series = series.where(np.isfinite(series[entries[own_rows].field]))
        values = {
            name: entry.convert(name, without_fills(field_values(recording, series, entry.field)))
            for name, entry in entries.items()
        }
        units = {name: entry.si(name) for name, entry in entries.items()}
        held = tuple(name for name, entry in entries.items() if entry.hold)
        conversion = tuple(
            f"{name}: {entry.frame} of {topic}.{entry.field}"
            for name, entry in entries.items()
            if entry.frame != "as_measured"
        )
        parts.append(_part(recording, series, values, units, gap, held, conversion=conversion))
    return parts


def present(recording: Recording, channels: Mapping[str, FieldMap]) -> dict[str, FieldMap]:
    """Return the channels without those that may be missing and are."""
    out = {}
    for name, entry in channels.items():
        if not entry.required:
            topic = (
                same_topic(entry.topic, recording.series)
                if entry.topic is not None
                else next(iter(recording.series), None)
            )
            series = recording.series.get(topic or "")
            if (
                series is None
                or not series.has(entry.field)
                or len(series) < 2
                or not np.isfinite(series[entry.field]).any()
            ):
                continue
        out[name] = entry
    return out


def position_part(recording: Recording, config: PositionConfig, longest_gap: float) -> Part:
    """Return x and y of the antenna, m.

    Raises:
        UsageError: where topic or field is missing, or PROJ is not installed.
        DataError: where there is no position, or a latitude is none.
    """
    series = recording[config.topic]
    if not isinstance(config, Geodetic):
        scale = to_si(config.unit)
        values = {
            "x": scale * field_values(recording, series, config.north),
            "y": scale * field_values(recording, series, config.east),
        }
        return _part(recording, series, values, {}, longest_gap, conversion=_moved(config.antenna))
    to_radians = to_si(config.unit)
    latitude, longitude = (
        to_radians * field_values(recording, series, name)
        for name in (config.latitude, config.longitude)
    )
    known = np.isfinite(latitude) & np.isfinite(longitude)
    none = known & (latitude == 0.0) & (longitude == 0.0)
    remarks: tuple[Remark, ...] = ()
    if none.any():
        # receivers without a fix report the origin
        text = (
            f"topic {series.name}: {int(none.sum())} fixes at latitude 0, longitude 0 are no fixes;"
            " left out"
        )
        remarks = (remark("note", "no_fix", text, rows=int(none.sum())),)
        latitude, longitude = np.where(none, np.nan, latitude), np.where(none, np.nan, longitude)
        known &= ~none
    if not known.any() or float(np.abs(latitude[known]).max()) > np.pi / 2:
        raise DataError(
            f"{recording.path}: topic {series.name}: '{config.latitude}' holds no latitude in"
            f" {config.unit}; check field and unit"
        )
    first = int(np.argmax(known))
    origin = (
        (float(latitude[first]), float(longitude[first]))
        if config.origin is None
        else (config.origin.latitude, config.origin.longitude)
    )
    north, east = tangent_plane(latitude, longitude, *origin)
    degrees = np.degrees(origin)
    conversion = (
        f"x, y: tangent plane of WGS 84 at {degrees[0]:.7f} deg N, {degrees[1]:.7f} deg E",
        *_moved(config.antenna),
    )
    return _part(
        recording,
        series,
        {"x": north, "y": east},
        {},
        longest_gap,
        remarks=remarks,
        conversion=conversion,
    )


def heading_part(recording: Recording, config: HeadingConfig, longest_gap: float) -> Part:
    """Return psi, unwrapped from its first value in [0, 2 pi); phi where wanted.

    Raises:
        UsageError: where topic or field is missing.
        DataError: where there is no heading.
    """
    series = recording[config.topic]
    values: dict[str, np.ndarray] = {}
    remarks: tuple[Remark, ...] = ()
    if isinstance(config, Angle):
        yaw = to_si(config.unit) * field_values(recording, series, config.field)
        offset = config.offset
    else:
        yaw, values, remarks = from_quaternion(recording, series, config)
        offset = 0.0
    psi = (np.pi / 2 - yaw if config.frame == "enu" else yaw) + offset
    values["psi"] = from_first_circle(unwrap(psi))
    conversion = (
        ("psi: counter-clockwise from east (REP-103) to clockwise from north",)
        if config.frame == "enu"
        else ()
    )
    return _part(recording, series, values, {}, longest_gap, remarks=remarks, conversion=conversion)


def velocity_part(
    recording: Recording, config: EarthFixed | CourseSpeed, longest_gap: float
) -> Part:
    """Return the northward and eastward velocity of the antenna, m/s.

    Raises:
        UsageError: where topic or field is missing.
        DataError: where there is no velocity.
    """
    series = recording[config.topic]
    if isinstance(config, CourseSpeed):
        course = to_si(config.course_unit, "rad") * field_values(recording, series, config.course)
        speed = to_si(config.speed_unit, "m/s") * field_values(recording, series, config.speed)
        # receivers give no course at rest
        north, east = speed * np.cos(np.nan_to_num(course)), speed * np.sin(np.nan_to_num(course))
        undirected = np.isnan(course) & (speed > 0.3)
        north, east = np.where(undirected, np.nan, north), np.where(undirected, np.nan, east)
    else:
        north, east = (
            to_si(config.unit) * field_values(recording, series, name)
            for name in (config.north, config.east)
        )
    conversion = (
        "u, v: earth-fixed velocity turned into body axes",
        *_moved(config.antenna, "u, v"),
    )
    return _part(
        recording,
        series,
        {"north_rate": north, "east_rate": east},
        {},
        longest_gap,
        conversion=conversion,
    )


def _part(
    recording: Recording,
    series: Series,
    values: dict[str, np.ndarray],
    units: dict[str, str],
    gap: float,
    held: tuple[str, ...] = (),
    remarks: tuple[Remark, ...] = (),
    conversion: tuple[str, ...] = (),
) -> Part:
    if len(series) < 2:
        raise DataError(
            f"{recording.path}: topic {series.name} has {len(series)} rows, at least 2 are needed;"
            " take it out of the map"
        )
    units = {name: units.get(name) or CHANNEL_UNITS.get(name, "m/s") for name in values}
    return Part(
        series.name,
        Log(series.name, series.clock, values, units),
        held,
        gap,
        (*series.remarks, *remarks),
        conversion,
    )


def _moved(lever: Lever, what: str = "x, y") -> tuple[str, ...]:
    return (
        ()
        if lever == Lever()
        else (
            f"{what}: moved to the vessel's centre from ({lever.x:g}, {lever.y:g}) m in body axes",
        )
    )
