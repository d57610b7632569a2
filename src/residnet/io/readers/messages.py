"""Automatic mapping of standard messages (ROS, PX4, ArduPilot, MAVLink, NMEA, MOOS) to channels.

Each entry of `MESSAGE_KINDS` defines a message by its types, or by its fields in sources without
types, and its channels. If several messages have one channel, the first entry is used; of several
topics of one entry the one with most rows is used.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.log import make_remark
from residnet.core.names import CHANNEL_UNITS
from residnet.io.readers.quantities import (
    AngleHeading,
    ChannelPlan,
    CourseSpeedVelocity,
    DerivedVelocity,
    EarthFixedVelocity,
    FieldMap,
    GeodeticPosition,
    LocalPosition,
    QuaternionHeading,
    list_source_channels,
)
from residnet.io.readers.recording import Recording, Series, normalize_field_path

_ROS_CONVERSION = "REP-103 (ENU, forward-left-up) to NED, forward-starboard-down"
_NED_CONVERSION = "already in NED and forward-starboard-down"
_BY_NAME_CONVERSION = "by channel names, assumed in SI, NED and body axes"
_WORLD_FRAMES = ("map", "odom", "earth", "world", "enu", "ned")
_INTEGERS = tuple(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64))
"""Message types of ROS (package std_msgs) with one whole number."""
_NUMBER_TYPES = ("Float64", "Float32", *_INTEGERS, "Float64Stamped", "Float32Stamped")
_FIX_FIELDS = ("latitude", "longitude")


@dataclass(frozen=True)
class MessageKind:
    """Definition of a standard message.

    Attributes:
        name: name for the log's meta.
        types: names of its message types without their package.
        plan: function from a series to its channels, position, heading and velocity.
        conversion: description of the conversion of frames for the log's meta.
        fields: fields that identify it in sources without message types; empty if only the type
            identifies it.
    """

    name: str
    types: tuple[str, ...]
    plan: Callable[[Series], ChannelPlan]
    conversion: str = _NED_CONVERSION
    fields: tuple[str, ...] = ()

    def matches(self, series: Series) -> bool:
        """Return whether a series consists of these messages."""
        if series.message_type:
            return series.message_type.rsplit("/", 1)[-1] in self.types
        if self.name == "Named":
            return len(_canonical_fields(series)) >= 3
        return bool(self.fields) and all(series.has_field(field) for field in self.fields)


def _map_fields(
    s: Series, unit: str, paths: dict[str, str], **settings: Any
) -> dict[str, FieldMap]:
    return {n: FieldMap(topic=s.name, field=f, unit=unit, **settings) for n, f in paths.items()}


def _find_prefix(s: Series, prefixes: tuple[str, ...], field: str) -> str:
    return next((prefix for prefix in prefixes if s.has_field(prefix + field)), "")


def _map_body_velocities(s: Series, prefix: str) -> dict[str, FieldMap]:
    """Map the velocities of a twist that are not zero everywhere.

    Sources of planar motion leave the other components zero.
    """
    field_maps: dict[str, FieldMap] = {}
    paths = {"u": "linear.x", "v": "linear.y", "r": "angular.z", "p": "angular.x"}
    paths |= {"w": "linear.z", "q": "angular.y"}
    for name, path in paths.items():
        if s.has_field(prefix + path) and s[prefix + path].any():
            field_maps |= _map_fields(
                s, CHANNEL_UNITS[name], {name: prefix + path}, frame="body_fpu"
            )
    return field_maps


def _map_depth(s: Series, field: str, **settings: Any) -> dict[str, FieldMap]:
    """Map the depth if it varies; sources of planar motion leave it zero."""
    is_varying = s.has_field(field) and float(np.nanstd(s[field])) > 0.0
    return _map_fields(s, "m", {"z": field}, **settings) if is_varying else {}


def _find_orientation(s: Series, path: str) -> QuaternionHeading | None:
    """Return the heading of a quaternion in ENU, with roll and pitch if they are not zero."""
    if not all(s.has_field(f"{path}.{axis}") for axis in "xyzw"):
        return None
    has_tilt = bool(s[f"{path}.x"].any() or s[f"{path}.y"].any())
    return QuaternionHeading(topic=s.name, field=path, frame="enu", roll=has_tilt)


def _plan_navigation(s: Series) -> ChannelPlan:
    """Map a pose, a twist, or both."""
    pose_prefix = _find_prefix(s, ("pose.pose.", "pose.", ""), "position.x")
    twist_prefix = _find_prefix(s, ("twist.twist.", "twist.", ""), "linear.x")
    if s.has_field(f"{pose_prefix}position.x"):
        position_source = LocalPosition(
            topic=s.name, north=f"{pose_prefix}position.y", east=f"{pose_prefix}position.x"
        )
        channels = _map_body_velocities(s, twist_prefix) | _map_depth(
            s, f"{pose_prefix}position.z", frame="enu"
        )
        return ChannelPlan(
            channels, position_source, _find_orientation(s, f"{pose_prefix}orientation")
        )
    if (
        s.sender is not None
        and len(s.sender)
        and str(s.sender[0]).strip("/").lower() in _WORLD_FRAMES
    ):
        # a twist in earth axes is ambiguous; the config must map it
        return ChannelPlan()
    return ChannelPlan(_map_body_velocities(s, twist_prefix))


def _plan_imu(s: Series) -> ChannelPlan:
    """Map the angular rates of an IMU, and its orientation if it has one."""
    rates = {"r": "angular_velocity.z", "p": "angular_velocity.x"}
    rate_fields = {name: path for name, path in rates.items() if s.has_field(path)}
    # drivers without orientation set the covariance to -1, or the quaternion to zeros
    covariance = "orientation_covariance.0"
    lacks_orientation = s.has_field(covariance) and bool((s[covariance] == -1.0).all())
    lacks_orientation = (
        lacks_orientation or not s.has_field("orientation.w") or not s["orientation.w"].any()
    )
    heading = None if lacks_orientation else _find_orientation(s, "orientation")
    return ChannelPlan(_map_fields(s, "rad/s", rate_fields, frame="body_fpu"), None, heading)


def _plan_wrench(s: Series) -> ChannelPlan:
    """Map forces and moment in body axes with zero-order hold."""
    prefix = _find_prefix(s, ("wrench.",), "force.x")
    body_settings: dict[str, Any] = {"frame": "body_fpu", "hold": True}
    forces = _map_fields(
        s, "N", {"tau_x": f"{prefix}force.x", "tau_y": f"{prefix}force.y"}, **body_settings
    )
    return ChannelPlan(
        forces | _map_fields(s, "N m", {"tau_n": f"{prefix}torque.z"}, **body_settings)
    )


def _plan_number(s: Series) -> ChannelPlan:
    """Map a message with one number to the channel that the end of its topic names."""
    if not s.has_field("data"):
        return ChannelPlan()
    name_parts = [part for part in normalize_field_path(s.name).split("_") if part]
    name_suffixes = ["_".join(name_parts[k:]) for k in range(len(name_parts))]
    name = next(
        (suffix for suffix in name_suffixes if suffix in CHANNEL_UNITS),
        "_".join(name_parts) or "data",
    )
    return ChannelPlan(_map_fields(s, CHANNEL_UNITS.get(name, "-"), {name: "data"}, hold=True))


def _plan_joints(s: Series) -> ChannelPlan:
    """Map positions, velocities and efforts of joints to channels with the names of the joints."""
    channels: dict[str, FieldMap] = {}
    for path in s.fields:
        quantity, _, joint = path.partition(".")
        unit = {"position": "rad", "velocity": "rad/s", "effort": "N m"}.get(quantity)
        if unit is not None and joint:
            name = joint if quantity == "position" else f"{joint}_{quantity}"
            # a joint with the name of a channel in another unit is another quantity
            name = name if CHANNEL_UNITS.get(name, unit) == unit else f"{name}_{quantity}"
            channels |= _map_fields(s, unit, {name: path})
    return ChannelPlan(channels)


def _plan_moos(s: Series) -> ChannelPlan:
    """Map position and heading of MOOS-IvP's navigation variables."""
    position_source = None
    if s.has_field("NAV_X") and s.has_field("NAV_Y"):
        position_source = LocalPosition(topic=s.name, north="NAV_Y", east="NAV_X")
    heading = (
        AngleHeading(topic=s.name, field="NAV_HEADING", unit="deg")
        if s.has_field("NAV_HEADING")
        else None
    )
    return ChannelPlan({}, position_source, heading)


