"""Rudders with propellers, fins and water jets.

Sources: the MMG standard method (Yasukawa and Yoshimura 2015); Gouletas 2020, section 5.2.2.3;
Halvorsen 2019, eqs. (6.12)-(6.16), with the missing values and
misprints listed in docs/documents/corrections.md (H10 to H16, G8 to G11).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, Literal, final

from pydantic import AfterValidator, Field

from residnet.core.config import Config, Metres, Newtons, Radians, RevsPerSecond
from residnet.physics.actuators.config import (
    CommandSpec,
    ServoConfig,
    ServoSpec,
    ShaftConfig,
    SteeredConfig,
    SteeringGearConfig,
    ThrustConfig,
)
from residnet.physics.parameters import (
    Density,
    Parameter,
    Positive,
    SquareMetres,
    require_dimension,
)

if TYPE_CHECKING:
    from torch import Tensor


class RudderConfig(SteeringGearConfig):
    """Rudder with its steering gear.

    Attributes:
        area: movable area.
        aspect_ratio: height divided by mean chord L; the gradient of the normal force is
            6.13 L / (L + 2.25) (Fujii).
        x: longitudinal position of the rudder stock, negative aft of the body origin.
        race_share: share of the area in the slipstream of the propeller; with 0 the force is
            proportional to u^2.
        straightening: flow-straightening factor, the share of the local drift angle at the rudder;
            0 for inflow from ahead only.
    """

    area: SquareMetres = Field(gt=0)
    aspect_ratio: float = Field(gt=0)
    x: Metres = Field(lt=0)
    race_share: float = Field(default=0.0, ge=0, le=1)
    straightening: float = Field(default=1.0, ge=0, le=1)


class PropellerShaftConfig(ShaftConfig, ThrustConfig):
    """Propeller with its shaft.

    Attributes:
        diameter: diameter of the propeller disc.
        advance_loss: decrease of the thrust with speed, T = curve - advance_loss |n| u [N s^2/m]
            for u >= 0, which is a linear K_T.
        thrust_deduction: thrust deduction fraction t.
    """

    diameter: Metres = Field(gt=0)
    advance_loss: float = Field(default=0.0, ge=0)
    thrust_deduction: float = Field(default=0.0, ge=0, lt=1)

    def thrust_at(self, n: Tensor, u: Tensor) -> Tensor:
        """Return the thrust [N] at n [1/s] and speed through the water u [m/s], any shape."""
        import torch

        forward = self.forward
        reverse = self.reverse
        forward_thrust = (forward[0] + n * (forward[1] + n * forward[2])).clamp(min=0.0)
        reverse_thrust = (reverse[0] + n * (reverse[1] + n * reverse[2])).clamp(max=0.0)
        # each polynomial is valid for one direction of rotation only
        static_thrust = torch.where(
            n > 0, forward_thrust, torch.where(n < 0, reverse_thrust, torch.zeros_like(n))
        )
        return static_thrust - self.advance_loss * n.abs() * u.clamp(min=0.0)


@final
class RudderPropellerConfig(SteeredConfig):
    """Propeller and rudder without hull interaction.

    Normal force and inflow follow the MMG standard method (Yasukawa and Yoshimura 2015):
    F_N = 0.5 rho A f sin(delta_e) U_R^2, X = -F_N sin delta, Y = -F_N cos delta, N = x Y, where
    delta > 0 turns to starboard. The inflow is U_R^2 = u|u| + race_share 2 T / (rho A_p), the fully
    contracted slipstream of an actuator disc.

    Commands are cmd_delta [rad] and cmd_n [1/s]; delta and n are states if they have dynamics.

    Attributes:
        rudder: the rudder.
        propeller: the propeller.
        density: density of the water in kg/m^3.
    """

    kind: Literal["rudder_propeller"] = "rudder_propeller"
    rudder: RudderConfig
    propeller: PropellerShaftConfig
    density: Density = Field(default=1025.0, gt=0)

    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the commands: rudder angle (steering) and revolutions (propulsion)."""
        return (
            CommandSpec("cmd_delta", "steer", self.rudder.limit),
            CommandSpec("cmd_n", "drive", self.propeller.n_max),
        )

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return self.rudder.servo_spec("delta"), self.propeller.servo_spec("n")

    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        import torch

        rudder = self.rudder
        propeller = self.propeller
        delta = position[..., 0]
        u = nu[..., 0]
        lift_factor = 0.5 * self.density * rudder.area
        # gradient of the normal force (Fujii)
        lift_factor *= 6.13 * rudder.aspect_ratio / (rudder.aspect_ratio + 2.25)
        disc_area = 0.25 * math.pi * propeller.diameter**2
        thrust = propeller.thrust_at(position[..., 1], u)
        # momentum theory: the far slipstream of a disc has the added dynamic pressure T / A_p;
        # astern thrust has no slipstream at the rudder
        race_factor = rudder.race_share * 2.0 / (self.density * disc_area)
        signed_inflow_squared = u * u.abs() + race_factor * thrust.clamp(min=0.0)
        # lateral velocity at the rudder, from sway and yaw
        cross_flow = rudder.straightening * (nu[..., 1] + rudder.x * nu[..., 2])
        # the offset keeps the gradient of the root finite at rest
        inflow = torch.sqrt(signed_inflow_squared.abs() + 1e-8)
        # U_R^2 sin(delta - beta_R) with the inflow angle beta_R, expanded so that no arctangent is
        # needed
        normal_force = lift_factor * (
            signed_inflow_squared * torch.sin(delta) + inflow * cross_flow * torch.cos(delta)
        )
        side_force = -normal_force * torch.cos(delta)
        net_thrust = (1.0 - propeller.thrust_deduction) * thrust
        return torch.stack(
            (net_thrust - normal_force * torch.sin(delta), side_force, rudder.x * side_force),
            dim=-1,
        )


