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
from residnet.core.format import join_list

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
    def dynamic_states(self) -> tuple[str, ...]:
        """Names of the velocities and of the angles that forces depend on."""
        return (*self.velocities, *self.attitude)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of pose, velocities and angles."""
        return (*self.pose, *self.dynamic_states)

    @property
    def band_channels(self) -> tuple[str, ...]:
        """What free runs have bands of: u, v, r, heading, position, then what else moves."""
        planar_velocities, other_states = (
            self.dynamic_states[: len(names.VELOCITY_NAMES)],
            self.dynamic_states[len(names.VELOCITY_NAMES) :],
        )
        return (*planar_velocities, "heading", "position", *other_states)

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.velocities)

    @property
    def pose_columns(self) -> slice:
        """The first columns, those of north, east and heading."""
        return slice(0, len(self.pose))

    @property
    def velocity_columns(self) -> slice:
        """Columns of the velocities and of the angles behind them."""
        return slice(len(self.pose), len(self.state_names))


PLANAR_LAYOUT = StateLayout(names.POSE_NAMES, names.VELOCITY_NAMES)
"""Three degrees of freedom: x, y, psi, u, v, r."""
ROLL_LAYOUT = StateLayout(names.POSE_NAMES, (*names.VELOCITY_NAMES, "p"), ("phi",))
"""Four degrees of freedom: x, y, psi, u, v, r, p, phi."""
SIX_DOF_LAYOUT = StateLayout(
    names.POSE_NAMES, (*names.VELOCITY_NAMES, "w", "p", "q"), ("z", "phi", "theta")
)
"""Six degrees of freedom: x, y, psi, u, v, r, w, p, q, z, phi, theta. Rotations are composed."""
VERTICAL_PLANE_VELOCITIES = ("u", "w", "q")
"""Velocities of a motion in an upright plane, which no roll and no turn leaves."""
_RATE_OF_ANGLE = {"phi": "p", "theta": "q"}
"""The velocity about whose axis an angle turns, and, where nothing else turns, its rate."""


def _is_motion(angle: np.ndarray) -> bool:
    """Return whether an angle [T] is a motion rather than a constant or the noise of a sensor.

    Of a motion neighbouring samples are alike: their correlation is above a half where less of the
    angle's variance is noise than is motion (von Neumann's ratio below 1; noise alone has 2).
    """
    finite = angle[np.isfinite(angle)]
    if finite.size <= _MIN_ANGLE_SAMPLES:
        return False
    return float(np.square(np.diff(finite)).mean()) < float(finite.var())


_MIN_ANGLE_SAMPLES = 50
"""Samples of an angle that tell nothing yet."""
_N_DEPTH_SPANS = 50
"""Spans of a log over which its depth changes as its motion says, or does not."""


def _depth_follows_motion(channels: Mapping[str, np.ndarray]) -> bool:
    """Return whether the depth follows from where the vessel points and moves.

    The waves that lift a boat, the water below it and the drift of a receiver's height do not.
    """
    z = np.asarray(channels["z"])
    is_finite = {
        name: channels.get(name, np.zeros(z.size)) for name in SIX_DOF_LAYOUT.dynamic_states
    }
    phi, theta = is_finite["phi"], is_finite["theta"]
    if channels.keys() >= {"x", "y"} and not channels.keys() >= {"u", "v"}:
        distance = np.hypot(*(np.diff(channels[name], prepend=np.nan) for name in ("x", "y")))
        depth_rate = -distance * np.tan(theta)
    else:
        cross_flow_down = is_finite["v"] * np.sin(phi) + is_finite["w"] * np.cos(phi)
        depth_rate = cross_flow_down * np.cos(theta) - is_finite["u"] * np.sin(theta)
    span_samples = max(1, z.size // _N_DEPTH_SPANS)
    predicted_change = np.cumsum(np.nan_to_num(depth_rate))
    predicted_change, measured_change = (
        predicted_change[span_samples:] - predicted_change[:-span_samples],
        z[span_samples:] - z[:-span_samples],
    )
    is_finite = np.isfinite(measured_change)
    if (
        min(float(np.std(predicted_change[is_finite])), float(np.std(measured_change[is_finite])))
        == 0.0
    ):
        return False
    return (
        float(np.corrcoef(predicted_change[is_finite], measured_change[is_finite])[0, 1])
        > _MIN_DEPTH_CORRELATION
    )


_MIN_DEPTH_CORRELATION = 0.5
"""Correlation of the depth's changes with those that the motion makes, of a vessel that dives."""


