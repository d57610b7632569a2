"""The plan of a recording from its standard messages, where a config leaves it open."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from residnet.data.readers.composing.compose import Plan
from residnet.data.readers.composing.quantities import Derived
from residnet.data.readers.messages.marine import MARINE
from residnet.data.readers.messages.message import Message
from residnet.data.readers.messages.ros import (
    Fix,
    Imu,
    Joints,
    Named,
    Number,
    Odometry,
    Pose,
    Twist,
    Wrench,
)
from residnet.data.readers.recording import Recording, remark

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
    plan, conversions, remarks = declared, [], []
    for message in MESSAGES:
        fitting = [
            series
            for series in recording.series.values()
            if len(series) > 1 and message.fits(series)
        ]
        alike = [
            series.name
            for series in fitting
            if isinstance(message, Named) and {"x", "y", "psi"} <= set(series.fields)
        ]
        if len(alike) > 1:
            text = (
                f"{len(alike)} tables hold positions and headings ({', '.join(alike[:6])}): several"
                " experiments? name one with `table`, or map fields"
            )
            remarks.append(remark("will mislead", "several_tables", text, tables=len(alike)))
        for series in sorted(fitting, key=lambda series: (-len(series), series.name)):
            offered = message.plan(series)
            plan, taken = _joined(plan, offered)
            if taken:
                conversions.append(
                    f"{', '.join(taken)}: {type(message).__name__} of {series.name},"
                    f" {message.conversion}"
                )
    if plan.heading is None and "psi" not in plan.channels and declared.velocity is None:
        # without a heading an earth-fixed velocity has no components in the body
        plan = dataclasses.replace(plan, velocity=None)
    return dataclasses.replace(
        plan,
        conversions=(*declared.conversions, *conversions),
        remarks=(*declared.remarks, *remarks),
    )


def _joined(plan: Plan, offered: Plan) -> tuple[Plan, Sequence[str]]:
    """Return a plan with what it lacks of another, and the names of that."""
    present = (
        set(plan.channels)
        | ({"x", "y"} if plan.position else set())
        | ({"psi"} if plan.heading else set())
    )
    present |= {"u", "v"} if plan.velocity else set()
    present |= {"r"} if isinstance(plan.velocity, Derived) else set()
    # a field that is taken under one name is not offered under another
    declared = {(entry.topic, entry.field, entry.sender) for entry in plan.channels.values()}
    new = {
        name: entry
        for name, entry in offered.channels.items()
        if name not in present and (entry.topic, entry.field, entry.sender) not in declared
    }
    position = offered.position if not {"x", "y"} & present else None
    heading = offered.heading if "psi" not in present else None
    velocity = offered.velocity if not {"u", "v"} & (present | set(new)) else None
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
