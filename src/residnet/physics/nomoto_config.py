"""Configuration of Nomoto steering models at constant speed.

Source: Gouletas 2020, section 5.1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from residnet.core.config import MetresPerSecond
from residnet.physics.actuators.config import ServoSpec, SteeringGearConfig
from residnet.physics.parameters import Parameter, convert_to_unit
from residnet.physics.plant_channels import PlantChannels
from residnet.physics.vessel_file import VesselFile

if TYPE_CHECKING:
    from residnet.physics.nomoto import NomotoVessel

Gain = Annotated[Parameter, AfterValidator(convert_to_unit("1/s"))]
TimeConstant = Annotated[Parameter, AfterValidator(convert_to_unit("s"))]
SwayGain = Annotated[Parameter, AfterValidator(convert_to_unit("m/s"))]


class SteeringStateSpace(NamedTuple):
    """State-space model z_dot = A z + b delta with z = (v, r, internal states).

    Attributes:
        a: matrix A [k, k].
        b: vector b [k].
        internal_states: names of the internal states.
    """

    a: np.ndarray
    b: np.ndarray
    internal_states: tuple[str, ...] = ()


class NomotoVesselConfig(VesselFile, ABC):
    """Common configuration of all steering models.

    Attributes:
        speed: constant surge velocity u.
        K: yaw rate per rudder angle in a steady turn. K divided by the product of the time
            constants must be positive, so that the initial response to a starboard rudder is to
            starboard.
        rudder: limits and dynamics of the rudder.
    """

    pole_names: ClassVar[tuple[str, ...]]
    """Fields with the time constants of the denominator of r/delta."""
    speed: MetresPerSecond = Field(gt=0)
    K: Gain
    rudder: SteeringGearConfig

    @abstractmethod
    def state_space(self) -> SteeringStateSpace:
        """Return the linear model from rudder angle to sway velocity and yaw rate, in SI units."""

    @model_validator(mode="after")
    def _validate_turning_sense(self) -> NomotoVesselConfig:
        # r_ddot (or r_dot) right after a rudder step is K / (T1 T2) delta (or K / T delta)
        gain_ratio = self.K.value
        for name in self.pole_names:
            time_constant = getattr(self, name).value
            if time_constant == 0:
                raise ValueError(f"{name} must not be zero")
            gain_ratio /= time_constant
        if gain_ratio <= 0:
            raise ValueError(
                "K divided by the time constants must be positive, so that a starboard rudder turns"
                " the vessel to starboard (an unstable ship has negative K and a negative T)"
            )
        return self

    @final
    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return (self.rudder.servo_spec("delta"),)

    @final
    def plant_channels(self) -> PlantChannels:
        (rudder,) = self.servo_specs()
        velocities_and_pose = ("x", "y", "psi", "u", "v", "r")
        return PlantChannels(
            (*velocities_and_pose, *self.state_space().internal_states, *rudder.state_names),
            ("cmd_delta",),
            max_rudder=self.rudder.limit,
        )

    @final
    def build(self) -> NomotoVessel:
        from residnet.physics.nomoto import NomotoVessel

        return NomotoVessel(self)


class NomotoConfig(NomotoVesselConfig):
    """First-order model T r_dot + r = K delta without sideslip (Gouletas 2020, eq. (5.9)).

    Attributes:
        T: time constant in s.
    """

    pole_names = ("T",)
    kind: Literal["nomoto"]
    T: TimeConstant

    def state_space(self) -> SteeringStateSpace:
        """Return the state-space model of r with constant v."""
        k = self.K.value
        T = self.T.value
        # without sideslip v is constant: its derivative is zero
        return SteeringStateSpace(np.diag([0.0, -1.0 / T]), np.array([0.0, k / T]))


class SecondOrderSteeringConfig(NomotoVesselConfig, ABC):
    """Time constants of r/delta = K (1 + T3 s) / ((1 + T1 s)(1 + T2 s)).

    Attributes:
        T1: first time constant of the denominator in s.
        T2: second time constant of the denominator in s.
        T3: time constant of the numerator in s.

    Source: Gouletas 2020, eq. (5.3).
    """

    pole_names = ("T1", "T2")
    T1: TimeConstant
    T2: TimeConstant
    T3: TimeConstant

    def companion_matrix(self) -> np.ndarray:
        """Return the companion matrix [[0, 1], [-1 / (T1 T2), -(T1 + T2) / (T1 T2)]]."""
        time_product = self.T1.value * self.T2.value
        time_sum = self.T1.value + self.T2.value
        return np.array([[0.0, 1.0], [-1.0 / time_product, -time_sum / time_product]])


class SecondOrderNomotoConfig(SecondOrderSteeringConfig):
    """Second-order model of the yaw rate without sideslip.

    T1 T2 r_ddot + (T1 + T2) r_dot + r = K (delta + T3 delta_dot): Gouletas 2020, eq. (5.5),
    with the missing time derivatives (G12 in docs/documents/corrections.md).

    The internal state q = r_dot - K T3 / (T1 T2) delta, named `_yaw_lag`, avoids the derivative of
    the rudder angle.
    """

    kind: Literal["nomoto_second_order"]

    def state_space(self) -> SteeringStateSpace:
        """Return the state-space model of v, r and q."""
        k = self.K.value
        companion = self.companion_matrix()
        # -companion[1, 0] is 1 / (T1 T2); with r_dot = q + direct_gain delta the rudder rate
        # cancels
        direct_gain = -k * self.T3.value * companion[1, 0]
        a = np.zeros((3, 3))
        b = np.array([0.0, direct_gain, -k * companion[1, 0] + companion[1, 1] * direct_gain])
        a[1:, 1:] = companion
        return SteeringStateSpace(a, b, ("_yaw_lag",))


class SideslipNomotoConfig(SecondOrderSteeringConfig):
    """Second-order model in yaw and sway, given by its transfer functions.

    M nu_dot + N(u) nu = b delta with nu = (v, r) (Gouletas 2020, eq. (5.1)) has the transfer
    functions (5.3) and v/delta = K_v (1 + T_v s) / ((1 + T1 s)(1 + T2 s)), (5.4), in
    which the source prints u for v (see G12 in docs/documents/corrections.md).

    Attributes:
        K_v: steady sway velocity per rudder angle in m/s per rad.
        T_v: time constant of the numerator of sway in s.
    """

    kind: Literal["nomoto_sideslip"]
    K_v: SwayGain
    T_v: TimeConstant

    @model_validator(mode="after")
    def _validate_distinct_zeros(self) -> SideslipNomotoConfig:
        if self.K_v.value == 0 or self.T_v.value == self.T3.value:
            raise ValueError(
                "K_v must not be zero and T_v must differ from T3, otherwise sway is not an"
                " independent state; use kind nomoto_second_order"
            )
        return self

    def state_space(self) -> SteeringStateSpace:
        """Return the state-space model of v and r."""
        k = self.K.value
        k_v = self.K_v.value
        companion = self.companion_matrix()
        # controllable canonical form: (v, r) = output_matrix (y, y_dot) with the common denominator
        # of both transfer functions; the change of variables to (v, r) is a similarity transform
        output_matrix = np.array([[k_v, k_v * self.T_v.value], [k, k * self.T3.value]])
        return SteeringStateSpace(
            output_matrix @ companion @ np.linalg.inv(output_matrix),
            output_matrix @ np.array([0.0, -companion[1, 0]]),
        )