def _canonical_fields(s: Series) -> list[str]:
    """Return the non-empty fields with names of canonical channels."""
    canonical_names = (name for name in s.fields if name in CHANNEL_UNITS and name != "t")
    return [name for name in canonical_names if s[name].size and not np.isnan(s[name]).all()]


def _plan_canonical_fields(s: Series) -> ChannelPlan:
    """Map fields with names of canonical channels."""
    names = _canonical_fields(s)
    heading = AngleHeading(topic=s.name, field="psi") if "psi" in names else None
    position_source = (
        LocalPosition(topic=s.name, north="x", east="y") if {"x", "y"} <= set(names) else None
    )
    channels: dict[str, FieldMap] = {}
    for name in names:
        if name != "psi" and not (position_source and name in ("x", "y")):
            is_command = name.startswith("cmd_")
            channels |= _map_fields(s, CHANNEL_UNITS[name], {name: name}, hold=is_command)
    return ChannelPlan(channels, position_source, heading)


def _map_instances(
    s: Series, unit: str, field: str, channel: str, sides: dict[str, str], **settings: Any
) -> dict[str, FieldMap]:
    """Map a field with one channel for each device on board; devices are the senders of the rows.

    Args:
        s: series.
        unit: unit of the field.
        field: field; without a value there is no channel.
        channel: name of the channel if there is one device; otherwise its prefix.
        sides: device -> suffix of the channel; other devices have their number.
        settings: further settings of the channel.
    """
    if not s.has_field(field) or not np.isfinite(s[field]).any():
        return {}
    senders = [] if s.sender is None else sorted(set(s.sender.tolist()))
    if len(senders) < 2:
        return _map_fields(s, unit, {channel: field}, **settings)
    channels: dict[str, FieldMap] = {}
    for sender in senders:
        if np.isfinite(s[field][s.sender == sender]).any():
            name = f"{channel}_{sides.get(sender, sender)}"
            channels |= _map_fields(s, unit, {name: field}, sender=sender, **settings)
    return channels


