"""Rudders behind propellers, in the race or not, and water jets.

Sources: the MMG standard method (Yasukawa and Yoshimura 2015); document 004, section 5.2.2.3;
document 000 eqs. (6.12)-(6.16), corrections H10 to H16.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import torch
from pydantic import AfterValidator, Field, field_validator, model_validator
from torch import Tensor

from residnet.core.config import (
    Config,
    Metres,
    Newtons,
    Radians,
    RadiansPerSecond,
    RevRate,
    RevsPerSecond,
)
from residnet.physics.actuators.base import (
    ActuatorConfig,
    Actuators,
    Coefficients,
    CurveRange,
    ServoConfig,
    ThrustCurve,
    require_range,
)
from residnet.physics.parameters import Density, Parameter, SquareMetres, above_zero, of_dimension


class SteeringGearConfig(ServoConfig):
    """The steering gear: how far and how fast the rudder turns.

    Attributes:
        limit: largest rudder angle of either side in rad.
        rate: largest rudder rate in rad/s; None for no limit.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class RudderConfig(SteeringGearConfig):
    """A rudder with its steering gear.

    Attributes:
        area: movable area.
        aspect_ratio: height over mean chord; the slope of the normal force is 6.13 L / (L + 2.25)
            (Fujii).
        x: of the rudder stock from the body origin, negative aft.
        race_share: share of the area in the propeller's race; 0 for a force that grows with u^2
            alone.
        straightening: share of the local drift angle that reaches the rudder; 0 for a rudder that
            sees the flow from ahead only.
    """

    area: SquareMetres = Field(gt=0)
    aspect_ratio: float = Field(gt=0)
    x: Metres = Field(lt=0)
    race_share: float = Field(default=0.0, ge=0, le=1)
    straightening: float = Field(default=1.0, ge=0, le=1)


class PropellerConfig(ServoConfig):
    """A propeller on its shaft.

    Attributes:
        diameter: of the disc.
        forward: coefficients c0 [N], c1 [N s], c2 [N s^2] of the thrust c0 + c1 n + c2 n^2 at
            standstill for n > 0 [1/s]; it never opposes the rotation.
        reverse: coefficients for n < 0.
        curve_range: revolutions (astern, ahead) that these were measured between; they must include
            +-n_max.
        n_max: largest revolutions of either direction; commands beyond it saturate.
        n_rate: rate limit of the shaft; None for no limit.
        advance_loss: thrust lost per revolution and speed, T = curve - advance_loss |n| u [N
            s^2/m], u >= 0; K_T falls linearly.
        thrust_deduction: share t of the thrust that the hull takes back.
    """

    diameter: Metres = Field(gt=0)
    forward: Coefficients
    reverse: Coefficients
    curve_range: CurveRange | None = None
    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)
    advance_loss: float = Field(default=0.0, ge=0)
    thrust_deduction: float = Field(default=0.0, ge=0, lt=1)

    @model_validator(mode="after")
    def _range(self) -> PropellerConfig:
        require_range(self)
        return self


class RudderPropellerConfig(ActuatorConfig):
    """A propeller and a rudder, without hull interaction.

    Normal force and inflow are those of the MMG standard method (Yasukawa and Yoshimura 2015).

    F_N = 0.5 rho A f sin(delta_e) U_R^2, X = -F_N sin delta, Y = -F_N cos delta, N = x Y; delta > 0
    turns to starboard. The inflow is U_R^2 = u|u| + race_share 2 T / (rho A_p): the race of an
    actuator disc, fully contracted.

    Attributes:
        rudder: the rudder.
        propeller: the propeller.
        density: of the water in kg/m^3.
    """

    kind: Literal["rudder_propeller"] = "rudder_propeller"
    rudder: RudderConfig
    propeller: PropellerConfig
    density: Density = Field(default=1025.0, gt=0)

    def build(self) -> RudderPropeller:
        return RudderPropeller(self)


