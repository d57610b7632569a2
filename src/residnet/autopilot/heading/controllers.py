"""Configurations of heading and depth controllers; missing parameters (null) are tuned."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.autopilot.base import Policy
from residnet.autopilot.heading.classical import (
    BangBangHeading,
    HeadingLaw,
    ProximateTimeOptimalLaw,
    RatedBangBangHeading,
    RegulatorLaw,
    regulator_gains,
)
from residnet.autopilot.heading.policies import (
    LOS_CONSTANTS,
    AnglePolicy,
    DepthPolicy,
    NetworkPolicy,
    ObserverPolicy,
)
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap_angle
from residnet.dynamics.store import Stored, read_spec, read_weights


class ControlTask(NamedTuple):
    """Task that a controller is built for.

    Attributes:
        vessel: controlled vessel.
        nomoto: Nomoto model of the vessel.
        limit: rudder limit in rad.
        dt: time step of the controller in s.
    """

    vessel: SteeredVessel
    nomoto: NomotoModel
    limit: float
    dt: float


class SearchRange(NamedTuple):
    """Logarithmic search range of a tuned parameter.

    Attributes:
        lower, upper: limits of the range, non-dimensional.
        disabled_value: value that switches the parameter's term off; None if it cannot be switched
            off. Tuning also tries this value, so that the result is never worse than the simpler
            law.
        time_power: power of T that the values are multiplied by to obtain SI units.
        is_distance: whether the values are also multiplied by the speed.
    """

    lower: float
    upper: float
    disabled_value: float | None = None
    time_power: int = 0
    is_distance: bool = False

    def to_si(self, nomoto: NomotoModel) -> SearchRange:
        """Convert the range to SI units for a vessel."""
        scale = nomoto.time**self.time_power * (nomoto.speed if self.is_distance else 1.0)
        disabled_value = None if self.disabled_value is None else self.disabled_value * scale
        return SearchRange(self.lower * scale, self.upper * scale, disabled_value)


@final
class LinearLaw(AnglePolicy):
    """The law kp e - kd r + ki I on filtered measurements, with separate gains for every row.

    First-order low-pass filters of heading and yaw rate attenuate noise and wave motion. The
    integration stops while the rudder is saturated (anti-windup).

    Memory [B, 3]: I [rad s], filtered heading [rad] and filtered yaw rate [rad/s].

    Args:
        task: vessel, rudder limit and time step.
        gains: kp, kd [s], ki [1/s] and time constant of the filter [s]; [B] or scalar each.
    """

    PARAMETERS: ClassVar[tuple[str, ...]] = ("kp", "kd", "ki", "filter_time")

    def __init__(self, task: ControlTask, gains: Sequence[Tensor]) -> None:
        super().__init__()
        self.set_state_columns(task.vessel.state)
        self.set_step(task.dt)
        self.limit = task.limit
        for name, gain in zip(self.PARAMETERS, gains, strict=True):
            self.register_buffer(name, gain.reshape(-1, 1), persistent=False)
        self.kp: Tensor
        self.kd: Tensor
        self.ki: Tensor
        self.filter_time: Tensor
        self.n_state = 3

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory: filters at the measured values, integral zero."""
        measured = x[:, [self.psi_column, self.r_column]]
        return torch.cat((torch.zeros_like(measured[:, :1]), measured), dim=1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        # exact step of the filter; a time constant of zero gives the factor 1, no filter
        filter_factor = 1.0 - torch.exp(-self.dt / self.filter_time.clamp(min=1e-6))
        # the difference is wrapped, so that the filter does not turn the long way round at +-pi
        measured_heading = x[:, self.psi_column : self.psi_column + 1]
        measured_rate = x[:, self.r_column : self.r_column + 1]
        heading = s[:, 1:2] + filter_factor * wrap_angle(measured_heading - s[:, 1:2])
        rate = s[:, 2:3] + filter_factor * (measured_rate - s[:, 2:3])
        error = wrap_angle(reference - heading)
        integral = s[:, 0:1]
        unlimited_command = self.kp * error - self.kd * rate + self.ki * integral
        is_winding_up = (unlimited_command.abs() > self.limit) & (unlimited_command * error > 0)
        next_integral = torch.where(is_winding_up, integral, integral + self.dt * error)
        return unlimited_command.clamp(-self.limit, self.limit), torch.cat(
            (next_integral, heading, rate), dim=1
        )


class ControllerConfig(Config, ABC):
    """Base class of the configs of heading controllers, whose `build` returns the controller."""

    @abstractmethod
    def build(self, task: ControlTask) -> Policy:
        """Build the controller for a vessel.

        Raises:
            ConfigError: if a gain is missing; it must be given or tuned.
        """


class TunableConfig(ControllerConfig, ABC):
    """Configuration of a controller whose missing parameters are tuned within `ranges`."""

    ranges: ClassVar[Mapping[str, SearchRange]]

    @property
    @abstractmethod
    def batched_parameters(self) -> tuple[str, ...]:
        """Names of the attributes of the batched controller that differ between rows."""

    def parameter_values(self) -> dict[str, float | None]:
        """Return the parameters by name; None for parameters to be tuned."""
        return {name: getattr(self, name) for name in self.ranges}

    def search_ranges(self, nomoto: NomotoModel) -> dict[str, SearchRange]:
        """Return the search ranges by parameter, in SI units."""
        return {name: search_range.to_si(nomoto) for name, search_range in self.ranges.items()}

    @abstractmethod
    def build_batched(self, parameters: Mapping[str, Tensor], task: ControlTask) -> Policy:
        """Build a controller with separate parameters [B] for every row."""

    def with_parameters(self, parameters: Mapping[str, float]) -> Self:
        """Return a copy in which the given parameters replace earlier or missing ones."""
        return type(self).model_validate(self.model_dump() | dict(parameters))

    def complete_parameters(self) -> dict[str, float]:
        """Return the parameters by name.

        Raises:
            ConfigError: if a parameter is missing.
        """
        parameters = self.parameter_values()
        if missing := [name for name, value in parameters.items() if value is None]:
            raise ConfigError(
                f"controller without {', '.join(missing)}: tune it first or give them"
            )
        return {name: value for name, value in parameters.items() if value is not None}


# from nearly no filter to a time constant that slows down the closed loop
_FILTER_RANGES = {"filter_time": SearchRange(0.002, 0.3, time_power=1)}


class LinearLawConfig(TunableConfig, ABC):
    """A linear law kp e - kd r + ki I whose missing parameters are tuned.

    Attributes:
        filter_time: time constant of the low-pass filters of heading and yaw rate in s; null to
            tune it with the other parameters, or for no filter if all others are given.
    """

    filter_time: Seconds | None = Field(default=None, ge=0)

    @property
    def batched_parameters(self) -> tuple[str, ...]:
        return LinearLaw.PARAMETERS

    @abstractmethod
    def gains(
        self, parameters: Mapping[str, Tensor], nomoto: NomotoModel
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Convert parameters of any shape to kp, kd and ki."""

    @final
    def parameter_values(self) -> dict[str, float | None]:
        parameters = super().parameter_values()
        filter_time = parameters.pop("filter_time")
        if filter_time is None and None not in parameters.values():
            filter_time = 0.0
        return {**parameters, "filter_time": filter_time}

    def build(self, task: ControlTask) -> LinearLaw:
        """Build the law with these parameters."""
        parameters = {
            name: torch.tensor([value]).double()
            for name, value in self.complete_parameters().items()
        }
        return self.build_batched(parameters, task)

    def build_batched(self, parameters: Mapping[str, Tensor], task: ControlTask) -> LinearLaw:
        """Build the law with separate gains for every row."""
        gains = self.gains(parameters, task.nomoto)
        return LinearLaw(task, [*gains, parameters["filter_time"]])


class PdConfig(LinearLawConfig):
    """Proportional and derivative action on the heading error.

    Attributes:
        kp: proportional gain in rad of rudder per rad of heading error.
        damping_time: kd / kp in s.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "kp": SearchRange(0.3, 60.0),
        "damping_time": SearchRange(0.05, 2.0, time_power=1),
        **_FILTER_RANGES,
    }
    kind: Literal["pd"] = "pd"
    kp: float | None = Field(default=None, gt=0)
    damping_time: Seconds | None = Field(default=None, gt=0)

    def gains(
        self, parameters: Mapping[str, Tensor], nomoto: NomotoModel
    ) -> tuple[Tensor, Tensor, Tensor]:
        return (
            parameters["kp"],
            parameters["kp"] * parameters["damping_time"],
            torch.zeros_like(parameters["kp"]),
        )


class PidConfig(PdConfig):
    """A PID law with anti-windup: the integration stops while the rudder is saturated.

    Attributes:
        integral_time: kp / ki in s.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "kp": SearchRange(0.3, 60.0),
        "damping_time": SearchRange(0.05, 2.0, time_power=1),
        # with 1e6 T the integral term vanishes in single precision
        "integral_time": SearchRange(1.0, 50.0, disabled_value=1e6, time_power=1),
        **_FILTER_RANGES,
    }
    kind: Literal["pid"] = "pid"  # type: ignore[assignment]
    integral_time: Seconds | None = Field(default=None, gt=0)

    def gains(
        self, parameters: Mapping[str, Tensor], nomoto: NomotoModel
    ) -> tuple[Tensor, Tensor, Tensor]:
        kp, kd, _ = super().gains(parameters, nomoto)
        return kp, kd, kp / parameters["integral_time"]


class LqrConfig(LinearLawConfig):
    """A linear-quadratic regulator of T r_dot + r = K delta.

    It minimises the integral of heading_weight e^2 + rate_weight (T r)^2 + delta^2. The Riccati
    equation of this model has the solution kp = sqrt(heading_weight),
    (1 + K kd)^2 = 1 + K^2 T^2 rate_weight + 2 K T kp.

    Attributes:
        heading_weight: weight of the squared heading error, dimensionless; None to tune it.
        rate_weight: weight of the squared yaw rate times T, dimensionless; None to tune it.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "heading_weight": SearchRange(0.1, 3600.0),
        "rate_weight": SearchRange(1e-3, 3600.0),
        **_FILTER_RANGES,
    }
    kind: Literal["lqr"] = "lqr"
    heading_weight: float | None = Field(default=None, gt=0)
    rate_weight: float | None = Field(default=None, ge=0)

    def gains(
        self, parameters: Mapping[str, Tensor], nomoto: NomotoModel
    ) -> tuple[Tensor, Tensor, Tensor]:
        gain = torch.tensor(nomoto.gain)
        time = torch.tensor(nomoto.time)
        kp, kd = regulator_gains(
            parameters["heading_weight"], parameters["rate_weight"], gain, time
        )
        return kp, kd, torch.zeros_like(kp)


