"""Classical heading controllers as configs: gains given, or left out to be tuned."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, Literal, NamedTuple, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.heading.bang_bang import BangBangHeading
from residnet.control.heading.bang_bang_rate import RatedBangBangHeading
from residnet.control.heading.document_autopilot import (
    DocumentAutopilot,
    Predictor,
    SimulatedPredictor,
)
from residnet.control.heading.heading_pid import HeadingPID
from residnet.control.heading.laws import regulator_gains
from residnet.control.heading.steering import NominalSteering, SteeredVessel
from residnet.control.heading.turning import Turning
from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap


class Steering(NamedTuple):
    """The task of a controller: vessel, K and T, largest rudder angle [rad] and step [s]."""

    vessel: SteeredVessel
    turning: Turning
    limit: float
    dt: float


class Axis(NamedTuple):
    """A range of a parameter that tuning searches, by its logarithm."""

    low: float
    high: float


@final
class LinearRows(Policy):
    """`HeadingPID` with gains of its own for every row: kp, kd, ki [B]."""

    def __init__(self, steering: Steering, gains: tuple[Tensor, Tensor, Tensor]) -> None:
        super().__init__()
        self.psi, self.r = steering.vessel.column("psi"), steering.vessel.column("r")
        self.limit, self.dt = steering.limit, steering.dt
        for name, gain in zip(("kp", "kd", "ki"), gains, strict=True):
            self.register_buffer(name, gain.unsqueeze(-1), persistent=False)
        self.kp: Tensor
        self.kd: Tensor
        self.ki: Tensor
        self.n_state = 1

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] and integral [B, 1]."""
        error = wrap(reference - x[:, self.psi : self.psi + 1])
        wish = self.kp * error - self.kd * x[:, self.r : self.r + 1] + self.ki * s
        winding = (wish.abs() > self.limit) & (wish * error > 0)
        return wish.clamp(-self.limit, self.limit), torch.where(winding, s, s + self.dt * error)


class ControllerConfig(Config, ABC):
    """The config of a heading controller."""

    @abstractmethod
    def build(self, steering: Steering) -> Policy:
        """Build the controller for a vessel.

        Raises:
            ConfigError: where a gain is missing that tuning should have filled in.
        """


class TunableConfig(ControllerConfig, ABC):
    """The config of a controller whose missing parameters are tuned.

    `own` names the numbers of what `rows` returns that every row has for itself.
    """

    own: ClassVar[tuple[str, ...]]

    @abstractmethod
    def parameters(self) -> dict[str, float | None]:
        """Return the parameters by name; None where they are to be tuned."""

    @abstractmethod
    def axes(self, turning: Turning) -> dict[str, Axis]:
        """Return the ranges that tuning searches, by parameter."""

    @abstractmethod
    def rows(self, parameters: dict[str, Tensor], steering: Steering) -> Policy:
        """Return a controller whose parameters [B] differ from row to row."""

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


