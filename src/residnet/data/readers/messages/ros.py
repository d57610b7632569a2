"""Standard messages of ROS map themselves to channels by REP-103 (ENU, forward-left-up).

A topic's message type decides where the source has types; a table without one is recognised by its
fields.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, final

import numpy as np

from residnet.core.names import CHANNEL_UNITS
from residnet.data.readers.composing.compose import Plan
from residnet.data.readers.composing.quantities import (
    Angle,
    Derived,
    FieldMap,
    Geodetic,
    Local,
    Quaternion,
)
from residnet.data.readers.messages.marine import MARINE
from residnet.data.readers.messages.message import Message
from residnet.data.readers.recording import Recording, Series, key_of, remark

_WORLD = ("map", "odom", "earth", "world", "enu", "ned")


def _body(one: Series, prefix: str) -> dict[str, FieldMap]:
    """Return the velocities in forward-left-up axes."""
    paths = {"u": "linear.x", "v": "linear.y", "r": "angular.z", "p": "angular.x"}
    si = {"u": "m/s", "v": "m/s", "r": "rad/s", "p": "rad/s"}
    fields = {name: f"{prefix}{path}" for name, path in paths.items()}
    told = {name: path for name, path in fields.items() if one.has(path) and one[path].any()}
    return {
        name: FieldMap(topic=one.name, field=path, unit=si[name], frame="body_fpu")
        for name, path in told.items()
    }


def _heading(one: Series, path: str) -> Quaternion | None:
    if not all(one.has(f"{path}.{axis}") for axis in "xyzw"):
        return None
    tilted = bool(one[f"{path}.x"].any() or one[f"{path}.y"].any())
    return Quaternion(topic=one.name, field=path, frame="enu", roll=tilted)


@final
class Odometry(Message):
    """nav_msgs/Odometry: pose in the world, twist in the body."""

    types = ("Odometry",)
    signature = ("pose.pose.position.x", "twist.twist.linear.x")

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        position = Local(topic=one.name, north="pose.pose.position.y", east="pose.pose.position.x")
        return Plan(_body(one, "twist.twist."), position, _heading(one, "pose.pose.orientation"))


@final
class Pose(Message):
    """geometry_msgs/PoseStamped, with or without covariance."""

    types = ("PoseStamped", "Pose", "PoseWithCovarianceStamped")
    signature = ("pose.position.x", "pose.orientation.w")

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        prefix = next((p for p in ("pose.pose.", "pose.", "") if one.has(f"{p}position.x")), "")
        position = Local(topic=one.name, north=f"{prefix}position.y", east=f"{prefix}position.x")
        return Plan({}, position, _heading(one, f"{prefix}orientation"))


@final
class Twist(Message):
    """geometry_msgs/TwistStamped, with or without covariance, in body axes."""

    types = ("TwistStamped", "Twist", "TwistWithCovarianceStamped")
    signature = ("twist.linear.x", "twist.angular.z")

    def plan(self, one: Series) -> Plan:
        """Return the channels of a series; a twist in the world frame is left to the config."""
        if (
            one.sender is not None
            and len(one.sender)
            and str(one.sender[0]).strip("/").lower() in _WORLD
        ):
            return Plan()
        prefix = next((p for p in ("twist.twist.", "twist.", "") if one.has(f"{p}linear.x")), "")
        return Plan(_body(one, prefix))


@final
class Imu(Message):
    """sensor_msgs/Imu: yaw rate, and heading where the sensor has one."""

    types = ("Imu",)
    signature = ("angular_velocity.z", "linear_acceleration.x")

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        rates = {"r": "angular_velocity.z", "p": "angular_velocity.x"}
        channels = {
            n: FieldMap(topic=one.name, field=path, unit="rad/s", frame="body_fpu")
            for n, path in rates.items()
            if one.has(path)
        }
        # the message's own sign that there is no orientation
        none = one.has("orientation_covariance.0") and bool(
            (one["orientation_covariance.0"] == -1.0).all()
        )
        heading = (
            None
            if none or not one.has("orientation.w") or not one["orientation.w"].any()
            else _heading(one, "orientation")
        )
        return Plan(channels, None, heading)


@final
class Fix(Message):
    """The message sensor_msgs/NavSatFix of ROS."""

    types = ("NavSatFix",)
    signature = ("latitude", "longitude")

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        return Plan({}, Geodetic(topic=one.name))


@final
class Wrench(Message):
    """geometry_msgs/WrenchStamped: generalised force in body axes."""

    types = ("WrenchStamped", "Wrench")
    signature = ("wrench.force.x", "wrench.torque.z")

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        prefix = "wrench." if one.has("wrench.force.x") else ""
        parts = {"tau_x": ("force.x", "N"), "tau_y": ("force.y", "N"), "tau_n": ("torque.z", "N m")}
        channels = {
            n: FieldMap(topic=one.name, field=prefix + path, unit=unit, frame="body_fpu", hold=True)
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

    def plan(self, one: Series) -> Plan:
        """Return the channel of a series.

        A channel that residnet knows is taken to be in its SI unit, any other has none.
        """
        if not one.has("data"):
            return Plan()
        name = _channel_name(one.name)
        return Plan(
            {
                name: FieldMap(
                    topic=one.name, field="data", unit=CHANNEL_UNITS.get(name, "-"), hold=True
                )
            }
        )


@final
class Joints(Message):
    """sensor_msgs/JointState: one channel per joint and quantity."""

    types = ("JointState",)
    signature = ("position.0", "effort.0")

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        channels = {}
        for path in one.fields:
            what, _, joint = path.partition(".")
            unit = {"position": "rad", "velocity": "rad/s", "effort": "N m"}.get(what)
            if unit is None or not joint:
                continue
            name = joint if what == "position" else f"{joint}_{what}"
            # a joint of a known name in another unit is another quantity
            name = name if CHANNEL_UNITS.get(name, unit) == unit else f"{name}_{what}"
            channels[name] = FieldMap(topic=one.name, field=path, unit=unit)
        return Plan(channels)


@final
class Named(Message):
    """A table without a type whose fields bear the names of residnet's channels.

    They are taken to be in SI, NED and body axes.
    """

    types = ()
    signature = ()
    said = "by its names, taken to be in SI, NED and body axes"
    _enough: ClassVar[int] = 3

    def fits(self, one: Series) -> bool:
        """Return whether the fields of a series bear such names."""
        return not one.kind and len(self._names(one)) >= self._enough

    def plan(self, one: Series) -> Plan:
        """Return the channels that a series of this message gives."""
        names = self._names(one)
        heading = Angle(topic=one.name, field="psi") if "psi" in names else None
        position = Local(topic=one.name, north="x", east="y") if {"x", "y"} <= set(names) else None
        taken = {"psi", *(("x", "y") if position else ())}
        plain = [name for name in names if name not in taken]
        channels = {
            name: FieldMap(
                topic=one.name, field=name, unit=CHANNEL_UNITS[name], hold=name.startswith("cmd_")
            )
            for name in plain
        }
        return Plan(channels, position, heading)

    @staticmethod
    def _names(one: Series) -> list[str]:
        return [
            name
            for name in one.fields
            if name in CHANNEL_UNITS
            and name != "t"
            and one[name].size
            and not np.isnan(one[name]).all()
        ]


# in the order in which they are asked: the one that says most first
MESSAGES: tuple[Message, ...] = (
    Odometry(),
    Pose(),
    Twist(),
    Imu(),
    Fix(),
    Wrench(),
    *MARINE,
    Joints(),
    Number(),
    Named(),
)


def standard_plan(recording: Recording, declared: Plan) -> Plan:
    """Return the declared plan with what standard messages add to it.

    The messages that say most come first, then the busiest topic of each kind.
    """
    plan, said, remarks = declared, [], []
    for message in MESSAGES:
        fitting = [one for one in recording.series.values() if len(one) > 1 and message.fits(one)]
        alike = [
            one.name
            for one in fitting
            if isinstance(message, Named) and {"x", "y", "psi"} <= set(one.fields)
        ]
        if len(alike) > 1:
            text = (
                f"{len(alike)} tables hold positions and headings ({', '.join(alike[:6])}): several"
                " experiments? name one with `table`, or map fields"
            )
            remarks.append(remark("will mislead", "several_tables", text, tables=len(alike)))
        for one in sorted(fitting, key=lambda one: (-len(one), one.name)):
            offered = message.plan(one)
            plan, taken = _joined(plan, offered)
            if taken:
                said.append(
                    f"{', '.join(taken)}: {type(message).__name__} of {one.name}, REP-103 (ENU,"
                    " forward-left-up) to NED, forward-starboard-down"
                )
    if plan.heading is None and "psi" not in plan.channels and declared.velocity is None:
        # without a heading an earth-fixed velocity has no components in the body
        plan = dataclasses.replace(plan, velocity=None)
    return dataclasses.replace(
        plan, said=(*declared.said, *said), remarks=(*declared.remarks, *remarks)
    )


def _joined(plan: Plan, offered: Plan) -> tuple[Plan, Sequence[str]]:
    """Return a plan with what it lacks of another, and the names of that."""
    given = (
        set(plan.channels)
        | ({"x", "y"} if plan.position else set())
        | ({"psi"} if plan.heading else set())
    )
    given |= {"u", "v"} if plan.velocity else set()
    given |= {"r"} if isinstance(plan.velocity, Derived) else set()
    new = {name: entry for name, entry in offered.channels.items() if name not in given}
    position = offered.position if not {"x", "y"} & given else None
    heading = offered.heading if "psi" not in given else None
    velocity = offered.velocity if not {"u", "v"} & (given | set(new)) else None
    taken = [
        *(["x", "y"] if position else []),
        *(["psi"] if heading else []),
        *(["u", "v"] if velocity else []),
        *new,
    ]
    joined = dataclasses.replace(
        plan,
        channels={**plan.channels, **new},
        position=plan.position or position,
        heading=plan.heading or heading,
        velocity=plan.velocity or velocity,
    )
    return joined, taken


def _channel_name(topic: str) -> str:
    """Return a channel's name from a topic's: the last part if known, else all parts."""
    parts = [part for part in key_of(topic).split("_") if part]
    for k in range(len(parts)):
        name = "_".join(parts[k:])
        if name in CHANNEL_UNITS:
            return name
    return "_".join(parts) or "data"