class FinPairConfig(SteeringGearConfig):
    """Pair of stabiliser fins that act in opposite directions (Gouletas 2020, section 5.2.2.3).

    A positive angle rolls the vessel to starboard. Lift and induced drag follow (5.20), (5.21) with
    correction G8 of docs/documents/corrections.md. The angle of attack is the fin angle minus the
    angle of the inflow that roll, sway and yaw cause,
    alpha_e = alpha - (r_f p - sin(gamma) (v + x r)) / u, with the lever
    r_f = y cos(gamma) + z sin(gamma). The normal forces L of both fins give the loads
    Y = -2 L sin(gamma), K = 2 r_f L, N = x Y and X = -2 D. The drag at zero angle is part of the
    calm-water resistance of the hull.

    Attributes:
        area: area of one fin.
        aspect_ratio: effective aspect ratio a of lift and induced drag.
        lift_slope: dC_L/d alpha per rad.
        stall: angle of attack at which lift and drag saturate.
        x: longitudinal position of the centre of pressure in m, positive forward of the body
            origin.
        y: distance of the centre of pressure from the centreline in m.
        z: position of the centre of pressure below the body origin in m.
        tilt: angle gamma of the span below the horizontal in rad.
        density: density of the water.
    """

    area: SquareMetres = Field(gt=0)
    aspect_ratio: float = Field(gt=0)
    lift_slope: float = Field(gt=0)
    stall: Radians = Field(gt=0, lt=1.5707)
    x: Metres
    y: Metres = Field(gt=0)
    z: Metres
    tilt: Radians = Field(ge=0, lt=1.5707)
    density: Density = Field(gt=0)

    def force(self, angle: Tensor, nu: Tensor) -> Tensor:
        """Compute the loads X, Y [N], K, N [N m], stacked [..., 4].

        Args:
            angle: fin angle [...] in rad.
            nu: velocities u, v, p, r through the water [..., 4].
        """
        import torch

        u, v, p, r = nu.unbind(dim=-1)
        sin_tilt = math.sin(self.tilt)
        lever = self.y * math.cos(self.tilt) + self.z * sin_tilt
        # the offset keeps the inflow angle and its gradient finite at rest
        speed_squared = u * u + 1e-4
        inflow_angle = (lever * p - sin_tilt * (v + self.x * r)) * u / speed_squared
        angle_of_attack = (angle - inflow_angle).clamp(-self.stall, self.stall)
        lift_coefficient = self.lift_slope * angle_of_attack
        dynamic_force = 0.5 * self.density * self.area * speed_squared
        lift = dynamic_force * lift_coefficient
        drag = dynamic_force * lift_coefficient**2 / (0.9 * math.pi * self.aspect_ratio)
        side_force = -2.0 * sin_tilt * lift
        return torch.stack(
            (-2.0 * drag, side_force, 2.0 * lever * lift, self.x * side_force), dim=-1
        )


