"""Which states and degrees of freedom a model has, and where they stand in its tensors.

The columns below are those of the planar model, three degrees of freedom; no other module counts
them. Functions serve code that TorchScript compiles, which takes no global slices.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from residnet.core import names


@dataclass(frozen=True)
class StateLayout:
    """The states of a model in the order of its tensors: pose, velocities, then its actuators'.

    Attributes:
        pose: names of the pose.
        velocities: names of the velocities, one for each degree of freedom.
    """

    pose: tuple[str, ...]
    velocities: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of pose and velocities."""
        return (*self.pose, *self.velocities)

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.velocities)

    @property
    def pose_columns(self) -> slice:
        """Columns of the pose."""
        return slice(0, len(self.pose))

    @property
    def velocity_columns(self) -> slice:
        """Columns of the velocities."""
        return slice(len(self.pose), len(self.names))

    @property
    def motion_columns(self) -> slice:
        """Columns of pose and velocities."""
        return slice(0, len(self.names))

    @property
    def actuator_columns(self) -> slice:
        """Columns of what follows: states of actuators and the like."""
        return slice(len(self.names), None)


PLANAR = StateLayout(names.POSE, names.VELOCITY)
"""Three degrees of freedom: x, y, psi, u, v, r."""


@dataclass(frozen=True)
class Live:
    """Which velocities of the planar state live, where only some were recorded.

    The others are zero at all times: they have no equation, no term and no error. The pose is what
    the live ones lead to, a straight line from surge alone, a turn on the spot from yaw alone; so
    the time loop, exports and windows are those of the planar state.

    Attributes:
        velocities: names of those that live, of u, v and r.
    """

    velocities: tuple[str, ...] = PLANAR.velocities

    @classmethod
    def told(cls, channels: Iterable[str]) -> Live:
        """Return the velocities that channels of a log tell; all where they tell none.

        They are measured, or follow from a heading (r) or from position and heading (all).
        """
        held = set(channels)
        if held.issuperset(PLANAR.pose):
            return cls()
        held |= {"r"} if "psi" in held else set()
        return cls(tuple(name for name in PLANAR.velocities if name in held) or PLANAR.velocities)

    @property
    def whole(self) -> bool:
        """Whether all velocities live."""
        return self.velocities == PLANAR.velocities

    @property
    def dead(self) -> tuple[str, ...]:
        """Names of those that do not."""
        return tuple(name for name in PLANAR.velocities if name not in self.velocities)

    @property
    def axes(self) -> list[int]:
        """Places of the live ones among u, v, r."""
        return [PLANAR.velocities.index(name) for name in self.velocities]

    @property
    def moves(self) -> bool:
        """Whether the position follows from them."""
        return "u" in self.velocities or "v" in self.velocities

    @property
    def turns(self) -> bool:
        """Whether the heading does."""
        return "r" in self.velocities

    @property
    def text(self) -> str:
        """What follows from some velocities not living, for a reader; empty where all live."""
        if self.whole:
            return ""
        text = f"the logs tell {' and '.join(self.velocities)} alone, and"
        text += f" {' and '.join(self.dead)} {'are' if len(self.dead) > 1 else 'is'} taken as zero"
        if not self.moves:
            return f"{text}: the vessel turns on the spot, and has no error of position"
        if not self.turns:
            return f"{text}: positions are the distance run on a straight line"
        return f"{text}: the vessel moves over ground where it points, without drift"

    def mask(self) -> Tensor:
        """Return 1 for each of u, v, r that lives and 0 for the others, [3] float64."""
        alive = [float(name in self.velocities) for name in PLANAR.velocities]
        return torch.tensor(alive, dtype=torch.float64)


ALIVE = Live()
"""All of u, v and r."""

POSE = PLANAR.pose_columns
VELOCITIES = PLANAR.velocity_columns
MOTION = PLANAR.motion_columns
ACCELERATIONS = slice(MOTION.stop, MOTION.stop + PLANAR.dof)
"""Of a motion with accelerations, which stand behind pose and velocities."""
ACTUATORS = PLANAR.actuator_columns
POSITION = slice(0, PLANAR.pose.index("psi"))
HEADING = PLANAR.names.index("psi")
SURGE = PLANAR.names.index("u")
SWAY = PLANAR.names.index("v")
YAW_RATE = PLANAR.names.index("r")
LATERAL = slice(SWAY, YAW_RATE + 1)
"""Columns of sway and yaw, whose motion is that of steering."""
HEADING_AND_VELOCITIES = slice(HEADING, len(PLANAR.names))
"""Columns of all that forces may depend on."""

RANGE_VELOCITIES = slice(0, PLANAR.dof)
"""Of ranges, channels and accelerations: velocities stand first."""
RANGE_INPUTS = slice(PLANAR.dof, None)
"""Of training ranges: inputs follow the velocities."""


def pose(x: Tensor) -> Tensor:
    """Return the pose (x, y, psi) [..., 3] of states [..., nx]."""
    return x[..., :3]


def velocities(x: Tensor) -> Tensor:
    """Return the velocities (u, v, r) [..., 3] of states [..., nx]."""
    return x[..., 3:6]


def motion(x: Tensor) -> Tensor:
    """Return pose and velocities [..., 6] of states [..., nx]."""
    return x[..., :6]


def actuators(x: Tensor) -> Tensor:
    """Return the states of actuators [..., nx - 6] of states [..., nx]."""
    return x[..., 6:]


def accelerations(x: Tensor) -> Tensor:
    """Return the accelerations [..., 3] behind pose and velocities of a motion [..., 9]."""
    return x[..., 6:9]


def velocities_on(x: Tensor) -> Tensor:
    """Return all but the pose [..., nx - 3] of states [..., nx]: velocities and what follows."""
    return x[..., 3:]


def position(x: Tensor) -> Tensor:
    """Return the position (x, y) [..., 2] of states [..., nx]."""
    return x[..., :2]


def heading(x: Tensor) -> Tensor:
    """Return the heading [...] in rad of states [..., nx]."""
    return x[..., 2]


def surge(x: Tensor) -> Tensor:
    """Return the surge velocity [...] in m/s of states [..., nx]."""
    return x[..., 3]


def sway(x: Tensor) -> Tensor:
    """Return the sway velocity [...] in m/s of states [..., nx]."""
    return x[..., 4]


def yaw_rate(x: Tensor) -> Tensor:
    """Return the yaw rate [...] in rad/s of states [..., nx]."""
    return x[..., 5]


def zero_acceleration(z: Tensor) -> Tensor:
    """Return accelerations of zero [..., 3], alike in type to channels [..., nz]."""
    return torch.zeros_like(z[..., :3])
