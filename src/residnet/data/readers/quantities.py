"""Where a log's channels, position, heading and velocity come from, in which unit and frame."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import AfterValidator, Field

from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.errors import UsageError
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import known_unit, si_unit, to_si
from residnet.data.readers.base import package, unwrap
from residnet.data.readers.recording import Remark
from residnet.data.readers.written import Form, LetterO

Frame = Literal["as_measured", "ned", "enu", "body_fsd", "body_fpu"]

_SAME = (1.0, 0.0)
_FLIP = (-1.0, 0.0)
_FROM_EAST = (-1.0, math.pi / 2.0)
_EARTH = ("x", "y", "z", "psi", "wind_dir", "current_north", "current_east")
QUATERNION = ("qx", "qy", "qz", "qw")
"""Channels of a table that become a heading together, where it has none."""
COSINE, SINE = "_cos", "_sin"
"""What stands behind an angle's name in those of its cosine and sine."""
_FORWARD = ("u", "p", "phi", "u_dot", "tau_x")
_SIDEWAYS_OR_DOWN = ("v", "r", "w", "q", "theta", "v_dot", "r_dot", "tau_y", "tau_n")
# frame -> channel -> (factor, offset [SI]) that brings the channel to residnet's frame.
# x and y have no entry in enu: "x" there means east to some and the north column to others, so the
# map must name the north column itself.
_FRAMES: dict[str, dict[str, tuple[float, float]]] = {
    "ned": dict.fromkeys((*_EARTH, "qw"), _SAME),
    # the frame of a quaternion is told at its scalar part
    "enu": {"psi": _FROM_EAST, "wind_dir": _FROM_EAST, "z": _FLIP, "qw": _SAME},
    "body_fsd": dict.fromkeys((*_FORWARD, *_SIDEWAYS_OR_DOWN), _SAME),
    "body_fpu": {**dict.fromkeys(_FORWARD, _SAME), **dict.fromkeys(_SIDEWAYS_OR_DOWN, _FLIP)},
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

    def require_fit(self, name: str) -> None:
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
            factor(self.unit, CHANNEL_UNITS.get(name))
        except ValueError as error:
            raise ValueError(f"channel {name}: {error}") from error
        if self.frame != "as_measured" and name not in _FRAMES[self.frame]:
            fitting = (
                ", ".join(frame for frame, table in _FRAMES.items() if name in table) or "none"
            )
            raise ValueError(
                f"channel {name}: frame '{self.frame}' says nothing about it (frames that do:"
                f" {fitting}); map the column that already holds this quantity, with sign: -1 where"
                " it points the other way"
            )

    def si(self, name: str) -> str:
        """Return the SI unit of channel `name`."""
        return si_unit(known_unit(self.unit, CHANNEL_UNITS.get(name)))

    def in_si(self, name: str, raw: np.ndarray) -> np.ndarray:
        """Return the size of the values [T] of channel `name` in SI, whatever their frame."""
        gain = to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        size: np.ndarray = np.abs(gain * (raw - self.offset))
        return size

    def convert(self, name: str, raw: np.ndarray) -> np.ndarray:
        """Return the values [T] of channel `name` in residnet's unit, sign and frame.

        psi unwrapped.
        """
        turn, ahead = _FRAMES[self.frame][name] if self.frame != "as_measured" else _SAME
        gain = turn * self.sign * to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        values = gain * (raw - self.offset) + ahead
        return true_headings(values) if name == "psi" else values


_EVEN = 0.2
"""Share by which the steps of an interpolation may differ, whose ends are rounded."""
_SWEPT = 10.0
"""Times that a step of such an interpolation exceeds the steps of an ordinary turn."""


def true_headings(psi: np.ndarray) -> np.ndarray:
    """Return headings [T] in rad, unwrapped; NaN where the recorder made them up.

    A recorder that resamples by straight lines goes from 359 to 1 deg by way of 180. Such samples
    lie in a run of even steps from one edge of the circle to the other, far larger than the steps
    before and behind it: a vessel gathers and loses its rate of turn.
    """
    out = unwrap(psi)
    known = np.flatnonzero(np.isfinite(psi))
    wrapped = np.remainder(psi[known], 2.0 * np.pi)
    step = np.diff(wrapped)
    size = np.abs(np.where(np.abs(step) > np.pi, 2.0 * np.pi - np.abs(step), step))
    if step.size < 3 or not size.any():
        return out
    swept = np.abs(step) > max(_SWEPT * float(np.median(size)), np.radians(5.0))
    sense = np.sign(step) * swept
    bounds = np.flatnonzero(np.diff(np.concatenate(([0.0], sense, [0.0]))))
    usual = np.where(swept, np.median(size), size)
    made = np.zeros(known.size, dtype=bool)
    for begin, end in itertools.pairwise(bounds):
        part = step[begin:end]
        if part.size < 2 or not sense[begin]:
            continue
        # the steps into and out of the interpolation may be cut short
        slope = np.abs(part).max()
        even = np.abs(part[1:-1]) >= (1.0 - _EVEN) * slope
        beside = np.append(usual[max(begin - 2, 0) : begin], usual[end : end + 2]).max(initial=0.0)
        across = 2.0 * np.pi - abs(part.sum()) < slope + 2.0 * beside
        # the short way round goes on as the vessel turned, and the long way does not
        short = (2.0 * np.pi - abs(part.sum())) / part.size
        sudden = slope - beside > abs(short - beside)
        if even.all() and across and sudden:
            made[begin + 1 : end] = True
    if not made.any():
        return out
    # where two follow each other, the sample between them lies on neither end
    made[1:-1] |= made[:-2] & made[2:]
    kept = known[~made]
    out[known[made]] = np.nan
    out[kept] = np.unwrap(psi[kept])
    return out


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
    form: Form = "number"
    hemisphere: str | None = None
    letter_o: LetterO | None = None
    hold: bool = False

    @property
    def is_angle(self) -> bool:
        """Whether its cells may be degrees with minutes or letters."""
        return self.form != "number" or self.hemisphere is not None

    def require_fit(self, name: str) -> None:
        """Stop where this cannot be the channel `name`; see `Conversion.require_fit`.

        Raises:
            ValueError: also where degrees with minutes are in another unit.
        """
        super().require_fit(name)
        if self.is_angle and known_unit(self.unit) != "deg":
            raise ValueError(
                f"channel {name}: `form` and `hemisphere` are for degrees; set unit: deg"
            )


def factor(unit: str, expected: str | None) -> float:
    """Return `to_si` for validators: pydantic adds the key path to a ValueError only."""
    try:
        return to_si(unit, expected)
    except UsageError as error:
        raise ValueError(str(error)) from error


def _converts(si: str) -> AfterValidator:
    def known(unit: str) -> str:
        factor(unit, si)
        return known_unit(unit, si)

    return AfterValidator(known)


AngleUnit = Annotated[str, _converts("rad")]
LengthUnit = Annotated[str, _converts("m")]
SpeedUnit = Annotated[str, _converts("m/s")]


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


class Antenna(Config):
    """The place of an antenna from the vessel's centre, in body axes.

    Attributes:
        x: forward of the centre in m.
        y: to starboard of the centre in m.
    """

    x: Metres = 0.0
    y: Metres = 0.0


class Origin(Config):
    """The origin of a local tangent plane on the WGS 84 ellipsoid.

    Plain numbers are rad, so write `63.44 deg`.

    Attributes:
        latitude: in rad, north positive.
        longitude: in rad, east positive.
    """

    latitude: Radians = Field(ge=-1.5708, le=1.5708)
    longitude: Radians = Field(ge=-6.2832, le=6.2832)


class Source(Config):
    """Fields of one topic.

    Attributes:
        topic: that holds the fields; may be left out where the recording has only one.
    """

    topic: str | None = None
    names: ClassVar[tuple[str, ...]] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return tuple(str(getattr(self, name)) for name in self.names)


class OfAntenna(Source):
    """What is measured at an antenna.

    Attributes:
        antenna: where it stands; the log holds what belongs to the vessel's centre. A velocity off
            the centre needs the yaw rate r as a channel.
    """

    antenna: Antenna = Field(default_factory=Antenna)


@final
class Geodetic(OfAntenna):
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
    names: ClassVar[tuple[str, ...]] = ("latitude", "longitude")


@final
class Local(OfAntenna):
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
    names: ClassVar[tuple[str, ...]] = ("north", "east")


PositionConfig = Annotated[Geodetic | Local, Field(discriminator="kind")]
"""Where x and y come from."""


@final
class Quaternion(Source):
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
    names: ClassVar[tuple[str, ...]] = ("field",)


@final
class Angle(Source):
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
    names: ClassVar[tuple[str, ...]] = ("field",)


HeadingConfig = Annotated[Quaternion | Angle, Field(discriminator="kind")]
"""Where psi comes from."""


@final
class Derived(Config):
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
class EarthFixed(OfAntenna):
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
    names: ClassVar[tuple[str, ...]] = ("north", "east")


@final
class CourseSpeed(OfAntenna):
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
    names: ClassVar[tuple[str, ...]] = ("course", "speed")


VelocityConfig = Annotated[Derived | EarthFixed | CourseSpeed, Field(discriminator="kind")]
"""Where u, v (and r) come from; velocities in body axes are plain channels."""


def given_by(
    position: PositionConfig | None, heading: HeadingConfig | None, velocity: VelocityConfig | None
) -> list[str]:
    """Return the channels that sources give."""
    sources = {("x", "y"): position, ("psi",): heading, ("u", "v"): velocity}
    return [name for names, source in sources.items() if source is not None for name in names]


@final
class Uniform(Config):
    """A uniform grid; where the recording has dates, on whole multiples of its step in Unix time.

    Attributes:
        step: between samples, s.
    """

    kind: Literal["uniform"] = "uniform"
    step: Seconds = Field(gt=0.0)


@final
class OfTopic(Config):
    """The samples of one topic, whatever its rate.

    Attributes:
        topic: null takes the topic of position, else of heading, else of the first channel.
    """

    kind: Literal["topic"] = "topic"
    topic: str | None = None


ClockConfig = Annotated[Uniform | OfTopic, Field(discriminator="kind")]
"""The clock of the log."""


@dataclass(frozen=True)
class Plan:
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


def tangent_plane(
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
    with package("geo", "pyproj", "a position in latitude and longitude"):
        from pyproj import Transformer
    origin = (
        f"+lat_0={float(np.degrees(latitude_0))!r} +lon_0={float(np.degrees(longitude_0))!r} +h_0=0"
    )
    plane = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
        f" {origin}"
    )
    known = np.isfinite(latitude) & np.isfinite(longitude)
    north, east = np.full(latitude.shape, np.nan), np.full(latitude.shape, np.nan)
    east[known], north[known], _ = plane.transform(
        longitude[known], latitude[known], np.zeros(int(known.sum())), radians=True
    )
    return north, east


def fixes_on_plane(
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
    none = (latitude == 0.0) & (longitude == 0.0)
    known = np.isfinite(latitude) & np.isfinite(longitude) & ~none
    if not known.any() or float(np.abs(latitude[known]).max()) > np.pi / 2:
        return latitude, longitude, None, int(none.sum())
    first = int(np.argmax(known))
    at = origin or (float(latitude[first]), float(longitude[first]))
    phi, lam = (np.where(known, angle, np.nan) for angle in (latitude, longitude))
    north, east = tangent_plane(phi, lam, *at)
    return north, east, at, int(none.sum())


def unit_quaternion(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return quaternions [T] of length one, x, y, z, w; NaN where they are empty."""
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    known = np.isfinite(norm) & (norm > 0.5)
    length = np.where(known, norm, 1.0)
    return tuple(np.where(known, part / length, np.nan) for part in (x, y, z, w))


def yaw_of(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the rotation [T] about the vertical axis in rad of quaternions of length one."""
    yaw: np.ndarray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw
