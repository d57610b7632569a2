"""Configuration of thrusters: fixed, differential, azimuth, vectored, and commanded forces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import (
    Config,
    Metres,
    NewtonMetres,
    Newtons,
    Radians,
    RadiansPerSecond,
    RevRate,
)
from residnet.core.names import FORCE_CHANNELS
from residnet.physics.actuators.config import (
    ActuatorConfig,
    CurveRange,
    FirstOrderConfig,
    ImmediateConfig,
    SecondOrderConfig,
    ServoConfig,
    ServoSpec,
    ShaftConfig,
    ThrustConfig,
    require_curve_covers_range,
)

if TYPE_CHECKING:
    from residnet.physics.actuators.thrusters import (
        AzimuthThrusters,
        ForceCommands,
        Thrusters,
        VectoredThrusters,
    )

_CHECK_POINTS = 401
"""Number of revolutions at which a thrust curve is checked."""


def _require_unique_names(names: Sequence[str]) -> None:
    if duplicates := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two thrusters are named '{duplicates[0]}'")


class ThrusterPositionConfig(Config):
    """Name and position of a thruster.

    Attributes:
        name: suffix of the names of its channels, for example `port`.
        x: distance forward of the body origin in m.
        y: distance to starboard of the body origin in m.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]*$")
    x: Metres = 0.0
    y: Metres = 0.0


class ThrusterConfig(ThrusterPositionConfig, ShaftConfig, ThrustConfig):
    """Fixed thruster.

    Attributes:
        name: suffix of its channels n_<name> and cmd_<name>.
        angle: direction of positive thrust, clockwise from the bow; 90 deg for a bow thruster with
            thrust to starboard.
    """

    angle: Radians = 0.0


