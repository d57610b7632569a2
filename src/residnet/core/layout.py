"""States and degrees of freedom of a model, and their columns in its tensors.

The column constants belong to the planar model with three degrees of freedom. A model with roll
has p and phi behind these columns; a model with six degrees of freedom has w, p, q, the depth z,
roll and pitch there.
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
    """States of a model in the order of its tensors: pose, dynamic states, actuator states.

    The dynamic states are the velocities and the states that forces depend on: roll, and for six
    degrees of freedom depth and pitch. The rates of the latter follow from the velocities; in all
    other respects (channels, ranges, limits, scales, errors) they are treated like velocities.

    Attributes:
        pose: names of the pose.
        velocities: names of the velocities, one per degree of freedom.
        attitude: names of the angles and the depth that forces depend on.
    """

    pose: tuple[str, ...]
    velocities: tuple[str, ...]
    attitude: tuple[str, ...] = ()

    @property
    def dynamic_states(self) -> tuple[str, ...]:
        """Names of the velocities and of the attitude."""
        return (*self.velocities, *self.attitude)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of pose and dynamic states."""
        return (*self.pose, *self.dynamic_states)

    @property
    def band_channels(self) -> tuple[str, ...]:
        """Channels with prediction intervals: u, v, r, heading, position, further states."""
        n_planar = len(names.VELOCITY_NAMES)
        planar_velocities = self.dynamic_states[:n_planar]
        other_states = self.dynamic_states[n_planar:]
        return (*planar_velocities, "heading", "position", *other_states)

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.velocities)

    @property
    def pose_columns(self) -> slice:
        """Columns of north, east and heading."""
        return slice(0, len(self.pose))

    @property
    def velocity_columns(self) -> slice:
        """Columns of velocities and of attitude and depth beyond the pose, in states x."""
        return slice(len(self.pose), len(self.state_names))


PLANAR_LAYOUT = StateLayout(names.POSE_NAMES, names.VELOCITY_NAMES)
"""Three degrees of freedom: x, y, psi, u, v, r."""
ROLL_LAYOUT = StateLayout(names.POSE_NAMES, (*names.VELOCITY_NAMES, "p"), ("phi",))
"""Four degrees of freedom: x, y, psi, u, v, r, p, phi."""
SIX_DOF_LAYOUT = StateLayout(
    names.POSE_NAMES, (*names.VELOCITY_NAMES, "w", "p", "q"), ("z", "phi", "theta")
)
"""Six degrees of freedom with quaternions: x, y, psi, u, v, r, w, p, q, z, phi, theta."""
VERTICAL_PLANE_VELOCITIES = ("u", "w", "q")
"""Velocities of a motion in the vertical plane, without roll, sway and yaw."""
_RATE_OF_ANGLE = {"phi": "p", "theta": "q"}
"""Angle -> velocity about its axis, which is its rate if the other angles are constant."""


def _is_motion(angle: np.ndarray) -> bool:
    """Return whether an angle [T] varies by more than the noise of its sensor.

    The test is the ratio of the mean squared difference of neighbouring samples to the variance
    (von Neumann's ratio): 2 for white noise, below 1 if the motion dominates.
    """
    finite = angle[np.isfinite(angle)]
    if finite.size <= _MIN_ANGLE_SAMPLES:
        return False
    return float(np.square(np.diff(finite)).mean()) < float(finite.var())


_MIN_ANGLE_SAMPLES = 50
"""Number of samples up to which an angle is not tested for motion."""
_N_DEPTH_SPANS = 50
"""Number of parts of a log whose changes of depth are compared with those of the motion."""