class BangBangConfig(ControllerConfig):
    """Time-optimal control of T r_dot + r = K delta with exact knowledge of vessel and rudder rate.

    It is the lower bound of the settling time of the nominal vessel.
    """

    kind: Literal["bang_bang"] = "bang_bang"

    def build(self, task: ControlTask) -> Policy:
        vessel = task.vessel
        nomoto = task.nomoto
        if vessel.rate is not None:
            return RatedBangBangHeading(
                vessel.state,
                gain=nomoto.gain,
                time=nomoto.time,
                limit=task.limit,
                rate=vessel.rate,
                dt=task.dt,
            )
        return BangBangHeading(
            task.vessel.state,
            gain=task.nomoto.gain,
            time=task.nomoto.time,
            limit=task.limit,
        )


Positive = Annotated[float, Field(gt=0)]


_OBSERVER_RANGES = {
    "heading_rate": SearchRange(1.0, 120.0, time_power=-1),
    "yaw_rate_rate": SearchRange(1.0, 120.0, time_power=-1),
    "push_rate": SearchRange(0.08, 30.0, time_power=-1),
    "cross_rate": SearchRange(0.15, 150.0, time_power=-2),
}
"""Ranges of the search for the gains of the observer, which scale with the times of the vessel."""


class ObservedConfig(TunableConfig, ABC):
    """A control law on the estimates of a disturbance observer with a dead-time predictor.

    Attributes:
        lag: dead time in s between a command and the rudder; 0 for no predictor.
        heading_rate: observer gain from heading innovation to heading in 1/s; null to tune it.
        yaw_rate_rate: observer gain from yaw-rate innovation to yaw rate in 1/s; null to tune it.
        push_rate: observer gain from yaw-rate innovation to disturbance in 1/s; null to tune it.
        cross_rate: observer gain from heading innovation to yaw rate in 1/s^2; null to tune it.
    """

    lag: Seconds = Field(default=0.0, ge=0, le=60.0)
    heading_rate: Positive | None = None
    yaw_rate_rate: Positive | None = None
    push_rate: Positive | None = None
    cross_rate: Positive | None = None

    @property
    def batched_parameters(self) -> tuple[str, ...]:
        return ("constants",)

    @abstractmethod
    def build_law(self, limit: float, rate: float | None) -> HeadingLaw:
        """Build the law for a rudder limit in rad and a rudder rate in rad/s (None: no limit)."""

    def build(self, task: ControlTask) -> ObserverPolicy:
        return self.build_batched(self.complete_parameters(), task)

    def build_batched(
        self, parameters: Mapping[str, float | Tensor], task: ControlTask
    ) -> ObserverPolicy:
        """Build the policy without a network; each constant is a scalar or [B]."""
        vessel = task.vessel
        return ObserverPolicy(
            vessel.state,
            nomoto=task.nomoto,
            law=self.build_law(task.limit, vessel.rate),
            constants=parameters,
            limit=task.limit,
            dt=task.dt,
            rate=vessel.rate,
            lag=self.lag,
        )


