"""Which states and degrees of freedom a model has, and where they stand in its tensors.

The columns below are those of the planar model, three degrees of freedom; no other module counts
them. A model with roll keeps them, with p and phi behind; one of all six degrees of freedom has w,
p, q and the depth z, roll and pitch there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from residnet.core import names
from residnet.core.errors import UsageError
from residnet.core.format import listed

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class StateLayout:
    """The states of a model in the order of its tensors: pose, what moves it, then its actuators'.

    What moves are the velocities and, behind them, those angles that forces depend on. The rates of
    the angles follow from the velocities, and everything else about them is as with velocities:
    they stand first among the channels, they have ranges, limits, scales and errors.

    Attributes:
        pose: names of the pose.
        velocities: names of the velocities, one for each degree of freedom.
        attitude: names of the angles that forces depend on.
    """

    pose: tuple[str, ...]
    velocities: tuple[str, ...]
    attitude: tuple[str, ...] = ()

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the velocities and of the angles that forces depend on."""
        return (*self.velocities, *self.attitude)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of pose, velocities and angles."""
        return (*self.pose, *self.moving)

    @property
    def banded(self) -> tuple[str, ...]:
        """What free runs have bands of: u, v, r, heading, position, then what else moves."""
        planar, beside = self.moving[: len(names.VELOCITY)], self.moving[len(names.VELOCITY) :]
        return (*planar, "heading", "position", *beside)

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.velocities)

    @property
    def pose_columns(self) -> slice:
        """The first columns, those of north, east and heading."""
        return slice(0, len(self.pose))

    @property
    def velocity_columns(self) -> slice:
        """Columns of the velocities and of the angles behind them."""
        return slice(len(self.pose), len(self.names))


PLANAR = StateLayout(names.POSE, names.VELOCITY)
"""Three degrees of freedom: x, y, psi, u, v, r."""
ROLL = StateLayout(names.POSE, (*names.VELOCITY, "p"), ("phi",))
"""Four degrees of freedom: x, y, psi, u, v, r, p, phi."""
SIX = StateLayout(names.POSE, (*names.VELOCITY, "w", "p", "q"), ("z", "phi", "theta"))
"""Six degrees of freedom: x, y, psi, u, v, r, w, p, q, z, phi, theta. Rotations are composed."""
VERTICAL = ("u", "w", "q")
"""Velocities of a motion in an upright plane, which no roll and no turn leaves."""
_RATES = {"phi": "p", "theta": "q"}
"""The velocity about whose axis an angle turns, and, where nothing else turns, its rate."""


def _moves(angle: np.ndarray) -> bool:
    """Return whether an angle [T] is a motion rather than a constant or the noise of a sensor.

    Of a motion neighbouring samples are alike: their correlation is above a half where less of the
    angle's variance is noise than is motion (von Neumann's ratio below 1; noise alone has 2).
    """
    known = angle[np.isfinite(angle)]
    if known.size <= _FEW:
        return False
    return float(np.square(np.diff(known)).mean()) < float(known.var())


_FEW = 50
"""Samples of an angle that tell nothing yet."""
_SPANS = 50
"""Spans of a log over which its depth changes as its motion says, or does not."""


def _dives(channels: Mapping[str, np.ndarray]) -> bool:
    """Return whether the depth follows from where the vessel points and moves.

    The waves that lift a boat, the water below it and the drift of a receiver's height do not.
    """
    z = np.asarray(channels["z"])
    known = {name: channels.get(name, np.zeros(z.size)) for name in SIX.moving}
    phi, theta = known["phi"], known["theta"]
    if channels.keys() >= {"x", "y"} and not channels.keys() >= {"u", "v"}:
        way = np.hypot(*(np.diff(channels[name], prepend=np.nan) for name in ("x", "y")))
        change = -way * np.tan(theta)
    else:
        level = known["v"] * np.sin(phi) + known["w"] * np.cos(phi)
        change = level * np.cos(theta) - known["u"] * np.sin(theta)
    span = max(1, z.size // _SPANS)
    said = np.cumsum(np.nan_to_num(change))
    said, seen = said[span:] - said[:-span], z[span:] - z[:-span]
    known = np.isfinite(seen)
    if min(float(np.std(said[known])), float(np.std(seen[known]))) == 0.0:
        return False
    return float(np.corrcoef(said[known], seen[known])[0, 1]) > _EXPLAINED


_EXPLAINED = 0.5
"""Correlation of the depth's changes with those that the motion makes, of a vessel that dives."""