def _plan_revolutions(s: Series) -> ChannelPlan:
    """Map the shaft speeds of NMEA RPM sentences, with one channel for each engine."""
    # NMEA 0183: odd engine numbers are starboard, even ones port
    return ChannelPlan(_map_instances(s, "rpm", "speed", "n", {"1": "stbd", "2": "port"}))


_NMEA_2000_SIDES = {"0": "port", "1": "stbd"}
"""Instance of an engine or a rudder -> side of a vessel with two (look-up ENGINE_INSTANCE)."""


def _plan_nmea_2000_rudder(s: Series) -> ChannelPlan:
    """Map the angles of rudders, and the ordered angles if the network has them."""
    channels = _map_instances(s, "rad", "position", "delta", _NMEA_2000_SIDES)
    ordered = _map_instances(s, "rad", "angleOrder", "cmd_delta", _NMEA_2000_SIDES, hold=True)
    return ChannelPlan(channels | ordered)


def _plan_nmea_2000_attitude(s: Series) -> ChannelPlan:
    """Map roll and pitch; the yaw angle is the heading of networks without vesselHeading."""
    fields = {"phi": "roll", "theta": "pitch"}
    measured = {name: path for name, path in fields.items() if np.isfinite(s[path]).any()}
    has_yaw = bool(np.isfinite(s["yaw"]).any())
    heading = AngleHeading(topic=s.name, field="yaw") if has_yaw else None
    return ChannelPlan(_map_fields(s, "rad", measured), None, heading)


def _plan_nmea_2000_course(s: Series) -> ChannelPlan:
    """Map course and speed over ground."""
    source = CourseSpeedVelocity(topic=s.name, course="cogTrue", course_unit="rad", speed="sog")
    return ChannelPlan({}, None, None, source)


def _earth_fixed_velocity(s: Series, north: str, east: str) -> EarthFixedVelocity | None:
    return EarthFixedVelocity(topic=s.name, north=north, east=east) if s.has_field(north) else None


def _plan_px4_gps(s: Series) -> ChannelPlan:
    latitude, longitude = (
        ("lat", "lon") if s.has_field("lat") else ("latitude_deg", "longitude_deg")
    )
    position_source = GeodeticPosition(topic=s.name, latitude=latitude, longitude=longitude)
    return ChannelPlan(
        {}, position_source, None, _earth_fixed_velocity(s, "vel_n_m_s", "vel_e_m_s")
    )


def _plan_mavlink_attitude(s: Series) -> ChannelPlan:
    """Map the Euler angles and the body rates."""
    angles = _map_fields(s, "rad", {"phi": "roll", "theta": "pitch"})
    rates = _map_fields(s, "rad/s", {"r": "yawspeed", "p": "rollspeed", "q": "pitchspeed"})
    return ChannelPlan(angles | rates, None, AngleHeading(topic=s.name, field="yaw"))