@dataclass(frozen=True)
class DegreesOfFreedom:
    """Which velocities a model moves: those of u, v and r that were recorded, p, or all six.

    Of u, v and r the others are zero at all times: they have no equation, no term and no error. The
    pose is what the live ones lead to, a straight line from surge alone, a turn on the spot from
    yaw alone; so the time loop, exports and windows are those of the planar state. With p the
    states are those of `ROLL_LAYOUT`; with w or q, beside u alone or all others, those of `SIX_DOF_LAYOUT`.

    Attributes:
        velocities: names of those that live, of u, v, r, w, p and q.
    """

    velocities: tuple[str, ...] = PLANAR_LAYOUT.velocities

    @classmethod
    def from_channels(cls, channels: Mapping[str, np.ndarray]) -> DegreesOfFreedom:
        """Return the velocities that channels of a log tell; u, v and r where they tell none.

        They are measured, or follow from a heading (r), from position and heading (all) or from a
        roll angle that moves (p, which nothing tells without it). Heading, depth, roll and pitch
        tell all six beside u and v or a position, where the depth follows from the motion.

        Args:
            channels: by name, [T] each.
        """
        angles = ("phi", "theta", "z")
        recorded = {name for name in channels if name not in angles or _is_motion(channels[name])}
        has_planar_motion = recorded >= {"u", "v"} or recorded >= {"x", "y"}
        if (
            recorded >= {"theta", "z", "psi"}
            and "phi" in channels
            and has_planar_motion
            and _depth_follows_motion(channels)
        ):
            # what turns and sinks the vessel follows from its attitude and depth
            return cls(SIX_DOF_LAYOUT.velocities)
        vertical_velocities = cls.vertical_plane_dof(recorded)
        # one that goes ahead may be a boat in waves over a bottom: its depth or its planes tell
        is_vertical_plane = bool({"delta_s", "cmd_delta_s"} & recorded) or (
            "z" in recorded and _depth_follows_motion(channels)
        )
        if vertical_velocities and ("u" not in vertical_velocities or is_vertical_plane):
            return cls(vertical_velocities)
        recorded |= (
            set(PLANAR_LAYOUT.velocities) if recorded.issuperset(PLANAR_LAYOUT.pose) else set()
        )
        recorded |= {"r"} if "psi" in recorded else set()
        velocities = [name for name in PLANAR_LAYOUT.velocities if name in recorded] or [
            *PLANAR_LAYOUT.velocities
        ]
        return cls((*velocities, *(["p"] if "phi" in recorded else [])))

    @staticmethod
    def vertical_plane_dof(recorded: Iterable[str]) -> tuple[str, ...]:
        """Return the velocities of a motion in an upright plane by channels; none of another.

        A depth beside a speed and nothing else may be that of the water below a boat.
        """
        recorded = set(recorded)
        vertical_velocities = recorded & {"w", "q"}
        vertical_velocities |= (
            {"w"}
            if "z" in recorded
            and (vertical_velocities or "theta" in recorded or "u" not in recorded)
            else set()
        )
        vertical_velocities |= (
            {"q"} if "theta" in recorded and "w" in vertical_velocities else set()
        )
        if not vertical_velocities or recorded & {
            "v",
            "r",
            "p",
            *PLANAR_LAYOUT.pose,
            "latitude",
            "longitude",
        }:
            return ()
        return tuple(
            name for name in VERTICAL_PLANE_VELOCITIES if name in recorded | vertical_velocities
        )

    @classmethod
    def intersection(cls, dofs: Iterable[DegreesOfFreedom]) -> DegreesOfFreedom:
        """Return the velocities that each of several tells; u, v and r where they share none."""
        dofs = list(dofs)
        velocity_sets = [dof.velocities for dof in dofs]
        if dofs and all(dof.is_six_dof and dof == dofs[0] for dof in dofs):
            return dofs[0]
        shared_velocities = [
            name for name in ROLL_LAYOUT.velocities if all(name in dof for dof in velocity_sets)
        ]
        has_planar_velocity = any(name in PLANAR_LAYOUT.velocities for name in shared_velocities)
        return cls(tuple(shared_velocities) if has_planar_velocity else PLANAR_LAYOUT.velocities)

    @property
    def layout(self) -> StateLayout:
        """The states of the model."""
        if "w" in self.velocities or "q" in self.velocities:
            return SIX_DOF_LAYOUT
        return ROLL_LAYOUT if "p" in self.velocities else PLANAR_LAYOUT

    @property
    def dynamic_states(self) -> tuple[str, ...]:
        """Names of what moves: velocities, living or not, and the angles that forces depend on."""
        return self.layout.dynamic_states

    @property
    def derivative_names(self) -> tuple[str, ...]:
        """Names of the derivatives of what moves."""
        return tuple(f"{name}_dot" for name in self.dynamic_states)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states: pose and what moves."""
        return self.layout.state_names

    @property
    def n_dynamic(self) -> int:
        """Number of what moves."""
        return len(self.dynamic_states)

    @property
    def dynamic_columns(self) -> slice:
        """Columns of what moves among the states."""
        return self.layout.velocity_columns

    @property
    def has_roll(self) -> bool:
        """Whether the vessel rolls."""
        return self.layout is not PLANAR_LAYOUT

    @property
    def is_six_dof(self) -> bool:
        """Whether it moves in all six degrees of freedom, so that its rotations are composed."""
        return self.layout is SIX_DOF_LAYOUT

    @property
    def is_vertical_plane(self) -> bool:
        """Whether it moves in an upright plane alone, so that it neither rolls nor turns."""
        return self.is_six_dof and set(self.velocities) <= set(VERTICAL_PLANE_VELOCITIES)

    @property
    def unmodelled_states(self) -> tuple[str, ...]:
        """Names of what moves and drives nothing: dead velocities, and the depth."""
        return (*self.fixed_states, *(("z",) if self.is_six_dof else ()))

    @property
    def is_complete(self) -> bool:
        """Whether all velocities of the layout live."""
        return self.velocities == self.layout.velocities

    @property
    def is_planar(self) -> bool:
        """Whether u, v and r live, and nothing else does."""
        return self.velocities == PLANAR_LAYOUT.velocities

    @property
    def fixed_states(self) -> tuple[str, ...]:
        """Names of those that do not, and of angles that nothing turns."""
        fixed_velocities = [name for name in self.layout.velocities if name not in self.velocities]
        fixed_angles = [
            name
            for name, rate in _RATE_OF_ANGLE.items()
            if self.is_vertical_plane and rate in fixed_velocities
        ]
        return (*fixed_velocities, *fixed_angles)

    @property
    def active_states(self) -> tuple[str, ...]:
        """Names of what lives of what moves, and so has errors."""
        return tuple(name for name in self.dynamic_states if name not in self.fixed_states)

    @property
    def active_indices(self) -> list[int]:
        """Places of what lives among what moves."""
        return [self.dynamic_states.index(name) for name in self.active_states]

    @property
    def regressed_indices(self) -> list[int]:
        """Places of the live velocities among what moves: what has an equation to find."""
        return [self.dynamic_states.index(name) for name in self.velocities]

    @property
    def has_position(self) -> bool:
        """Whether the position follows from them."""
        return "u" in self.velocities or "v" in self.velocities

    @property
    def has_heading(self) -> bool:
        """Whether the heading does."""
        return "r" in self.velocities

    @property
    def pose_error_names(self) -> tuple[str, ...]:
        """Names of the errors of the pose that the velocities lead to, in `names.END_UNITS`."""
        if self.is_six_dof:
            has_attitude = not self.is_vertical_plane or "q" in self.velocities
            return (*["position"] * self.has_position, "depth", *["attitude"] * has_attitude)
        return (*["position"] * self.has_position, *["heading"] * self.has_heading)

    @property
    def description(self) -> str:
        """What follows from the velocities not being u, v and r, for a reader; empty for these."""
        if self.is_vertical_plane:
            text = f"the logs tell {join_list(self.velocities)} alone: the vessel moves in an"
            return f"{text} upright plane, without roll, turn or drift"
        if self.is_six_dof:
            return "all six degrees of freedom, with depth, roll and pitch"
        if self.is_complete:
            return "surge, sway, yaw and roll, with the roll angle" if self.has_roll else ""
        text = f"the logs tell {' and '.join(self.velocities)} alone, and"
        text += f" {' and '.join(self.fixed_states)} {'are' if len(self.fixed_states) > 1 else 'is'} taken as zero"
        if not self.has_position:
            return f"{text}: the vessel turns on the spot, and has no error of position"
        if not self.has_heading:
            return f"{text}: positions are the distance run on a straight line"
        if "v" in self.velocities:
            return text
        return f"{text}: the vessel moves over ground where it points, without drift"

    def require_on_surface(self, subject: str) -> None:
        """Check that the vessel does not dive, for what knows no depth and pitch.

        Raises:
            UsageError: where it does.
        """
        if self.is_six_dof:
            raise UsageError(
                f"{subject} knows no depth and pitch, but the model moves"
                f" {', '.join(self.velocities)}; fit one of signals.velocities: [u, v, r] for it"
            )

    def require_no_roll(self, subject: str) -> None:
        """Check that the vessel does not roll, for what knows no roll.

        Raises:
            UsageError: where it does.
        """
        self.require_on_surface(subject)
        if self.has_roll:
            raise UsageError(
                f"{subject} knows no roll, but the model moves {', '.join(self.velocities)}; fit one"
                " without p (signals.velocities: [u, v, r])"
            )

    def range_limits(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the size [n] of what moves at the ends of its ranges, [n] or more each.

        Infinite for a depth, and for the angles of rotations that are composed: a vessel that loops
        or dives deeper has not run away.
        """
        max_abs = np.asarray(np.maximum(np.abs(lower), np.abs(upper))[: self.n_dynamic])
        if self.is_six_dof:
            max_abs[[self.dynamic_states.index(name) for name in self.layout.attitude]] = np.inf
        return max_abs

    def equation_mask(self) -> Tensor:
        """Return 1 for each that has an equation of its own and 0 for the others, [n] float64."""
        import torch

        is_regressed = torch.zeros(self.n_dynamic, dtype=torch.float64)
        is_regressed[self.regressed_indices] = 1.0
        return is_regressed

    def active_mask(self) -> Tensor:
        """Return 0 for each velocity that is zero at all times and 1 for the others, [n]."""
        import torch

        is_active = torch.zeros(self.n_dynamic, dtype=torch.float64)
        is_active[self.active_indices] = 1.0
        return is_active

    def angle_rate_matrix(self) -> Tensor:
        """Return K [n, n] with nu K the rates of the angles, from what moves nu [..., n]."""
        import torch

        rate_matrix = torch.zeros(self.n_dynamic, self.n_dynamic, dtype=torch.float64)
        for angle in self.layout.attitude:
            if angle in _RATE_OF_ANGLE:
                rate_matrix[
                    self.dynamic_states.index(_RATE_OF_ANGLE[angle]),
                    self.dynamic_states.index(angle),
                ] = 1.0
        return rate_matrix