@final
class RudderPropeller(Actuators):
    """The forces tau [..., 3] of a propeller and a rudder.

    Commands are cmd_delta [rad] and cmd_n [1/s]; states are delta and n where they do not follow at
    once.
    """

    commands = ("cmd_delta", "cmd_n")

    def __init__(self, config: RudderPropellerConfig) -> None:
        rudder, propeller = config.rudder, config.propeller
        super().__init__(
            rudder.follow(rudder.limit, rudder.rate, "delta"),
            propeller.follow(propeller.n_max, propeller.n_rate, "n"),
        )
        self.config = config
        self.curve = ThrustCurve([propeller.forward], [propeller.reverse])
        slope = 6.13 * rudder.aspect_ratio / (rudder.aspect_ratio + 2.25)
        self.lift = 0.5 * config.density * rudder.area * slope
        disc = 0.25 * math.pi * propeller.diameter**2
        self.race = rudder.race_share * 2.0 / (config.density * disc)

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the rudder angle from steer and revolutions from drive, as shares of their limits.

        Steer to starboard is positive.
        """
        angle = steer.clamp(-1.0, 1.0) * self.config.rudder.limit
        return torch.stack((angle, drive.clamp(-1.0, 1.0) * self.config.propeller.n_max), dim=-1)

    def thrust(self, n: Tensor, u: Tensor) -> Tensor:
        """Return the thrust [N] of the propeller at n [1/s] and speed through the water u [m/s]."""
        loss = self.config.propeller.advance_loss
        thrust: Tensor = self.curve(n) - loss * n.abs() * u.clamp(min=0.0)
        return thrust

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        rudder, position = self.config.rudder, self.positions(a, command)
        delta, u = position[..., 0], nu[..., 0]
        thrust = self.thrust(position[..., 1], u)
        square = u * u.abs() + self.race * thrust.clamp(min=0.0)
        across = rudder.straightening * (nu[..., 1] + rudder.x * nu[..., 2])
        # the offset keeps the gradient finite at rest
        inflow = torch.sqrt(square.abs() + 1e-8)
        normal = self.lift * (square * torch.sin(delta) + inflow * across * torch.cos(delta))
        side = -normal * torch.cos(delta)
        ahead = (1.0 - self.config.propeller.thrust_deduction) * thrust
        return torch.stack((ahead - normal * torch.sin(delta), side, rudder.x * side), dim=-1)


class SternRuddersConfig(SteeringGearConfig, ActuatorConfig, ABC):
    """Rudders that move together behind propellers whose thrust is commanded.

    Attributes:
        x: place of the rudders' centre of pressure ahead of the body origin in m; negative aft.
        z: the same below the body origin in m.
        thrust: of all propellers together at full drive; the source knows no astern thrust, so
            commands hold between zero and this.
    """

    x: Metres = Field(lt=0)
    z: Metres
    thrust: Newtons = Field(gt=0)

    @abstractmethod
    def foil(self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lift and drag [...] in N of all rudders.

        Args:
            delta: rudder angle [...] in rad.
            u: surge velocity through the water [...] in m/s.
            v: sway velocity through the water [...] in m/s.
            thrust: of all propellers [...] in N.
        """

    @final
    def build(self) -> SternRudders:
        return SternRudders(self)


@final
class FoilRuddersConfig(SternRuddersConfig):
    """Rudders as foils in the open water's speed, corrected for the propellers' race.

    Document 004 eqs. (5.20)-(5.25), corrections G8, G11. The drag at zero angle belongs to the
    hull's calm-water resistance.

    Attributes:
        rudders: how many rudders share the lift evenly.
        propellers: how many propellers share the thrust evenly.
        area: of one rudder.
        aspect_ratio: effective, of the induced drag C_L^2 / (0.9 pi a).
        lift_slope: dC_L/d alpha per rad.
        stall: angle of attack beyond which lift and drag grow no more.
        diameter: of a propeller.
        density: of the water.
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

    def foil(self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor) -> tuple[Tensor, Tensor]:
        disc = 0.25 * math.pi * self.diameter**2
        # C_Th V^2 per newton of total thrust: each propeller has its share
        loading = 2.0 / (self.propellers * self.density * disc)
        angle = delta.clamp(-self.stall, self.stall)
        square = u * u + v * v
        # 1/sqrt(1 + C_Th); the offset keeps it and its gradient finite at rest
        share = torch.sqrt((square + 1e-20) / (square + loading * thrust + 1e-20))
        race = thrust * (1.0 + share)
        coefficient = self.lift_slope * angle
        flow = 0.5 * self.density * self.area * self.rudders * square
        induced = 1.0 / (0.9 * math.pi * self.aspect_ratio)
        lift = flow * coefficient + race * torch.sin(angle)
        drag = flow * induced * coefficient * coefficient + race * (1.0 - torch.cos(angle))
        return lift, drag


@final
class LinearRuddersConfig(SternRuddersConfig):
    """Rudders whose side force is Y_delta_uu u^2 delta, without drag and race.

    Source: document 004, Table 5.3.

    Attributes:
        Y_delta_uu: of all rudders together, in kg/m per rad.
    """

    kind: Literal["linear_rudders"] = "linear_rudders"
    Y_delta_uu: float = Field(gt=0)

    def foil(self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor) -> tuple[Tensor, Tensor]:
        return self.Y_delta_uu * u * u * delta, torch.zeros_like(delta)


@final
class SternRudders(Actuators):
    """The forces tau [..., 4] along x, y and about x, z of rudders and propellers at the stern.

    Commands are cmd_delta [rad] and cmd_thrust [N]; delta [rad] is a state where the rudder has a
    rate.

    delta > 0 turns to starboard: Y = -L, K = z L, N = -x L, X = T - D (document 004 eqs.
    (5.26)-(5.29), signs as in corrections G9, G10).
    """

    commands = ("cmd_delta", "cmd_thrust")

    def __init__(self, config: SternRuddersConfig) -> None:
        super().__init__(config.follow(config.limit, config.rate, "delta"))
        self.config = config
        self.delta_max, self.thrust_max = config.limit, config.thrust

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return rudder angle and thrust [..., 2] for steer and drive, shares of their limits.

        There is no thrust astern.
        """
        angle, thrust = steer.clamp(-1.0, 1.0), drive.clamp(0.0, 1.0)
        return torch.stack((angle * self.delta_max, thrust * self.thrust_max), dim=-1)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        delta = self.positions(a, command)[..., 0]
        thrust = command[..., 1].clamp(0.0, self.thrust_max)
        lift, drag = self.config.foil(delta, nu[..., 0], nu[..., 1], thrust)
        return torch.stack(
            (thrust - drag, -lift, self.config.z * lift, -self.config.x * lift), dim=-1
        )

    def followed(self, command: Tensor) -> Tensor:
        """Return the rudder's command [..., 1]; thrust acts at once."""
        return command[..., :1]


