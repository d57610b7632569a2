"""Classical laws with a disturbance observer and a predictor, as configs, and all controllers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.heading.controllers import (
    Axis,
    BangBangConfig,
    DocumentConfig,
    LqrConfig,
    PdConfig,
    PidConfig,
    Steering,
    TunableConfig,
)
from residnet.control.heading.laws import HeadingLaw, RegulatorLaw, StoppingLaw
from residnet.control.heading.turning import Turning
from residnet.control.observed.observer import CONSTANTS
from residnet.control.observed.policy import ObservedPolicy
from residnet.core.config import Seconds

Positive = Annotated[float, Field(gt=0)]


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

    own: ClassVar[tuple[str, ...]] = ("constants",)

    @abstractmethod
    def law(self, limit: float, rate: float | None) -> HeadingLaw:
        """Return the law for a rudder with a limit in rad and a rate in rad/s, None for none."""

    @abstractmethod
    def law_axes(self) -> dict[str, Axis]:
        """Return the ranges of the law's own constants."""

    def parameters(self) -> dict[str, float | None]:
        """Return the constants of law and observer; None where they are to be tuned."""
        return {name: getattr(self, name) for name in (*self.law_axes(), *CONSTANTS)}

    def axes(self, turning: Turning) -> dict[str, Axis]:
        """Return the ranges of all constants; those of the observer go with 1/T."""
        once = 1.0 / turning.time
        return {
            **self.law_axes(),
            "heading_rate": Axis(once, 120.0 * once),
            "yaw_rate_rate": Axis(once, 120.0 * once),
            "push_rate": Axis(0.08 * once, 30.0 * once),
            "cross_rate": Axis(0.15 * once**2, 150.0 * once**2),
        }

    def rows(self, parameters: dict[str, Tensor], steering: Steering) -> Policy:
        """Return the law with constants of its own for every row."""
        return self.policy(parameters, steering)

    def build(self, steering: Steering) -> Policy:
        """Return the law with its constants."""
        return self.policy(self.complete(), steering)

    def policy(self, constants: Mapping[str, float | Tensor], steering: Steering) -> ObservedPolicy:
        """Return the policy without a network; each constant is one number or [B]."""
        vessel = steering.vessel
        return ObservedPolicy(
            vessel.state,
            turning=steering.turning,
            law=self.law(steering.limit, vessel.rate),
            constants=constants,
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

    kind: Literal["lqr_observer"] = "lqr_observer"
    heading_weight: Positive | None = None
    rate_weight: Positive | None = None

    def law(self, limit: float, rate: float | None) -> HeadingLaw:
        """Return the linear regulator with this rudder limit in rad."""
        return RegulatorLaw(limit)

    def law_axes(self) -> dict[str, Axis]:
        """Return both weights over decades."""
        return {"heading_weight": Axis(0.01, 3600.0), "rate_weight": Axis(1e-3, 3600.0)}


class PtosConfig(ObservedConfig):
    """The proximate time-optimal law with a disturbance observer.

    Attributes:
        steepness: errors per rad that full rudder answers.
        share: of the rudder's braking that is counted on.
        damping: relative damping near the reference.
    """

    kind: Literal["ptos"] = "ptos"
    steepness: Positive | None = None
    share: Positive | None = None
    damping: Positive | None = None

    def law(self, limit: float, rate: float | None) -> HeadingLaw:
        """Return the time-optimal law."""
        return StoppingLaw(0.0 if rate is None else limit / rate)

    def law_axes(self) -> dict[str, Axis]:
        """Return the ranges of steepness, share and damping."""
        return {
            "steepness": Axis(3.0, 600.0),
            "share": Axis(0.2, 1.2),
            "damping": Axis(0.3, 3.0),
        }


AnyObserved = Annotated[ObservedLqrConfig | PtosConfig, Field(discriminator="kind")]

AnyController = Annotated[
    PdConfig
    | PidConfig
    | LqrConfig
    | ObservedLqrConfig
    | PtosConfig
    | BangBangConfig
    | DocumentConfig,
    Field(discriminator="kind"),
]