SURGE_SWAY_YAW = DegreesOfFreedom()
"""All of u, v and r, and no other."""

POSE = PLANAR_LAYOUT.pose_columns
VELOCITIES = PLANAR_LAYOUT.velocity_columns
MOTION = slice(0, len(PLANAR_LAYOUT.state_names))
ACCELERATIONS = slice(MOTION.stop, MOTION.stop + PLANAR_LAYOUT.n_dof)
"""Of a motion with accelerations, which stand behind pose and velocities."""
ACTUATORS = slice(MOTION.stop, None)
DYNAMIC_STATES = slice(POSE.stop, None)
"""Of a free run: what moves."""
EXTRA_STATES = slice(MOTION.stop, None)
"""Of a free run: what moves beside u, v and r."""
POSITION = slice(0, PLANAR_LAYOUT.pose.index("psi"))
HEADING = PLANAR_LAYOUT.state_names.index("psi")
SURGE = PLANAR_LAYOUT.state_names.index("u")
SWAY = PLANAR_LAYOUT.state_names.index("v")
YAW_RATE = PLANAR_LAYOUT.state_names.index("r")
LATERAL = slice(SWAY, YAW_RATE + 1)
"""Columns of sway and yaw, whose motion is that of steering."""

RANGE_VELOCITIES = slice(0, PLANAR_LAYOUT.n_dof)
"""Of ranges, channels and accelerations: velocities stand first."""
RANGE_INPUTS = slice(PLANAR_LAYOUT.n_dof, None)
"""Of training ranges: inputs follow the velocities."""


