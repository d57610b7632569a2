"""Where a recording holds a channel, position, heading or velocity, and its unit and frame."""

from __future__ import annotations

from typing import Annotated, Literal, final

from pydantic import AfterValidator, Field

from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.units import known_unit
from residnet.data.readers.tables.channel_map import Conversion, factor


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
        longest_gap: longest step that is interpolated across or held over, s; null takes the
            reader's.
        required: stops where the recording has no such topic or no number in it; otherwise the log
            lacks the channel, and says so.
    """

    topic: str | None = None
    field: str
    sender: str | None = None
    hold: bool = False
    longest_gap: Seconds | None = Field(default=None, gt=0.0)
    required: bool = True


class Lever(Config):
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


@final
class Geodetic(Config):
    """Latitude and longitude, brought to a local tangent plane (north, east) with PROJ.

    Attributes:
        topic: of the fixes.
        latitude: field.
        longitude: field.
        unit: of both.
        origin: of the plane; null takes the first fix, which is written into the log's meta.
        antenna: where the antenna stands; the log's x and y are those of the vessel's centre.
    """

    kind: Literal["geodetic"] = "geodetic"
    topic: str | None = None
    latitude: str = "latitude"
    longitude: str = "longitude"
    unit: AngleUnit = "deg"
    origin: Origin | None = None
    antenna: Lever = Field(default_factory=Lever)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return self.latitude, self.longitude


@final
class Local(Config):
    """Position in a local frame that the source made.

    Attributes:
        topic: of the positions.
        north: field of the northward component (in ENU the one that the source calls y).
        east: field of the eastward component.
        unit: of both.
        antenna: where the measured point stands; the log's x and y are those of the vessel's
            centre.
    """

    kind: Literal["local"] = "local"
    topic: str | None = None
    north: str
    east: str
    unit: LengthUnit = "m"
    antenna: Lever = Field(default_factory=Lever)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return self.north, self.east


PositionConfig = Annotated[Geodetic | Local, Field(discriminator="kind")]
"""Where x and y come from."""


@final
class Quaternion(Config):
    """Heading from a quaternion; its sign, which flips in many sources, does not matter.

    Attributes:
        topic: of the orientation.
        field: path whose x, y, z, w are meant, for example `pose.pose.orientation`.
        frame: `ned` (yaw clockwise from north) or `enu` (REP-103: counter-clockwise from east).
        roll: writes the roll angle as channel phi too.
    """

    kind: Literal["quaternion"] = "quaternion"
    topic: str | None = None
    field: str
    frame: Literal["ned", "enu"]
    roll: bool = False

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return (self.field,)


@final
class Angle(Config):
    """Heading as an angle; wraps are taken out.

    Attributes:
        topic: of the angle.
        field: its field.
        unit: its unit.
        frame: `ned` (clockwise from north, a compass) or `enu` (counter-clockwise from east).
        offset: added after conversion, rad: the mounting angle of a compass or of a pair of
            antennas.
    """

    kind: Literal["angle"] = "angle"
    topic: str | None = None
    field: str
    unit: AngleUnit = "rad"
    frame: Literal["ned", "enu"] = "ned"
    offset: Radians = 0.0

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return (self.field,)


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
class EarthFixed(Config):
    """u, v from northward and eastward velocity of the antenna.

    They are turned into body axes and moved to the vessel's centre.

    Attributes:
        topic: of the velocity.
        north: field of the northward component (in ENU the one that the source calls y).
        east: field of the eastward component.
        unit: of both.
        antenna: where the measured point stands; needs the yaw rate r as a channel unless both are
            zero.
    """

    kind: Literal["earth_fixed"] = "earth_fixed"
    topic: str | None = None
    north: str
    east: str
    unit: SpeedUnit = "m/s"
    antenna: Lever = Field(default_factory=Lever)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return self.north, self.east


@final
class CourseSpeed(Config):
    """u, v from course and speed over ground of the antenna.

    They are turned into body axes and moved to the vessel's centre.

    Attributes:
        topic: of course and speed.
        course: field of the course over ground, clockwise from north.
        speed: field of the speed over ground.
        course_unit: of the course.
        speed_unit: of the speed.
        antenna: where the measured point stands; needs the yaw rate r as a channel unless both are
            zero.
    """

    kind: Literal["course_speed"] = "course_speed"
    topic: str | None = None
    course: str
    speed: str
    course_unit: AngleUnit = "deg"
    speed_unit: SpeedUnit = "m/s"
    antenna: Lever = Field(default_factory=Lever)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are read."""
        return self.course, self.speed


VelocityConfig = Annotated[Derived | EarthFixed | CourseSpeed, Field(discriminator="kind")]
"""Where u, v (and r) come from; velocities in body axes are plain channels."""


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