@dataclass(frozen=True)
class Live:
    """Which velocities a model moves: those of u, v and r that were recorded, p, or all six.

    Of u, v and r the others are zero at all times: they have no equation, no term and no error. The
    pose is what the live ones lead to, a straight line from surge alone, a turn on the spot from
    yaw alone; so the time loop, exports and windows are those of the planar state. With p the
    states are those of `ROLL`; with w or q, beside u alone or all others, those of `SIX`.

    Attributes:
        velocities: names of those that live, of u, v, r, w, p and q.
    """

    velocities: tuple[str, ...] = PLANAR.velocities

    @classmethod
    def told(cls, channels: Mapping[str, np.ndarray]) -> Live:
        """Return the velocities that channels of a log tell; u, v and r where they tell none.

        They are measured, or follow from a heading (r), from position and heading (all) or from a
        roll angle that moves (p, which nothing tells without it). Heading, depth, roll and pitch
        tell all six beside u and v or a position, where the depth follows from the motion.

        Args:
            channels: by name, [T] each.
        """
        angles = ("phi", "theta", "z")
        held = {name for name in channels if name not in angles or _moves(channels[name])}
        placed = held >= {"u", "v"} or held >= {"x", "y"}
        if held >= {"theta", "z", "psi"} and "phi" in channels and placed and _dives(channels):
            # what turns and sinks the vessel follows from its attitude and depth
            return cls(SIX.velocities)
        plunging = cls.plunging(held)
        # one that goes ahead may be a boat in waves over a bottom: its depth or its planes tell
        plane = bool({"delta_s", "cmd_delta_s"} & held) or ("z" in held and _dives(channels))
        if plunging and ("u" not in plunging or plane):
            return cls(plunging)
        held |= set(PLANAR.velocities) if held.issuperset(PLANAR.pose) else set()
        held |= {"r"} if "psi" in held else set()
        found = [name for name in PLANAR.velocities if name in held] or [*PLANAR.velocities]
        return cls((*found, *(["p"] if "phi" in held else [])))

    @staticmethod
    def plunging(held: Iterable[str]) -> tuple[str, ...]:
        """Return the velocities of a motion in an upright plane by channels; none of another.

        A depth beside a speed and nothing else may be that of the water below a boat.
        """
        held = set(held)
        deep = held & {"w", "q"}
        deep |= {"w"} if "z" in held and (deep or "theta" in held or "u" not in held) else set()
        deep |= {"q"} if "theta" in held and "w" in deep else set()
        if not deep or held & {"v", "r", "p", *PLANAR.pose, "latitude", "longitude"}:
            return ()
        return tuple(name for name in VERTICAL if name in held | deep)

    @classmethod
    def shared(cls, told: Iterable[Live]) -> Live:
        """Return the velocities that each of several tells; u, v and r where they share none."""
        told = list(told)
        sets = [one.velocities for one in told]
        if told and all(one.spatial and one == told[0] for one in told):
            return told[0]
        found = [name for name in ROLL.velocities if all(name in one for one in sets)]
        planar = any(name in PLANAR.velocities for name in found)
        return cls(tuple(found) if planar else PLANAR.velocities)

    @property
    def layout(self) -> StateLayout:
        """The states of the model."""
        if "w" in self.velocities or "q" in self.velocities:
            return SIX
        return ROLL if "p" in self.velocities else PLANAR

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of what moves: velocities, living or not, and the angles that forces depend on."""
        return self.layout.moving

    @property
    def rates(self) -> tuple[str, ...]:
        """Names of the derivatives of what moves."""
        return tuple(f"{name}_dot" for name in self.moving)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states: pose and what moves."""
        return self.layout.names

    @property
    def size(self) -> int:
        """Number of what moves."""
        return len(self.moving)

    @property
    def columns(self) -> slice:
        """Columns of what moves among the states."""
        return self.layout.velocity_columns

    @property
    def rolls(self) -> bool:
        """Whether the vessel rolls."""
        return self.layout is not PLANAR

    @property
    def spatial(self) -> bool:
        """Whether it moves in all six degrees of freedom, so that its rotations are composed."""
        return self.layout is SIX

    @property
    def upright(self) -> bool:
        """Whether it moves in an upright plane alone, so that it neither rolls nor turns."""
        return self.spatial and set(self.velocities) <= set(VERTICAL)

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of what moves and drives nothing: dead velocities, and the depth."""
        return (*self.dead, *(("z",) if self.spatial else ()))

    @property
    def whole(self) -> bool:
        """Whether all velocities of the layout live."""
        return self.velocities == self.layout.velocities

    @property
    def planar(self) -> bool:
        """Whether u, v and r live, and nothing else does."""
        return self.velocities == PLANAR.velocities

    @property
    def dead(self) -> tuple[str, ...]:
        """Names of those that do not, and of angles that nothing turns."""
        still = [name for name in self.layout.velocities if name not in self.velocities]
        angles = [name for name, rate in _RATES.items() if self.upright and rate in still]
        return (*still, *angles)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of what lives of what moves, and so has errors."""
        return tuple(name for name in self.moving if name not in self.dead)

    @property
    def axes(self) -> list[int]:
        """Places of what lives among what moves."""
        return [self.moving.index(name) for name in self.channels]

    @property
    def learned(self) -> list[int]:
        """Places of the live velocities among what moves: what has an equation to find."""
        return [self.moving.index(name) for name in self.velocities]

    @property
    def moves(self) -> bool:
        """Whether the position follows from them."""
        return "u" in self.velocities or "v" in self.velocities

    @property
    def turns(self) -> bool:
        """Whether the heading does."""
        return "r" in self.velocities

    @property
    def ends(self) -> tuple[str, ...]:
        """Names of the errors of the pose that the velocities lead to, in `names.END_UNITS`."""
        if self.spatial:
            turns = not self.upright or "q" in self.velocities
            return (*["position"] * self.moves, "depth", *["attitude"] * turns)
        return (*["position"] * self.moves, *["heading"] * self.turns)

    @property
    def text(self) -> str:
        """What follows from the velocities not being u, v and r, for a reader; empty for these."""
        if self.upright:
            text = f"the logs tell {listed(self.velocities)} alone: the vessel moves in an"
            return f"{text} upright plane, without roll, turn or drift"
        if self.spatial:
            return "all six degrees of freedom, with depth, roll and pitch"
        if self.whole:
            return "surge, sway, yaw and roll, with the roll angle" if self.rolls else ""
        text = f"the logs tell {' and '.join(self.velocities)} alone, and"
        text += f" {' and '.join(self.dead)} {'are' if len(self.dead) > 1 else 'is'} taken as zero"
        if not self.moves:
            return f"{text}: the vessel turns on the spot, and has no error of position"
        if not self.turns:
            return f"{text}: positions are the distance run on a straight line"
        if "v" in self.velocities:
            return text
        return f"{text}: the vessel moves over ground where it points, without drift"

    def require_on_surface(self, who: str) -> None:
        """Check that the vessel does not dive, for what knows no depth and pitch.

        Raises:
            UsageError: where it does.
        """
        if self.spatial:
            raise UsageError(
                f"{who} knows no depth and pitch, but the model moves"
                f" {', '.join(self.velocities)}; fit one of signals.velocities: [u, v, r] for it"
            )

    def require_no_roll(self, who: str) -> None:
        """Check that the vessel does not roll, for what knows no roll.

        Raises:
            UsageError: where it does.
        """
        self.require_on_surface(who)
        if self.rolls:
            raise UsageError(
                f"{who} knows no roll, but the model moves {', '.join(self.velocities)}; fit one"
                " without p (signals.velocities: [u, v, r])"
            )

    def largest(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the size [n] of what moves at the ends of its ranges, [n] or more each.

        Infinite for a depth, and for the angles of rotations that are composed: a vessel that loops
        or dives deeper has not run away.
        """
        size = np.asarray(np.maximum(np.abs(low), np.abs(high))[: self.size])
        if self.spatial:
            size[[self.moving.index(name) for name in self.layout.attitude]] = np.inf
        return size

    def mask(self) -> Tensor:
        """Return 1 for each that has an equation of its own and 0 for the others, [n] float64."""
        import torch

        out = torch.zeros(self.size, dtype=torch.float64)
        out[self.learned] = 1.0
        return out

    def alive(self) -> Tensor:
        """Return 0 for each velocity that is zero at all times and 1 for the others, [n]."""
        import torch

        out = torch.zeros(self.size, dtype=torch.float64)
        out[self.axes] = 1.0
        return out

    def known_rates(self) -> Tensor:
        """Return K [n, n] with nu K the rates of the angles, from what moves nu [..., n]."""
        import torch

        out = torch.zeros(self.size, self.size, dtype=torch.float64)
        for angle in self.layout.attitude:
            if angle in _RATES:
                out[self.moving.index(_RATES[angle]), self.moving.index(angle)] = 1.0
        return out


ALIVE = Live()
"""All of u, v and r, and no other."""

POSE = PLANAR.pose_columns
VELOCITIES = PLANAR.velocity_columns
MOTION = slice(0, len(PLANAR.names))
ACCELERATIONS = slice(MOTION.stop, MOTION.stop + PLANAR.dof)
"""Of a motion with accelerations, which stand behind pose and velocities."""
ACTUATORS = slice(MOTION.stop, None)
MOVING = slice(POSE.stop, None)
"""Of a free run: what moves."""
BESIDE = slice(MOTION.stop, None)
"""Of a free run: what moves beside u, v and r."""
POSITION = slice(0, PLANAR.pose.index("psi"))
HEADING = PLANAR.names.index("psi")
SURGE = PLANAR.names.index("u")
SWAY = PLANAR.names.index("v")
YAW_RATE = PLANAR.names.index("r")
LATERAL = slice(SWAY, YAW_RATE + 1)
"""Columns of sway and yaw, whose motion is that of steering."""

RANGE_VELOCITIES = slice(0, PLANAR.dof)
"""Of ranges, channels and accelerations: velocities stand first."""
RANGE_INPUTS = slice(PLANAR.dof, None)
"""Of training ranges: inputs follow the velocities."""


ATTITUDE = tuple(map(SIX.names.index, ("phi", "theta", "psi")))
"""Columns of states of six degrees of freedom, those of an attitude."""


_STEEP = 1e-3
"""Least cosine of the pitch by which the rate of a heading is divided."""


def levelled(nu: np.ndarray) -> np.ndarray:
    """Return what moves a pose [..., 3], u, v cos phi and r cos phi, from what moves [..., n].

    Source: document 004, without heave and pitch; Fossen 2021, eq. (2.41) with them.
    """
    if nu.shape[-1] == PLANAR.dof:
        return nu
    if nu.shape[-1] == len(SIX.moving):
        import torch

        from residnet.core.columns import tilted

        ahead, across, _ = (part.numpy() for part in tilted(torch.from_numpy(np.array(nu))))
        r, q, phi, theta = (nu[..., SIX.moving.index(name)] for name in ("r", "q", "phi", "theta"))
        flat = np.maximum(np.cos(theta), _STEEP)
        return np.stack((ahead, across, (q * np.sin(phi) + r * np.cos(phi)) / flat), axis=-1)
    level = np.cos(nu[..., ROLL.moving.index("phi")])
    return np.stack((nu[..., 0], nu[..., 1] * level, nu[..., 2] * level), axis=-1)
