"""Messages of PX4, ArduPilot and NMEA 0183 that map themselves to channels.

All three speak NED, and forward-right-down in the body.
"""

from __future__ import annotations

from typing import ClassVar, final

from residnet.data.readers.composing.compose import Plan
from residnet.data.readers.composing.quantities import (
    Angle,
    CourseSpeed,
    EarthFixed,
    FieldMap,
    Geodetic,
    Local,
    Quaternion,
)
from residnet.data.readers.messages.message import Message
from residnet.data.readers.recording import Series

_CONVERSION = "already in NED and forward-starboard-down"


@final
class Px4LocalPosition(Message):
    """PX4 vehicle_local_position: the navigation filter's position and velocity."""

    types = ("vehicle_local_position",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        velocity = (
            EarthFixed(topic=series.name, north="vx", east="vy") if series.has("vx") else None
        )
        return Plan({}, Local(topic=series.name, north="x", east="y"), None, velocity)


@final
class Px4Attitude(Message):
    """The message vehicle_attitude of PX4."""

    types = ("vehicle_attitude",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan({}, None, Quaternion(topic=series.name, field="q", frame="ned", roll=True))


@final
class Px4AngularVelocity(Message):
    """The message vehicle_angular_velocity of PX4."""

    types = ("vehicle_angular_velocity",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {
                name: FieldMap(topic=series.name, field=f"xyz[{axis}]", unit="rad/s")
                for name, axis in (("r", 2), ("p", 0))
            }
        )


@final
class Px4Gps(Message):
    """PX4 vehicle_gps_position and sensor_gps: the receiver's fix."""

    types = ("vehicle_gps_position", "sensor_gps")
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        names = ("lat", "lon") if series.has("lat") else ("latitude_deg", "longitude_deg")
        velocity = (
            EarthFixed(topic=series.name, north="vel_n_m_s", east="vel_e_m_s")
            if series.has("vel_n_m_s")
            else None
        )
        return Plan(
            {}, Geodetic(topic=series.name, latitude=names[0], longitude=names[1]), None, velocity
        )


@final
class ArduPilotFilter(Message):
    """ArduPilot XKF1, NKF1: the navigation filter's position and velocity."""

    types = ("XKF1", "NKF1")
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {},
            Local(topic=series.name, north="PN", east="PE"),
            None,
            EarthFixed(topic=series.name, north="VN", east="VE"),
        )


@final
class ArduPilotAttitude(Message):
    """The message ATT of ArduPilot."""

    types = ("ATT",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {"phi": FieldMap(topic=series.name, field="Roll", unit="deg")},
            None,
            Angle(topic=series.name, field="Yaw", unit="deg"),
        )


@final
class ArduPilotImu(Message):
    """The message IMU of ArduPilot."""

    types = ("IMU",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {
                name: FieldMap(topic=series.name, field=field, unit="rad/s")
                for name, field in (("r", "GyrZ"), ("p", "GyrX"))
            }
        )


@final
class ArduPilotGps(Message):
    """ArduPilot GPS: the receiver's fix, course and speed."""

    types = ("GPS",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {},
            Geodetic(topic=series.name, latitude="Lat", longitude="Lng"),
            None,
            CourseSpeed(topic=series.name, course="GCrs", speed="Spd"),
        )


@final
class NmeaFix(Message):
    """NMEA GGA, GNS, RMC, GLL: latitude and longitude; RMC has course and speed too."""

    types = ("GGA", "GNS", "RMC", "GLL")
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        course = (
            CourseSpeed(
                topic=series.name, course="true_course", speed="spd_over_grnd", speed_unit="kn"
            )
            if series.has("spd_over_grnd")
            else None
        )
        return Plan({}, Geodetic(topic=series.name), None, course)


@final
class NmeaCourse(Message):
    """NMEA VTG: course and speed over ground."""

    types = ("VTG",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {},
            None,
            None,
            CourseSpeed(
                topic=series.name, course="true_track", speed="spd_over_grnd_kts", speed_unit="kn"
            ),
        )


@final
class NmeaHeading(Message):
    """NMEA HDT: true heading."""

    types = ("HDT",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan({}, None, Angle(topic=series.name, field="heading", unit="deg"))


@final
class NmeaRateOfTurn(Message):
    """NMEA ROT: rate of turn, positive to starboard."""

    types = ("ROT",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan({"r": FieldMap(topic=series.name, field="rate_of_turn", unit="deg/s")})


@final
class NmeaRudder(Message):
    """NMEA RSA: rudder angle, negative where the bow turns to port."""

    types = ("RSA",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan(
            {"delta": FieldMap(topic=series.name, field=next(iter(series.fields)), unit="deg")}
        )


@final
class NmeaRevolutions(Message):
    """NMEA RPM: revolutions of an engine or shaft; of several, those of each are told apart."""

    types = ("RPM",)
    conversion: ClassVar[str] = _CONVERSION

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        if not series.has("speed"):
            return Plan()
        senders = [] if series.sender is None else sorted(set(series.sender.tolist()))
        if len(senders) < 2:
            return Plan({"n": FieldMap(topic=series.name, field="speed", unit="rpm")})
        # odd numbers are to starboard, even ones to port
        sides = {"1": "n_stbd", "2": "n_port"}
        return Plan(
            {
                sides.get(sender, f"n_{sender}"): FieldMap(
                    topic=series.name, field="speed", unit="rpm", sender=sender
                )
                for sender in senders
            }
        )


MARINE: tuple[Message, ...] = (
    Px4LocalPosition(),
    Px4Attitude(),
    Px4AngularVelocity(),
    Px4Gps(),
    ArduPilotFilter(),
    ArduPilotAttitude(),
    ArduPilotImu(),
    ArduPilotGps(),
    NmeaFix(),
    NmeaCourse(),
    NmeaHeading(),
    NmeaRateOfTurn(),
    NmeaRudder(),
    NmeaRevolutions(),
)
"""In the order in which they are asked: the one that says most of each system first."""