Force = Annotated[Parameter, AfterValidator(of_dimension(1, 1, -2))]
ForcePerSpeed = Annotated[Parameter, AfterValidator(of_dimension(1, 0, -1))]
ForcePerSquaredSpeed = Annotated[Parameter, AfterValidator(of_dimension(1, -1, 0))]
Ratio = Annotated[Parameter, AfterValidator(of_dimension(0, 0, 0))]
PerRevolutions = Annotated[Parameter, AfterValidator(of_dimension(0, 0, 1))]
PerSquaredRevolutions = Annotated[Parameter, AfterValidator(of_dimension(0, 0, 2))]


class SpeedCurve(Config):
    """The thrust at reference revolutions over the speed through the water: a0 + a1 u + a2 u^2.

    Attributes:
        a0: thrust at rest in N.
        a1: slope in N s/m.
        a2: curvature in N s^2/m^2.
    """

    a0: Force
    a1: ForcePerSpeed
    a2: ForcePerSquaredSpeed


class RevolutionsCurve(Config):
    """The share of that thrust at n revolutions per second: (r0 + r1 n + r2 n^2) / reference.

    Attributes:
        r0: share at rest, dimensionless.
        r1: slope in s.
        r2: curvature in s^2.
        reference: value of the polynomial at the reference revolutions, dimensionless.
    """

    r0: Ratio
    r1: PerRevolutions
    r2: PerSquaredRevolutions
    reference: Ratio

    _positive = field_validator("reference")(above_zero)


