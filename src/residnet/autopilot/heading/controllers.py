"""Heading controllers as configs: constants given, or left out to be tuned."""

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
    SIGHT_CONSTANTS,
    AnglePolicy,
    DepthPolicy,
    NetworkPolicy,
    ObservedPolicy,
)
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap_angle
from residnet.dynamics.store import Stored, read_spec, read_weights


class ControlTask(NamedTuple):
    """The task of a controller: vessel, K and T, largest rudder angle [rad] and step [s]."""

    vessel: SteeredVessel
    nomoto: NomotoModel
    limit: float
    dt: float


class SearchRange(NamedTuple):
    """A range of a parameter that tuning searches, by its logarithm.

    Attributes:
        low, high: its ends.
        disabled_value: value at which the law does without the parameter, None for none. The law is searched
            without it too, so that none does worse than the simpler one within it.
        time_power: of T that all three are multiples of; those of a distance go with the speed too.
        is_distance: whether it is a distance.
    """

    lower: float
    upper: float
    disabled_value: float | None = None
    time_power: int = 0
    is_distance: bool = False

    def to_si(self, nomoto: NomotoModel) -> SearchRange:
        """Return the range of a vessel in SI units."""
        scale = nomoto.time**self.time_power * (nomoto.speed if self.is_distance else 1.0)
        disabled_value = None if self.disabled_value is None else self.disabled_value * scale
        return SearchRange(self.lower * scale, self.upper * scale, disabled_value)


@final
class LinearLaw(AnglePolicy):
    """The law kp e - kd r + ki I on filtered measurements, with gains of its own for every row.

    Heading and yaw rate pass a low pass of first order each, as autopilots have one against noise
    and waves; the integral stops while the rudder is saturated by it.

    Memory [B, 3]: I [rad s], and the filtered heading [rad] and yaw rate [rad/s].

    Args:
        gains: kp, kd [s], ki [1/s] and the filter's time constant [s]; [B] or one number each.
    """

    PARAMETERS: ClassVar[tuple[str, ...]] = ("kp", "kd", "ki", "lag")

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
        self.lag: Tensor
        self.n_state = 3

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at the start: the filters stand at what is measured."""
        measured = x[:, [self.psi, self.r]]
        return torch.cat((torch.zeros_like(measured[:, :1]), measured), dim=1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        filter_factor = 1.0 - torch.exp(-self.dt / self.lag.clamp(min=1e-6))
        heading = s[:, 1:2] + filter_factor * wrap_angle(x[:, self.psi : self.psi + 1] - s[:, 1:2])
        rate = s[:, 2:3] + filter_factor * (x[:, self.r : self.r + 1] - s[:, 2:3])
        error = wrap_angle(reference - heading)
        integral = s[:, 0:1]
        unlimited_command = self.kp * error - self.kd * rate + self.ki * integral
        is_winding_up = (unlimited_command.abs() > self.limit) & (unlimited_command * error > 0)
        next_integral = torch.where(is_winding_up, integral, integral + self.dt * error)
        return unlimited_command.clamp(-self.limit, self.limit), torch.cat(
            (next_integral, heading, rate), dim=1
        )


class ControllerConfig(Config, ABC):
    """The config of a heading controller."""

    @abstractmethod
    def build(self, task: ControlTask) -> Policy:
        """Build the controller for a vessel.

        Raises:
            ConfigError: where a gain is missing that tuning should have filled in.
        """


class TunableConfig(ControllerConfig, ABC):
    """The config of a controller whose missing parameters are tuned, within `ranges`."""

    ranges: ClassVar[Mapping[str, SearchRange]]

    @property
    @abstractmethod
    def batched_parameters(self) -> tuple[str, ...]:
        """The names of the numbers of what `build_batched` returns that every row has for itself."""

    def parameter_values(self) -> dict[str, float | None]:
        """Return the parameters by name; None where they are to be tuned."""
        return {name: getattr(self, name) for name in self.ranges}

    def search_ranges(self, nomoto: NomotoModel) -> dict[str, SearchRange]:
        """Return the ranges that tuning searches, by parameter."""
        return {name: search_range.to_si(nomoto) for name, search_range in self.ranges.items()}

    @abstractmethod
    def build_batched(self, parameters: Mapping[str, Tensor], task: ControlTask) -> Policy:
        """Return a controller whose parameters [B] differ from row to row."""

    def with_parameters(self, parameters: Mapping[str, float]) -> Self:
        """Return the config with parameters given."""
        return type(self).model_validate(self.model_dump() | dict(parameters))

    def complete_parameters(self) -> dict[str, float]:
        """Return the parameters by name.

        Raises:
            ConfigError: where one is still to be tuned.
        """
        parameters = self.parameter_values()
        if missing := [name for name, value in parameters.items() if value is None]:
            raise ConfigError(
                f"controller without {', '.join(missing)}: tune it first or give them"
            )
        return {name: value for name, value in parameters.items() if value is not None}


# from nearly none to where it slows the loop
_FILTER_RANGES = {"filter_time": SearchRange(0.002, 0.3, time_power=1)}


class LinearLawConfig(TunableConfig, ABC):
    """A linear law kp e - kd r + ki I whose missing parameters are tuned.

    Attributes:
        filter_time: time constant of the low pass of heading and yaw rate; null to tune it with the
            others, and none where these are all given.
    """

    filter_time: Seconds | None = Field(default=None, ge=0)

    @property
    def batched_parameters(self) -> tuple[str, ...]:
        return LinearLaw.PARAMETERS

    @abstractmethod
    def gains(
        self, parameters: Mapping[str, Tensor], nomoto: NomotoModel
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return kp, kd, ki of parameters, any shape."""

    @final
    def parameter_values(self) -> dict[str, float | None]:
        parameters = super().parameter_values()
        lag = self.filter_time
        has_open_gain = None in [
            value for name, value in parameters.items() if name != "filter_time"
        ]
        return {**parameters, "filter_time": 0.0 if lag is None and not has_open_gain else lag}

    def build(self, task: ControlTask) -> LinearLaw:
        """Return the law with these parameters."""
        parameters = {
            name: torch.tensor([value]).double()
            for name, value in self.complete_parameters().items()
        }
        return self.build_batched(parameters, task)

    def build_batched(self, parameters: Mapping[str, Tensor], task: ControlTask) -> LinearLaw:
        """Return the law with gains of its own for every row."""
        gains = self.gains(parameters, task.nomoto)
        return LinearLaw(task, [*gains, parameters["filter_time"]])


