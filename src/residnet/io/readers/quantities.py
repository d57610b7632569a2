"""Configs of channels, position, heading and velocity: their fields, units, signs and frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import UsageError
from residnet.core.frames import unwrap_angle
from residnet.core.log import Remark
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import canonical_unit, si_unit, to_si
from residnet.io.readers.angles import AngleForm, LetterO
from residnet.io.readers.base import optional_import
from residnet.preprocessing.motion import Antenna

Frame = Literal["as_measured", "ned", "enu", "body_fsd", "body_fpu"]

# factor and offset of the conversion of a channel to NED and forward-starboard-down
_IDENTITY = (1.0, 0.0)
"""No conversion."""
_NEGATE = (-1.0, 0.0)
"""Conversion of an axis to the opposite direction, such as port to starboard."""
_EAST_TO_NORTH = (-1.0, math.pi / 2.0)
"""Conversion of an angle anticlockwise from east to one clockwise from north, in rad."""
_EARTH_CHANNELS = ("x", "y", "z", "psi", "wind_dir", "current_north", "current_east")
EARTH_VELOCITIES = ("u", "v")
"""Channels of a table that are the velocities to the north and to the east in the frame `ned`."""
QUATERNION = ("qx", "qy", "qz", "qw")
"""Channels with the parts of a quaternion, from which tables without a heading derive it."""
PLANAR_QUATERNION = ("qz", "qw")
"""Channels with the parts of a quaternion about the vertical axis, whose other parts are zero."""
SPEED_CHANNELS = {"speed": "m/s", "drift_angle": "rad"}
"""Channels, with their SI units, from which tables without u and v derive these velocities."""


def resolve_drift_angle(channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Replace speed and drift angle by surge and sway velocity, unless one of these is mapped.

    A positive drift angle is that of a flow from port, v = -U sin(beta) (SNAME, Technical and
    Research Bulletin 1-5, 1952).

    Args:
        channels: name -> values [T] in SI.
    """
    if not channels.keys() >= {*SPEED_CHANNELS} or {"u", "v"} & channels.keys():
        return dict(channels)
    speed = channels["speed"]
    drift_angle = channels["drift_angle"]
    velocities = {"u": speed * np.cos(drift_angle), "v": -speed * np.sin(drift_angle)}
    others = {name: values for name, values in channels.items() if name not in SPEED_CHANNELS}
    return {**others, **velocities}


def require_speed_units(units: Mapping[str, str]) -> None:
    """Check the units of speed and drift angle if both are mapped.

    Args:
        units: channel -> unit of its column or field.

    Raises:
        ValueError: if a unit has the wrong dimension.
    """
    if not units.keys() >= {*SPEED_CHANNELS}:
        return
    for name, unit in SPEED_CHANNELS.items():
        try:
            conversion_factor(units[name], unit)
        except ValueError as error:
            raise ValueError(f"channel {name}: {error}") from error


COSINE_SUFFIX = "_cos"
SINE_SUFFIX = "_sin"
"""Suffixes of channels with the cosine and the sine of an angle."""
_FORWARD_CHANNELS = ("u", "p", "phi", "u_dot", "tau_x")
_STARBOARD_OR_DOWN_CHANNELS = ("v", "r", "w", "q", "theta", "v_dot", "r_dot", "tau_y", "tau_n")
# frame -> channel -> (factor, offset in SI) of the conversion to residnet's frame.
# x and y have no entry in enu, because "x" may be the east or the north column there: the channel
# map must name the north column.
_FRAME_CONVERSIONS: dict[str, dict[str, tuple[float, float]]] = {
    "ned": dict.fromkeys((*_EARTH_CHANNELS, "qw"), _IDENTITY),
    # the frame of a quaternion is given in the entry of its scalar part qw
    "enu": {"psi": _EAST_TO_NORTH, "wind_dir": _EAST_TO_NORTH, "z": _NEGATE, "qw": _IDENTITY},
    "body_fsd": dict.fromkeys((*_FORWARD_CHANNELS, *_STARBOARD_OR_DOWN_CHANNELS), _IDENTITY),
    "body_fpu": {
        **dict.fromkeys(_FORWARD_CHANNELS, _IDENTITY),
        **dict.fromkeys(_STARBOARD_OR_DOWN_CHANNELS, _NEGATE),
    },
}