class ObservedLqrConfig(ObservedConfig):
    """A linear-quadratic regulator with a disturbance observer.

    Attributes:
        heading_weight: weight of the squared heading error, dimensionless.
        rate_weight: weight of the squared yaw rate times T, dimensionless.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "heading_weight": SearchRange(0.01, 3600.0),
        "rate_weight": SearchRange(1e-3, 3600.0),
        **_OBSERVER_RANGES,
    }
    kind: Literal["lqr_observer"] = "lqr_observer"
    heading_weight: Positive | None = None
    rate_weight: Positive | None = None

    def build_law(self, limit: float, rate: float | None) -> HeadingLaw:
        """Build the linear regulator for a rudder limit in rad."""
        return RegulatorLaw(limit)


class PtosConfig(ObservedConfig):
    """The proximate time-optimal law with a disturbance observer.

    Attributes:
        steepness: gain from heading error in rad to the fraction of the rudder limit.
        share: fraction of the available braking acceleration that the law relies on.
        damping: damping ratio near the reference.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "steepness": SearchRange(3.0, 600.0),
        "share": SearchRange(0.2, 1.2),
        "damping": SearchRange(0.3, 3.0),
        **_OBSERVER_RANGES,
    }
    kind: Literal["ptos"] = "ptos"
    steepness: Positive | None = None
    share: Positive | None = None
    damping: Positive | None = None

    def build_law(self, limit: float, rate: float | None) -> HeadingLaw:
        # the time that the rudder needs from zero to its limit
        return ProximateTimeOptimalLaw(0.0 if rate is None else limit / rate)


