"""Kinds of message that map themselves to channels: one row of `MESSAGES` each.

A row says by which types (or fields, where a source tells no types) a message is known, and which
channels it holds. Of rows that hold the same channel the first wins, of topics alike the longest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.names import CHANNEL_UNITS
from residnet.data.readers.quantities import (
    Angle,
    CourseSpeed,
    Derived,
    EarthFixed,
    FieldMap,
    Geodetic,
    Local,
    Plan,
    Quaternion,
    given_by,
)
from residnet.data.readers.recording import Recording, Series, key_of, remark

_ROS = "REP-103 (ENU, forward-left-up) to NED, forward-starboard-down"
_NED = "already in NED and forward-starboard-down"
_NAMES = "by its names, taken to be in SI, NED and body axes"
_WORLD = ("map", "odom", "earth", "world", "enu", "ned")
_INTEGERS = tuple(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64))
_NUMBERS = ("Float64", "Float32", *_INTEGERS, "Float64Stamped", "Float32Stamped")
_FIX = ("latitude", "longitude")


@dataclass(frozen=True)
class Message:
    """A kind of message.

    Attributes:
        name: for the log's meta.
        types: names of the message's type, without its package.
        plan: series -> channels, position, heading and velocity that it gives.
        conversion: how its frames become residnet's, for the log's meta.
        fields: that tell it where the source has no types; none where only a type does.
    """

    name: str
    types: tuple[str, ...]
    plan: Callable[[Series], Plan]
    conversion: str = _NED
    fields: tuple[str, ...] = ()

    def fits(self, series: Series) -> bool:
        """Return whether a series holds messages of this kind."""
        if series.kind:
            return series.kind.rsplit("/", 1)[-1] in self.types
        if self.name == "Named":
            return len(_named(series)) >= 3
        return bool(self.fields) and all(series.has(field) for field in self.fields)


def _maps(s: Series, unit: str, paths: dict[str, str], **settings: Any) -> dict[str, FieldMap]:
    return {n: FieldMap(topic=s.name, field=f, unit=unit, **settings) for n, f in paths.items()}


def _prefix(s: Series, prefixes: tuple[str, ...], field: str) -> str:
    return next((prefix for prefix in prefixes if s.has(prefix + field)), "")


def _body(s: Series, prefix: str) -> dict[str, FieldMap]:
    """Velocities of a twist that are not zero throughout: a planar source leaves others empty."""
    out: dict[str, FieldMap] = {}
    paths = {"u": "linear.x", "v": "linear.y", "r": "angular.z", "p": "angular.x"}
    paths |= {"w": "linear.z", "q": "angular.y"}
    for name, path in paths.items():
        if s.has(prefix + path) and s[prefix + path].any():
            out |= _maps(s, CHANNEL_UNITS[name], {name: prefix + path}, frame="body_fpu")
    return out


def _depth(s: Series, field: str, **settings: Any) -> dict[str, FieldMap]:
    """The depth, where it moves: a planar source leaves it at zero."""
    moves = s.has(field) and float(np.nanstd(s[field])) > 0.0
    return _maps(s, "m", {"z": field}, **settings) if moves else {}


def _orientation(s: Series, path: str) -> Quaternion | None:
    if not all(s.has(f"{path}.{axis}") for axis in "xyzw"):
        return None
    tilted = bool(s[f"{path}.x"].any() or s[f"{path}.y"].any())
    return Quaternion(topic=s.name, field=path, frame="enu", roll=tilted)


def _navigation(s: Series) -> Plan:
    """A pose, a twist, or both."""
    at = _prefix(s, ("pose.pose.", "pose.", ""), "position.x")
    moves = _prefix(s, ("twist.twist.", "twist.", ""), "linear.x")
    if s.has(f"{at}position.x"):
        place = Local(topic=s.name, north=f"{at}position.y", east=f"{at}position.x")
        channels = _body(s, moves) | _depth(s, f"{at}position.z", frame="enu")
        return Plan(channels, place, _orientation(s, f"{at}orientation"))
    if s.sender is not None and len(s.sender) and str(s.sender[0]).strip("/").lower() in _WORLD:
        # along the axes of the earth, which is left to the config
        return Plan()
    return Plan(_body(s, moves))


def _imu(s: Series) -> Plan:
    rates = {"r": "angular_velocity.z", "p": "angular_velocity.x"}
    held = {name: path for name, path in rates.items() if s.has(path)}
    # a driver without orientation says so by -1 in the covariance, or leaves zeros
    covariance = "orientation_covariance.0"
    empty = s.has(covariance) and bool((s[covariance] == -1.0).all())
    empty = empty or not s.has("orientation.w") or not s["orientation.w"].any()
    heading = None if empty else _orientation(s, "orientation")
    return Plan(_maps(s, "rad/s", held, frame="body_fpu"), None, heading)


def _wrench(s: Series) -> Plan:
    at = _prefix(s, ("wrench.",), "force.x")
    body: dict[str, Any] = {"frame": "body_fpu", "hold": True}
    forces = _maps(s, "N", {"tau_x": f"{at}force.x", "tau_y": f"{at}force.y"}, **body)
    return Plan(forces | _maps(s, "N m", {"tau_n": f"{at}torque.z"}, **body))


def _number(s: Series) -> Plan:
    if not s.has("data"):
        return Plan()
    parts = [part for part in key_of(s.name).split("_") if part]
    ends = ["_".join(parts[k:]) for k in range(len(parts))]
    name = next((end for end in ends if end in CHANNEL_UNITS), "_".join(parts) or "data")
    return Plan(_maps(s, CHANNEL_UNITS.get(name, "-"), {name: "data"}, hold=True))


def _joints(s: Series) -> Plan:
    channels: dict[str, FieldMap] = {}
    for path in s.fields:
        what, _, joint = path.partition(".")
        unit = {"position": "rad", "velocity": "rad/s", "effort": "N m"}.get(what)
        if unit is not None and joint:
            name = joint if what == "position" else f"{joint}_{what}"
            # a joint of a known name in another unit is another quantity
            name = name if CHANNEL_UNITS.get(name, unit) == unit else f"{name}_{what}"
            channels |= _maps(s, unit, {name: path})
    return Plan(channels)


def _moos(s: Series) -> Plan:
    place = None
    if s.has("NAV_X") and s.has("NAV_Y"):
        place = Local(topic=s.name, north="NAV_Y", east="NAV_X")
    heading = Angle(topic=s.name, field="NAV_HEADING", unit="deg") if s.has("NAV_HEADING") else None
    return Plan({}, place, heading)


def _named(s: Series) -> list[str]:
    known = (name for name in s.fields if name in CHANNEL_UNITS and name != "t")
    return [name for name in known if s[name].size and not np.isnan(s[name]).all()]


def _by_name(s: Series) -> Plan:
    names = _named(s)
    heading = Angle(topic=s.name, field="psi") if "psi" in names else None
    place = Local(topic=s.name, north="x", east="y") if {"x", "y"} <= set(names) else None
    channels: dict[str, FieldMap] = {}
    for name in names:
        if name != "psi" and not (place and name in ("x", "y")):
            held = name.startswith("cmd_")
            channels |= _maps(s, CHANNEL_UNITS[name], {name: name}, hold=held)
    return Plan(channels, place, heading)


def _revolutions(s: Series) -> Plan:
    if not s.has("speed"):
        return Plan()
    senders = [] if s.sender is None else sorted(set(s.sender.tolist()))
    if len(senders) < 2:
        return Plan(_maps(s, "rpm", {"n": "speed"}))
    # odd numbers are to starboard, even ones to port
    sides = {"1": "n_stbd", "2": "n_port"}
    channels: dict[str, FieldMap] = {}
    for sender in senders:
        channels |= _maps(s, "rpm", {sides.get(sender, f"n_{sender}"): "speed"}, sender=sender)
    return Plan(channels)


def _earth_fixed(s: Series, north: str, east: str) -> EarthFixed | None:
    return EarthFixed(topic=s.name, north=north, east=east) if s.has(north) else None


def _px4_gps(s: Series) -> Plan:
    latitude, longitude = ("lat", "lon") if s.has("lat") else ("latitude_deg", "longitude_deg")
    place = Geodetic(topic=s.name, latitude=latitude, longitude=longitude)
    return Plan({}, place, None, _earth_fixed(s, "vel_n_m_s", "vel_e_m_s"))


def _local(north: str, east: str, down: str, v_north: str, v_east: str) -> Callable[[Series], Plan]:
    return lambda s: Plan(
        _depth(s, down),
        Local(topic=s.name, north=north, east=east),
        None,
        _earth_fixed(s, v_north, v_east),
    )


def _gives(
    fields: dict[str, str],
    unit: str = "deg",
    *,
    fix: tuple[str, str] | None = None,
    heading: str = "",
    over_ground: tuple[str, str, str] | None = None,
) -> Callable[[Series], Plan]:
    """A message by its fields: channels -> fields, latitude and longitude, and a heading in deg,
    and course in deg, speed and the unit of the speed over ground.
    """

    def plan(s: Series) -> Plan:
        known = {name: field for name, field in fields.items() if s.has(field)}
        place = Geodetic(topic=s.name, latitude=fix[0], longitude=fix[1]) if fix else None
        angle = Angle(topic=s.name, field=heading, unit="deg") if heading else None
        if over_ground is None or not s.has(over_ground[1]):
            return Plan(_maps(s, unit, known), place, angle)
        course, speed, per = over_ground
        moves = CourseSpeed(topic=s.name, course=course, speed=speed, speed_unit=per)
        return Plan(_maps(s, unit, known), place, angle, moves)

    return plan


MESSAGES = (
    Message(
        "Odometry",
        ("Odometry",),
        _navigation,
        _ROS,
        ("pose.pose.position.x", "twist.twist.linear.x"),
    ),
    Message(
        "Pose",
        ("PoseStamped", "Pose", "PoseWithCovarianceStamped"),
        _navigation,
        _ROS,
        ("pose.position.x", "pose.orientation.w"),
    ),
    Message(
        "Twist",
        ("TwistStamped", "Twist", "TwistWithCovarianceStamped"),
        _navigation,
        _ROS,
        ("twist.linear.x", "twist.angular.z"),
    ),
    Message(
        "Pose2D",
        ("Pose2D", "Pose2DStamped"),
        lambda s: Plan(
            {},
            Local(topic=s.name, north="y", east="x"),
            Angle(topic=s.name, field="theta", frame="enu"),
        ),
        _ROS,
        ("x", "y", "theta"),
    ),
    Message("Imu", ("Imu",), _imu, _ROS, ("angular_velocity.z", "linear_acceleration.x")),
    Message("Fix", ("NavSatFix",), _gives({}, fix=_FIX), _ROS, _FIX),
    Message(
        "Wrench", ("WrenchStamped", "Wrench"), _wrench, _ROS, ("wrench.force.x", "wrench.torque.z")
    ),
    Message("Px4LocalPosition", ("vehicle_local_position",), _local("x", "y", "z", "vx", "vy")),
    Message(
        "Px4Attitude",
        ("vehicle_attitude",),
        lambda s: Plan({}, None, Quaternion(topic=s.name, field="q", frame="ned", roll=True)),
    ),
    Message(
        "Px4AngularVelocity",
        ("vehicle_angular_velocity",),
        _gives({"r": "xyz[2]", "p": "xyz[0]"}, "rad/s"),
    ),
    Message("Px4Gps", ("vehicle_gps_position", "sensor_gps"), _px4_gps),
    Message("ArduPilotFilter", ("XKF1", "NKF1"), _local("PN", "PE", "PD", "VN", "VE")),
    Message(
        "ArduPilotAttitude", ("ATT",), _gives({"phi": "Roll", "theta": "Pitch"}, heading="Yaw")
    ),
    Message("ArduPilotImu", ("IMU",), _gives({"r": "GyrZ", "p": "GyrX"}, "rad/s")),
    Message(
        "ArduPilotGps", ("GPS",), _gives({}, fix=("Lat", "Lng"), over_ground=("GCrs", "Spd", "m/s"))
    ),
    Message(
        "NmeaFix",
        ("GGA", "GNS", "RMC", "GLL"),
        _gives({}, fix=_FIX, over_ground=("true_course", "spd_over_grnd", "kn")),
    ),
    Message(
        "NmeaCourse", ("VTG",), _gives({}, over_ground=("true_track", "spd_over_grnd_kts", "kn"))
    ),
    Message("MoosNavigation", ("Variables",), _moos),
    Message("NmeaHeading", ("HDT",), _gives({}, heading="heading")),
    Message("NmeaRateOfTurn", ("ROT",), _gives({"r": "rate_of_turn"}, "deg/s")),
    Message(
        "NmeaRudder", ("RSA",), lambda s: Plan(_maps(s, "deg", {"delta": next(iter(s.fields))}))
    ),
    Message("NmeaRevolutions", ("RPM",), _revolutions),
    Message("Joints", ("JointState",), _joints, _ROS, ("position.0", "effort.0")),
    Message("Number", _NUMBERS, _number, _ROS, ("data",)),
    Message("Named", (), _by_name, _NAMES),
)
"""In the order in which they are asked: the one that says most first."""


def in_ned(series: Series) -> bool:
    """Return whether a series holds messages whose format fixes their frames as NED."""
    return any(m.conversion == _NED and m.fits(series) for m in MESSAGES)


def standard_plan(recording: Recording, declared: Plan) -> Plan:
    """Return the declared plan with what standard messages add to it."""
    plan, conversions, remarks = declared, [], []
    for message in MESSAGES:
        fitting = [s for s in recording.series.values() if len(s) > 1 and message.fits(s)]
        alike = [s.name for s in fitting if {"x", "y", "psi"} <= set(s.fields)]
        if message.name == "Named" and len(alike) > 1:
            text = (
                f"{len(alike)} tables hold positions and headings ({', '.join(alike[:6])}): several"
                " experiments? name one with `table`, or map fields"
            )
            remarks.append(remark("will mislead", "several_tables", text, tables=len(alike)))
        for series in sorted(fitting, key=lambda s: (-len(s), s.name)):
            offered = message.plan(series)
            present = {*plan.channels, *given_by(plan.position, plan.heading, plan.velocity)}
            present |= {"r"} if isinstance(plan.velocity, Derived) else set()
            # a field that is taken under one name is not offered under another
            used = {(entry.topic, entry.field, entry.sender) for entry in plan.channels.values()}
            new = {
                name: entry
                for name, entry in offered.channels.items()
                if name not in present and (entry.topic, entry.field, entry.sender) not in used
            }
            position = None if {"x", "y"} & present else offered.position
            heading = None if "psi" in present else offered.heading
            velocity = None if {"u", "v"} & (present | set(new)) else offered.velocity
            plan = dataclasses.replace(
                plan,
                channels={**plan.channels, **new},
                position=plan.position or position,
                heading=plan.heading or heading,
                velocity=plan.velocity or velocity,
            )
            taken = [*given_by(position, heading, velocity), *new]
            if taken:
                of = f"{', '.join(taken)}: {message.name} of {series.name}"
                conversions.append(f"{of}, {message.conversion}")
    if plan.heading is None and "psi" not in plan.channels and declared.velocity is None:
        # without a heading an earth-fixed velocity has no components in the body
        plan = dataclasses.replace(plan, velocity=None)
    return dataclasses.replace(
        plan,
        conversions=(*declared.conversions, *conversions),
        remarks=(*declared.remarks, *remarks),
    )