class ThrustersConfig(ActuatorConfig):
    """Fixed thrusters at any positions of the hull.

    The propulsion command acts on each thruster in proportion to the surge component of its
    direction. The steering command acts on it with the sign of its lever about the origin.

    Attributes:
        thrusters: the thrusters, in the order of the commands.
    """

    kind: Literal["thrusters"] = "thrusters"
    thrusters: Annotated[tuple[ThrusterConfig, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _validate_names(self) -> ThrustersConfig:
        _require_unique_names([thruster.name for thruster in self.thrusters])
        return self

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return tuple(thruster.servo_spec(f"n_{thruster.name}") for thruster in self.thrusters)

    def command_names(self) -> tuple[str, ...]:
        return tuple(f"cmd_{thruster.name}" for thruster in self.thrusters)

    def build(self) -> Thrusters:
        from residnet.physics.actuators.thrusters import Thrusters

        return Thrusters(self.thrusters, self)


class DifferentialThrustConfig(ThrustConfig, ActuatorConfig):
    """Two fixed thrusters for differential thrust (Woo et al. 2018, section 4.1).

    The thrust curve is clipped to the sign of the rotation, which removes the discontinuity of the
    published polynomials at zero (W5 in docs/documents/corrections.md).

    Attributes:
        spacing: lateral distance between the thrusters in m.
        n_rate: maximum rate of change of the revolutions in 1/s^2.
    """

    kind: Literal["differential_thrust"] = "differential_thrust"
    spacing: Metres = Field(gt=0)
    n_rate: RevRate = Field(gt=0)

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return (ServoConfig().limited_servo(self.n_max, self.n_rate, "n_port", "n_stbd"),)

    def command_names(self) -> tuple[str, ...]:
        return "cmd_port", "cmd_stbd"

    def build(self) -> Thrusters:
        """Build the port and the starboard thruster, in this order."""
        from residnet.physics.actuators.thrusters import Thrusters

        thrusters = [
            ThrusterConfig(
                name=name, y=y, n_max=self.n_max, forward=self.forward, reverse=self.reverse
            )
            for name, y in (("port", -0.5 * self.spacing), ("stbd", 0.5 * self.spacing))
        ]
        return Thrusters(thrusters, self)


class AzimuthConfig(ServoConfig):
    """Azimuth drive of a thruster, with a limited angle to either side of the bow.

    Attributes:
        limit: maximum angle from the bow in rad.
        rate: maximum azimuth rate in rad/s; None for no limit.
    """

    limit: Radians = Field(default=math.pi, gt=0)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class AzimuthThrustersConfig(ActuatorConfig):
    """Equal azimuth thrusters, commanded by revolutions and angles.

    The commands are cmd_n_<name> [1/s], then cmd_alpha_<name> [rad] clockwise from the bow.

    Attributes:
        places: names and positions of the thrusters.
        thrust: coefficients c0, c1, ... of the thrust T = c0 + c1 n + c2 n^2 + ... in N, n in 1/s.
        curve_range: range of revolutions (astern, ahead) in which the curve was measured; it must
            increase between +-n_max.
        shaft: dynamics and limits of the revolutions.
        azimuth: dynamics and limits of the angles.
    """

    kind: Literal["azimuth_thrusters"]
    places: Annotated[tuple[ThrusterPositionConfig, ...], Field(min_length=1)]
    thrust: Annotated[tuple[float, ...], Field(min_length=2)]
    curve_range: CurveRange | None = None
    shaft: ShaftConfig
    azimuth: AzimuthConfig = AzimuthConfig()

    @model_validator(mode="after")
    def _validate_thrusters(self) -> AzimuthThrustersConfig:
        _require_unique_names([thruster_position.name for thruster_position in self.places])
        require_curve_covers_range(self.curve_range, self.shaft.n_max)
        # allocation inverts the thrust curve, which must therefore be monotonic
        n = np.linspace(-self.shaft.n_max, self.shaft.n_max, _CHECK_POINTS)
        decreasing = n[np.polynomial.Polynomial(self.thrust).deriv()(n) <= 0]
        if len(decreasing):
            raise ValueError(
                f"thrust decreases with the revolutions at {decreasing[0] * 60:.0f} rpm, so that"
                " its inverse is not unique; lower n_max"
            )
        if (
            len({(thruster_position.x, thruster_position.y) for thruster_position in self.places})
            == 1
        ):
            raise ValueError(
                "thrusters at one position cannot produce surge, sway and yaw independently; give"
                " two positions"
            )
        return self

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        names = [thruster_position.name for thruster_position in self.places]
        return (
            self.shaft.servo_spec(*(f"n_{name}" for name in names)),
            self.azimuth.limited_servo(
                self.azimuth.limit, self.azimuth.rate, *(f"alpha_{name}" for name in names)
            ),
        )

    def command_names(self) -> tuple[str, ...]:
        return tuple(
            f"cmd_{quantity}_{thruster_position.name}"
            for quantity in ("n", "alpha")
            for thruster_position in self.places
        )

    def build(self) -> AzimuthThrusters:
        from residnet.physics.actuators.thrusters import AzimuthThrusters

        return AzimuthThrusters(self)


class ForceCommandsConfig(ActuatorConfig):
    """Commanded forces tau_x, tau_y [N] and moment tau_n [N m] with limits.

    Attributes:
        x_max: maximum surge force in either direction in N.
        y_max: maximum sway force to either side in N.
        n_max: maximum yaw moment to either side in N m.
        response: dynamic response of the forces; immediate by default.
    """

    kind: Literal["forces"] = "forces"
    x_max: Newtons = Field(gt=0)
    y_max: Newtons = Field(ge=0)
    n_max: NewtonMetres = Field(gt=0)
    response: Annotated[
        ImmediateConfig | FirstOrderConfig | SecondOrderConfig, Field(discriminator="kind")
    ] = ImmediateConfig()

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        # a lag of second order may overshoot the limits of the commands
        names = [f"acting_{name}" for name in self.command_names()]
        return (ServoConfig(response=self.response).limited_servo(math.inf, None, *names),)

    def command_names(self) -> tuple[str, ...]:
        return FORCE_CHANNELS

    def build(self) -> ForceCommands:
        from residnet.physics.actuators.thrusters import ForceCommands

        return ForceCommands(self)


class VectoredThrusterConfig(ThrusterPositionConfig):
    """Fixed thruster with any direction of thrust, whose thrust is commanded.

    Attributes:
        name: suffix of its command cmd_thrust_<name> in N.
        z: distance below the body origin in m.
        push: direction of positive thrust (forward, starboard, down), normalised to length one.
    """

    z: Metres = 0.0
    push: tuple[float, float, float]


class VectoredThrustersConfig(ActuatorConfig):
    """Equal thrusters of a vessel in six degrees of freedom.

    The command is the thrust, because the motor controllers invert the thrust curve.

    Attributes:
        thrusters: the thrusters, in the order of the commands.
        limit: maximum thrust of each thruster in either direction.
    """

    kind: Literal["vectored_thrusters"] = "vectored_thrusters"
    thrusters: Annotated[tuple[VectoredThrusterConfig, ...], Field(min_length=1)]
    limit: Newtons = Field(gt=0)

    @model_validator(mode="after")
    def _validate_names(self) -> VectoredThrustersConfig:
        _require_unique_names([thruster.name for thruster in self.thrusters])
        return self

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        names = [f"thrust_{thruster.name}" for thruster in self.thrusters]
        return (ServoConfig().limited_servo(self.limit, None, *names),)

    def command_names(self) -> tuple[str, ...]:
        return tuple(f"cmd_thrust_{thruster.name}" for thruster in self.thrusters)

    @property
    def can_dive(self) -> bool:
        return True

    def build(self) -> VectoredThrusters:
        from residnet.physics.actuators.thrusters import VectoredThrusters

        return VectoredThrusters(self)