class PdConfig(LinearLawConfig):
    """Proportional and derivative action on the heading error.

    Attributes:
        kp: rad of rudder per rad of error.
        damping_time: kd/kp.
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
    """A PD law with integral action that stops while the rudder is saturated.

    Attributes:
        integral_time: kp/ki.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "kp": SearchRange(0.3, 60.0),
        "damping_time": SearchRange(0.05, 2.0, time_power=1),
        # a million T is no integral in single precision
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

    The integral of heading_weight e^2 + rate_weight (T r)^2 + delta^2 is least.

    The Riccati equation of this model has the solution kp = sqrt(heading_weight), (1 + K kd)^2 = 1
    + K^2 T^2 rate_weight + 2 K T kp.

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
    """Time-optimal control of T r_dot + r = K delta, which knows vessel and rudder rate exactly.

    No controller of the nominal vessel can be faster.
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


class ObservedConfig(TunableConfig, ABC):
    """A law on the estimates of a disturbance observer, with a predictor of pending commands.

    Attributes:
        lag: time in s between a command and its rudder that the predictor bridges; 0 for no
            predictor.
        heading_rate: how fast the estimated heading follows the measured one, in 1/s; null to tune
            it, as with all that follow.
        yaw_rate_rate: how fast the estimated yaw rate follows the measured one, in 1/s.
        push_rate: how fast the estimated push follows the yaw rate's surprises, in 1/s.
        cross_rate: how fast the estimated yaw rate follows the heading's surprises, in 1/s^2.
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
        """Return the law for a rudder with a limit in rad and a rate in rad/s, None for none."""

    def build(self, task: ControlTask) -> ObservedPolicy:
        return self.build_batched(self.complete_parameters(), task)

    def build_batched(
        self, parameters: Mapping[str, float | Tensor], task: ControlTask
    ) -> ObservedPolicy:
        """Return the law without a network; each constant is one number or [B]."""
        vessel = task.vessel
        return ObservedPolicy(
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
        """Return the linear regulator with this rudder limit in rad."""
        return RegulatorLaw(limit)


class PtosConfig(ObservedConfig):
    """The proximate time-optimal law with a disturbance observer.

    Attributes:
        steepness: errors per rad that full rudder answers.
        share: of the rudder's braking that is counted on.
        damping: relative damping near the reference.
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
        return ProximateTimeOptimalLaw(0.0 if rate is None else limit / rate)


AnyObservedLaw = Annotated[ObservedLqrConfig | PtosConfig, Field(discriminator="kind")]

AnyPitchLaw = Annotated[
    PdConfig | PidConfig | LqrConfig | ObservedLqrConfig | PtosConfig, Field(discriminator="kind")
]


class DepthConfig(TunableConfig):
    """A line of sight down to a depth, and a law on the dive angle; all constants are tuned as one.

    Attributes:
        pitch: the law on the dive angle, any that steers a heading.
        steepest: largest dive angle wanted in rad.
        lookahead: distance in m from which the line of sight points down; null to tune it, as with
            the next two.
        depth_rate: how fast the estimated depth follows the measured one, in 1/s.
        drift_rate: how fast the drift of the depth is learned, in 1/s.
    """

    # a vessel goes speed times T while its dive angle changes
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
        return ("constants", *(f"law.{name}" for name in self.pitch.batched_parameters))

    def parameter_values(self) -> dict[str, float | None]:
        """Return the constants of the line of sight, then those of the law."""
        return super().parameter_values() | self.pitch.parameter_values()

    def search_ranges(self, nomoto: NomotoModel) -> dict[str, SearchRange]:
        return super().search_ranges(nomoto) | self.pitch.search_ranges(nomoto)

    def with_parameters(self, parameters: Mapping[str, float]) -> Self:
        """Return the config with parameters given, those of the law in it."""
        sight_parameters = {
            name: parameters[name] for name in SIGHT_CONSTANTS if name in parameters
        }
        law_parameters = {
            name: value for name, value in parameters.items() if name not in sight_parameters
        }
        return self.model_copy(
            update={**sight_parameters, "pitch": self.pitch.with_parameters(law_parameters)}
        )

    def build_batched(self, parameters: Mapping[str, Tensor], task: ControlTask) -> DepthPolicy:
        """Return the policy with constants of its own for every row."""
        return self.build_policy(self.pitch.build_batched(parameters, task), parameters, task)

    def build(self, task: ControlTask) -> DepthPolicy:
        return self.build_policy(self.pitch.build(task), self.complete_parameters(), task)

    def build_policy(
        self, law: AnglePolicy, constants: Mapping[str, float | Tensor], task: ControlTask
    ) -> DepthPolicy:
        """Return the policy over a law; each constant is one number or [B]."""
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
    """Return the law that a peer steers by: that on the dive angle of a depth controller."""
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
    """What descriptions of learned heading policies share.

    Attributes:
        state: names of the state of the vessel that it was trained on.
        gain: K of that vessel about straight ahead in 1/s.
        time: T of that vessel in s.
        speed: at which K and T hold, in m/s.
        righting: c of its dive angle; zero of a heading.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        dt: step in s that it runs with.
        trained_at: step of its training in s.
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
        """K, T, speed and c of that vessel."""
        return NomotoModel(self.gain, self.time, self.speed, self.righting)


class ObservedPolicySpec(_PolicySpec):
    """A description of a heading policy with observer, predictor and recurrent network.

    Attributes:
        schema_name: kind and version of the format.
        law: with the constants that its training began with.
        units: of the network; 0 for none.
    """

    schema_name: Literal["residnet.observed_policy/1"] = Field(
        default="residnet.observed_policy/1", alias="schema"
    )
    law: AnyObservedLaw
    units: int = Field(ge=0, le=10_000)

    def build(self) -> ObservedPolicy:
        """Return the policy with its network not yet trained."""
        return ObservedPolicy(
            self.state,
            nomoto=self.nomoto,
            law=self.law.build_law(self.limit, self.rate),
            constants=self.law.complete_parameters(),
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            lag=self.law.lag,
            units=self.units,
            trained_at=self.trained_at,
        )


class NetworkPolicySpec(_PolicySpec):
    """A description of a heading policy that is a recurrent network alone.

    Attributes:
        schema_name: kind and version of the format.
        units: of the network.
    """

    schema_name: Literal["residnet.network_policy/1"] = Field(
        default="residnet.network_policy/1", alias="schema"
    )
    units: int = Field(ge=1, le=10_000)

    def build(self) -> NetworkPolicy:
        """Return the policy with its network not yet trained."""
        return NetworkPolicy(
            self.state,
            nomoto=self.nomoto,
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            units=self.units,
            trained_at=self.trained_at,
        )


class DepthPolicySpec(Stored):
    """A description of a depth policy over an observed law with a recurrent network.

    Attributes:
        schema_name: kind and version of the format.
        law: on the dive angle.
        steepest: largest dive angle wanted in rad.
        sight: the constants `SIGHT` that training began with.
    """

    schema_name: Literal["residnet.depth_policy/1"] = Field(
        default="residnet.depth_policy/1", alias="schema"
    )
    law: ObservedPolicySpec
    steepest: float = Field(gt=0)
    sight: dict[str, Positive]

    def build(self) -> DepthPolicy:
        """Return the policy with its network not yet trained."""
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


RecurrentSpec = ObservedPolicySpec | NetworkPolicySpec | DepthPolicySpec
RecurrentPolicy = ObservedPolicy | NetworkPolicy | DepthPolicy


def load_recurrent(folder: Path, spec_type: type[RecurrentSpec]) -> RecurrentPolicy:
    """Read a trained recurrent policy, frozen and in float64.

    Raises:
        UsageError: where the folder holds none, or one that is not as it was written.
    """
    policy = read_spec(folder, spec_type).build()
    read_weights(folder, policy)
    return policy.eval().requires_grad_(False).double()
