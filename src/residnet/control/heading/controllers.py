"""Heading controllers as configs: constants given, or left out to be tuned."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.heading.classical import (
    BangBangHeading,
    HeadingLaw,
    RatedBangBangHeading,
    RegulatorLaw,
    StoppingLaw,
    regulator_gains,
)
from residnet.control.heading.policies import (
    SIGHT,
    AnglePolicy,
    DepthPolicy,
    NetworkPolicy,
    ObservedPolicy,
)
from residnet.control.heading.turning import Turning
from residnet.control.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap
from residnet.dynamics.store import Stored, read_spec, read_weights


class Steering(NamedTuple):
    """The task of a controller: vessel, K and T, largest rudder angle [rad] and step [s]."""

    vessel: SteeredVessel
    turning: Turning
    limit: float
    dt: float


class SearchRange(NamedTuple):
    """A range of a parameter that tuning searches, by its logarithm.

    Attributes:
        low, high: its ends.
        idle: value at which the law does without the parameter, None for none. The law is searched
            without it too, so that none does worse than the simpler one within it.
        power: of T that all three are multiples of; those of a distance go with the speed too.
        way: whether it is a distance.
    """

    low: float
    high: float
    idle: float | None = None
    power: int = 0
    way: bool = False

    def of(self, turning: Turning) -> SearchRange:
        """Return the range of a vessel in SI units."""
        unit = turning.time**self.power * (turning.speed if self.way else 1.0)
        idle = None if self.idle is None else self.idle * unit
        return SearchRange(self.low * unit, self.high * unit, idle)


@final
class LinearLaw(AnglePolicy):
    """The law kp e - kd r + ki I on filtered measurements, with gains of its own for every row.

    Heading and yaw rate pass a low pass of first order each, as autopilots have one against noise
    and waves; the integral stops while the rudder is saturated by it.

    Memory [B, 3]: I [rad s], and the filtered heading [rad] and yaw rate [rad/s].

    Args:
        gains: kp, kd [s], ki [1/s] and the filter's time constant [s]; [B] or one number each.
    """

    NUMBERS: ClassVar[tuple[str, ...]] = ("kp", "kd", "ki", "lag")

    def __init__(self, steering: Steering, gains: Sequence[Tensor]) -> None:
        super().__init__()
        self.read_from(steering.vessel.state)
        self.at(steering.dt)
        self.limit = steering.limit
        for name, gain in zip(self.NUMBERS, gains, strict=True):
            self.register_buffer(name, gain.reshape(-1, 1), persistent=False)
        self.kp: Tensor
        self.kd: Tensor
        self.ki: Tensor
        self.lag: Tensor
        self.n_state = 3

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at the start: the filters stand at what is measured."""
        seen = x[:, [self.psi, self.r]]
        return torch.cat((torch.zeros_like(seen[:, :1]), seen), dim=1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        share = 1.0 - torch.exp(-self.dt / self.lag.clamp(min=1e-6))
        heading = s[:, 1:2] + share * wrap(x[:, self.psi : self.psi + 1] - s[:, 1:2])
        rate = s[:, 2:3] + share * (x[:, self.r : self.r + 1] - s[:, 2:3])
        error, integral = wrap(reference - heading), s[:, 0:1]
        wish = self.kp * error - self.kd * rate + self.ki * integral
        winding = (wish.abs() > self.limit) & (wish * error > 0)
        after = torch.where(winding, integral, integral + self.dt * error)
        return wish.clamp(-self.limit, self.limit), torch.cat((after, heading, rate), dim=1)


class ControllerConfig(Config, ABC):
    """The config of a heading controller."""

    @abstractmethod
    def build(self, steering: Steering) -> Policy:
        """Build the controller for a vessel.

        Raises:
            ConfigError: where a gain is missing that tuning should have filled in.
        """


class TunableConfig(ControllerConfig, ABC):
    """The config of a controller whose missing parameters are tuned, within `ranges`."""

    ranges: ClassVar[Mapping[str, SearchRange]]

    @property
    @abstractmethod
    def own(self) -> tuple[str, ...]:
        """The names of the numbers of what `rows` returns that every row has for itself."""

    def parameters(self) -> dict[str, float | None]:
        """Return the parameters by name; None where they are to be tuned."""
        return {name: getattr(self, name) for name in self.ranges}

    def axes(self, turning: Turning) -> dict[str, SearchRange]:
        """Return the ranges that tuning searches, by parameter."""
        return {name: one.of(turning) for name, one in self.ranges.items()}

    @abstractmethod
    def rows(self, parameters: Mapping[str, Tensor], steering: Steering) -> Policy:
        """Return a controller whose parameters [B] differ from row to row."""

    def tuned(self, found: Mapping[str, float]) -> Self:
        """Return the config with parameters given."""
        return type(self).model_validate(self.model_dump() | dict(found))

    def complete(self) -> dict[str, float]:
        """Return the parameters by name.

        Raises:
            ConfigError: where one is still to be tuned.
        """
        given = self.parameters()
        if missing := [name for name, value in given.items() if value is None]:
            raise ConfigError(
                f"controller without {', '.join(missing)}: tune it first or give them"
            )
        return {name: value for name, value in given.items() if value is not None}


# from nearly none to where it slows the loop
_FILTER = {"filter_time": SearchRange(0.002, 0.3, power=1)}


class TunedConfig(TunableConfig, ABC):
    """A linear law kp e - kd r + ki I whose missing parameters are tuned.

    Attributes:
        filter_time: time constant of the low pass of heading and yaw rate; null to tune it with the
            others, and none where these are all given.
    """

    filter_time: Seconds | None = Field(default=None, ge=0)

    @property
    def own(self) -> tuple[str, ...]:
        return LinearLaw.NUMBERS

    @abstractmethod
    def gains(
        self, parameters: Mapping[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return kp, kd, ki of parameters, any shape."""

    @final
    def parameters(self) -> dict[str, float | None]:
        given, lag = super().parameters(), self.filter_time
        open_ = None in [value for name, value in given.items() if name != "filter_time"]
        return {**given, "filter_time": 0.0 if lag is None and not open_ else lag}

    def build(self, steering: Steering) -> LinearLaw:
        """Return the law with these parameters."""
        found = {name: torch.tensor([value]).double() for name, value in self.complete().items()}
        return self.rows(found, steering)

    def rows(self, parameters: Mapping[str, Tensor], steering: Steering) -> LinearLaw:
        """Return the law with gains of its own for every row."""
        gains = self.gains(parameters, steering.turning)
        return LinearLaw(steering, [*gains, parameters["filter_time"]])


class PdConfig(TunedConfig):
    """Proportional and derivative action on the heading error.

    Attributes:
        kp: rad of rudder per rad of error.
        damping_time: kd/kp.
    """

    ranges: ClassVar[Mapping[str, SearchRange]] = {
        "kp": SearchRange(0.3, 60.0),
        "damping_time": SearchRange(0.05, 2.0, power=1),
        **_FILTER,
    }
    kind: Literal["pd"] = "pd"
    kp: float | None = Field(default=None, gt=0)
    damping_time: Seconds | None = Field(default=None, gt=0)

    def gains(
        self, parameters: Mapping[str, Tensor], turning: Turning
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
        "damping_time": SearchRange(0.05, 2.0, power=1),
        # a million T is no integral in single precision
        "integral_time": SearchRange(1.0, 50.0, idle=1e6, power=1),
        **_FILTER,
    }
    kind: Literal["pid"] = "pid"  # type: ignore[assignment]
    integral_time: Seconds | None = Field(default=None, gt=0)

    def gains(
        self, parameters: Mapping[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        kp, kd, _ = super().gains(parameters, turning)
        return kp, kd, kp / parameters["integral_time"]


class LqrConfig(TunedConfig):
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
        **_FILTER,
    }
    kind: Literal["lqr"] = "lqr"
    heading_weight: float | None = Field(default=None, gt=0)
    rate_weight: float | None = Field(default=None, ge=0)

    def gains(
        self, parameters: Mapping[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        gain, time = torch.tensor(turning.gain), torch.tensor(turning.time)
        kp, kd = regulator_gains(
            parameters["heading_weight"], parameters["rate_weight"], gain, time
        )
        return kp, kd, torch.zeros_like(kp)


class BangBangConfig(ControllerConfig):
    """Time-optimal control of T r_dot + r = K delta, which knows vessel and rudder rate exactly.

    No controller of the nominal vessel can be faster.
    """

    kind: Literal["bang_bang"] = "bang_bang"

    def build(self, steering: Steering) -> Policy:
        vessel, turning = steering.vessel, steering.turning
        if vessel.rate is not None:
            return RatedBangBangHeading(
                vessel.state,
                gain=turning.gain,
                time=turning.time,
                limit=steering.limit,
                rate=vessel.rate,
                dt=steering.dt,
            )
        return BangBangHeading(
            steering.vessel.state,
            gain=steering.turning.gain,
            time=steering.turning.time,
            limit=steering.limit,
        )


Positive = Annotated[float, Field(gt=0)]


_OBSERVER = {
    "heading_rate": SearchRange(1.0, 120.0, power=-1),
    "yaw_rate_rate": SearchRange(1.0, 120.0, power=-1),
    "push_rate": SearchRange(0.08, 30.0, power=-1),
    "cross_rate": SearchRange(0.15, 150.0, power=-2),
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
    def own(self) -> tuple[str, ...]:
        return ("constants",)

    @abstractmethod
    def law(self, limit: float, rate: float | None) -> HeadingLaw:
        """Return the law for a rudder with a limit in rad and a rate in rad/s, None for none."""

    def build(self, steering: Steering) -> ObservedPolicy:
        return self.rows(self.complete(), steering)

    def rows(self, parameters: Mapping[str, float | Tensor], steering: Steering) -> ObservedPolicy:
        """Return the law without a network; each constant is one number or [B]."""
        vessel = steering.vessel
        return ObservedPolicy(
            vessel.state,
            turning=steering.turning,
            law=self.law(steering.limit, vessel.rate),
            constants=parameters,
            limit=steering.limit,
            dt=steering.dt,
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
        **_OBSERVER,
    }
    kind: Literal["lqr_observer"] = "lqr_observer"
    heading_weight: Positive | None = None
    rate_weight: Positive | None = None

    def law(self, limit: float, rate: float | None) -> HeadingLaw:
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
        **_OBSERVER,
    }
    kind: Literal["ptos"] = "ptos"
    steepness: Positive | None = None
    share: Positive | None = None
    damping: Positive | None = None

    def law(self, limit: float, rate: float | None) -> HeadingLaw:
        return StoppingLaw(0.0 if rate is None else limit / rate)


AnyObserved = Annotated[ObservedLqrConfig | PtosConfig, Field(discriminator="kind")]

AnyPitch = Annotated[
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
        "lookahead": SearchRange(0.3, 20.0, power=1, way=True),
        "depth_rate": SearchRange(0.05, 20.0, power=-1),
        "drift_rate": SearchRange(0.01, 1.0, power=-1),
    }
    kind: Literal["depth"] = "depth"
    pitch: AnyPitch
    steepest: Radians = Field(default=0.5235987755982988, gt=0, lt=1.3)
    lookahead: Annotated[Metres, Field(gt=0)] | None = None
    depth_rate: Positive | None = None
    drift_rate: Positive | None = None

    @property
    def own(self) -> tuple[str, ...]:
        return ("constants", *(f"law.{name}" for name in self.pitch.own))

    def parameters(self) -> dict[str, float | None]:
        """Return the constants of the line of sight, then those of the law."""
        return super().parameters() | self.pitch.parameters()

    def axes(self, turning: Turning) -> dict[str, SearchRange]:
        return super().axes(turning) | self.pitch.axes(turning)

    def tuned(self, found: Mapping[str, float]) -> Self:
        """Return the config with parameters given, those of the law in it."""
        own = {name: found[name] for name in SIGHT if name in found}
        law = {name: value for name, value in found.items() if name not in own}
        return self.model_copy(update={**own, "pitch": self.pitch.tuned(law)})

    def rows(self, parameters: Mapping[str, Tensor], steering: Steering) -> DepthPolicy:
        """Return the policy with constants of its own for every row."""
        return self.over(self.pitch.rows(parameters, steering), parameters, steering)

    def build(self, steering: Steering) -> DepthPolicy:
        return self.over(self.pitch.build(steering), self.complete(), steering)

    def over(
        self, law: AnglePolicy, constants: Mapping[str, float | Tensor], steering: Steering
    ) -> DepthPolicy:
        """Return the policy over a law; each constant is one number or [B]."""
        return DepthPolicy(
            steering.vessel.state,
            turning=steering.turning,
            law=law,
            constants=constants,
            steepest=self.steepest,
            limit=steering.limit,
            dt=steering.dt,
            rate=steering.vessel.rate,
        )


def observed_of(peer: object) -> object:
    """Return the law that a peer steers by: that on the dive angle of a depth controller."""
    return peer.pitch if isinstance(peer, DepthConfig) else peer


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
    def turning(self) -> Turning:
        """K, T, speed and c of that vessel."""
        return Turning(self.gain, self.time, self.speed, self.righting)


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
    law: AnyObserved
    units: int = Field(ge=0, le=10_000)

    def build(self) -> ObservedPolicy:
        """Return the policy with its network not yet trained."""
        return ObservedPolicy(
            self.state,
            turning=self.turning,
            law=self.law.law(self.limit, self.rate),
            constants=self.law.complete(),
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
            turning=self.turning,
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
            turning=law.turning,
            law=law.build(),
            constants=self.sight,
            steepest=self.steepest,
            limit=law.limit,
            dt=law.dt,
            rate=law.rate,
        )


RecurrentSpec = ObservedPolicySpec | NetworkPolicySpec | DepthPolicySpec
RecurrentPolicy = ObservedPolicy | NetworkPolicy | DepthPolicy


def load_recurrent(folder: Path, kind: type[RecurrentSpec]) -> RecurrentPolicy:
    """Read a trained recurrent policy, frozen and in float64.

    Raises:
        UsageError: where the folder holds none, or one that is not as it was written.
    """
    policy = read_spec(folder, kind).build()
    read_weights(folder, policy)
    return policy.eval().requires_grad_(False).double()