AnyObservedLaw = Annotated[ObservedLqrConfig | PtosConfig, Field(discriminator="kind")]

AnyPitchLaw = Annotated[
    PdConfig | PidConfig | LqrConfig | ObservedLqrConfig | PtosConfig, Field(discriminator="kind")
]


class DepthConfig(TunableConfig):
    """Line-of-sight depth guidance with an inner law on the dive angle; tuned jointly.

    Attributes:
        pitch: inner law on the dive angle; any law for the heading.
        steepest: largest desired dive angle in rad.
        lookahead: look-ahead distance in m; null to tune it, also for the following gains.
        depth_rate: observer gain of the depth in 1/s.
        drift_rate: observer gain of the vertical drift in 1/s.
    """

    # distances scale with speed times T, the distance covered while the dive angle changes
    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "lookahead": SearchRange(0.3, 20.0, time_power=1, is_distance=True),
        "depth_rate": SearchRange(0.05, 20.0, time_power=-1),
        "drift_rate": SearchRange(0.01, 1.0, time_power=-1),
    }
    kind: Literal["depth"] = "depth"
    pitch: AnyPitchLaw
    steepest: Radians = Field(default=0.5235987755982988, gt=0, lt=1.3)
    lookahead: Annotated[Metres, Field(gt=0)] | None = None
    depth_rate: Positive | None = None
    drift_rate: Positive | None = None

    @property
    def batched_parameters(self) -> tuple[str, ...]:
        return ("constants", *(f"inner_policy.{name}" for name in self.pitch.batched_parameters))

    def parameter_values(self) -> dict[str, float | None]:
        """Return the parameters of the line of sight and of the inner policy."""
        return super().parameter_values() | self.pitch.parameter_values()

    def search_ranges(self, nomoto: NomotoModel) -> dict[str, SearchRange]:
        return super().search_ranges(nomoto) | self.pitch.search_ranges(nomoto)

    def with_parameters(self, parameters: Mapping[str, float]) -> Self:
        """Return a copy with parameter values, including the inner law."""
        sight_parameters = {name: parameters[name] for name in LOS_CONSTANTS if name in parameters}
        law_parameters = {
            name: value for name, value in parameters.items() if name not in sight_parameters
        }
        return self.model_copy(
            update={**sight_parameters, "pitch": self.pitch.with_parameters(law_parameters)}
        )

    def build_batched(self, parameters: Mapping[str, Tensor], task: ControlTask) -> DepthPolicy:
        """Build the policy with separate constants for every row."""
        return self.build_policy(self.pitch.build_batched(parameters, task), parameters, task)

    def build(self, task: ControlTask) -> DepthPolicy:
        return self.build_policy(self.pitch.build(task), self.complete_parameters(), task)

    def build_policy(
        self, law: AnglePolicy, constants: Mapping[str, float | Tensor], task: ControlTask
    ) -> DepthPolicy:
        """Build the policy around an inner law; each constant is a scalar or [B]."""
        return DepthPolicy(
            task.vessel.state,
            nomoto=task.nomoto,
            law=law,
            constants=constants,
            steepest=self.steepest,
            limit=task.limit,
            dt=task.dt,
            rate=task.vessel.rate,
        )


def angle_law_of(controller: object) -> object:
    """Return the inner law of a depth controller, or the controller itself otherwise."""
    return controller.pitch if isinstance(controller, DepthConfig) else controller


ClassicalController = Annotated[
    PdConfig
    | PidConfig
    | LqrConfig
    | ObservedLqrConfig
    | PtosConfig
    | BangBangConfig
    | DepthConfig,
    Field(discriminator="kind"),
]


class _PolicySpec(Stored):
    """Common fields of the stored specifications of learned heading policies.

    Attributes:
        state: names of the state of the vessel used in training.
        gain: Nomoto gain K of that vessel on a straight course in 1/s.
        time: Nomoto time constant T of that vessel in s.
        speed: speed in m/s that K and T refer to.
        righting: restoring coefficient c of the dive angle; zero for a heading.
        limit: rudder limit in rad.
        rate: rudder rate in rad/s; None for a rudder without a rate limit.
        dt: time step in s.
        trained_at: time step of training in s.
    """

    state: tuple[str, ...]
    gain: float
    time: float = Field(gt=0)
    speed: float
    righting: float = 0.0
    limit: float = Field(gt=0)
    rate: float | None = Field(gt=0)
    dt: float = Field(gt=0)
    trained_at: float = Field(gt=0)

    @property
    def nomoto(self) -> NomotoModel:
        """Nomoto model of the vessel used in training, on a straight course."""
        return NomotoModel(self.gain, self.time, self.speed, self.righting)


class ObserverPolicySpec(_PolicySpec):
    """Stored specification of a heading policy with observer, predictor and recurrent network.

    Attributes:
        schema_name: name and version of the format.
        law: control law with the initial constants of the training.
        units: units of the network; 0 for no network.
    """

    schema_name: Literal["residnet.observed_policy/1"] = Field(
        default="residnet.observed_policy/1", alias="schema"
    )
    law: AnyObservedLaw
    units: int = Field(ge=0, le=10_000)

    def build(self) -> ObserverPolicy:
        """Build the policy with random initial weights."""
        return ObserverPolicy(
            self.state,
            nomoto=self.nomoto,
            law=self.law.build_law(self.limit, self.rate),
            constants=self.law.complete_parameters(),
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            lag=self.law.lag,
            units=self.units,
            training_time_step=self.trained_at,
        )


class NetworkPolicySpec(_PolicySpec):
    """Stored specification of a heading policy that is a recurrent network alone.

    Attributes:
        schema_name: name and version of the format.
        units: units of the network.
    """

    schema_name: Literal["residnet.network_policy/1"] = Field(
        default="residnet.network_policy/1", alias="schema"
    )
    units: int = Field(ge=1, le=10_000)

    def build(self) -> NetworkPolicy:
        """Build the policy with an untrained network."""
        return NetworkPolicy(
            self.state,
            nomoto=self.nomoto,
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            units=self.units,
            training_time_step=self.trained_at,
        )


class DepthPolicySpec(Stored):
    """Stored specification of a depth policy; its inner policy has an observer and a network.

    Attributes:
        schema_name: name and version of the format.
        law: inner policy on the dive angle.
        steepest: largest desired dive angle in rad.
        sight: initial values of `LOS_CONSTANTS` in the training.
    """

    schema_name: Literal["residnet.depth_policy/1"] = Field(
        default="residnet.depth_policy/1", alias="schema"
    )
    law: ObserverPolicySpec
    steepest: float = Field(gt=0)
    sight: dict[str, Positive]

    def build(self) -> DepthPolicy:
        """Build the policy with an untrained network."""
        law = self.law
        return DepthPolicy(
            law.state,
            nomoto=law.nomoto,
            law=law.build(),
            constants=self.sight,
            steepest=self.steepest,
            limit=law.limit,
            dt=law.dt,
            rate=law.rate,
        )


RecurrentSpec = ObserverPolicySpec | NetworkPolicySpec | DepthPolicySpec
RecurrentPolicy = ObserverPolicy | NetworkPolicy | DepthPolicy


def load_recurrent(folder: Path, spec_type: type[RecurrentSpec]) -> RecurrentPolicy:
    """Load a trained recurrent policy in float64, with fixed parameters.

    Raises:
        UsageError: if the folder holds no policy, or a file was changed after it was written.
    """
    policy = read_spec(folder, spec_type).build()
    read_weights(folder, policy)
    return policy.eval().requires_grad_(False).double()