class TunedConfig(TunableConfig, ABC):
    """A linear law kp e - kd r + ki I whose missing parameters are tuned."""

    own: ClassVar[tuple[str, ...]] = ("kp", "kd", "ki")

    @abstractmethod
    def gains(
        self, parameters: dict[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return kp, kd, ki of parameters, any shape."""

    def build(self, steering: Steering) -> Policy:
        """Return a PID controller with these gains."""
        parameters = {
            name: torch.tensor(value, dtype=torch.float64)
            for name, value in self.complete().items()
        }
        kp, kd, ki = (float(gain) for gain in self.gains(parameters, steering.turning))
        return HeadingPID(
            steering.vessel.state,
            kp=kp,
            kd=kd,
            ki=ki,
            limit=steering.limit,
            dt=steering.dt if ki > 0 else None,
        )

    def rows(self, parameters: dict[str, Tensor], steering: Steering) -> Policy:
        """Return the law with gains of its own for every row."""
        return LinearRows(steering, self.gains(parameters, steering.turning))


class PdConfig(TunedConfig):
    """Proportional and derivative action on the heading error.

    Attributes:
        kp: rad of rudder per rad of error.
        damping_time: kd/kp.
    """

    kind: Literal["pd"] = "pd"
    kp: float | None = Field(default=None, gt=0)
    damping_time: Seconds | None = Field(default=None, gt=0)

    def parameters(self) -> dict[str, float | None]:
        """Return kp and damping_time; None where they are to be tuned."""
        return {"kp": self.kp, "damping_time": self.damping_time}

    def axes(self, turning: Turning) -> dict[str, Axis]:
        """Return the ranges: two decades of kp, damping_time from a twentieth of T to twice T."""
        return {
            "kp": Axis(0.3, 60.0),
            "damping_time": Axis(0.05 * turning.time, 2.0 * turning.time),
        }

    def gains(
        self, parameters: dict[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return kp and kd of the parameters; ki is zero."""
        return (
            parameters["kp"],
            parameters["kp"] * parameters["damping_time"],
            torch.zeros_like(parameters["kp"]),
        )


class PidConfig(TunedConfig):
    """A PD law with integral action that stops while the rudder is saturated.

    Attributes:
        kp: rad of rudder per rad of error.
        damping_time: kd/kp.
        integral_time: kp/ki.
    """

    kind: Literal["pid"] = "pid"
    kp: float | None = Field(default=None, gt=0)
    damping_time: Seconds | None = Field(default=None, gt=0)
    integral_time: Seconds | None = Field(default=None, gt=0)

    def parameters(self) -> dict[str, float | None]:
        """Return kp, damping_time and integral_time; None where they are to be tuned."""
        return {
            "kp": self.kp,
            "damping_time": self.damping_time,
            "integral_time": self.integral_time,
        }

    def axes(self, turning: Turning) -> dict[str, Axis]:
        """Return the ranges of a PD law, and an integral_time from T to 50 T."""
        pd = PdConfig().axes(turning)
        return {**pd, "integral_time": Axis(turning.time, 50.0 * turning.time)}

    def gains(
        self, parameters: dict[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return kp, kd and ki of the parameters."""
        kp = parameters["kp"]
        return kp, kp * parameters["damping_time"], kp / parameters["integral_time"]


class LqrConfig(TunedConfig):
    """A linear-quadratic regulator of T r_dot + r = K delta.

    The integral of heading_weight e^2 + rate_weight (T r)^2 + delta^2 is least.

    The Riccati equation of this model has the solution kp = sqrt(heading_weight), (1 + K kd)^2 = 1
    + K^2 T^2 rate_weight + 2 K T kp.

    Attributes:
        heading_weight: weight of the squared heading error, dimensionless; None to tune it.
        rate_weight: weight of the squared yaw rate times T, dimensionless; None to tune it.
    """

    kind: Literal["lqr"] = "lqr"
    heading_weight: float | None = Field(default=None, gt=0)
    rate_weight: float | None = Field(default=None, ge=0)

    def parameters(self) -> dict[str, float | None]:
        """Return heading_weight and rate_weight; None where they are to be tuned."""
        return {"heading_weight": self.heading_weight, "rate_weight": self.rate_weight}

    def axes(self, turning: Turning) -> dict[str, Axis]:
        """Return both weights over decades."""
        return {"heading_weight": Axis(0.1, 3600.0), "rate_weight": Axis(1e-3, 3600.0)}

    def gains(
        self, parameters: dict[str, Tensor], turning: Turning
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return kp and kd of the weights."""
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
        """Build the time-optimal controller of the vessel."""
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


class DocumentConfig(ControllerConfig):
    """The predictive law of document 004 with an exact predictor of the nominal vessel.

    Attributes:
        horizon: of the prediction; the source's 0.01 s cannot settle (corrections of document 004).
        candidates: rudder angles.
        weight: of the choice for the heading error.
    """

    kind: Literal["document"] = "document"
    horizon: Seconds = Field(gt=0)
    candidates: int = Field(default=41, ge=3, le=10_001)
    weight: float = Field(default=0.2, ge=0, le=1)

    def predictor(self, steering: Steering) -> SimulatedPredictor:
        """Return the exact predictor: a simulation of the nominal vessel.

        Long horizons are predicted in steps of at most a twentieth of T.
        """
        steps = math.ceil(self.horizon / max(steering.turning.time / 20.0, steering.dt))
        model = NominalSteering(steering.vessel, self.horizon / steps)
        return SimulatedPredictor(model, steering.vessel.state, steps, model.others)

    def law(self, predictor: Predictor, steering: Steering) -> DocumentAutopilot:
        """Return the controller with some predictor of this horizon."""
        return DocumentAutopilot(
            predictor, limit=steering.limit, candidates=self.candidates, weight=self.weight
        )

    def build(self, steering: Steering) -> Policy:
        """Return the controller with the exact predictor."""
        return self.law(self.predictor(steering), steering)