class Conversion(Config):
    """Unit, sign and frame of one foreign channel.

    Attributes:
        unit: unit of the scaled values, for example `deg/s`.
        offset: number that is subtracted first, in counts of the source: for example the neutral
            position 1500 of a servo.
        scale: factor from counts of the source to `unit`, for example 0.07 if 1000 us are 70 deg.
        sign: -1 reverses the direction.
        frame: frame of the source: `as_measured` (no conversion), `ned`, `body_fsd` (forward,
            starboard, down), `enu` (angles counter-clockwise from east) or `body_fpu` (forward,
            port, up).
    """

    unit: str
    offset: float = 0.0
    scale: float = 1.0
    sign: Literal[1, -1] = 1
    frame: Frame = "as_measured"

    def require_valid_channel(self, name: str) -> None:
        """Check that unit and frame are possible for a channel.

        Args:
            name: name of the channel.

        Raises:
            ValueError: if the name is reserved, the unit is unknown or has another dimension, or
                the frame does not define the channel.
        """
        if name == "t" or name.startswith("mask:"):
            raise ValueError(f"'{name}' is no name of a channel; set time with the key `time`")
        if self.scale == 0.0:
            raise ValueError(f"channel {name}: scale is zero, another factor was expected")
        try:
            conversion_factor(self.unit, CHANNEL_UNITS.get(name))
        except ValueError as error:
            raise ValueError(f"channel {name}: {error}") from error
        if self.frame != "as_measured" and not self.is_frame_defined(self.frame, name):
            valid_frames = (
                ", ".join(f for f in _FRAME_CONVERSIONS if self.is_frame_defined(f, name)) or "none"
            )
            raise ValueError(
                f"channel {name}: frame '{self.frame}' does not define it (frames that do:"
                f" {valid_frames}); map the column with this quantity, with sign: -1 if it has the"
                " opposite direction"
            )

    def is_frame_defined(self, frame: str, name: str) -> bool:
        """Return whether a frame defines the direction of a channel."""
        return name in _FRAME_CONVERSIONS[frame]

    def si_unit_of(self, name: str) -> str:
        """Return the SI unit of the values that a channel of this name receives."""
        return si_unit(canonical_unit(self.unit, CHANNEL_UNITS.get(name)))

    def magnitude_in_si(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the absolute values [T] of a channel in SI, before any conversion of frames."""
        gain = to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        magnitude: np.ndarray = np.abs(gain * (values - self.offset))
        return magnitude

    def convert(self, name: str, raw_values: np.ndarray) -> np.ndarray:
        """Convert values to residnet's unit, sign and frame.

        Args:
            name: name of the channel; `psi` and azimuths of thrusters are also unwrapped.
            raw_values: values [T] of the source.

        Returns:
            Values [T] in SI.
        """
        frame_factor, frame_offset = (
            _FRAME_CONVERSIONS[self.frame].get(name, _IDENTITY)
            if self.frame != "as_measured"
            else _IDENTITY
        )
        gain = frame_factor * self.sign * to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        values = gain * (raw_values - self.offset) + frame_offset
        if name.removeprefix("cmd_").startswith("azimuth"):
            return unwrap_azimuth(values)
        return mask_interpolated_headings(values) if name == "psi" else values


def unwrap_azimuth(azimuth: np.ndarray) -> np.ndarray:
    """Unwrap the azimuth of a thruster [T] in rad if it crosses the end of its range.

    Resampling would interpolate from 359 to 1 deg over 180 deg. The median is in [-pi, pi].
    """
    is_finite = np.isfinite(azimuth)
    measured = azimuth[is_finite]
    if not (np.abs(np.diff(measured)) > np.pi).any():
        return azimuth
    unwrapped = azimuth.copy()
    continuous = np.unwrap(measured)
    turns = np.round(np.median(continuous) / (2.0 * np.pi))
    unwrapped[is_finite] = continuous - 2.0 * np.pi * turns
    return unwrapped


_STEP_TOLERANCE = 0.2
"""Largest relative difference between the steps of an interpolation across the wrap, which differ
because recorded headings are rounded.
"""
_MIN_SWEEP_RATIO = 10.0
"""Smallest step of an interpolation across the wrap, in median steps of the log."""


def mask_interpolated_headings(psi: np.ndarray) -> np.ndarray:
    """Unwrap headings, and remove samples that a recorder interpolated across the wrap.

    A recorder that interpolates linearly goes from 359 deg over 180 deg to 1 deg. Such samples form
    a run of equal steps across the full circle. The steps are far larger than those before and
    after the run, whereas the yaw rate of a vessel changes gradually.

    Args:
        psi: headings [T] in rad.

    Returns:
        Unwrapped headings [T] in rad, NaN for interpolated samples.
    """
    unwrapped = unwrap_angle(psi)
    finite_indices = np.flatnonzero(np.isfinite(psi))
    wrapped = np.remainder(psi[finite_indices], 2.0 * np.pi)
    step = np.diff(wrapped)
    step_size = np.abs(np.where(np.abs(step) > np.pi, 2.0 * np.pi - np.abs(step), step))
    if step.size < 3 or not step_size.any():
        return unwrapped
    is_sweep = np.abs(step) > max(_MIN_SWEEP_RATIO * float(np.median(step_size)), np.radians(5.0))
    sweep_sign = np.sign(step) * is_sweep
    bounds = np.flatnonzero(np.diff(np.concatenate(([0.0], sweep_sign, [0.0]))))
    # steps outside of interpolations, with which those of an interpolation are compared
    typical_step = np.where(is_sweep, np.median(step_size), step_size)
    is_interpolated = np.zeros(finite_indices.size, dtype=bool)
    for start, stop in itertools.pairwise(bounds):
        sweep_steps = step[start:stop]
        if sweep_steps.size < 2 or not sweep_sign[start]:
            continue
        # the first and the last step may be shorter
        largest_step = np.abs(sweep_steps).max()
        has_equal_steps = np.abs(sweep_steps[1:-1]) >= (1.0 - _STEP_TOLERANCE) * largest_step
        neighbour_step = np.append(
            typical_step[max(start - 2, 0) : start], typical_step[stop : stop + 2]
        ).max(initial=0.0)
        spans_circle = 2.0 * np.pi - abs(sweep_steps.sum()) < largest_step + 2.0 * neighbour_step
        # step if the vessel turned the short way around the circle during the same samples; it must
        # be closer to the neighbouring steps
        short_way_step = (2.0 * np.pi - abs(sweep_steps.sum())) / sweep_steps.size
        is_sudden = largest_step - neighbour_step > abs(short_way_step - neighbour_step)
        if has_equal_steps.all() and spans_circle and is_sudden:
            is_interpolated[start + 1 : stop] = True
    if not is_interpolated.any():
        return unwrapped
    # a sample between two interpolated ones is interpolated too
    is_interpolated[1:-1] |= is_interpolated[:-2] & is_interpolated[2:]
    measured_indices = finite_indices[~is_interpolated]
    unwrapped[finite_indices[is_interpolated]] = np.nan
    unwrapped[measured_indices] = np.unwrap(psi[measured_indices])
    return unwrapped


class ChannelMap(Conversion):
    """Entry of a channel map: one column of a table as one channel.

    Attributes:
        column: name of the column in the header.
        form: notation of angles: `number` for decimal degrees, `ddmm` for degrees and minutes in
            one number (5954.321 is 59 degrees and 54.321 minutes). Latitudes and longitudes such as
            `59°54.321'N` or `59 54 19.3 N` are accepted in both cases.
        hemisphere: column with the hemispheres N, S, E or W of the numbers; null if there is none.
        letter_o: meaning of the letter O in longitudes, `east` (Ost, Oost) or `west` (Oeste, Ouest,
            Ovest); null rejects it.
        hold: whether a value is valid until the next one (zero-order hold), as for commands that
            are recorded when they change. A row with values of such channels only is no sample of
            the log.
    """

    column: str
    form: AngleForm = "number"
    hemisphere: str | None = None
    letter_o: LetterO | None = None
    hold: bool = False

    def is_frame_defined(self, frame: str, name: str) -> bool:
        """Return whether a frame defines a channel; u and v in `ned` are velocities to N and E."""
        is_earth_velocity = frame == "ned" and name in EARTH_VELOCITIES
        return is_earth_velocity or super().is_frame_defined(frame, name)

    @property
    def is_angle(self) -> bool:
        """Whether cells may be angles with minutes or hemispheres."""
        return self.form != "number" or self.hemisphere is not None

    def require_valid_channel(self, name: str) -> None:
        """Check that unit, frame and notation are possible for a channel.

        Raises:
            ValueError: as `Conversion.require_valid_channel`, or if an angle with minutes or
                hemispheres has another unit than degrees.
        """
        super().require_valid_channel(name)
        if self.is_angle and canonical_unit(self.unit) != "deg":
            raise ValueError(
                f"channel {name}: `form` and `hemisphere` apply to degrees; set unit: deg"
            )


def conversion_factor(unit: str, expected: str | None) -> float:
    """Return the factor of a unit to SI; an error is a `ValueError`.

    Validators of pydantic must raise this class, to which pydantic adds the path of the key.

    Raises:
        ValueError: if the unit is unknown or has another dimension than `expected`.
    """
    try:
        return to_si(unit, expected)
    except UsageError as error:
        raise ValueError(str(error)) from error


def _unit_validator(expected_unit: str) -> AfterValidator:
    def validate_unit(unit: str) -> str:
        conversion_factor(unit, expected_unit)
        return canonical_unit(unit, expected_unit)

    return AfterValidator(validate_unit)


AngleUnit = Annotated[str, _unit_validator("rad")]
LengthUnit = Annotated[str, _unit_validator("m")]
SpeedUnit = Annotated[str, _unit_validator("m/s")]


@final
class FieldMap(Conversion):
    """Mapping of one field of a topic to one channel.

    Attributes:
        topic: topic, message type or table; optional if the recording has only one.
        field: path of the field, for example `twist.linear.x`.
        sender: sender whose rows are used, if several publish to the topic.
        hold: whether a value is valid until the next one (zero-order hold, for commands); otherwise
            values are interpolated linearly.
        longest_gap: longest step in s that is interpolated or held; null means one second. Three
            median steps of the topic are always allowed.
        required: whether a missing topic or field is an error; otherwise the log lacks the channel
            and has a remark.
    """

    topic: str | None = None
    field: str
    sender: str | None = None
    hold: bool = False
    longest_gap: Seconds | None = Field(default=None, gt=0.0)
    required: bool = True


class Origin(Config):
    """Origin of a local tangent plane on the WGS 84 ellipsoid.

    Numbers without a unit are rad, so write `63.44 deg`.

    Attributes:
        latitude: latitude in rad, positive north.
        longitude: longitude in rad, positive east.
    """

    latitude: Radians = Field(ge=-1.5708, le=1.5708)
    longitude: Radians = Field(ge=-6.2832, le=6.2832)


class TopicSource(Config):
    """Base class of quantities that are computed from fields of one topic.

    Attributes:
        topic: topic with the fields; optional if the recording has only one.
    """

    topic: str | None = None
    field_keys: ClassVar[tuple[str, ...]] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Paths of the fields of the topic that the quantity needs, such as `twist.linear.x`."""
        return tuple(str(getattr(self, name)) for name in self.field_keys)


class AntennaSource(TopicSource):
    """Base class of quantities that are measured at an antenna.

    Attributes:
        antenna: position of the antenna in body axes. The log has the quantity at the vessel's
            origin; for a velocity this needs the yaw rate r as a channel.
    """

    antenna: Antenna = Field(default_factory=Antenna)


@final
class GeodeticPosition(AntennaSource):
    """Position from latitude and longitude, projected to a local tangent plane with PROJ.

    Attributes:
        latitude: field of the latitude.
        longitude: field of the longitude.
        unit: unit of both.
        origin: origin of the plane; null takes the first fix and writes it to the log's meta.
    """

    kind: Literal["geodetic"] = "geodetic"
    latitude: str = "latitude"
    longitude: str = "longitude"
    unit: AngleUnit = "deg"
    origin: Origin | None = None
    field_keys: ClassVar[tuple[str, ...]] = ("latitude", "longitude")


@final
class LocalPosition(AntennaSource):
    """Position in a local frame of the source.

    Attributes:
        north: field of the northward component (y of a source in ENU).
        east: field of the eastward component (x of a source in ENU).
        unit: unit of both.
    """

    kind: Literal["local"] = "local"
    north: str
    east: str
    unit: LengthUnit = "m"
    field_keys: ClassVar[tuple[str, ...]] = ("north", "east")


PositionConfig = Annotated[GeodeticPosition | LocalPosition, Field(discriminator="kind")]
"""Source of x and y."""


@final
class QuaternionHeading(TopicSource):
    """Heading from a quaternion of either sign.

    Attributes:
        field: path of the quaternion with the parts x, y, z, w, for example
            `pose.pose.orientation`; or the four fields of the parts in this order; or the fields of
            z and w, where x and y are zero.
        frame: `ned` (yaw clockwise from north) or `enu` (REP 103: counter-clockwise from east).
        roll: whether roll and pitch become the channels phi and theta.
    """

    kind: Literal["quaternion"] = "quaternion"
    field: str | list[str]
    frame: Literal["ned", "enu"]
    roll: bool = False
    field_keys: ClassVar[tuple[str, ...]] = ("field",)

    @property
    def fields(self) -> tuple[str, ...]:
        """Path of the quaternion, or paths of its parts."""
        return (self.field,) if isinstance(self.field, str) else tuple(self.field)

    @field_validator("field")
    @classmethod
    def _validate_parts(cls, field: str | list[str]) -> str | list[str]:
        if not isinstance(field, str) and len(field) not in (2, 4):
            raise ValueError(
                f"{len(field)} fields; give those of the parts x, y, z, w, or those of z, w"
            )
        return field

    @property
    def parts(self) -> tuple[str, ...]:
        """Paths of the parts x, y, z, w, or of z, w."""
        if isinstance(self.field, str):
            return tuple(f"{self.field}.{axis}" for axis in "xyzw")
        return tuple(self.field)


@final
class AngleHeading(TopicSource):
    """Heading from an angle, which is unwrapped.

    Attributes:
        field: field of the angle.
        unit: unit of the angle.
        frame: `ned` (clockwise from north, a compass) or `enu` (counter-clockwise from east).
        offset: angle in rad that is added after the conversion: the mounting angle of a compass or
            of a pair of antennas.
    """

    kind: Literal["angle"] = "angle"
    field: str
    unit: AngleUnit = "rad"
    frame: Literal["ned", "enu"] = "ned"
    offset: Radians = 0.0
    field_keys: ClassVar[tuple[str, ...]] = ("field",)


HeadingConfig = Annotated[QuaternionHeading | AngleHeading, Field(discriminator="kind")]
"""Source of psi."""


@final
class DerivedVelocity(Config):
    """Velocities u, v, r from position and heading by a Savitzky-Golay filter.

    The filter runs at the sampling rate of the positions and smooths position and heading too.

    Attributes:
        window: length of the filter for positions in s.
        yaw_window: length of the filter for headings in s; null takes `window`.
        order: order of the polynomials.
    """

    kind: Literal["derived"] = "derived"
    window: Seconds = Field(default=2.0, gt=0.0)
    yaw_window: Seconds | None = Field(default=None, gt=0.0)
    order: int = Field(default=3, ge=1, le=7)


@final
class EarthFixedVelocity(AntennaSource):
    """Velocities u, v from the northward and eastward velocity of the antenna.

    They are rotated to body axes and transformed to the vessel's origin.

    Attributes:
        north: field of the northward component (y of a source in ENU).
        east: field of the eastward component (x of a source in ENU).
        unit: unit of both.
    """

    kind: Literal["earth_fixed"] = "earth_fixed"
    north: str
    east: str
    unit: SpeedUnit = "m/s"
    field_keys: ClassVar[tuple[str, ...]] = ("north", "east")


@final
class CourseSpeedVelocity(AntennaSource):
    """Velocities u, v from course and speed over ground of the antenna.

    They are rotated to body axes and transformed to the vessel's origin.

    Attributes:
        course: field of the course over ground, clockwise from north.
        speed: field of the speed over ground.
        course_unit: unit of the course.
        speed_unit: unit of the speed.
    """

    kind: Literal["course_speed"] = "course_speed"
    course: str
    speed: str
    course_unit: AngleUnit = "deg"
    speed_unit: SpeedUnit = "m/s"
    field_keys: ClassVar[tuple[str, ...]] = ("course", "speed")


VelocityConfig = Annotated[
    DerivedVelocity | EarthFixedVelocity | CourseSpeedVelocity, Field(discriminator="kind")
]
"""Source of u, v (and r); velocities in body axes are mapped as channels instead."""


def list_source_channels(
    position: PositionConfig | None, heading: HeadingConfig | None, velocity: VelocityConfig | None
) -> list[str]:
    """Return the names of the channels that configured sources provide."""
    sources = {("x", "y"): position, ("psi",): heading, ("u", "v"): velocity}
    return [name for names, source in sources.items() if source is not None for name in names]


@final
class UniformClock(Config):
    """Clock with a constant step.

    In a recording with dates the samples are at integer multiples of the step in Unix time, so that
    the samples of several recordings coincide.

    Attributes:
        step: time between samples in s.
    """

    kind: Literal["uniform"] = "uniform"
    step: Seconds = Field(gt=0.0)


@final
class TopicClock(Config):
    """Clock with the samples of one topic, which need not be uniform.

    Attributes:
        topic: topic; null takes the topic of the position, else of the heading, else of the
            first channel.
    """

    kind: Literal["topic"] = "topic"
    topic: str | None = None


ClockConfig = Annotated[UniformClock | TopicClock, Field(discriminator="kind")]
"""Clock of the log."""


@dataclass(frozen=True)
class ChannelPlan:
    """Mapping of a recording to channels.

    Attributes:
        channels: channel -> field of a topic.
        position: source of x and y.
        heading: source of psi.
        velocity: source of u, v (and r) if they are not mapped as channels.
        conversions: automatic conversions of frames, as text for the log's meta.
        remarks: remarks on ambiguous messages.
    """

    channels: Mapping[str, FieldMap] = field(default_factory=dict)
    position: PositionConfig | None = None
    heading: HeadingConfig | None = None
    velocity: VelocityConfig | None = None
    conversions: tuple[str, ...] = ()
    remarks: tuple[Remark, ...] = ()


def project_to_tangent_plane(
    latitude: np.ndarray, longitude: np.ndarray, latitude_0: float, longitude_0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Project points of the WGS 84 ellipsoid to the tangent plane at an origin.

    The result are topocentric coordinates (EPSG method 9837) for zero height, which shifts a point
    at 100 m height and 1 km distance by 16 mm.

    Args:
        latitude: latitudes [T] in rad.
        longitude: longitudes [T] in rad.
        latitude_0: latitude of the origin in rad.
        longitude_0: longitude of the origin in rad.

    Returns:
        North and east coordinates [T] in m.

    Raises:
        UsageError: if pyproj is not installed.
    """
    with optional_import("geo", "pyproj", "a position in latitude and longitude"):
        from pyproj import Transformer
    origin = (
        f"+lat_0={float(np.degrees(latitude_0))!r} +lon_0={float(np.degrees(longitude_0))!r} +h_0=0"
    )
    transformer = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
        f" {origin}"
    )
    is_finite = np.isfinite(latitude) & np.isfinite(longitude)
    north = np.full(latitude.shape, np.nan)
    east = np.full(latitude.shape, np.nan)
    east[is_finite], north[is_finite], _ = transformer.transform(
        longitude[is_finite], latitude[is_finite], np.zeros(int(is_finite.sum())), radians=True
    )
    return north, east


def project_fixes(
    latitude: np.ndarray, longitude: np.ndarray, origin: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[float, float] | None, int]:
    """Project fixes to a tangent plane, without samples at latitude 0, longitude 0.

    Receivers without a fix report latitude 0, longitude 0.

    Args:
        latitude: latitudes [T] in rad.
        longitude: longitudes [T] in rad.
        origin: latitude and longitude of the origin in rad; None takes the first fix.

    Returns:
        North and east coordinates [T] in m; the origin in rad (None without any fix, or if a
        latitude exceeds 90 deg); the number of samples at latitude 0, longitude 0.
    """
    is_null_fix = (latitude == 0.0) & (longitude == 0.0)
    is_valid = np.isfinite(latitude) & np.isfinite(longitude) & ~is_null_fix
    if not is_valid.any() or float(np.abs(latitude[is_valid]).max()) > np.pi / 2:
        return latitude, longitude, None, int(is_null_fix.sum())
    first_index = int(np.argmax(is_valid))
    plane_origin = origin or (float(latitude[first_index]), float(longitude[first_index]))
    north, east = project_to_tangent_plane(
        np.where(is_valid, latitude, np.nan), np.where(is_valid, longitude, np.nan), *plane_origin
    )
    return north, east, plane_origin, int(is_null_fix.sum())


def complete_quaternion(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the parts x, y, z, w [T] of quaternions of which x and y may be missing (zero)."""
    zero_parts = (np.zeros_like(parts[-1]),) * (len(QUATERNION) - len(parts))
    return (*zero_parts, *parts)


def normalize_quaternion(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return the parts x, y, z, w of unit quaternions, [T] each; NaN for quaternions of zeros."""
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    is_valid = np.isfinite(norm) & (norm > 0.5)
    safe_norm = np.where(is_valid, norm, 1.0)
    return tuple(np.where(is_valid, component / safe_norm, np.nan) for component in (x, y, z, w))


def quaternion_tilt(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the roll and pitch angles [T] of unit quaternions in rad.

    They belong to the order yaw, pitch, roll (Fossen 2021, section 2.2).
    """
    roll: np.ndarray = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch: np.ndarray = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return roll, pitch


def quaternion_yaw(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the yaw angle [T] of unit quaternions in rad (Fossen 2021, section 2.2)."""
    yaw: np.ndarray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw
