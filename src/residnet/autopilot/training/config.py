"""How a policy is trained under stated conditions. No Lightning here: `check` must stay quick."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from residnet.autopilot.heading.conditions import SteadinessLimits
from residnet.core.config import Seconds
from residnet.training.config import OneStage


class PolicyTraining(OneStage):
    """Settings of a training through the whole closed loop, under the conditions of the run.

    The loss of a batch is the mean cost of its flights, with a share of the integral of the
    absolute error that fades out, and with the late rudder swing and the nominal overshoot of
    flights without noise. Every batch is drawn anew, under the conditions in full. A policy without
    a law inside may begin with the nominal vessel in calm water instead (`nominal`, `spread`).

    Attributes:
        epochs: at most; each ends with a validation.
        learning_rate: of Adam at the start; it falls along a cosine with every batch. An epoch that
            costs 15 % more than the start once the conditions are full is undone: the next one
            begins with the best policy, half of the rate and a fifth of `calm` and `exact`.
        final: share of it at the end.
        steps: batches of an epoch.
        batch: flights of a batch.
        dt: step in s of vessel and controller in training, but for its end.
        fine: share of the training, at its end, that takes the step of the conditions: a loop that
            hardly swings at long steps may swing at short ones.
        integrator: of the vessel in training.
        hold: longest time in s before the change of heading in training.
        duration: time in s from the change to the end of a training flight; null for that of the
            conditions. It should be longer where large changes do not end within that: a policy
            creeps through what lies behind the end of its training.
        nominal: share of the training, at its beginning, that flies the nominal vessel in calm
            water. A policy that starts from a tuned law would leave what the law does well.
        spread: share of the training after which the conditions are drawn in full, at least
            `nominal`.
        guide: weight of the integral of the absolute error in deg s at the start.
        faded: share of the training after which that weight is zero.
        outlying: how much of the loss reaches the gradient of one flight, as a multiple of what the
            median flight of a batch has: a loop at the edge of swinging has flights whose gradients
            are millions of times as large as those of others. Only compiled flights are held so.
        quiet: share of the flights of a batch without noise and slow push, in which a loop that
            swings by itself is seen; half of them are at corners of the spread, a quarter flies the
            nominal vessel without delay.
        calm: cost in s of a variance of one degree squared of the rudder command in the last third
            of those flights, mean over the quarter of them that swings most; a movement of half of
            what `steady` allows is free.
        exact: cost in s of one degree of overshoot of the flights of the nominal vessel.
        excess: cost in s of one degree of overshoot beyond `steady.overshoot_p95`, in all flights,
            besides what the conditions count for it.
        stricter: factor on `calm` and `exact` after every epoch that `steady` refuses though it
            costs less than the start.
        steady: what a policy must keep to without noise. Epochs that do come first; of those that
            do not, a flight beyond counts twice. Null to choose by the cost alone.
        validation: number of flights that epochs are chosen on.
        compiled: whether flights and their gradient are compiled as C, which takes a C compiler;
            without one the training says so and is some thirty times slower.
    """

    epochs: int = Field(default=18, ge=1, le=100_000)
    learning_rate: float = Field(default=4e-3, gt=0)
    final: float = Field(default=0.0, ge=0, le=1)
    steps: int = Field(default=100, ge=1, le=100_000)
    batch: int = Field(default=384, ge=2, le=1_000_000)
    dt: Seconds = Field(default=0.04, gt=0)
    fine: float = Field(default=0.3, ge=0, le=1)
    integrator: Annotated[str, Field(pattern="^(rk4|heun)$")] = "heun"
    hold: Seconds = Field(default=2.0, ge=0)
    duration: Seconds | None = Field(default=None, gt=0)
    nominal: float = Field(default=0.0, ge=0, le=1)
    spread: float = Field(default=0.0, ge=0, le=1)
    guide: float = Field(default=0.01, ge=0)
    faded: float = Field(default=0.6, gt=0, le=1)
    outlying: float = Field(default=4.0, ge=1)
    quiet: float = Field(default=0.1, ge=0, le=1)
    calm: float = Field(default=0.5, ge=0)
    exact: float = Field(default=1.0, ge=0)
    excess: float = Field(default=1.0, ge=0)
    stricter: float = Field(default=1.2, ge=1, le=10)
    steady: SteadinessLimits | None = SteadinessLimits()
    validation: int = Field(default=512, ge=2, le=1_000_000)
    compiled: bool = True

    @model_validator(mode="after")
    def _ramp(self) -> PolicyTraining:
        if self.nominal > self.spread:
            raise ValueError(
                f"nominal ({self.nominal:g}) must not be larger than spread ({self.spread:g}):"
                " the conditions grow from the end of the one to the end of the other"
            )
        return self

    def share(self, progress: float) -> float:
        """Return the share of the conditions that is drawn, at a progress of 0 to 1."""
        if progress >= self.spread:
            return 1.0
        return max(progress - self.nominal, 0.0) / max(self.spread - self.nominal, 1e-9)

    def guiding(self, progress: float) -> float:
        """Return the weight of the absolute error at a progress of 0 to 1."""
        return self.guide * max(1.0 - progress / self.faded, 0.0)