def _depth_follows_motion(channels: Mapping[str, np.ndarray]) -> bool:
    """Return whether the measured depth correlates with the depth integrated from the motion.

    It does for a diving vessel. Heave in waves, the water depth and the drift of a receiver's
    height do not correlate.
    """
    z = np.asarray(channels["z"])
    state_values = {
        name: channels.get(name, np.zeros(z.size)) for name in SIX_DOF_LAYOUT.dynamic_states
    }
    phi = state_values["phi"]
    theta = state_values["theta"]
    if channels.keys() >= {"x", "y"} and not channels.keys() >= {"u", "v"}:
        # without velocities: the path is inclined by the pitch angle, positive nose up
        distance = np.hypot(*(np.diff(channels[name], prepend=np.nan) for name in ("x", "y")))
        depth_rate = -distance * np.tan(theta)
    else:
        # third row of the rotation from body axes to NED (Fossen 2021, eq. (2.31))
        cross_flow_down = state_values["v"] * np.sin(phi) + state_values["w"] * np.cos(phi)
        depth_rate = cross_flow_down * np.cos(theta) - state_values["u"] * np.sin(theta)
    # changes over spans instead of single samples, in which the noise of the depth dominates
    span_samples = max(1, z.size // _N_DEPTH_SPANS)
    predicted_change = np.cumsum(np.nan_to_num(depth_rate))
    predicted_change = predicted_change[span_samples:] - predicted_change[:-span_samples]
    measured_change = z[span_samples:] - z[:-span_samples]
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
"""Smallest correlation of measured and integrated depth changes of a diving vessel."""


@dataclass(frozen=True)
class DegreesOfFreedom:
    """Active velocities of a model: a subset of u, v and r, with p for roll, or six.

    Inactive velocities are always zero and have no equation, no term and no error. The pose is
    integrated from the active ones: surge alone gives a straight line, yaw alone a turn on the
    spot. Tensors always have the columns of the layout. With p the layout is `ROLL_LAYOUT`; with w
    or q (vertical plane or all six) it is `SIX_DOF_LAYOUT`.

    Attributes:
        velocities: names of the active velocities, from u, v, r, w, p and q.
    """

    velocities: tuple[str, ...] = PLANAR_LAYOUT.velocities

    @classmethod
    def from_channels(cls, channels: Mapping[str, np.ndarray]) -> DegreesOfFreedom:
        """Infer the active velocities from the channels of a log.

        A velocity is active if it is measured, or if it follows from other channels: r from the
        heading; u, v and r from position and heading; p from a varying roll angle. Heading, depth,
        roll and a varying pitch with u and v or a position give all six, if the depth follows from
        the motion.

        Args:
            channels: name -> values [T].

        Returns:
            The active velocities; u, v and r if the channels determine none.
        """
        angles = ("phi", "theta", "z")
        recorded = {name for name in channels if name not in angles or _is_motion(channels[name])}
        has_planar_motion = recorded >= {"u", "v"} or recorded >= {"x", "y"}
        if (
            recorded >= {"z", "psi"}
            # noise of an angle would excite equations of roll and pitch that the logs do not
            # determine: a vessel that dives by heave alone is planar
            and "theta" in recorded
            and "phi" in channels
            and has_planar_motion
            and _depth_follows_motion(channels)
        ):
            # the angular velocities and w follow from attitude and depth
            return cls(SIX_DOF_LAYOUT.velocities)
        vertical_velocities = cls.vertical_plane_dof(recorded)
        # with a forward speed, depth and pitch may be those of a surface vessel in waves; dive
        # planes or
        # a depth that follows from the motion exclude it
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
        """Return the velocities of a motion in the vertical plane; empty for other motions.

        Depth and speed alone do not suffice, because the depth may be the water depth.

        Args:
            recorded: names of the recorded channels.
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
        """Return the velocities that are active in all of `dofs`; u, v and r without any."""
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
        """Smallest layout with these velocities: planar, with roll, or six degrees of freedom."""
        if "w" in self.velocities or "q" in self.velocities:
            return SIX_DOF_LAYOUT
        return ROLL_LAYOUT if "p" in self.velocities else PLANAR_LAYOUT

    @property
    def dynamic_states(self) -> tuple[str, ...]:
        """Names of the dynamic states, active or not."""
        return self.layout.dynamic_states

    @property
    def derivative_names(self) -> tuple[str, ...]:
        """Names of the derivatives such as `u_dot`, in the order of the dynamic states."""
        return tuple(f"{name}_dot" for name in self.dynamic_states)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of pose and dynamic states."""
        return self.layout.state_names

    @property
    def n_dynamic(self) -> int:
        """Number of dynamic states: 3, 5 with roll, 9 in six degrees of freedom."""
        return len(self.dynamic_states)

    @property
    def dynamic_columns(self) -> slice:
        """Columns of the dynamic states among the states."""
        return self.layout.velocity_columns

    @property
    def has_roll(self) -> bool:
        """Whether the layout has a roll angle."""
        return self.layout is not PLANAR_LAYOUT

    @property
    def is_six_dof(self) -> bool:
        """Whether the layout has six degrees of freedom, with quaternion kinematics."""
        return self.layout is SIX_DOF_LAYOUT

    @property
    def is_vertical_plane(self) -> bool:
        """Whether the vessel moves in the vertical plane only, without roll, sway and yaw."""
        return self.is_six_dof and set(self.velocities) <= set(VERTICAL_PLANE_VELOCITIES)

    @property
    def unmodelled_states(self) -> tuple[str, ...]:
        """Names of the dynamic states that enter no force: inactive states, and the depth."""
        return (*self.fixed_states, *(("z",) if self.is_six_dof else ()))

    @property
    def is_complete(self) -> bool:
        """Whether all velocities of the layout are active."""
        return self.velocities == self.layout.velocities

    @property
    def is_planar(self) -> bool:
        """Whether exactly u, v and r are active."""
        return self.velocities == PLANAR_LAYOUT.velocities

    @property
    def fixed_states(self) -> tuple[str, ...]:
        """Names of the inactive velocities, and of the angles that they leave constant."""
        fixed_velocities = [name for name in self.layout.velocities if name not in self.velocities]
        fixed_angles = [
            name
            for name, rate in _RATE_OF_ANGLE.items()
            if self.is_vertical_plane and rate in fixed_velocities
        ]
        return (*fixed_velocities, *fixed_angles)

    @property
    def active_states(self) -> tuple[str, ...]:
        """Names of the dynamic states that are not constant zero."""
        return tuple(name for name in self.dynamic_states if name not in self.fixed_states)

    @property
    def active_indices(self) -> list[int]:
        """Indices of the active states among the dynamic states."""
        return [self.dynamic_states.index(name) for name in self.active_states]

    @property
    def active_velocity_indices(self) -> list[int]:
        """Indices of the active velocities among the dynamic states: those with an equation."""
        return [self.dynamic_states.index(name) for name in self.velocities]

    @property
    def has_position(self) -> bool:
        """Whether the position changes, that is, u or v is active."""
        return "u" in self.velocities or "v" in self.velocities

    @property
    def has_heading(self) -> bool:
        """Whether the heading changes, that is, r is active."""
        return "r" in self.velocities

    @property
    def pose_error_names(self) -> tuple[str, ...]:
        """Those of position and heading, or position, depth and attitude, that change at all."""
        if self.is_six_dof:
            has_attitude = not self.is_vertical_plane or "q" in self.velocities
            return (*["position"] * self.has_position, "depth", *["attitude"] * has_attitude)
        return (*["position"] * self.has_position, *["heading"] * self.has_heading)

    @property
    def description(self) -> str:
        """Sentence for reports about velocities other than u, v and r; empty for these."""
        if self.is_vertical_plane:
            text = f"the logs contain only {join_list(self.velocities)}: the vessel moves in the"
            return f"{text} vertical plane, without roll, yaw and sway"
        if self.is_six_dof:
            return "all six degrees of freedom, with depth, roll and pitch"
        if self.is_complete:
            return "surge, sway, yaw and roll, with the roll angle" if self.has_roll else ""
        verb = "are" if len(self.fixed_states) > 1 else "is"
        text = (
            f"the logs contain only {' and '.join(self.velocities)};"
            f" {' and '.join(self.fixed_states)} {verb} assumed to be zero"
        )
        if not self.has_position:
            return f"{text}: the vessel turns on the spot and has no position error"
        if not self.has_heading:
            return f"{text}: the position is the distance travelled on a straight line"
        if "v" in self.velocities:
            return text
        return f"{text}: the course over ground equals the heading, without drift"

    def require_on_surface(self, subject: str) -> None:
        """Check that the model has no depth and pitch.

        Args:
            subject: part that does not support depth and pitch, as the subject of the message.

        Raises:
            UsageError: if the model has six degrees of freedom.
        """
        if self.is_six_dof:
            raise UsageError(
                f"{subject} does not support depth and pitch, but the model has"
                f" {', '.join(self.velocities)}; fit a model with signals.velocities: [u, v, r]"
            )

    def require_no_roll(self, subject: str) -> None:
        """Check that the model has no roll, depth and pitch.

        Args:
            subject: part that does not support roll, as the subject of the message.

        Raises:
            UsageError: if the model has roll.
        """
        self.require_on_surface(subject)
        if self.has_roll:
            raise UsageError(
                f"{subject} does not support roll, but the model has {', '.join(self.velocities)};"
                " fit a model without p (signals.velocities: [u, v, r])"
            )

    def range_limits(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the largest absolute value [n] of each dynamic state within its range.

        The limit is infinite for the depth and the angles of six degrees of freedom: a loop or a
        deeper dive is not a divergence.

        Args:
            lower: lower ends of the ranges, [n] or more.
            upper: upper ends of the ranges, [n] or more.
        """
        max_abs = np.asarray(np.maximum(np.abs(lower), np.abs(upper))[: self.n_dynamic])
        if self.is_six_dof:
            max_abs[[self.dynamic_states.index(name) for name in self.layout.attitude]] = np.inf
        return max_abs

    def equation_mask(self) -> Tensor:
        """Return 1 for each dynamic state with an identified equation, else 0, [n] float64."""
        import torch

        is_regressed = torch.zeros(self.n_dynamic, dtype=torch.float64)
        is_regressed[self.active_velocity_indices] = 1.0
        return is_regressed

    def active_mask(self) -> Tensor:
        """Return 1 for each active dynamic state, else 0, [n] float64."""
        import torch

        is_active = torch.zeros(self.n_dynamic, dtype=torch.float64)
        is_active[self.active_indices] = 1.0
        return is_active

    def angle_rate_matrix(self) -> Tensor:
        """Return K [n, n] such that nu K are the angle rates, with dynamic states nu [..., n]."""
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
"""Exactly u, v and r."""

POSE = PLANAR_LAYOUT.pose_columns
VELOCITIES = PLANAR_LAYOUT.velocity_columns
MOTION = slice(0, len(PLANAR_LAYOUT.state_names))
"""Columns of pose and velocities of a planar vessel."""
ACCELERATIONS = slice(MOTION.stop, MOTION.stop + PLANAR_LAYOUT.n_dof)
"""Columns of the accelerations of a motion, behind pose and velocities."""
ACTUATORS = slice(MOTION.stop, None)
DYNAMIC_STATES = slice(POSE.stop, None)
"""Columns of the dynamic states of a free run."""
EXTRA_STATES = slice(MOTION.stop, None)
"""Columns of the dynamic states of a free run behind u, v and r."""
POSITION = slice(0, PLANAR_LAYOUT.pose.index("psi"))
"""Columns of the horizontal position."""
HEADING = PLANAR_LAYOUT.state_names.index("psi")
SURGE = PLANAR_LAYOUT.state_names.index("u")
SWAY = PLANAR_LAYOUT.state_names.index("v")
YAW_RATE = PLANAR_LAYOUT.state_names.index("r")
LATERAL = slice(SWAY, YAW_RATE + 1)
"""Columns of sway and yaw rate, the states of steering."""

RANGE_VELOCITIES = slice(0, PLANAR_LAYOUT.n_dof)
"""Velocities in ranges, channels and accelerations, where they are first."""
RANGE_INPUTS = slice(PLANAR_LAYOUT.n_dof, None)
"""Inputs in training ranges, where they follow the velocities."""
ATTITUDE = tuple(map(SIX_DOF_LAYOUT.state_names.index, ("phi", "theta", "psi")))
"""Columns of roll, pitch and heading among the states of six degrees of freedom."""
_MIN_COS_PITCH = 1e-3
"""Lower bound on cos(pitch) as a divisor of the heading rate."""


def to_horizontal_plane(nu: np.ndarray) -> np.ndarray:
    """Return surge, sway and yaw rate of the horizontal plane [..., 3] from dynamic states.

    With roll only these are u, v cos(phi) and r cos(phi).
    Source: Gouletas 2020 without heave and pitch; Fossen 2021, eq. (2.41) with them.

    Args:
        nu: dynamic states [..., n].
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


ROLL_PLANT_LAYOUT = StateLayout(("x", "y", "phi", "psi"), ("u", "v", "p", "r"))
"""Plants with surge, sway, roll and yaw, in the order of states of Gouletas 2020; models have the
order of `ROLL_LAYOUT`."""
SIX_DOF_PLANT_LAYOUT = StateLayout(
    ("x", "y", "z", "phi", "theta", "psi"), ("u", "v", "w", "p", "q", "r")
)
"""Plants in six degrees of freedom, in the order of states of Fossen; models have the order of
`SIX_DOF_LAYOUT`."""