def _plan_mavlink_position(s: Series) -> ChannelPlan:
    """Map the fix, the heading and the earth-fixed velocity of the autopilot's filter."""
    has_heading = bool(np.isfinite(s["hdg"]).any())
    return ChannelPlan(
        {},
        GeodeticPosition(topic=s.name, latitude="lat", longitude="lon"),
        AngleHeading(topic=s.name, field="hdg", unit="deg") if has_heading else None,
        _earth_fixed_velocity(s, "vx", "vy"),
    )


def _make_local_position_plan(
    north: str, east: str, down: str, v_north: str, v_east: str
) -> Callable[[Series], ChannelPlan]:
    return lambda s: ChannelPlan(
        _map_depth(s, down),
        LocalPosition(topic=s.name, north=north, east=east),
        None,
        _earth_fixed_velocity(s, v_north, v_east),
    )


def _make_field_plan(
    channel_fields: dict[str, str],
    unit: str = "deg",
    *,
    fix_fields: tuple[str, str] | None = None,
    heading: str = "",
    course_speed_fields: tuple[str, str, str] | None = None,
) -> Callable[[Series], ChannelPlan]:
    """Return a function that maps a message with fixed field names.

    Args:
        channel_fields: channel -> field.
        unit: unit of these fields.
        fix_fields: fields of latitude and longitude in deg.
        heading: field of the heading in deg; empty if there is none.
        course_speed_fields: field of the course in deg, field of the speed over ground, and the
            unit of the speed.
    """

    def make_plan(s: Series) -> ChannelPlan:
        available_fields = {
            name: field for name, field in channel_fields.items() if s.has_field(field)
        }
        position_source = (
            GeodeticPosition(topic=s.name, latitude=fix_fields[0], longitude=fix_fields[1])
            if fix_fields
            else None
        )
        heading_source = AngleHeading(topic=s.name, field=heading, unit="deg") if heading else None
        if course_speed_fields is None or not s.has_field(course_speed_fields[1]):
            return ChannelPlan(
                _map_fields(s, unit, available_fields), position_source, heading_source
            )
        course, speed, speed_unit = course_speed_fields
        velocity_source = CourseSpeedVelocity(
            topic=s.name, course=course, speed=speed, speed_unit=speed_unit
        )
        return ChannelPlan(
            _map_fields(s, unit, available_fields), position_source, heading_source, velocity_source
        )

    return make_plan


KNOWN_COMMANDS: dict[tuple[str, str], tuple[str, dict[str, Any]]] = {
    ("Variables", "DESIRED_THRUST"): ("cmd_throttle", {"unit": "%"}),
    ("Variables", "DESIRED_THRUST_L"): ("cmd_throttle_port", {"unit": "%"}),
    ("Variables", "DESIRED_THRUST_R"): ("cmd_throttle_stbd", {"unit": "%"}),
    ("CTUN", "Steer"): ("cmd_delta", {"unit": "deg", "scale": 0.01}),
    ("CTUN", "ThrOut"): ("cmd_throttle", {"unit": "%"}),
}
"""Message type without package and field of a command whose unit the format defines -> channel and
settings. MOOS-IvP: thrust from -100 to 100 per cent (documentation of pMarinePID and uSimMarine).
ArduRover to 3.x: steering from -4500 to 4500 (hundredths of a degree), throttle in per cent."""


