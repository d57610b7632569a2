"""Standard messages of ROS map themselves to channels by REP-103 (ENU, forward-left-up).

A topic's message type decides where the source has types; a table without one is recognised by its
fields.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from residnet.core.names import CHANNEL_UNITS
from residnet.data.readers.composing.compose import Plan
from residnet.data.readers.composing.quantities import (
    Angle,
    FieldMap,
    Geodetic,
    Local,
    Quaternion,
)
from residnet.data.readers.messages.message import Message
from residnet.data.readers.recording import Series, key_of

_WORLD = ("map", "odom", "earth", "world", "enu", "ned")


def _body(series: Series, prefix: str) -> dict[str, FieldMap]:
    """Return the velocities in forward-left-up axes."""
    paths = {"u": "linear.x", "v": "linear.y", "r": "angular.z", "p": "angular.x"}
    si = {"u": "m/s", "v": "m/s", "r": "rad/s", "p": "rad/s"}
    fields = {name: f"{prefix}{path}" for name, path in paths.items()}
    measured = {
        name: path for name, path in fields.items() if series.has(path) and series[path].any()
    }
    return {
        name: FieldMap(topic=series.name, field=path, unit=si[name], frame="body_fpu")
        for name, path in measured.items()
    }


def _heading(series: Series, path: str) -> Quaternion | None:
    if not all(series.has(f"{path}.{axis}") for axis in "xyzw"):
        return None
    tilted = bool(series[f"{path}.x"].any() or series[f"{path}.y"].any())
    return Quaternion(topic=series.name, field=path, frame="enu", roll=tilted)


@final
class Odometry(Message):
    """nav_msgs/Odometry: pose in the world, twist in the body."""

    types = ("Odometry",)
    signature = ("pose.pose.position.x", "twist.twist.linear.x")

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        position = Local(
            topic=series.name, north="pose.pose.position.y", east="pose.pose.position.x"
        )
        return Plan(
            _body(series, "twist.twist."), position, _heading(series, "pose.pose.orientation")
        )


@final
class Pose(Message):
    """geometry_msgs/PoseStamped, with or without covariance."""

    types = ("PoseStamped", "Pose", "PoseWithCovarianceStamped")
    signature = ("pose.position.x", "pose.orientation.w")

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        prefix = next((p for p in ("pose.pose.", "pose.", "") if series.has(f"{p}position.x")), "")
        position = Local(topic=series.name, north=f"{prefix}position.y", east=f"{prefix}position.x")
        return Plan({}, position, _heading(series, f"{prefix}orientation"))


@final
class Twist(Message):
    """geometry_msgs/TwistStamped, with or without covariance, in body axes."""

    types = ("TwistStamped", "Twist", "TwistWithCovarianceStamped")
    signature = ("twist.linear.x", "twist.angular.z")

    def plan(self, series: Series) -> Plan:
        """Return the channels of a series; a twist in the world frame is left to the config."""
        if (
            series.sender is not None
            and len(series.sender)
            and str(series.sender[0]).strip("/").lower() in _WORLD
        ):
            return Plan()
        prefix = next((p for p in ("twist.twist.", "twist.", "") if series.has(f"{p}linear.x")), "")
        return Plan(_body(series, prefix))


@final
class Imu(Message):
    """sensor_msgs/Imu: yaw rate, and heading where the sensor has one."""

    types = ("Imu",)
    signature = ("angular_velocity.z", "linear_acceleration.x")

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        rates = {"r": "angular_velocity.z", "p": "angular_velocity.x"}
        channels = {
            n: FieldMap(topic=series.name, field=path, unit="rad/s", frame="body_fpu")
            for n, path in rates.items()
            if series.has(path)
        }
        # the message's own sign that there is no orientation
        zeros = series.has("orientation_covariance.0") and bool(
            (series["orientation_covariance.0"] == -1.0).all()
        )
        heading = (
            None
            if zeros or not series.has("orientation.w") or not series["orientation.w"].any()
            else _heading(series, "orientation")
        )
        return Plan(channels, None, heading)


@final
class Fix(Message):
    """The message sensor_msgs/NavSatFix of ROS."""

    types = ("NavSatFix",)
    signature = ("latitude", "longitude")

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan({}, Geodetic(topic=series.name))


@final
class Wrench(Message):
    """geometry_msgs/WrenchStamped: generalised force in body axes."""

    types = ("WrenchStamped", "Wrench")
    signature = ("wrench.force.x", "wrench.torque.z")

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        prefix = "wrench." if series.has("wrench.force.x") else ""
        parts = {"tau_x": ("force.x", "N"), "tau_y": ("force.y", "N"), "tau_n": ("torque.z", "N m")}
        channels = {
            n: FieldMap(
                topic=series.name, field=prefix + path, unit=unit, frame="body_fpu", hold=True
            )
            for n, (path, unit) in parts.items()
        }
        return Plan(channels)


@final
class Number(Message):
    """std_msgs/Float64 and its kin: one number; the topic's name is the channel's."""

    types = (
        "Float64",
        "Float32",
        "Int8",
        "Int16",
        "Int32",
        "Int64",
        "UInt8",
        "UInt16",
        "UInt32",
        "UInt64",
        "Float64Stamped",
        "Float32Stamped",
    )
    signature = ("data",)

    def plan(self, series: Series) -> Plan:
        """Return the channel of a series.

        A channel that residnet knows is taken to be in its SI unit, any other has none.
        """
        if not series.has("data"):
            return Plan()
        name = _channel_name(series.name)
        return Plan(
            {
                name: FieldMap(
                    topic=series.name, field="data", unit=CHANNEL_UNITS.get(name, "-"), hold=True
                )
            }
        )


@final
class Joints(Message):
    """sensor_msgs/JointState: one channel per joint and quantity."""

    types = ("JointState",)
    signature = ("position.0", "effort.0")

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        channels = {}
        for path in series.fields:
            what, _, joint = path.partition(".")
            unit = {"position": "rad", "velocity": "rad/s", "effort": "N m"}.get(what)
            if unit is None or not joint:
                continue
            name = joint if what == "position" else f"{joint}_{what}"
            # a joint of a known name in another unit is another quantity
            name = name if CHANNEL_UNITS.get(name, unit) == unit else f"{name}_{what}"
            channels[name] = FieldMap(topic=series.name, field=path, unit=unit)
        return Plan(channels)


@final
class Named(Message):
    """A table without a type whose fields bear the names of residnet's channels.

    They are taken to be in SI, NED and body axes.
    """

    types = ()
    signature = ()
    conversions = "by its names, taken to be in SI, NED and body axes"
    _enough: ClassVar[int] = 3

    def fits(self, series: Series) -> bool:
        """Return whether the fields of a series bear such names."""
        return not series.kind and len(self._names(series)) >= self._enough

    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        names = self._names(series)
        heading = Angle(topic=series.name, field="psi") if "psi" in names else None
        position = (
            Local(topic=series.name, north="x", east="y") if {"x", "y"} <= set(names) else None
        )
        taken = {"psi", *(("x", "y") if position else ())}
        plain = [name for name in names if name not in taken]
        channels = {
            name: FieldMap(
                topic=series.name,
                field=name,
                unit=CHANNEL_UNITS[name],
                hold=name.startswith("cmd_"),
            )
            for name in plain
        }
        return Plan(channels, position, heading)

    @staticmethod
    def _names(series: Series) -> list[str]:
        return [
            name
            for name in series.fields
            if name in CHANNEL_UNITS
            and name != "t"
            and series[name].size
            and not np.isnan(series[name]).all()
        ]


def _channel_name(topic: str) -> str:
    """Return a channel's name from a topic's: the last part if known, else all parts."""
    parts = [part for part in key_of(topic).split("_") if part]
    for k in range(len(parts)):
        name = "_".join(parts[k:])
        if name in CHANNEL_UNITS:
            return name
    return "_".join(parts) or "data"