class MotorConfig(ServoConfig):
    """The motor of each jet, which turns in one direction.

    Attributes:
        n_max: largest revolutions in 1/s.
        n_rate: largest change of revolutions in 1/s^2; None for at once.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)


class WaterJetsConfig(ActuatorConfig):
    """Equal water jets that turn and run together.

    Commands are cmd_n [1/s] and cmd_nozzle [rad], whose thrust pushes to starboard where positive.

    Attributes:
        jets: how many there are.
        x: place of the nozzles ahead of the body origin; negative astern.
        speed: parabola of the thrust of one jet over the speed; its product with `revolutions` is
            the thrust (6.16), which may be negative below some revolutions (H15).
        revolutions: parabola of the thrust over the revolutions.
        motor: limits of the revolutions.
        nozzle: limits of the angle of the nozzles, which direct the jets.
    """

    kind: Literal["water_jets"]
    jets: int = Field(gt=0)
    x: Metres
    speed: SpeedCurve
    revolutions: RevolutionsCurve
    motor: MotorConfig
    nozzle: SteeringGearConfig

    def build(self) -> WaterJets:
        return WaterJets(self)


@final
class WaterJets(Actuators):
    """The forces tau [..., 3] of water jets from motor speed and nozzle angle."""

    commands = ("cmd_n", "cmd_nozzle")

    def __init__(self, config: WaterJetsConfig) -> None:
        motor, nozzle = config.motor, config.nozzle
        super().__init__(
            motor.follow(motor.n_max, motor.n_rate, "n"),
            nozzle.follow(nozzle.limit, nozzle.rate, "nozzle"),
        )
        self.config = config

    def thrust(self, n: Tensor, u: Tensor) -> Tensor:
        """Return the thrust [N] of one jet at revolutions n [1/s] and speed u [m/s], any shape.

        Source: document 000 eq. (6.16).
        """
        a, r = self.config.speed, self.config.revolutions
        by_speed = a.a0.value + u * (a.a1.value + u * a.a2.value)
        share = (r.r0.value + n * (r.r1.value + n * r.r2.value)) / r.reference.value
        return by_speed * share

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., 2] for drive and steer.

        Drive ahead is the share of the motor's revolutions (jets do not push astern), steer the yaw
        moment's sense.
        """
        limit = self.config.nozzle.limit
        side = steer.clamp(-1.0, 1.0) * (limit if self.config.x > 0 else -limit)
        return torch.stack((drive.clamp(0.0, 1.0) * self.config.motor.n_max, side), dim=-1)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        n, angle = self.positions(a, command).unbind(-1)
        total = self.config.jets * self.thrust(n, nu[..., 0])
        across = total * torch.sin(angle)
        return torch.stack((total * torch.cos(angle), across, self.config.x * across), dim=-1)

    def followed(self, command: Tensor) -> Tensor:
        """Return the commands [..., 2] without negative revolutions."""
        return torch.stack((command[..., 0].clamp(min=0.0), command[..., 1]), dim=-1)


class TorpedoFinsConfig(ServoConfig, ActuatorConfig):
    """A propeller, a rudder and stern planes at the tail of a torpedo, each behind the same lag.

    Commands are cmd_delta [rad] (positive to starboard), cmd_delta_s [rad] (positive to dive) and
    cmd_n [1/s].

    Attributes:
        limit: largest angle of rudder and planes.
        n_max: largest revolutions.
        density: of the water.
        x: place of the fins ahead of the body origin; negative aft.
        rudder: area times slope of the lift coefficient by angle.
        planes: the same of the stern planes together.
        diameter: of the propeller.
        K_T: thrust coefficients at rest and per advance number.
        K_Q: torque coefficients at rest and per advance number.
        wake: speed at the propeller by that of the vessel.
        thrust_deduction: share of the thrust that the hull loses again.
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

    def build(self) -> TorpedoFins:
        return TorpedoFins(self)


@final
class TorpedoFins(Actuators):
    """The forces tau [..., 6] of fins and propeller.

    The lift of a fin is across the hull, its drag grows by the square of its angle. Astern the
    propeller has its thrust at rest.

    Source: Fossen's model of the REMUS 100 (PythonVehicleSimulator, vehicles/remus100.py).
    """

    commands = ("cmd_delta", "cmd_delta_s", "cmd_n")

    def __init__(self, config: TorpedoFinsConfig) -> None:
        super().__init__(
            config.follow(config.limit, None, "delta", "delta_s"),
            config.follow(config.n_max, None, "n"),
        )
        self.config = config
        self.diving = torch.tensor([0.0, config.limit, 0.0], dtype=torch.float64)

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return rudder, planes amidships and revolutions [..., 3], shares of their limits."""
        angle = steer.clamp(-1.0, 1.0) * self.config.limit
        turning = drive.clamp(0.0, 1.0) * self.config.n_max
        return torch.stack((angle, torch.zeros_like(angle), turning), dim=-1)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        c, position = self.config, self.positions(a, command)
        delta, dive, n = position.unbind(-1)
        square = 0.5 * c.density * nu[..., 0].square()
        side, lift = -square * c.rudder * delta, -square * c.planes * dive
        drag = -side * delta - lift * dive
        advance = c.wake * nu[..., 0] / c.diameter * n.clamp(min=0.0)
        thrust, torque = (
            c.density * c.diameter**power * (rest * n * n.abs() + slope * advance)
            for power, (rest, slope) in ((4, c.K_T), (5, c.K_Q))
        )
        ahead = (1.0 - c.thrust_deduction) * thrust - drag
        return torch.stack((ahead, side, lift, torque, -c.x * lift, c.x * side), dim=-1)