class SternRuddersConfig(SteeringGearConfig, SteeredConfig, ABC):
    """Coupled stern rudders with propellers whose thrust is commanded, and optional fins.

    Commands are cmd_delta [rad], with fins cmd_fin [rad], and cmd_thrust [N]; delta and fin [rad]
    are states if they have dynamics. The rudder forces are Y = -L, K = z L, N = -x L and
    X = T - D, where delta > 0 turns to starboard (Gouletas 2020, eqs. (5.26)-(5.29), where two
    signs are wrong, see G9 and G10 in docs/documents/corrections.md).

    Attributes:
        x: longitudinal position of the centre of pressure of the rudders in m, negative aft of the
            body origin.
        z: vertical position of the centre of pressure in m, positive below the body origin.
        thrust: maximum total thrust of the propellers. Commands are clamped between zero and this
            value, because the source has no astern thrust.
        fins: stabiliser fins, for vessels with roll; null for none.
    """

    x: Metres = Field(lt=0)
    z: Metres
    thrust: Newtons = Field(gt=0)
    fins: FinPairConfig | None = None

    @abstractmethod
    def lift_and_drag(
        self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the lift and drag [...] in N of all rudders.

        Args:
            delta: rudder angle [...] in rad.
            u: surge velocity through the water [...] in m/s.
            v: sway velocity through the water [...] in m/s.
            thrust: total thrust of the propellers [...] in N.
        """

    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the commands: rudder angle, fin angle, and thrust without astern thrust."""
        fin_commands = (
            [] if self.fins is None else [CommandSpec("cmd_fin", "roll", self.fins.limit)]
        )
        return (
            CommandSpec("cmd_delta", "steer", self.limit),
            *fin_commands,
            CommandSpec("cmd_thrust", "drive", self.thrust, 0.0),
        )

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        fin_servos = [] if self.fins is None else [self.fins.servo_spec("fin")]
        return (self.servo_spec("delta"), *fin_servos)

    def servo_commands(self, command: Tensor) -> Tensor:
        """Return the commands of rudder and fins [..., 1 or 2]; thrust has no dynamics."""
        return command[..., :-1]

    @final
    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        import torch

        thrust = command[..., -1].clamp(0.0, self.thrust)
        lift, drag = self.lift_and_drag(position[..., 0], nu[..., 0], nu[..., 1], thrust)
        force = torch.stack((thrust - drag, -lift, self.z * lift, -self.x * lift), dim=-1)
        if self.fins is None:
            return force
        return force + self.fins.force(position[..., 1], nu)


@final
class FoilRuddersConfig(SternRuddersConfig):
    """Rudders modelled as foils, with a correction for the slipstream of the propellers.

    Gouletas 2020, eqs. (5.20)-(5.25), without its misprints (see G8 and G11 in
    docs/documents/corrections.md). The drag at zero angle is part of the calm-water resistance of
    the hull.

    Attributes:
        rudders: number of rudders with equal lift.
        propellers: number of propellers with equal thrust.
        area: area of one rudder.
        aspect_ratio: effective aspect ratio a of the induced drag C_L^2 / (0.9 pi a).
        lift_slope: dC_L/d alpha per rad.
        stall: angle of attack at which lift and drag saturate.
        diameter: diameter of a propeller.
        density: density of the water.
    """

    kind: Literal["foil_rudders"] = "foil_rudders"
    rudders: int = Field(gt=0)
    area: SquareMetres = Field(gt=0)
    aspect_ratio: float = Field(gt=0)
    lift_slope: float = Field(gt=0)
    stall: Radians = Field(gt=0, lt=1.5707)
    propellers: int = Field(gt=0)
    diameter: Metres = Field(gt=0)
    density: Density = Field(gt=0)

    def lift_and_drag(
        self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor
    ) -> tuple[Tensor, Tensor]:
        import torch

        disc_area = 0.25 * math.pi * self.diameter**2
        # C_Th V^2 per newton of total thrust, which the propellers share equally
        thrust_loading = 2.0 / (self.propellers * self.density * disc_area)
        # beyond the stall angle lift and drag are constant
        angle_of_attack = delta.clamp(-self.stall, self.stall)
        speed_squared = u * u + v * v
        # 1/sqrt(1 + C_Th); the offset keeps it and its gradient finite at rest
        slipstream_ratio = torch.sqrt(
            (speed_squared + 1e-20) / (speed_squared + thrust_loading * thrust + 1e-20)
        )
        race_force = thrust * (1.0 + slipstream_ratio)
        lift_coefficient = self.lift_slope * angle_of_attack
        dynamic_force = 0.5 * self.density * self.area * self.rudders * speed_squared
        induced_drag_factor = 1.0 / (0.9 * math.pi * self.aspect_ratio)
        lift = dynamic_force * lift_coefficient + race_force * torch.sin(angle_of_attack)
        drag = (
            dynamic_force * induced_drag_factor * lift_coefficient * lift_coefficient
            + race_force * (1.0 - torch.cos(angle_of_attack))
        )
        return lift, drag


@final
class LinearRuddersConfig(SternRuddersConfig):
    """Rudders with the side force Y_delta_uu u^2 delta, without drag and slipstream.

    Source: Gouletas 2020, Table 5.3.

    Attributes:
        Y_delta_uu: coefficient of all rudders in kg/m per rad.
    """

    kind: Literal["linear_rudders"] = "linear_rudders"
    Y_delta_uu: float = Field(gt=0)

    def lift_and_drag(
        self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor
    ) -> tuple[Tensor, Tensor]:
        import torch

        return self.Y_delta_uu * u * u * delta, torch.zeros_like(delta)


Force = Annotated[Parameter, AfterValidator(require_dimension(1, 1, -2))]
ForcePerSpeed = Annotated[Parameter, AfterValidator(require_dimension(1, 0, -1))]
ForcePerSquaredSpeed = Annotated[Parameter, AfterValidator(require_dimension(1, -1, 0))]
Ratio = Annotated[Parameter, AfterValidator(require_dimension(0, 0, 0))]
PerRevolutions = Annotated[Parameter, AfterValidator(require_dimension(0, 0, 1))]
PerSquaredRevolutions = Annotated[Parameter, AfterValidator(require_dimension(0, 0, 2))]


class SpeedCurve(Config):
    """Thrust at reference revolutions over speed through the water, a0 + a1 u + a2 u^2.

    Attributes:
        a0: thrust at zero speed in N.
        a1: slope in N s/m.
        a2: curvature in N s^2/m^2.
    """

    a0: Force
    a1: ForcePerSpeed
    a2: ForcePerSquaredSpeed


class RevolutionsCurve(Config):
    """Relative thrust at n revolutions per second, (r0 + r1 n + r2 n^2) / reference.

    Attributes:
        r0: value at zero revolutions, dimensionless.
        r1: slope in s.
        r2: curvature in s^2.
        reference: value of the polynomial at the reference revolutions, dimensionless.
    """

    r0: Ratio
    r1: PerRevolutions
    r2: PerSquaredRevolutions
    reference: Annotated[Ratio, Positive]


@final
class WaterJetsConfig(SteeredConfig):
    """Equal water jets with coupled nozzles and revolutions.

    Commands are cmd_n [1/s] and cmd_nozzle [rad]; at a positive angle the force acts to starboard.

    Attributes:
        jets: number of jets.
        x: longitudinal position of the nozzles, negative aft of the body origin.
        speed: quadratic thrust of one jet over speed. Its product with `revolutions` is the thrust
            (6.16), which can be negative at low revolutions (H15).
        revolutions: quadratic relative thrust over revolutions.
        motor: dynamics and limits of the revolutions, which have one direction.
        nozzle: dynamics and limits of the nozzle angle.
    """

    kind: Literal["water_jets"]
    jets: int = Field(gt=0)
    x: Metres
    speed: SpeedCurve
    revolutions: RevolutionsCurve
    motor: ShaftConfig
    nozzle: SteeringGearConfig

    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the commands: nonnegative revolutions (propulsion) and nozzle angle (steering)."""
        # jets aft of the origin turn the bow to starboard by a force to port
        max_nozzle_angle = self.nozzle.limit if self.x > 0 else -self.nozzle.limit
        return (
            CommandSpec("cmd_n", "drive", self.motor.n_max, 0.0),
            CommandSpec("cmd_nozzle", "steer", max_nozzle_angle),
        )

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return self.motor.servo_spec("n"), self.nozzle.servo_spec("nozzle")

    def servo_commands(self, command: Tensor) -> Tensor:
        """Return the commands [..., 2] without negative revolutions."""
        import torch

        return torch.stack((command[..., 0].clamp(min=0.0), command[..., 1]), dim=-1)

    def jet_thrust(self, n: Tensor, u: Tensor) -> Tensor:
        """Compute the thrust [N] of one jet at revolutions n [1/s] and speed u [m/s], any shape.

        Source: Halvorsen 2019, eq. (6.16).
        """
        speed_curve = self.speed
        revolutions_curve = self.revolutions
        reference_thrust = speed_curve.a0.value + u * (
            speed_curve.a1.value + u * speed_curve.a2.value
        )
        revolutions_share = (
            revolutions_curve.r0.value
            + n * (revolutions_curve.r1.value + n * revolutions_curve.r2.value)
        ) / revolutions_curve.reference.value
        return reference_thrust * revolutions_share

    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        import torch

        n, angle = position.unbind(-1)
        total_thrust = self.jets * self.jet_thrust(n, nu[..., 0])
        side_force = total_thrust * torch.sin(angle)
        return torch.stack(
            (total_thrust * torch.cos(angle), side_force, self.x * side_force), dim=-1
        )


@final
class TorpedoFinsConfig(ServoConfig, SteeredConfig):
    """Propeller, rudder and stern planes of a torpedo-shaped vehicle, with equal lags.

    Commands are cmd_delta [rad] (positive to starboard), cmd_delta_s [rad] (positive to dive) and
    cmd_n [1/s]. The lift of a fin is normal to the hull, and its drag is quadratic in its angle. At
    astern revolutions the thrust is that at zero speed.

    Source: Fossen's model of the REMUS 100 (PythonVehicleSimulator, vehicles/remus100.py).

    Attributes:
        limit: maximum angle of rudder and planes.
        n_max: maximum revolutions.
        density: density of the water.
        x: longitudinal position of the fins, negative aft of the body origin.
        rudder: area of the rudder times its lift-curve slope.
        planes: area of both stern planes times their lift-curve slope.
        diameter: diameter of the propeller.
        K_T: thrust coefficient at zero advance and its slope by advance ratio.
        K_Q: torque coefficient at zero advance and its slope by advance ratio.
        wake: ratio of inflow speed of the propeller to speed of the vessel.
        thrust_deduction: thrust deduction fraction.
    """

    kind: Literal["torpedo_fins"] = "torpedo_fins"
    limit: Radians = Field(gt=0, lt=1.5707)
    n_max: RevsPerSecond = Field(gt=0)
    density: Density = Field(gt=0)
    x: Metres = Field(lt=0)
    rudder: SquareMetres = Field(gt=0)
    planes: SquareMetres = Field(gt=0)
    diameter: Metres = Field(gt=0)
    K_T: tuple[float, float]
    K_Q: tuple[float, float]
    wake: float = Field(gt=0, le=1)
    thrust_deduction: float = Field(ge=0, lt=1)

    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the commands: rudder, planes, and revolutions without astern revolutions."""
        return (
            CommandSpec("cmd_delta", "steer", self.limit),
            CommandSpec("cmd_delta_s", "dive", self.limit),
            CommandSpec("cmd_n", "drive", self.n_max, 0.0),
        )

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return (
            self.limited_servo(self.limit, None, "delta", "delta_s"),
            self.limited_servo(self.n_max, None, "n"),
        )

    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        import torch

        delta, delta_s, n = position.unbind(-1)
        dynamic_pressure = 0.5 * self.density * nu[..., 0].square()
        side_force = -dynamic_pressure * self.rudder * delta
        lift = -dynamic_pressure * self.planes * delta_s
        # the component of the normal forces along the hull, for small angles
        drag = -side_force * delta - lift * delta_s
        # J n |n| D = u_a n: the thrust coefficient is linear in the advance ratio J; astern
        # revolutions have no such term
        advance_product = self.wake * nu[..., 0] / self.diameter * n.clamp(min=0.0)
        thrust, torque = (
            self.density
            * self.diameter**diameter_power
            * (static_coefficient * n * n.abs() + advance_slope * advance_product)
            for diameter_power, (static_coefficient, advance_slope) in (
                (4, self.K_T),
                (5, self.K_Q),
            )
        )
        surge_force = (1.0 - self.thrust_deduction) * thrust - drag
        return torch.stack(
            (surge_force, side_force, lift, torque, -self.x * lift, self.x * side_force), dim=-1
        )