ATTITUDE = tuple(map(SIX_DOF_LAYOUT.state_names.index, ("phi", "theta", "psi")))
"""Columns of states of six degrees of freedom, those of an attitude."""


_MIN_COS_PITCH = 1e-3
"""Least cosine of the pitch by which the rate of a heading is divided."""


def to_horizontal_plane(nu: np.ndarray) -> np.ndarray:
    """Return what moves a pose [..., 3], u, v cos phi and r cos phi, from what moves [..., n].

    Source: document 004, without heave and pitch; Fossen 2021, eq. (2.41) with them.
    """
    if nu.shape[-1] == PLANAR_LAYOUT.n_dof:
        return nu
    if nu.shape[-1] == len(SIX_DOF_LAYOUT.dynamic_states):
        import torch

        from residnet.core.columns import level_velocities

        forward, starboard, _ = (
            component.numpy() for component in level_velocities(torch.from_numpy(np.array(nu)))
        )
        r, q, phi, theta = (
            nu[..., SIX_DOF_LAYOUT.dynamic_states.index(name)]
            for name in ("r", "q", "phi", "theta")
        )
        cos_pitch = np.maximum(np.cos(theta), _MIN_COS_PITCH)
        return np.stack(
            (forward, starboard, (q * np.sin(phi) + r * np.cos(phi)) / cos_pitch), axis=-1
        )
    cos_roll = np.cos(nu[..., ROLL_LAYOUT.dynamic_states.index("phi")])
    return np.stack((nu[..., 0], nu[..., 1] * cos_roll, nu[..., 2] * cos_roll), axis=-1)