MESSAGE_KINDS = (
    MessageKind(
        "Odometry",
        ("Odometry",),
        _plan_navigation,
        _ROS_CONVERSION,
        ("pose.pose.position.x", "twist.twist.linear.x"),
    ),
    MessageKind(
        "Pose",
        ("PoseStamped", "Pose", "PoseWithCovarianceStamped"),
        _plan_navigation,
        _ROS_CONVERSION,
        ("pose.position.x", "pose.orientation.w"),
    ),
    MessageKind(
        "Twist",
        ("TwistStamped", "Twist", "TwistWithCovarianceStamped"),
        _plan_navigation,
        _ROS_CONVERSION,
        ("twist.linear.x", "twist.angular.z"),
    ),
    MessageKind(
        "Pose2D",
        ("Pose2D", "Pose2DStamped"),
        lambda s: ChannelPlan(
            {},
            LocalPosition(topic=s.name, north="y", east="x"),
            AngleHeading(topic=s.name, field="theta", frame="enu"),
        ),
        _ROS_CONVERSION,
        ("x", "y", "theta"),
    ),
    MessageKind(
        "Imu", ("Imu",), _plan_imu, _ROS_CONVERSION, ("angular_velocity.z", "linear_acceleration.x")
    ),
    MessageKind(
        "Fix",
        ("NavSatFix",),
        _make_field_plan({}, fix_fields=_FIX_FIELDS),
        _ROS_CONVERSION,
        _FIX_FIELDS,
    ),
    MessageKind(
        "Wrench",
        ("WrenchStamped", "Wrench"),
        _plan_wrench,
        _ROS_CONVERSION,
        ("wrench.force.x", "wrench.torque.z"),
    ),
    MessageKind(
        "Px4LocalPosition",
        ("vehicle_local_position",),
        _make_local_position_plan("x", "y", "z", "vx", "vy"),
    ),
    MessageKind(
        "Px4Attitude",
        ("vehicle_attitude",),
        lambda s: ChannelPlan(
            {}, None, QuaternionHeading(topic=s.name, field="q", frame="ned", roll=True)
        ),
    ),
    MessageKind(
        "Px4AngularVelocity",
        ("vehicle_angular_velocity",),
        _make_field_plan({"r": "xyz[2]", "p": "xyz[0]"}, "rad/s"),
    ),
    MessageKind("Px4Gps", ("vehicle_gps_position", "sensor_gps"), _plan_px4_gps),
    MessageKind(
        "ArduPilotFilter",
        ("XKF1", "NKF1", "EKF1"),
        _make_local_position_plan("PN", "PE", "PD", "VN", "VE"),
    ),
    MessageKind(
        "ArduPilotAttitude",
        ("ATT",),
        _make_field_plan({"phi": "Roll", "theta": "Pitch"}, heading="Yaw"),
    ),
    MessageKind("ArduPilotImu", ("IMU",), _make_field_plan({"r": "GyrZ", "p": "GyrX"}, "rad/s")),
    MessageKind(
        "ArduPilotGps",
        ("GPS",),
        _make_field_plan({}, fix_fields=("Lat", "Lng"), course_speed_fields=("GCrs", "Spd", "m/s")),
    ),
    MessageKind(
        "MavlinkLocalPosition",
        ("LOCAL_POSITION_NED",),
        _make_local_position_plan("x", "y", "z", "vx", "vy"),
    ),
    MessageKind("MavlinkAttitude", ("ATTITUDE",), _plan_mavlink_attitude),
    MessageKind("MavlinkPosition", ("GLOBAL_POSITION_INT",), _plan_mavlink_position),
    MessageKind(
        "MavlinkGps",
        ("GPS_RAW_INT",),
        _make_field_plan({}, fix_fields=("lat", "lon"), course_speed_fields=("cog", "vel", "m/s")),
    ),
    MessageKind(
        "NmeaFix",
        ("GGA", "GNS", "RMC", "GLL"),
        _make_field_plan(
            {}, fix_fields=_FIX_FIELDS, course_speed_fields=("true_course", "spd_over_grnd", "kn")
        ),
    ),
    MessageKind(
        "NmeaCourse",
        ("VTG",),
        _make_field_plan({}, course_speed_fields=("true_track", "spd_over_grnd_kts", "kn")),
    ),
    MessageKind("MoosNavigation", ("Variables",), _plan_moos),
    MessageKind("NmeaHeading", ("HDT",), _make_field_plan({}, heading="heading")),
    MessageKind("NmeaCompass", ("HDG", "HDM"), _make_field_plan({}, heading="heading_true")),
    MessageKind("NmeaRateOfTurn", ("ROT",), _make_field_plan({"r": "rate_of_turn"}, "deg/s")),
    MessageKind(
        "NmeaRudder",
        ("RSA",),
        lambda s: ChannelPlan(_map_fields(s, "deg", {"delta": next(iter(s.fields))})),
    ),
    MessageKind("NmeaRevolutions", ("RPM",), _plan_revolutions),
    MessageKind(
        "Nmea2000Fix", ("positionRapidUpdate",), _make_field_plan({}, fix_fields=_FIX_FIELDS)
    ),
    MessageKind(
        "Nmea2000SlowFix", ("gnssPositionData",), _make_field_plan({}, fix_fields=_FIX_FIELDS)
    ),
    MessageKind(
        "Nmea2000Heading",
        ("vesselHeading",),
        lambda s: ChannelPlan({}, None, AngleHeading(topic=s.name, field="headingTrue")),
    ),
    MessageKind("Nmea2000RateOfTurn", ("rateOfTurn",), _make_field_plan({"r": "rate"}, "rad/s")),
    MessageKind("Nmea2000Attitude", ("attitude",), _plan_nmea_2000_attitude),
    MessageKind("Nmea2000Course", ("cogSogRapidUpdate",), _plan_nmea_2000_course),
    MessageKind("Nmea2000Rudder", ("rudder",), _plan_nmea_2000_rudder),
    MessageKind(
        "Nmea2000Engine",
        ("engineParametersRapidUpdate",),
        lambda s: ChannelPlan(_map_instances(s, "rpm", "speed", "n", _NMEA_2000_SIDES)),
    ),
    MessageKind(
        "Nmea2000ElectricDrive",
        ("electricDriveStatusRapidUpdate",),
        lambda s: ChannelPlan(
            _map_instances(s, "rpm", "rotationalShaftSpeed", "n", _NMEA_2000_SIDES)
        ),
    ),
    MessageKind(
        "Joints", ("JointState",), _plan_joints, _ROS_CONVERSION, ("position.0", "effort.0")
    ),
    MessageKind("Number", _NUMBER_TYPES, _plan_number, _ROS_CONVERSION, ("data",)),
    MessageKind("Named", (), _plan_canonical_fields, _BY_NAME_CONVERSION),
)
"""Standard messages in order of precedence, those with most channels first."""


def is_ned_format(series: Series) -> bool:
    """Return whether a series has a message type that is defined in NED."""
    return any(m.conversion == _NED_CONVERSION and m.matches(series) for m in MESSAGE_KINDS)


def extend_with_standard_messages(recording: Recording, declared: ChannelPlan) -> ChannelPlan:
    """Add the channels of standard messages to a plan.

    Args:
        recording: recording with aligned clocks.
        declared: plan of the config, which has precedence.
    """
    plan = declared
    conversions = []
    remarks = []
    for message in MESSAGE_KINDS:
        matching_series = [
            s for s in recording.series.values() if len(s) > 1 and message.matches(s)
        ]
        pose_tables = [s.name for s in matching_series if {"x", "y", "psi"} <= set(s.fields)]
        if message.name == "Named" and len(pose_tables) > 1:
            text = (
                f"{len(pose_tables)} tables have positions and headings"
                f" ({', '.join(pose_tables[:6])}), probably of several experiments; select one with"
                " `table`, or map fields"
            )
            remarks.append(
                make_remark("will mislead", "several_tables", text, tables=len(pose_tables))
            )
        for series in sorted(matching_series, key=lambda s: (-len(s), s.name)):
            message_plan = message.plan(series)
            planned_channels = {
                *plan.channels,
                *list_source_channels(plan.position, plan.heading, plan.velocity),
            }
            planned_channels |= {"r"} if isinstance(plan.velocity, DerivedVelocity) else set()
            # a field that the config maps under one name is not mapped under another
            used_fields = {
                (entry.topic, entry.field, entry.sender) for entry in plan.channels.values()
            }
            new_channels = {
                name: entry
                for name, entry in message_plan.channels.items()
                if name not in planned_channels
                and (entry.topic, entry.field, entry.sender) not in used_fields
            }
            position = None if {"x", "y"} & planned_channels else message_plan.position
            heading = None if "psi" in planned_channels else message_plan.heading
            velocity = (
                None
                if {"u", "v"} & (planned_channels | set(new_channels))
                else message_plan.velocity
            )
            plan = dataclasses.replace(
                plan,
                channels={**plan.channels, **new_channels},
                position=plan.position or position,
                heading=plan.heading or heading,
                velocity=plan.velocity or velocity,
            )
            added_channels = [*list_source_channels(position, heading, velocity), *new_channels]
            if added_channels:
                source_text = f"{', '.join(added_channels)}: {message.name} of {series.name}"
                conversions.append(f"{source_text}, {message.conversion}")
    if plan.heading is None and "psi" not in plan.channels and declared.velocity is None:
        # an earth-fixed velocity without a heading cannot be rotated to body axes
        plan = dataclasses.replace(plan, velocity=None)
    return dataclasses.replace(
        plan,
        conversions=(*declared.conversions, *conversions),
        remarks=(*declared.remarks, *remarks),
    )
