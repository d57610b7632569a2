"""Where a log's channels, position, heading and velocity come from, in which unit and frame."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import AfterValidator, Field

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import UsageError
from residnet.core.frames import unwrap_angle
from residnet.core.log import Remark
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import canonical_unit, si_unit, to_si
from residnet.io.readers.base import optional_import
from residnet.io.readers.written import AngleForm, LetterO
from residnet.preprocessing.motion import Antenna

Frame = Literal["as_measured", "ned", "enu", "body_fsd", "body_fpu"]

_IDENTITY = (1.0, 0.0)
_NEGATE = (-1.0, 0.0)
_EAST_TO_NORTH = (-1.0, math.pi / 2.0)
_EARTH_CHANNELS = ("x", "y", "z", "psi", "wind_dir", "current_north", "current_east")
QUATERNION = ("qx", "qy", "qz", "qw")
"""Channels of a table that become a heading together, where it has none."""
COSINE_SUFFIX, SINE_SUFFIX = "_cos", "_sin"
"""What stands behind an angle's name in those of its cosine and sine."""
_FORWARD_CHANNELS = ("u", "p", "phi", "u_dot", "tau_x")
_STARBOARD_OR_DOWN_CHANNELS = ("v", "r", "w", "q", "theta", "v_dot", "r_dot", "tau_y", "tau_n")
# frame -> channel -> (factor, offset [SI]) that brings the channel to residnet's frame.
# x and y have no entry in enu: "x" there means east to some and the north column to others, so the
# map must name the north column itself.
_FRAME_CONVERSIONS: dict[str, dict[str, tuple[float, float]]] = {
    "ned": dict.fromkeys((*_EARTH_CHANNELS, "qw"), _IDENTITY),
    # the frame of a quaternion is told at its scalar part
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
        unit: its unit, for example `deg/s`.
        offset: taken from the column's number first, in the column's own unit: the neutral of a
            servo, for example 1500.
        scale: what the rest is multiplied by to be in `unit`, for example 0.07 where 1000 us more
            are 70 deg more.
        sign: -1 turns it around.
        frame: `as_measured` (nothing to convert), `ned`, `body_fsd` (forward, starboard, down),
            `enu` (angles counter-clockwise from east) or `body_fpu` (forward, port, up).
    """

    unit: str
    offset: float = 0.0
    scale: float = 1.0
    sign: Literal[1, -1] = 1
    frame: Frame = "as_measured"

    def require_valid_channel(self, name: str) -> None:
        """Stop where this cannot be the channel `name`.

        Raises:
            ValueError: where the name is no channel's, the unit is unknown or of another dimension,
                or the frame says nothing about the channel.
        """
        if name == "t" or name.startswith("mask:"):
            raise ValueError(f"'{name}' cannot name a channel; time has its own key")
        if self.scale == 0.0:
            raise ValueError(f"channel {name}: scale must not be zero, all would be the same")
        try:
            conversion_factor(self.unit, CHANNEL_UNITS.get(name))
        except ValueError as error:
            raise ValueError(f"channel {name}: {error}") from error
        if self.frame != "as_measured" and name not in _FRAME_CONVERSIONS[self.frame]:
            valid_frames = (
                ", ".join(frame for frame, table in _FRAME_CONVERSIONS.items() if name in table)
                or "none"
            )
            raise ValueError(
                f"channel {name}: frame '{self.frame}' says nothing about it (frames that do:"
                f" {valid_frames}); map the column that already holds this quantity, with sign: -1 where"
                " it points the other way"
            )

    def si_unit_of(self, name: str) -> str:
        """Return the SI unit of channel `name`."""
        return si_unit(canonical_unit(self.unit, CHANNEL_UNITS.get(name)))

    def magnitude_in_si(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the size of the values [T] of channel `name` in SI, whatever their frame."""
        gain = to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        magnitude: np.ndarray = np.abs(gain * (values - self.offset))
        return magnitude

    def convert(self, name: str, raw_values: np.ndarray) -> np.ndarray:
        """Return the values [T] of channel `name` in residnet's unit, sign and frame.

        psi unwrapped.
        """
        frame_factor, frame_offset = (
            _FRAME_CONVERSIONS[self.frame][name] if self.frame != "as_measured" else _IDENTITY
        )
        gain = frame_factor * self.sign * to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        values = gain * (raw_values - self.offset) + frame_offset
        return mask_interpolated_headings(values) if name == "psi" else values


_STEP_TOLERANCE = 0.2
"""Share by which the steps of an interpolation may differ, whose ends are rounded."""
_MIN_SWEEP_RATIO = 10.0
"""Times that a step of such an interpolation exceeds the steps of an ordinary turn."""


def mask_interpolated_headings(psi: np.ndarray) -> np.ndarray:
    """Return headings [T] in rad, unwrapped; NaN where the recorder made them up.

    A recorder that resamples by straight lines goes from 359 to 1 deg by way of 180. Such samples
    lie in a run of even steps from one edge of the circle to the other, far larger than the steps
    before and behind it: a vessel gathers and loses its rate of turn.
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
    typical_step = np.where(is_sweep, np.median(step_size), step_size)
    is_interpolated = np.zeros(finite_indices.size, dtype=bool)
    for start, stop in itertools.pairwise(bounds):
        sweep_steps = step[start:stop]
        if sweep_steps.size < 2 or not sweep_sign[start]:
            continue
        # the steps into and out of the interpolation may be cut short
        largest_step = np.abs(sweep_steps).max()
        is_even = np.abs(sweep_steps[1:-1]) >= (1.0 - _STEP_TOLERANCE) * largest_step
        neighbour_step = np.append(
            typical_step[max(start - 2, 0) : start], typical_step[stop : stop + 2]
        ).max(initial=0.0)
        spans_circle = 2.0 * np.pi - abs(sweep_steps.sum()) < largest_step + 2.0 * neighbour_step
        # the short way round goes on as the vessel turned, and the long way does not
        short_way_step = (2.0 * np.pi - abs(sweep_steps.sum())) / sweep_steps.size
        is_sudden = largest_step - neighbour_step > abs(short_way_step - neighbour_step)
        if is_even.all() and spans_circle and is_sudden:
            is_interpolated[start + 1 : stop] = True
    if not is_interpolated.any():
        return unwrapped
    # where two follow each other, the sample between them lies on neither end
    is_interpolated[1:-1] |= is_interpolated[:-2] & is_interpolated[2:]
    measured_indices = finite_indices[~is_interpolated]
    unwrapped[finite_indices[is_interpolated]] = np.nan
    unwrapped[measured_indices] = np.unwrap(psi[measured_indices])
    return unwrapped


class ChannelMap(Conversion):
    """One channel of a foreign table.

    Attributes:
        column: name of the column, as the file's header has it.
        form: of numbers that are angles: `number`, or `ddmm` for degrees and minutes in one, as
            receivers write 5954.321 for 59 degrees and 54.321 minutes. Latitudes and longitudes
            such as `59°54.321'N` or `59 54 19.3 N` are read in either case.
        hemisphere: column with the letters N and S or E and W that belong to the numbers; null
            where there is none.
        letter_o: what the letter O means in longitudes, `east` (Ost, Oost) or `west` (Oeste, Ouest,
            Ovest); null refuses it.
        hold: the last value holds until the next, as of commands that are recorded when they
            change; rows that hold nothing else are left out.
    """

    column: str
    form: AngleForm = "number"
    hemisphere: str | None = None
    letter_o: LetterO | None = None
    hold: bool = False

    @property
    def is_angle(self) -> bool:
        """Whether its cells may be degrees with minutes or letters."""
        return self.form != "number" or self.hemisphere is not None

    def require_valid_channel(self, name: str) -> None:
        """Stop where this cannot be the channel `name`; see `Conversion.require_fit`.

        Raises:
            ValueError: also where degrees with minutes are in another unit.
        """
        super().require_valid_channel(name)
        if self.is_angle and canonical_unit(self.unit) != "deg":
            raise ValueError(
                f"channel {name}: `form` and `hemisphere` are for degrees; set unit: deg"
            )


def conversion_factor(unit: str, expected: str | None) -> float:
    """Return `to_si` for validators: pydantic adds the key path to a ValueError only."""
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
    """One channel of a log from one field of a topic.

    Attributes:
        topic: topic, message type or table; may be left out where the recording has only one.
        field: path of the field, for example `twist.linear.x`.
        sender: takes only the rows of one sender, where several publish to the topic.
        hold: the last value holds until the next (commands); otherwise values are interpolated.
        longest_gap: longest step that is interpolated across or held over, s; null takes a second.
            Slow topics may always step over three of their usual steps.
        required: stops where the recording has no such topic or no number in it; otherwise the log
            lacks the channel, and says so.
    """

    topic: str | None = None
    field: str
    sender: str | None = None
    hold: bool = False
    longest_gap: Seconds | None = Field(default=None, gt=0.0)
    required: bool = True


class Origin(Config):
    """The origin of a local tangent plane on the WGS 84 ellipsoid.

    Plain numbers are rad, so write `63.44 deg`.

    Attributes:
        latitude: in rad, north positive.
        longitude: in rad, east positive.
    """

    latitude: Radians = Field(ge=-1.5708, le=1.5708)
    longitude: Radians = Field(ge=-6.2832, le=6.2832)


class TopicSource(Config):
    """Fields of one topic.

    Attributes:
        topic: that holds the fields; may be left out where the recording has only one.
    """

    topic: str | None = None
    field_keys: ClassVar[tuple[str, ...]] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return tuple(str(getattr(self, name)) for name in self.field_keys)


class AntennaSource(TopicSource):
    """What is measured at an antenna.

    Attributes:
        antenna: where it stands; the log holds what belongs to the vessel's centre. A velocity off
            the centre needs the yaw rate r as a channel.
    """

    antenna: Antenna = Field(default_factory=Antenna)


@final
class GeodeticPosition(AntennaSource):
    """Latitude and longitude, brought to a local tangent plane (north, east) with PROJ.

    Attributes:
        latitude: field.
        longitude: field.
        unit: of both.
        origin: of the plane; null takes the first fix, which is written into the log's meta.
    """

    kind: Literal["geodetic"] = "geodetic"
    latitude: str = "latitude"
    longitude: str = "longitude"
    unit: AngleUnit = "deg"
    origin: Origin | None = None
    field_keys: ClassVar[tuple[str, ...]] = ("latitude", "longitude")


@final
class LocalPosition(AntennaSource):
    """Position in a local frame that the source made.

    Attributes:
        north: field of the northward component (in ENU the one that the source calls y).
        east: field of the eastward component.
        unit: of both.
    """

    kind: Literal["local"] = "local"
    north: str
    east: str
    unit: LengthUnit = "m"
    field_keys: ClassVar[tuple[str, ...]] = ("north", "east")


PositionConfig = Annotated[GeodeticPosition | LocalPosition, Field(discriminator="kind")]
"""Where x and y come from."""


@final
class QuaternionHeading(TopicSource):
    """Heading from a quaternion; its sign, which flips in many sources, does not matter.

    Attributes:
        field: path whose x, y, z, w are meant, for example `pose.pose.orientation`.
        frame: `ned` (yaw clockwise from north) or `enu` (REP-103: counter-clockwise from east).
        roll: writes the angles of roll and pitch as channels phi and theta too.
    """

    kind: Literal["quaternion"] = "quaternion"
    field: str
    frame: Literal["ned", "enu"]
    roll: bool = False
    field_keys: ClassVar[tuple[str, ...]] = ("field",)


@final
class AngleHeading(TopicSource):
    """Heading as an angle; wraps are taken out.

    Attributes:
        field: of the angle.
        unit: its unit.
        frame: `ned` (clockwise from north, a compass) or `enu` (counter-clockwise from east).
        offset: added after conversion, rad: the mounting angle of a compass or of a pair of
            antennas.
    """

    kind: Literal["angle"] = "angle"
    field: str
    unit: AngleUnit = "rad"
    frame: Literal["ned", "enu"] = "ned"
    offset: Radians = 0.0
    field_keys: ClassVar[tuple[str, ...]] = ("field",)


HeadingConfig = Annotated[QuaternionHeading | AngleHeading, Field(discriminator="kind")]
"""Where psi comes from."""


@final
class DerivedVelocity(Config):
    """u, v, r from position and heading, by Savitzky-Golay polynomials at the positions' rate.

    Position and heading are smoothed by them too.

    Attributes:
        window: length of the polynomials for translation, s.
        yaw_window: the same for heading; null takes `window`.
        order: of the polynomials.
    """

    kind: Literal["derived"] = "derived"
    window: Seconds = Field(default=2.0, gt=0.0)
    yaw_window: Seconds | None = Field(default=None, gt=0.0)
    order: int = Field(default=3, ge=1, le=7)


@final
class EarthFixedVelocity(AntennaSource):
    """u, v from northward and eastward velocity of the antenna.

    They are turned into body axes and moved to the vessel's centre.

    Attributes:
        north: field of the northward component (in ENU the one that the source calls y).
        east: field of the eastward component.
        unit: of both.
    """

    kind: Literal["earth_fixed"] = "earth_fixed"
    north: str
    east: str
    unit: SpeedUnit = "m/s"
    field_keys: ClassVar[tuple[str, ...]] = ("north", "east")


@final
class CourseSpeedVelocity(AntennaSource):
    """u, v from course and speed over ground of the antenna.

    They are turned into body axes and moved to the vessel's centre.

    Attributes:
        course: field of the course over ground, clockwise from north.
        speed: field of the speed over ground.
        course_unit: of the course.
        speed_unit: of the speed.
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
"""Where u, v (and r) come from; velocities in body axes are plain channels."""


def source_channels(
    position: PositionConfig | None, heading: HeadingConfig | None, velocity: VelocityConfig | None
) -> list[str]:
    """Return the channels that sources give."""
    sources = {("x", "y"): position, ("psi",): heading, ("u", "v"): velocity}
    return [name for names, source in sources.items() if source is not None for name in names]


@final
class UniformClock(Config):
    """A uniform grid; where the recording has dates, on whole multiples of its step in Unix time.

    Attributes:
        step: between samples, s.
    """

    kind: Literal["uniform"] = "uniform"
    step: Seconds = Field(gt=0.0)


@final
class TopicClock(Config):
    """The samples of one topic, whatever its rate.

    Attributes:
        topic: null takes the topic of position, else of heading, else of the first channel.
    """

    kind: Literal["topic"] = "topic"
    topic: str | None = None


ClockConfig = Annotated[UniformClock | TopicClock, Field(discriminator="kind")]
"""The clock of the log."""


@dataclass(frozen=True)
class ChannelPlan:
    """Which parts of a recording become which channels.

    Attributes:
        channels: name -> field of a topic.
        position: source of x and y.
        heading: source of psi.
        velocity: source of u, v (and r) where no channels are.
        conversions: what was converted without a setting for it, for the log's meta.
        remarks: what was noticed while deciding.
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
    """Return north and east [T] in m of points of the WGS 84 ellipsoid.

    They lie on the plane that touches the ellipsoid at the origin.

    Topocentric coordinates (EPSG method 9837); heights are taken as zero, which shifts a point at
    100 m height and 1 km distance by 16 mm.

    Args:
        latitude: [T] rad.
        longitude: [T] rad.
        latitude_0: of the origin, rad.
        longitude_0: of the origin, rad.

    Raises:
        UsageError: where pyproj is not installed.
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
    north, east = np.full(latitude.shape, np.nan), np.full(latitude.shape, np.nan)
    east[is_finite], north[is_finite], _ = transformer.transform(
        longitude[is_finite], latitude[is_finite], np.zeros(int(is_finite.sum())), radians=True
    )
    return north, east


def project_fixes(
    latitude: np.ndarray, longitude: np.ndarray, origin: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[float, float] | None, int]:
    """Return north and east [T] in m, the origin, and how many fixes were none.

    Receivers without a fix report latitude 0, longitude 0. There is no origin where there is no
    fix, or one beyond a pole.

    Args:
        latitude: [T] rad.
        longitude: [T] rad.
        origin: of the plane, rad; None takes the first fix.
    """
    is_null_fix = (latitude == 0.0) & (longitude == 0.0)
    is_valid = np.isfinite(latitude) & np.isfinite(longitude) & ~is_null_fix
    if not is_valid.any() or float(np.abs(latitude[is_valid]).max()) > np.pi / 2:
        return latitude, longitude, None, int(is_null_fix.sum())
    first_index = int(np.argmax(is_valid))
    plane_origin = origin or (float(latitude[first_index]), float(longitude[first_index]))
    phi, lam = (np.where(is_valid, angle, np.nan) for angle in (latitude, longitude))
    north, east = project_to_tangent_plane(phi, lam, *plane_origin)
    return north, east, plane_origin, int(is_null_fix.sum())


def normalize_quaternion(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return quaternions [T] of length one, x, y, z, w; NaN where they are empty."""
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    is_valid = np.isfinite(norm) & (norm > 0.5)
    safe_norm = np.where(is_valid, norm, 1.0)
    return tuple(np.where(is_valid, component / safe_norm, np.nan) for component in (x, y, z, w))


def quaternion_yaw(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the rotation [T] about the vertical axis in rad of quaternions of length one."""
    yaw: np.ndarray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw
